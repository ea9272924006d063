import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.learning.checkpoint import load_checkpoint, save_checkpoint


@pytest.fixture
def checkpoint(tmp_path):
    path = tmp_path / "checkpoint" / "state.safetensors"
    arrays = {"weights": np.arange(6, dtype=np.float32).reshape(2, 3), "empty": np.zeros((0, 4))}
    save_checkpoint(path, arrays, {"episodes": 3, "big": 2**100})
    return path


def test_checkpoint_is_read_as_written(checkpoint):
    arrays, values = load_checkpoint(checkpoint)
    np.testing.assert_array_equal(arrays["weights"], [[0, 1, 2], [3, 4, 5]])
    assert arrays["weights"].dtype == np.float32
    assert arrays["empty"].shape == (0, 4)
    assert values == {"episodes": 3, "big": 2**100}


def test_save_checkpoint_leaves_no_other_file(checkpoint):
    assert [path.name for path in checkpoint.parent.iterdir()] == ["state.safetensors"]


@pytest.mark.parametrize("kept", [0, 7, 100, -1])
def test_load_checkpoint_refuses_a_truncated_file(checkpoint, kept):
    checkpoint.write_bytes(checkpoint.read_bytes()[:kept])
    with pytest.raises(InputError, match="damaged"):
        load_checkpoint(checkpoint)


def test_load_checkpoint_refuses_a_flipped_bit(checkpoint):
    content = bytearray(checkpoint.read_bytes())
    content[-2] ^= 1
    checkpoint.write_bytes(bytes(content))
    with pytest.raises(InputError, match="damaged"):
        load_checkpoint(checkpoint)


def test_load_checkpoint_names_a_missing_file(tmp_path):
    with pytest.raises(InputError, match=r"state\.safetensors"):
        load_checkpoint(tmp_path / "state.safetensors")
