import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.common.files import write_atomically


def test_write_atomically_refuses_a_path_below_a_file(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="cannot be written"):
        write_atomically(tmp_path / "file" / "table.csv", b"")
    assert (tmp_path / "file").read_text() == "mine"
