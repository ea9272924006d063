import pytest

from guiderail.diagrams.guidance.registry import GUIDANCE
from guiderail.models.common.errors import InputError
from guiderail.tools.environments import changed_environment, check_environment
from guiderail.tools.imports import import_modules


@pytest.mark.parametrize(("learned_on", "eval_set"), [("gantry", "mujoco"), ("gantry", "arm"), ("arm", "gantry")])
def test_run_of_one_station_is_evaluated_on_another(learned_on, eval_set):
    learned = check_environment("BncConnector", {"station": learned_on, "action_repeat": 3})
    there = check_environment("BncConnector", changed_environment("BncConnector", learned, {"station": eval_set}))
    assert (there["station"], there["action_repeat"]) == (eval_set, 3)
    assert there == check_environment("BncConnector", {"station": eval_set, "action_repeat": 3})


def test_option_that_the_other_station_lacks_is_refused():
    learned = check_environment("BncConnector", {"impedance_control": "cartesian"})
    assert changed_environment("BncConnector", learned, {}) == learned
    assert changed_environment("BncConnector", learned, {"station": "gantry"})["impedance_control"] == "cartesian"
    asked = changed_environment("BncConnector", learned, {"station": "arm", "impedance_control": "joint"})
    with pytest.raises(InputError, match="it is an option of station='gantry'"):
        check_environment("BncConnector", asked)


def test_an_environment_of_no_station_takes_others():
    assert changed_environment("Bead", {"wall": 1.0}, {"wall": 2.0}) == {"wall": 2.0}
    assert changed_environment("Bead", {"wall": 1.0}, {"station": "gantry"}) == {"wall": 1.0, "station": "gantry"}


def test_imported_file_runs_once_for_each_content(tmp_path, monkeypatch):
    monkeypatch.setitem(GUIDANCE._entries, "step_of_mine", None)  # no other test has this one
    file = tmp_path / "step_of_mine.py"
    declared = (
        "import guiderail as gr\n\n@gr.register_guidance('step_of_mine', label='{}')\ndef step(known):\n    pass\n"
    )
    file.write_text(declared.format("one"), encoding="utf-8")
    import_modules([file])
    first = GUIDANCE.get("step_of_mine")
    assert import_modules([file]) == (str(file),)
    assert GUIDANCE.get("step_of_mine") is first
    file.write_text(declared.format("another"), encoding="utf-8")
    import_modules([file])
    assert GUIDANCE.get("step_of_mine").label == "another"
