"""A place where nothing can be written is refused before anything is run for it."""

import os
import subprocess
import sys

import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.evaluation.evaluate import evaluate
from guiderail.tools.evaluation.rollout import check_seed
from guiderail.tools.files import LOCK, check_page, check_picture, check_writable, remove_parts
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.visualization.episode_spec import EpisodeSpec


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
        lambda: EpisodeSpec.of_run(bead_run, seed=seed),
        lambda: evaluate(bead_run, save=tmp_path / "x.npz", seed=seed),
    ):
        with pytest.raises(InputError, match=f"a seed is a whole number from 0 to {2**31 - 1}, not {seed}"):
            refused()


def test_a_recording_is_refused_before_an_episode_is_run(bead_run, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setattr(Policy, "load", lambda path: pytest.fail("it goes on"))
    with pytest.raises(InputError, match="cannot be written"):
        evaluate(bead_run, save=tmp_path / "file" / "x.npz")


@pytest.fixture
def gone():
    """The number of a process that is over."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_a_locked_folder_is_rid_of_the_files_and_folders_that_a_killed_process_left(gone, tmp_path):
    (tmp_path / "checkpoint").mkdir()
    for number in (gone, os.getpid(), 10**30):
        (tmp_path / "checkpoint" / f".state.safetensors.{number}.part").touch()
        (tmp_path / f".peg.{number}.part" / "parts").mkdir(parents=True)
    (tmp_path / "checkpoint" / ".own.part").touch()  # of somebody who names things otherwise
    with RunFolder(tmp_path).locked():
        left = {path.name for path in tmp_path.rglob("*")}
    assert left == {"checkpoint", ".own.part", LOCK}


def test_what_others_are_writing_stays(gone, tmp_path):
    alive = os.getppid()
    another = tmp_path / "another_run"
    kept = [tmp_path / f".report.html.{alive}.part", another / "checkpoint" / f".state.safetensors.{gone}.part"]
    kept += [tmp_path / f".peg.{alive}.part" / f".part.yaml.{gone}.part", another / LOCK]
    for path in kept:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    remove_parts(tmp_path)
    assert all(path.exists() for path in kept)
