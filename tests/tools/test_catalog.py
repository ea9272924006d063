from pydantic import Field

from guiderail.diagrams.envs.options import Options, option_fields
from guiderail.diagrams.guidance.registry import GUIDANCE, register_guidance
from guiderail.tools.catalog import BASIC, describe_task_groups, describe_task_options
from guiderail.tools.learning.learner_config import OffPolicyConfig


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


def test_basic_options_are_listed_first_and_entries_follow_their_option():
    groups = describe_task_groups("BncConnector")
    assert [*groups] == ["basic", "task", "motion", "station", "disturbances", "difficulties", "reset"]
    assert tuple(groups["basic"]) == BASIC
    assert len(BASIC) <= 12
    motion = [*groups["motion"]]
    assert motion[motion.index("history") + 1 :][:3] == ["  .variance", "  .source", "  .adaptive"]
    assert groups["motion"]["  .variance"].endswith("default 1e-11")
    assert "  .tare" in groups["disturbances"]


def test_numbers_of_options_and_settings_stay_small():
    """A further option or setting replaces another one, or is an entry of a structured one."""
    options = {name for name in describe_task_options("BncConnector") if ":" not in name and "=" not in name}
    assert len({name.partition(".")[0] for name in options}) <= 50
    assert len({name.partition(".")[0] for name in option_fields(OffPolicyConfig)}) <= 22
