import os
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.common.files import write_atomically


def test_write_atomically_refuses_a_path_below_a_file(tmp_path):
    (tmp_path / "file").write_text("unchanged")
    with pytest.raises(InputError, match="cannot be written"):
        write_atomically(tmp_path / "file" / "table.csv", b"")
    assert (tmp_path / "file").read_text() == "unchanged"


def test_write_atomically_does_not_mix_contents_of_threads(tmp_path, monkeypatch):
    barrier, contents = threading.Barrier(2, timeout=20.0), (b"a" * 1000, b"b" * 2000)
    monkeypatch.setattr(os, "fsync", lambda file: barrier.wait())  # until both threads have written
    with ThreadPoolExecutor(2) as pool:
        for future in [pool.submit(write_atomically, tmp_path / "file", content) for content in contents]:
            future.result()
    assert (tmp_path / "file").read_bytes() in contents
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
