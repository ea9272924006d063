"""Where nothing can be written is said before the work, and what fails leaves nothing that stands in its own way."""

import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.datasets.paths import check_new, is_there
from guiderail.tools.datasets.record import record
from guiderail.tools.files import atomic_folder


def test_a_new_place_may_lie_in_folders_that_are_not_there_yet(tmp_path):
    check_new(tmp_path / "new" / "deep" / "file.npz", "file")
    assert list(tmp_path.iterdir()) == []


def test_what_is_there_is_kept(tmp_path):
    (tmp_path / "file.npz").write_text("mine")
    with pytest.raises(InputError, match="already exists: name another file"):
        check_new(tmp_path / "file.npz", "file")


@pytest.mark.parametrize("place", ["file/below", "file/below/deep"])
def test_below_a_file_nothing_can_be_written(place, tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match=r"cannot be written \(Not a directory\)"):
        check_new(tmp_path / place, "folder")
    with pytest.raises(InputError, match=r"cannot be written \(Not a directory\)"), atomic_folder(tmp_path / place):
        pass


def test_a_name_that_is_too_long_is_a_sentence(tmp_path):
    with pytest.raises(InputError, match="File name too long"):
        is_there(tmp_path / ("x" * 300))


def fail_on_the_way(folder, error):
    with atomic_folder(folder) as made:
        (made / "half").write_text("half")
        raise error


def test_a_folder_is_there_whole_or_not_at_all(tmp_path):
    with pytest.raises(OverflowError):
        fail_on_the_way(tmp_path / "made", OverflowError())
    assert list(tmp_path.iterdir()) == []
    with atomic_folder(tmp_path / "made") as made:
        (made / "all").write_text("all")
        assert not (tmp_path / "made").exists()
    assert [one.relative_to(tmp_path).as_posix() for one in tmp_path.rglob("*")] == ["made", "made/all"]


def test_a_full_disk_is_a_sentence_and_leaves_nothing(tmp_path):
    with pytest.raises(InputError, match="No space left"):
        fail_on_the_way(tmp_path / "made", OSError(28, "No space left on device"))
    assert list(tmp_path.iterdir()) == []


def test_a_recording_that_cannot_be_written_is_refused_before_its_run_is_read(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="cannot be written"):
        record(tmp_path / "none", tmp_path / "file" / "shown.npz")
