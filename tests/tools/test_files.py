"""Checks of output paths before a computation, and removal of partial files of processes that were killed."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.evaluation.episode import check_seed
from guiderail.tools.evaluation.evaluate import evaluate
from guiderail.tools.evaluation.subject import EpisodeSpec
from guiderail.tools.files import (
    LOCK,
    atomic_folder,
    check_new,
    check_page,
    check_picture,
    check_writable,
    path_exists,
    refuse_existing_run,
    remove_partial_files,
)
from guiderail.tools.learning.run_folder import RunFolder


@pytest.mark.parametrize("name", ["file/x.png", "file/a/b/x.png"])
def test_path_below_a_file_is_refused(name, tmp_path):
    (tmp_path / "file").touch()
    path = tmp_path / name
    for refuse in (
        lambda: check_picture(path),
        lambda: check_new(path, "folder"),
        lambda: atomic_folder(path).__enter__(),
        lambda: evaluate(tmp_path / "none", save=path.with_suffix(".npz")),  # before the run is read
    ):
        with pytest.raises(InputError, match=r"cannot be written"):
            refuse()


def test_missing_parent_folders_are_accepted_and_not_made(tmp_path):
    check_writable(tmp_path / "new" / "folder" / "x.png")
    check_new(tmp_path / "new" / "deep" / "file.npz", "file")
    assert list(tmp_path.iterdir()) == []


def test_check_new_refuses_an_existing_file(tmp_path):
    (tmp_path / "file.npz").touch()
    with pytest.raises(InputError, match="already exists: name another file"):
        check_new(tmp_path / "file.npz", "file")


def test_path_exists_refuses_a_name_that_is_too_long(tmp_path):
    with pytest.raises(InputError, match="File name too long"):
        path_exists(tmp_path / ("x" * 300))


def fail_while_writing(folder, error):
    """Raise an error after half of the folder is written."""
    with atomic_folder(folder) as part:
        (part / "half").write_text("half")
        raise error


def test_atomic_folder_exists_only_when_complete(tmp_path):
    with pytest.raises(OverflowError):
        fail_while_writing(tmp_path / "folder", OverflowError())
    assert list(tmp_path.iterdir()) == []
    with atomic_folder(tmp_path / "folder") as part:
        (part / "all").write_text("all")
        assert not (tmp_path / "folder").exists()
    assert [path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*")] == ["folder", "folder/all"]


def test_atomic_folder_keeps_the_error_of_another_file(tmp_path):
    with pytest.raises(FileNotFoundError), atomic_folder(tmp_path / "folder"):
        (tmp_path / "input.obj").read_bytes()
    assert not list(tmp_path.iterdir())


def test_atomic_folder_leaves_nothing_when_the_disk_is_full(tmp_path):
    with pytest.raises(InputError, match="No space left"):
        fail_while_writing(tmp_path / "folder", OSError(28, "No space left on device"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("path", ["", "."])
def test_current_folder_is_refused_for_a_run_when_not_empty(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    refuse_existing_run(Path(path))
    (tmp_path / "file").touch()
    message = "^a run needs a folder of its own, and the current folder is not empty: name"
    with pytest.raises(InputError, match=message):
        refuse_existing_run(Path(path))


def test_check_refuses_an_existing_folder(tmp_path):
    (tmp_path / "page.html").mkdir()
    for check in (check_writable, check_page):
        with pytest.raises(InputError, match="is a folder"):
            check(tmp_path / "page.html")


@pytest.mark.parametrize("seed", [-1, 2**31])
def test_seed_is_refused_when_out_of_range(seed, bead_run, tmp_path):
    for use_seed in (
        lambda: check_seed(seed),
        lambda: EpisodeSpec.of_policy(bead_run, seed=seed),
        lambda: evaluate(bead_run, save=tmp_path / "x.npz", seed=seed),
    ):
        with pytest.raises(InputError, match=f"a seed must be a whole number from 0 to {2**31 - 1}, not {seed}"):
            use_seed()


@pytest.fixture
def ended_process():
    """Return the id of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_lock_removes_partial_files_of_ended_processes(ended_process, tmp_path):
    (tmp_path / "checkpoint").mkdir()
    for number in (ended_process, os.getpid(), 10**30):
        (tmp_path / "checkpoint" / f".state.safetensors.{number}.part").touch()
        (tmp_path / f".peg.{number}.part" / "parts").mkdir(parents=True)
    (tmp_path / "checkpoint" / ".own.part").touch()  # `write_atomically` creates no file of this name
    with RunFolder(tmp_path).locked():
        remaining = {path.name for path in tmp_path.rglob("*")}
    assert remaining == {"checkpoint", ".own.part", LOCK}


def test_partial_files_of_running_processes_are_not_removed(ended_process, tmp_path):
    running_process, another_run = os.getppid(), tmp_path / "another_run"
    paths = [
        tmp_path / f".report.html.{running_process}.part",
        tmp_path / f".peg.{running_process}.part" / f".part.yaml.{ended_process}.part",
        another_run / "checkpoint" / f".state.safetensors.{ended_process}.part",
        another_run / LOCK,
    ]
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    remove_partial_files(tmp_path)
    assert all(path.exists() for path in paths)


def test_atomic_folder_removes_partial_files_of_a_killed_process(ended_process, tmp_path):
    for name in (f".peg.{ended_process}.part", f".pegs.{ended_process}.part", f".peg.{os.getppid()}.part", ".peg.part"):
        (tmp_path / name / "parts").mkdir(parents=True)
    with atomic_folder(tmp_path / "peg") as folder:
        (folder / "file").touch()
    remaining = {path.name for path in tmp_path.iterdir()}
    assert remaining == {"peg", f".pegs.{ended_process}.part", f".peg.{os.getppid()}.part", ".peg.part"}
    assert [path.name for path in (tmp_path / "peg").iterdir()] == ["file"]
