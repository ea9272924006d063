from pydantic import Field

from guiderail.diagrams.envs.options import Options
from guiderail.diagrams.guidance.registry import GUIDANCE, register_guidance
from guiderail.tools.catalog import describe_task_options


class LabOptions(Options):
    reach: float = Field(0.05, ge=0, le=1, description="motion of a full action [m]")
    history: int = Field(3, description="number of past outputs")


def test_options_of_a_registered_guidance_are_described(monkeypatch):
    packaged = describe_task_options("NarrowPassage")
    assert "reach" not in packaged
    monkeypatch.setitem(GUIDANCE._entries, "lab_guidance", None)  # removed after the test
    register_guidance("lab_guidance", options=LabOptions)(lambda known: None)
    extended = describe_task_options("NarrowPassage")
    assert extended["reach"] == "with guidance=lab_guidance: motion of a full action [m]: from 0 to 1; default 0.05"
    assert "default None" not in "".join(text for text in packaged.values() if "default: " in text)
    assert extended["history"].startswith(f"{packaged['history']}; with guidance=lab_guidance: number of past outputs")
