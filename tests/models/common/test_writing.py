import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.common.files import write_atomically


def test_below_a_file_nothing_is_written(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="cannot be written"):
        write_atomically(tmp_path / "file" / "table.csv", b"")
    assert (tmp_path / "file").read_text() == "mine"
