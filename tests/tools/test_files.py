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
    check_page,
    check_picture,
    check_writable,
    refuse_existing_run,
    remove_partial_files,
)
from guiderail.tools.learning.run_folder import RunFolder


def test_check_refuses_a_path_below_a_file(tmp_path):
    (tmp_path / "file").touch()
    for name in ("file/x.png", "file/a/b/x.png"):
        with pytest.raises(InputError, match="cannot be written"):
            check_picture(tmp_path / name)
    check_writable(tmp_path / "new" / "folder" / "x.png")
    assert not (tmp_path / "new").exists()


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
