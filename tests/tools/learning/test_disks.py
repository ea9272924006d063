"""Full disks, read-only folders and checkpoints of other versions: one sentence, and nothing is lost."""

from contextlib import ExitStack
from dataclasses import replace
from unittest.mock import Mock

import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.learning.checkpoint import load_checkpoint, save_checkpoint
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.learning.trainer import run_training
from oracles.disks import bound_by_permissions, full_disk
from oracles.same_runs import differences


@pytest.fixture(scope="module")
def whole(module_config, tmp_path_factory):
    folder = RunFolder(tmp_path_factory.mktemp("whole") / "run")
    run_training(folder, module_config)
    return folder.path


@pytest.fixture(scope="module")
def module_config():
    from guiderail.tools.learning.train import configure

    settings = {"net_arch": "16", "batch_size": 16, "learning_starts": 10, "gradient_steps": 4}
    return configure("Bead", {}, settings=settings, episodes=6, seed=5)


def content(folder):
    return {path: path.read_bytes() for path in folder.path.rglob("*") if path.is_file()}


def refused(words):
    return pytest.raises(InputError, match=rf"^[^\n]*{words}[^\n]*$")


@pytest.mark.parametrize("at", [0, 3])
def test_run_resumes_when_a_full_disk_has_room_again(at, whole, module_config, tmp_path):
    folder = RunFolder(tmp_path / "run")
    with ExitStack() as until_now, refused("cannot be written .*choose a folder with room"):

        def fill(row):
            if row["episode"] == at:
                until_now.enter_context(full_disk())

        run_training(folder, module_config, report=fill)
    assert not list(folder.path.rglob("*.part"))
    run_training(folder, module_config, resume=True)
    assert differences(whole, folder.path) == []


def test_policy_is_kept_when_a_full_disk_refuses_to_resume(module_config, tmp_path):
    folder = RunFolder(tmp_path / "run")
    run_training(folder, replace(module_config, episodes=3))
    before = content(folder)
    with full_disk(), refused("cannot be written"):
        run_training(folder, module_config, resume=True)
    assert content(folder) == before


def test_run_is_unchanged_when_its_folder_is_read_only(whole, module_config, tmp_path):
    folder = RunFolder(tmp_path / "run")
    run_training(folder, replace(module_config, episodes=3))
    before = content(folder)
    places = (folder.path, folder.checkpoint.parent)
    for place in places:
        place.chmod(0o555)
    with bound_by_permissions(), refused("cannot be written .Permission denied.*choose a folder"):
        run_training(folder, module_config, resume=True)
    with bound_by_permissions(), refused("cannot be written"):
        run_training(RunFolder(folder.path / "another"), module_config)
    for place in places:
        place.chmod(0o755)
    assert content(folder) == before
    run_training(folder, module_config, resume=True)
    assert differences(whole, folder.path) == []


@pytest.mark.parametrize("lost", ["array", "value"])
def test_run_is_unchanged_when_its_checkpoint_does_not_fit(lost, module_config, tmp_path):
    folder = RunFolder(tmp_path / "run")
    run_training(folder, replace(module_config, episodes=3))
    arrays, values = load_checkpoint(folder.checkpoint)
    if lost == "array":
        arrays["buffer/returns"] = arrays.pop("buffer/rewards")
    else:
        values["learner"]["steps"] = values["learner"].pop("transitions")
    save_checkpoint(folder.checkpoint, arrays, values)
    before = content(folder)
    with refused("belongs to other settings"):
        run_training(folder, module_config, resume=True)
    assert content(folder) == before


def test_defect_of_a_learner_is_not_reported_as_other_settings(module_config, tmp_path, monkeypatch):
    folder = RunFolder(tmp_path / "run")
    run_training(folder, replace(module_config, episodes=3))
    monkeypatch.setattr(
        "guiderail.tools.learning.off_policy.OffPolicyLearner.restore", Mock(side_effect=AttributeError)
    )
    with pytest.raises(AttributeError):
        run_training(folder, module_config, resume=True)


def test_run_starts_again_when_killed_before_its_configuration(whole, module_config, tmp_path):
    folder = RunFolder(tmp_path / "run")
    folder.path.mkdir()
    (folder.path / ".config.yaml.123.part").write_text("task: Be")
    (folder.path / ".lock").touch()
    run_training(folder, module_config)
    assert differences(whole, folder.path) == []
