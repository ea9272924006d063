"""LeRobot datasets: refused descriptions and data, and notes and refusals of the export."""

import json

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import Demonstrations
from guiderail_data.formats.lerobot import INFO, read_lerobot, write_lerobot

CLOCK = 0.1 * np.arange(5)


@pytest.fixture
def dataset(tmp_path):
    write_lerobot(tmp_path / "set", Demonstrations([CLOCK], [CLOCK[:, None]]))
    return tmp_path / "set"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"features": {"action": "x"}}, "info.json is missing or damaged"),
        ({"features": {"action": {"dtype": "float32", "shape": 1}}}, "info.json is missing or damaged"),
        ({"fps": "1_0"}, "info.json is missing or damaged"),
        ({"fps": True}, "info.json is missing or damaged"),
        ({"fps": 0}, "0 frames a second: correct fps"),
        ({"fps": -10}, "-10 frames a second"),
        ({"fps": float("nan")}, "nan frames a second"),
    ],
)
def test_dataset_is_refused_when_its_description_is_invalid(changes, message, dataset):
    info = json.loads((dataset / INFO).read_text())
    (dataset / INFO).write_text(json.dumps(info | changes))
    with pytest.raises(InputError, match=message):
        read_lerobot(dataset, "action")


def test_hidden_file_next_to_the_data_is_not_read(dataset):
    (file,) = (dataset / "data").rglob("*.parquet")
    file.with_name(f"._{file.name}").write_bytes(b"\x00\x05\x16\x07")
    assert len(read_lerobot(dataset, "action").times) == 1


def test_dataset_is_refused_with_too_many_rows(dataset, monkeypatch):
    monkeypatch.setattr("guiderail_data.formats.lerobot.MAX_LINES", len(CLOCK) - 1)
    with pytest.raises(InputError, match=f"more than {len(CLOCK) - 1} rows"):
        read_lerobot(dataset, "action")


def test_dataset_is_refused_when_pyarrow_cannot_read_it(dataset, monkeypatch):
    def fail(*_, **__):
        raise pyarrow.ArrowNotImplementedError("Support for codec 'lzo' not built")

    monkeypatch.setattr(pyarrow.parquet, "read_table", fail)
    with pytest.raises(InputError, match=r"holds data that its .*info\.json does not describe: .*lzo"):
        read_lerobot(dataset, "action")


def test_lerobot_export_notes_a_shifted_start(dataset, tmp_path):
    notes = write_lerobot(tmp_path / "later", Demonstrations([CLOCK - 0.2], [CLOCK[:, None]]))
    assert "first samples were at -0.2 s" in notes[-1]
    np.testing.assert_allclose(read_lerobot(tmp_path / "later", "action").times[0], CLOCK)
    assert "shifted" not in " ".join(write_lerobot(tmp_path / "zero", Demonstrations([CLOCK], [CLOCK[:, None]])))


@pytest.mark.parametrize(
    ("clock", "number", "message"), [(np.array([0.0, 1e8]), 1.0, "give --rate"), (CLOCK, -1e39, "1e\\+39 exceeds")]
)
def test_lerobot_export_refuses_long_gaps_and_large_numbers(clock, number, message, tmp_path):
    with pytest.raises(InputError, match=message):
        write_lerobot(tmp_path / "set", Demonstrations([clock], [np.full((len(clock), 1), number)]))
    assert list(tmp_path.iterdir()) == []
