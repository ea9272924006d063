import pytest

from guiderail.diagrams.guidance.registry import GUIDANCE
from guiderail.models.common.errors import InputError
from guiderail.tools.environments import changed_environment, check_environment
from guiderail.tools.imports import import_modules


@pytest.mark.parametrize(("trained_on", "evaluated_on"), [("gantry", "mujoco"), ("gantry", "arm"), ("arm", "gantry")])
def test_run_of_one_station_is_evaluated_on_another(trained_on, evaluated_on):
    trained = check_environment("BncConnector", {"station": trained_on, "action_repeat": 3})
    evaluated = check_environment(
        "BncConnector", changed_environment("BncConnector", trained, {"station": evaluated_on})
    )
    assert (evaluated["station"], evaluated["action_repeat"]) == (evaluated_on, 3)
    assert evaluated == check_environment("BncConnector", {"station": evaluated_on, "action_repeat": 3})


def test_option_that_the_other_station_lacks_is_refused():
    trained = check_environment("BncConnector", {"impedance_control": "cartesian"})
    assert changed_environment("BncConnector", trained, {}) == trained
    assert changed_environment("BncConnector", trained, {"station": "gantry"})["impedance_control"] == "cartesian"
    changed = changed_environment("BncConnector", trained, {"station": "arm", "impedance_control": "joint"})
    with pytest.raises(InputError, match="it is an option of station='gantry'"):
        check_environment("BncConnector", changed)


def test_environment_without_stations_accepts_any_option():
    assert changed_environment("Bead", {"wall": 1.0}, {"wall": 2.0}) == {"wall": 2.0}
    assert changed_environment("Bead", {"wall": 1.0}, {"station": "gantry"}) == {"wall": 1.0, "station": "gantry"}


def test_imported_file_runs_once_for_each_content(tmp_path, monkeypatch):
    monkeypatch.setitem(GUIDANCE._entries, "lab_step", None)  # removed after the test
    file = tmp_path / "lab_step.py"
    source = "import guiderail as gr\n\n@gr.register_guidance('lab_step', label='{}')\ndef step(known):\n    pass\n"
    file.write_text(source.format("one"), encoding="utf-8")
    import_modules([file])
    first = GUIDANCE.get("lab_step")
    assert import_modules([file]) == (str(file),)
    assert GUIDANCE.get("lab_step") is first
    file.write_text(source.format("another"), encoding="utf-8")
    import_modules([file])
    assert GUIDANCE.get("lab_step").label == "another"
