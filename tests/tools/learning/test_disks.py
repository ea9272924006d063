"""Full disks, read-only folders and unfit checkpoints: one sentence, and the run folder is unchanged."""

from contextlib import ExitStack
from dataclasses import replace

import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.learning.checkpoint import load_checkpoint, save_checkpoint
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.learning.trainer import Observers, run_training
from oracles.disks import bound_by_permissions, full_disk
from oracles.same_runs import differences


@pytest.fixture
def folder(tmp_path):
    return RunFolder(tmp_path / "other")


def content(folder):
    """Return the bytes of every file of a run folder."""
    return {path: path.read_bytes() for path in folder.path.rglob("*") if path.is_file()}


def refused(message):
    """Expect an `InputError` of one line."""
    return pytest.raises(InputError, match=rf"^[^\n]*{message}[^\n]*$")


@pytest.mark.parametrize("episode", [0, 3])
def test_run_resumes_when_a_full_disk_has_room_again(episode, bead_run, bead_config, folder):
    with ExitStack() as disk, refused("cannot be written .*choose a folder with room"):

        def fill(row):
            if row["episode"] == episode:
                disk.enter_context(full_disk())

        run_training(folder, bead_config, observers=Observers(fill))
    assert not list(folder.path.rglob("*.part"))
    run_training(folder, bead_config, resume=True)
    assert differences(bead_run, folder.path) == []


def test_policy_is_kept_when_a_full_disk_refuses_to_resume(bead_config, folder):
    run_training(folder, replace(bead_config, episodes=3))
    before = content(folder)
    with full_disk(), refused("cannot be written"):
        run_training(folder, bead_config, resume=True)
    assert content(folder) == before


def test_run_is_unchanged_when_its_folder_is_read_only(bead_run, bead_config, folder):
    run_training(folder, replace(bead_config, episodes=3))
    before = content(folder)
    folders = (folder.path, folder.checkpoint.parent)
    for path in folders:
        path.chmod(0o555)
    with bound_by_permissions(), refused("cannot be written .Permission denied.*choose a folder"):
        run_training(folder, bead_config, resume=True)
    with bound_by_permissions(), refused("cannot be written"):
        run_training(RunFolder(folder.path / "another"), bead_config)
    for path in folders:
        path.chmod(0o755)
    assert content(folder) == before
    run_training(folder, bead_config, resume=True)
    assert differences(bead_run, folder.path) == []


@pytest.mark.parametrize("lost_entry", ["array", "value"])
def test_run_is_unchanged_when_its_checkpoint_is_unfit(lost_entry, bead_config, folder):
    run_training(folder, replace(bead_config, episodes=3))
    arrays, values = load_checkpoint(folder.checkpoint)
    if lost_entry == "array":
        arrays["buffer/returns"] = arrays.pop("buffer/rewards")
    else:
        values["learner"]["steps"] = values["learner"].pop("transitions")
    save_checkpoint(folder.checkpoint, arrays, values)
    before = content(folder)
    with refused("belongs to other settings"):
        run_training(folder, bead_config, resume=True)
    assert content(folder) == before


def test_run_starts_again_when_killed_before_its_configuration(bead_run, bead_config, folder):
    folder.path.mkdir()
    (folder.path / ".config.yaml.123.part").write_text("task: Be")
    (folder.path / ".lock").touch()
    run_training(folder, bead_config)
    assert differences(bead_run, folder.path) == []
