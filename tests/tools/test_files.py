"""A place where nothing can be written is refused before anything is run for it."""

import pytest

from guiderail.models.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.files import check_page, check_picture, check_writable
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


def test_a_folder_that_is_there_is_no_file_to_write(tmp_path):
    (tmp_path / "page.html").mkdir()
    for refused in (check_writable, check_page):
        with pytest.raises(InputError, match="is a folder"):
            refused(tmp_path / "page.html")


@pytest.mark.parametrize("name", ["policy.safetensors", "config.yaml", "page", "."])
def test_a_page_is_not_written_over_what_is_none(name, tmp_path):
    with pytest.raises(InputError, match=r"has the ending.*a page is \.html"):
        check_page(tmp_path / name)


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
