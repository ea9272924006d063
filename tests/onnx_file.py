"""Writer of a minimal ONNX file (Protocol Buffers), so that the tests do not need the package `onnx`."""

import numpy as np


def _number(field, value):
    """Return a field with a whole number."""
    return _varint(field << 3) + _varint(value)


def _bytes(field, *parts):
    """Return a field with texts and encoded messages."""
    content = b"".join(part.encode() if isinstance(part, str) else part for part in parts)
    return _varint(field << 3 | 2) + _varint(len(content)) + content


def _varint(value):
    """Return the encoding of a whole number in groups of seven bits, the lowest first."""
    low, value = value & 0x7F, value >> 7
    return bytes([low | 0x80]) + _varint(value) if value else bytes([low])


def _tensor(name, array):
    """Return the field of an initializer with float32 numbers."""
    dims = b"".join(_number(1, size) for size in array.shape)
    return _bytes(5, dims, _number(2, 1), _bytes(8, name), _bytes(9, array.astype("<f4").tobytes()))


def _value(field, name, sizes):
    """Return the field of a float32 input or output; text names a variable size, and None omits a dimension."""
    dims = [_bytes(1, _bytes(2, size) if isinstance(size, str) else _number(1, size)) for size in sizes if size]
    return _bytes(field, _bytes(1, name), _bytes(2, _bytes(1, _number(1, 1), _bytes(2, *dims))))


def linear_policy(weight: np.ndarray, bias: np.ndarray, batch: int | str | None) -> bytes:
    """Return the content of an ONNX file: tanh(observation @ weight + bias), with or without a batch dimension."""
    nodes = [
        _bytes(1, _bytes(1, "observation"), _bytes(1, "weight"), _bytes(2, "product"), _bytes(4, "MatMul")),
        _bytes(1, _bytes(1, "product"), _bytes(1, "bias"), _bytes(2, "sum"), _bytes(4, "Add")),
        _bytes(1, _bytes(1, "sum"), _bytes(2, "action"), _bytes(4, "Tanh")),
    ]
    graph = _bytes(
        7, *nodes, _bytes(2, "policy"), _tensor("weight", weight), _tensor("bias", bias),
        _value(11, "observation", (batch, weight.shape[0])), _value(12, "action", (batch, weight.shape[1])),
    )  # fmt: skip
    return _number(1, 8) + _bytes(8, _number(2, 13)) + graph
