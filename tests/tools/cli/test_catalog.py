"""What `guiderail list` says of what somebody else registered."""

from pydantic import Field

from guiderail.diagrams.envs.options import Options
from guiderail.diagrams.guidance.registry import GUIDANCE, register_guidance
from guiderail.tools.cli.catalog import options_in_words


class Clock(Options):
    reach: float = Field(0.05, ge=0, le=1, description="how far a full action leads [m]")
    history: int = Field(3, description="past outputs that are remembered")


def test_the_options_of_a_foreign_guidance_are_named(monkeypatch):
    before = options_in_words("NarrowPassage")
    assert "reach" not in before
    monkeypatch.setitem(GUIDANCE._entries, "pace_of_mine", None)  # no other test has this one
    register_guidance("pace_of_mine", options=Clock)(lambda known: None)
    told = options_in_words("NarrowPassage")
    own = "of guidance=pace_of_mine: how far a full action leads [m]: from 0 to 1; 0.05 unless given"
    assert told["reach"] == own
    assert told["history"].startswith(f"{before['history']}; of guidance=pace_of_mine: past outputs")
