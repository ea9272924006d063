"""`guiderail export RUN --target onnx`: the policy as ONNX, a description, and the data of the guidance."""

import io
import math
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

import numpy as np

from guiderail.diagrams.guidance.primitive import make_law
from guiderail.diagrams.tasks.options import CONTACT_MEMORY, MIN_CONTACT_FORCE
from guiderail.models.laws.primitive import PRIMITIVE_FILE, SKILL_FILE
from guiderail.models.policy import Policy
from guiderail.models.primitives.kernels import DEFAULT_KERNEL
from guiderail_cpp.recording import COMPUTED, record_skill, signal_sizes
from guiderail_cpp.skill import GUIDED, Exporter, TrainedSkill, to_json

EXPORTED = {"kernel": DEFAULT_KERNEL, "history.source": "commanded", "history.adaptive": False}
"""Options whose other values the loop of a skill without an environment does not implement."""
POLICY_FILE, RECORDING_FILE, LOOP_FILE = "policy.onnx", "recording.npz", "loop.py"


def _onnx_files(skill: TrainedSkill) -> dict[str, bytes]:
    """Return the policy, the meaning of observation and action, the data of the guidance, and a loop that uses them.

    `policy.onnx` is the deterministic policy: observation (1, n) → action (1, A), both float32. `skill.json` lists the
    entries of both in their order, with names, units, centers and scales, and the settings of the guidance.
    `primitive.npz` has the reference, constraints and gains of a movement primitive. `loop.py` computes the commands
    without an environment, and compares them with the random steps of `recording.npz`.
    """
    environment, config = skill.config.environment, skill.prior.primitive
    assert config is not None
    law = make_law(skill.prior, history=environment["guidance"] == "skgrl")
    primitive = law.primitive
    buffer = io.BytesIO()
    constraints = primitive.constraints
    np.savez(
        buffer, times=primitive.reference.times, means=primitive.reference.means,
        covariances=primitive.reference.covariances, G=constraints.G, c=constraints.c,
        gains=law.gain,
    )  # fmt: skip
    description = skill.description | {"policy": POLICY_FILE}
    description["primitive"] = {
        "file": PRIMITIVE_FILE, "lambda_": config.lambda_, "beta": config.beta,
        "horizon": config.horizon, "history": primitive.history,
        "history_variance": config.history_variance, "history_source": law.history_source,
        "kernel": environment["kernel"], "length_scale": environment["length_scale"],
    }  # fmt: skip
    for entry, output in zip(description["action"], law.outputs, strict=True):
        entry["output"] = output
    description["contact"] = {"min_force": MIN_CONTACT_FORCE, "memory_s": CONTACT_MEMORY}
    return {
        POLICY_FILE: policy_to_onnx(skill.policy), PRIMITIVE_FILE: buffer.getvalue(), SKILL_FILE: to_json(description),
        LOOP_FILE: (files("guiderail_cpp") / "onnx_files" / LOOP_FILE).read_bytes(), RECORDING_FILE: _recorded(skill),
    }  # fmt: skip


def _recorded(skill: TrainedSkill) -> bytes:
    """Return recorded random steps (.npz): measured poses, commands, and the signals that are measured, too."""
    sizes = signal_sizes(skill.description["observation"])
    recording = record_skill(skill, sizes)
    ends = np.cumsum([*sizes.values()])
    signals = dict(zip(sizes, np.split(recording["replay/signals"], ends[:-1], axis=1), strict=True))
    columns: dict[str, Any] = {name: recording[f"replay/{name}"] for name in ("reset", "pose", "command")}
    buffer = io.BytesIO()
    columns |= {name: signals[name] for name in signals if name not in COMPUTED}
    np.savez_compressed(buffer, **columns)
    return buffer.getvalue()


export_onnx = Exporter(GUIDED, EXPORTED, _onnx_files)
"""Write the skill of a run as ONNX, JSON and NumPy files."""


def policy_to_onnx(policy: Policy) -> bytes:
    """Return the content of an ONNX file that computes a policy's action (1, A) for an observation (1, n)."""
    layers, description = policy.layers, policy.description
    nodes: list[tuple[str, Sequence[str], str]] = []
    tensors: dict[str, np.ndarray] = {}
    value = "observation"
    for index, (weight, bias) in enumerate(layers):
        tensors |= {f"weight_{index}": weight.T.copy(), f"bias_{index}": bias}
        nodes.append(("MatMul", (value, f"weight_{index}"), f"product_{index}"))
        nodes.append(("Add", (f"product_{index}", f"bias_{index}"), f"sum_{index}"))
        value = f"sum_{index}"
        if index + 1 == len(layers):
            break
        if description["activation"] == "normalized_relu":
            tensors["epsilon"] = np.array([1e-5], np.float32)
            steps: Sequence[tuple[str, Sequence[str], str]] = (
                ("ReduceMean", (value,), "mean"), ("Sub", (value, f"mean_{index}"), "centered"),
                ("Mul", (f"centered_{index}",) * 2, "squared"), ("ReduceMean", (f"squared_{index}",), "variance"),
                ("Add", (f"variance_{index}", "epsilon"), "shifted"), ("Sqrt", (f"shifted_{index}",), "deviation"),
                ("Div", (f"centered_{index}", f"deviation_{index}"), "normal"),
            )  # fmt: skip
            nodes += [(kind, inputs, f"{output}_{index}") for kind, inputs, output in steps]
            value = f"normal_{index}"
        nodes.append(("Tanh" if description["activation"] == "tanh" else "Relu", (value,), f"hidden_{index}"))
        value = f"hidden_{index}"
    low, high = (np.asarray(description[f"action_{end}"], np.float32) for end in ("low", "high"))
    tensors["low"] = low
    if description.get("squash", "tanh") == "clip":
        tensors["high"] = high
        nodes += [("Max", (value, "low"), "above"), ("Min", ("above", "high"), "action")]
    else:
        tensors |= {"half": np.float32(0.5) * (high - low), "one": np.ones(1, np.float32)}
        nodes += [("Tanh", (value,), "squashed"), ("Add", ("squashed", "one"), "raised")]
        nodes += [("Mul", ("raised", "half"), "range"), ("Add", ("range", "low"), "action")]
    return _model(nodes, tensors, math.prod(description["observation_shape"]), len(low))


# Fields of ONNX's Protocol Buffers, so that the package `onnx` is not needed.


def _varint(value: int) -> bytes:
    low, value = value & 0x7F, value >> 7
    return bytes([low | 0x80]) + _varint(value) if value else bytes([low])


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _bytes(field: int, *parts: bytes | str) -> bytes:
    content = b"".join(part.encode() if isinstance(part, str) else part for part in parts)
    return _varint(field << 3 | 2) + _varint(len(content)) + content


def _tensor(name: str, array: np.ndarray) -> bytes:
    dims = b"".join(_number(1, size) for size in array.shape)
    return _bytes(5, dims, _number(2, 1), _bytes(8, name), _bytes(9, array.astype("<f4").tobytes()))


def _value(field: int, name: str, size: int) -> bytes:
    dims = [_bytes(1, _number(1, number)) for number in (1, size)]
    return _bytes(field, _bytes(1, name), _bytes(2, _bytes(1, _number(1, 1), _bytes(2, *dims))))


def _model(
    nodes: Sequence[tuple[str, Sequence[str], str]], tensors: Mapping[str, np.ndarray], observation: int, action: int
) -> bytes:
    """Return an ONNX model (version 8 of the format, operators of version 13)."""
    axes = _bytes(5, _bytes(1, "axes"), _number(8, 1), _number(20, 7))  # the last of two dimensions
    encoded = [
        _bytes(1, *(_bytes(1, name) for name in inputs), _bytes(2, output), _bytes(4, kind),
               *([axes] if kind == "ReduceMean" else []))
        for kind, inputs, output in nodes
    ]  # fmt: skip
    graph = _bytes(
        7, *encoded, _bytes(2, "policy"), *(_tensor(name, array) for name, array in tensors.items()),
        _value(11, "observation", observation), _value(12, "action", action),
    )  # fmt: skip
    return _number(1, 8) + _bytes(8, _number(2, 13)) + graph
