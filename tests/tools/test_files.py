"""A place where nothing can be written is refused before anything is run for it."""

import pytest

from guiderail.models.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.files import check_picture, check_writable
from guiderail.tools.recording.record import record
from guiderail.tools.rollouts.rollout import check_seed
from guiderail.tools.viewing.shown import Shown


def test_a_file_below_a_file_cannot_be_written(tmp_path):
    (tmp_path / "file").touch()
    for name in ("file/x.png", "file/a/b/x.png"):
        with pytest.raises(InputError, match="cannot be written"):
            check_picture(tmp_path / name)
    check_writable(tmp_path / "new" / "folder" / "x.png")
    assert not (tmp_path / "new").exists()


def test_a_name_that_no_system_takes_is_refused(tmp_path):
    with pytest.raises(InputError, match="cannot be written"):
        check_writable(tmp_path / ("x" * 300) / "x.png")


@pytest.mark.parametrize("seed", [-1, 2**31])
def test_a_seed_that_no_environment_takes_is_refused(seed, bead_run, tmp_path):
    for refused in (
        lambda: check_seed(seed),
        lambda: Shown.of_run(bead_run, seed=seed),
        lambda: record(bead_run, tmp_path / "x.npz", seed=seed),
    ):
        with pytest.raises(InputError, match=f"a seed is a whole number from 0 to {2**31 - 1}, not {seed}"):
            refused()


def test_a_recording_is_refused_before_an_episode_is_run(bead_run, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setattr(Policy, "load", lambda path: pytest.fail("it goes on"))
    with pytest.raises(InputError, match="cannot be written"):
        record(bead_run, tmp_path / "file" / "x.npz")
