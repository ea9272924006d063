import math
import os
from contextlib import nullcontext

import numpy as np
import pandas as pd
import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.tables import check_parquet, read_table, table_text, write_table


def test_rows_are_read_as_written(tmp_path):
    rows = [{"a": 0.1 + 0.2, "b": 3, "c": "blocked", "d": -math.inf}, {"a": 1e-300, "b": -1, "c": "", "d": 2.0}]
    (tmp_path / "t.csv").write_text(table_text(rows))
    assert read_table(tmp_path / "t.csv").to_dict("records") == rows


def test_floats_are_read_bit_for_bit(tmp_path):
    numbers = np.random.default_rng(0).integers(0, 2**63, 2000, dtype=np.int64).view(float)
    numbers = numbers[np.isfinite(numbers)]
    (tmp_path / "t.csv").write_text(table_text(pd.DataFrame({"a": numbers})))
    np.testing.assert_array_equal(read_table(tmp_path / "t.csv")["a"], numbers)


def test_missing_values_are_empty_cells(tmp_path):
    rows = [{"a": 3, "b": "kgrl, hold 1", "c": None}, {"a": None, "b": "nan", "c": None}]
    assert table_text(rows) == 'a,b,c\n3,"kgrl, hold 1",\n,nan,\n'
    (tmp_path / "t.csv").write_text(table_text(rows))
    table = read_table(tmp_path / "t.csv")
    assert table["b"].tolist() == ["kgrl, hold 1", "nan"]
    assert table["a"][0] == 3
    assert math.isnan(table["a"][1])


def test_markdown_has_the_rows_of_the_csv(tmp_path):
    markdown = write_table(tmp_path / "t", pd.DataFrame({"a_b": [0.123456, 2], "c": ["x", None]}).astype(object))
    assert markdown.read_text().splitlines() == ["| a b | c |", "| --- | --- |", "| 0.1235 | x |", "| 2 | – |"]
    assert read_table(tmp_path / "t.csv")["a_b"].tolist() == [0.123456, 2]


def test_tables_whose_names_have_dots_are_separate_files(tmp_path):
    written = [write_table(tmp_path / f"bound-0.{digit}", [{"a": digit}]) for digit in (5, 6)]
    assert [file.name for file in written] == ["bound-0.5.md", "bound-0.6.md"]
    assert [read_table(file.with_suffix(".csv"))["a"].tolist() for file in written] == [[5], [6]]


def test_column_is_numeric_when_all_cells_are_numbers(tmp_path):
    (tmp_path / "t.csv").write_text("a,b,c,d\n1,0x10,True,1e400\n,2,False,-inf\n", encoding="utf-8")
    table = read_table(tmp_path / "t.csv")
    assert table["a"].tolist()[0] == 1.0
    assert math.isnan(table["a"][1])
    assert table["b"].tolist() == ["0x10", "2"]
    assert table["c"].tolist() == [True, False]
    assert table["d"].tolist() == [math.inf, -math.inf]


@pytest.mark.parametrize(
    "text", ["", "a,a\n1,2\n", ",b\n1,2\n", "a,b\n1\n", "a,b\n1,2,3\n", 'a\n"1\n', "a\n" + "1" * 200_000 + "\n"]
)
def test_read_refuses_an_invalid_table(text, tmp_path):
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(InputError, match="not a table"):
        read_table(tmp_path / "t.csv")


@pytest.mark.parametrize(("spare_bytes", "is_accepted"), [(0, True), (-1, False)])
def test_size_of_a_table_is_limited(spare_bytes, is_accepted, tmp_path, monkeypatch):
    (tmp_path / "t.csv").write_text("a,b\n1,2\n")
    monkeypatch.setattr("guiderail.tools.tables.MAX_FILE_SIZE", 8 + spare_bytes)  # the file has 8 bytes
    with nullcontext() if is_accepted else pytest.raises(InputError, match="larger than 7 bytes"):
        read_table(tmp_path / "t.csv")


@pytest.mark.parametrize(("max_rows", "is_accepted"), [(6, True), (5, False)])
def test_number_of_rows_of_parquet_files_is_limited(max_rows, is_accepted, tmp_path):
    for name in "ab":
        pd.DataFrame({"x": [1.0, 2.0, 3.0]}).to_parquet(tmp_path / f"{name}.parquet")
    with nullcontext() if is_accepted else pytest.raises(InputError, match="more than 5 rows"):
        check_parquet([tmp_path / "a.parquet", tmp_path / "b.parquet"], max_rows)


def test_long_lists_and_pipes_are_refused_as_parquet(tmp_path):
    pd.DataFrame({"x": [[0.0] * 100_000]}).to_parquet(tmp_path / "list.parquet")
    with pytest.raises(InputError, match="more than 50 rows"):
        check_parquet([tmp_path / "list.parquet"], 50)
    os.mkfifo(tmp_path / "pipe.parquet")
    with pytest.raises(InputError, match="not a regular file"):
        check_parquet([tmp_path / "pipe.parquet"])
