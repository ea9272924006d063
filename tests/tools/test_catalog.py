from pydantic import Field

from guiderail.diagrams.envs.options import Options
from guiderail.diagrams.guidance.registry import GUIDANCE, register_guidance
from guiderail.tools.catalog import describe_task_options


class Clock(Options):
    reach: float = Field(0.05, ge=0, le=1, description="motion of a full action [m]")
    history: int = Field(3, description="number of past outputs")


def test_options_of_a_registered_guidance_are_described(monkeypatch):
    before = describe_task_options("NarrowPassage")
    assert "reach" not in before
    monkeypatch.setitem(GUIDANCE._entries, "pace_of_mine", None)  # undone after the test
    register_guidance("pace_of_mine", options=Clock)(lambda known: None)
    after = describe_task_options("NarrowPassage")
    assert after["reach"] == "with guidance=pace_of_mine: motion of a full action [m]: from 0 to 1; default 0.05"
    assert "default None" not in "".join(text for text in before.values() if "default: " in text)
    assert after["history"].startswith(f"{before['history']}; with guidance=pace_of_mine: number of past outputs")
