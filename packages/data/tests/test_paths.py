"""Output paths: checks before any work, and folders that exist only when complete."""

import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.evaluation.evaluate import evaluate
from guiderail.tools.files import atomic_folder, check_new, path_exists


def test_check_new_accepts_missing_parent_folders(tmp_path):
    check_new(tmp_path / "new" / "deep" / "file.npz", "file")
    assert list(tmp_path.iterdir()) == []


def test_check_new_refuses_an_existing_file(tmp_path):
    (tmp_path / "file.npz").write_text("text")
    with pytest.raises(InputError, match="already exists: name another file"):
        check_new(tmp_path / "file.npz", "file")


@pytest.mark.parametrize("path", ["file/below", "file/below/deep"])
def test_check_new_refuses_a_path_below_a_file(path, tmp_path):
    (tmp_path / "file").write_text("text")
    with pytest.raises(InputError, match=r"cannot be written \(Not a directory\)"):
        check_new(tmp_path / path, "folder")
    with pytest.raises(InputError, match=r"cannot be written \(Not a directory\)"), atomic_folder(tmp_path / path):
        pass


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


def test_evaluate_checks_its_output_before_reading_the_run(tmp_path):
    (tmp_path / "file").write_text("text")
    with pytest.raises(InputError, match="cannot be written"):
        evaluate(tmp_path / "none", save=tmp_path / "file" / "demonstrations.npz")
