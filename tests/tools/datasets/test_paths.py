"""Tests of paths: they are checked before any work, and a failure leaves nothing behind."""

import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.evaluation.evaluate import evaluate
from guiderail.tools.files import atomic_folder, check_new, path_exists


def test_check_new_accepts_missing_parent_folders(tmp_path):
    check_new(tmp_path / "new" / "deep" / "file.npz", "file")
    assert list(tmp_path.iterdir()) == []


def test_check_new_refuses_an_existing_file(tmp_path):
    (tmp_path / "file.npz").write_text("mine")
    with pytest.raises(InputError, match="already exists: name another file"):
        check_new(tmp_path / "file.npz", "file")


@pytest.mark.parametrize("place", ["file/below", "file/below/deep"])
def test_check_new_refuses_a_path_below_a_file(place, tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match=r"cannot be written \(Not a directory\)"):
        check_new(tmp_path / place, "folder")
    with pytest.raises(InputError, match=r"cannot be written \(Not a directory\)"), atomic_folder(tmp_path / place):
        pass


def test_path_exists_refuses_a_name_that_is_too_long(tmp_path):
    with pytest.raises(InputError, match="File name too long"):
        path_exists(tmp_path / ("x" * 300))


def fail_while_writing(folder, error):
    with atomic_folder(folder) as part:
        (part / "half").write_text("half")
        raise error


def test_atomic_folder_exists_only_when_complete(tmp_path):
    with pytest.raises(OverflowError):
        fail_while_writing(tmp_path / "made", OverflowError())
    assert list(tmp_path.iterdir()) == []
    with atomic_folder(tmp_path / "made") as part:
        (part / "all").write_text("all")
        assert not (tmp_path / "made").exists()
    assert [one.relative_to(tmp_path).as_posix() for one in tmp_path.rglob("*")] == ["made", "made/all"]


def test_error_of_another_file_is_not_one_of_the_folder(tmp_path):
    with pytest.raises(FileNotFoundError), atomic_folder(tmp_path / "made"):
        (tmp_path / "input.obj").read_bytes()
    assert not list(tmp_path.iterdir())


def test_atomic_folder_leaves_nothing_when_the_disk_is_full(tmp_path):
    with pytest.raises(InputError, match="No space left"):
        fail_while_writing(tmp_path / "made", OSError(28, "No space left on device"))
    assert list(tmp_path.iterdir()) == []


def test_evaluate_checks_its_save_file_before_it_reads_the_run(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="cannot be written"):
        evaluate(tmp_path / "none", save=tmp_path / "file" / "demonstrations.npz")
