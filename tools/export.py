"""Export of a trained skill to files for other programs: the policy as ONNX, a description, and the guidance's data."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_prior_knowledge
from guiderail.diagrams.guidance.primitive import make_law
from guiderail.diagrams.tasks.registry import TASKS
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import POSE_NAMES
from guiderail.models.laws.skill import PRIMITIVE_FILE, SKILL_FILE
from guiderail.models.policy import Policy
from guiderail.models.primitives.kernels import DEFAULT_KERNEL
from guiderail.tools.files import check_new, write_atomically
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.pretrained import find_run

WRENCH_NAMES = ("Fx [N]", "Fy [N]", "Fz [N]", "Mx [Nm]", "My [Nm]", "Mz [Nm]")
NAMES = {"time": ("time [s]",), "phase": ("phase",), "wrench": WRENCH_NAMES}
NAMES["center_of_pressure"] = ("center of pressure x [m]", "center of pressure y [m]")
NAMES |= {signal: tuple(f"{signal} {name}" for name in POSE_NAMES) for signal in ("pose", "desired_pose")}
"""Names of a signal's entries with their units; entries of another signal are numbered."""
EXPORTED = {"kernel": DEFAULT_KERNEL, "history.source": "commanded", "history.adaptive": False}
"""Options whose other values the loop of a skill without an environment does not implement."""
GUIDED = ("kgrl", "skgrl")  # guidance whose data can be exported
POLICY_FILE = "policy.onnx"


def export_skill(run: Path | str, out: Path) -> list[Path]:
    """Write the policy of a run, the meaning of its observation and action, and the data of its guidance.

    `policy.onnx` is the deterministic policy: observation (1, n) → action (1, A), both float32. `skill.json` lists the
    entries of both in their order, with names, units, centers and scales, and the settings of the guidance.
    `primitive.npz` has the reference, constraints and gains of a movement primitive.

    Args:
        run: Folder of a run, or `pretrained:NAME`.
        out: Folder to write, which must not exist.

    Returns:
        Paths of the files.

    Raises:
        InputError: If there is no such run, its policy observes images, or the folder cannot be written.
    """
    folder = RunFolder(find_run(run))
    config, policy = folder.config(), Policy.load(folder.path)
    if config.task not in TASKS.names() or config.environment.get("guidance") not in GUIDED:
        raise InputError(
            f"the guidance of a run to export is {' or '.join(GUIDED)}: evaluate this policy with guiderail evaluate"
        )
    check_new(out, "folder")
    files = {POLICY_FILE: policy_to_onnx(policy)}
    skill: dict[str, Any] = {"task": config.task, "environment": dict(config.environment)}
    skill |= {"action_repeat": config.action_repeat, "policy": POLICY_FILE}
    resolved = EnvConfig.resolve(config.task, config.environment)
    task, prior = resolved.make_task(), make_prior_knowledge(resolved)
    primitive_config = prior.primitive
    skill["observation"] = _observation(task.observation_terms(), task.clip, prior.pose_size)
    if len(skill["observation"]) != math.prod(policy.description["observation_shape"]):
        raise InputError(f"the entries of {config.task}'s observation have no known names: this run cannot be exported")
    assert primitive_config is not None
    if primitive_config.motion is not None or primitive_config.progress is not None:
        raise InputError("constraints of the motion and progress=state cannot be exported: train without them")
    for option, exported in EXPORTED.items():
        if (value := config.environment.get(option, exported)) != exported:
            raise InputError(f"{option}={value} cannot be exported, only {option}={exported}: train with this value")
    law = make_law(prior, history=config.environment["guidance"] == "skgrl")
    primitive = law.primitive
    buffer = io.BytesIO()
    constraints = primitive.constraints
    np.savez(
        buffer, times=primitive.reference.times, means=primitive.reference.means,
        covariances=primitive.reference.covariances, G=constraints.G, c=constraints.c,
        gains=law.gain,
    )  # fmt: skip
    files[PRIMITIVE_FILE] = buffer.getvalue()
    skill["primitive"] = {
        "file": PRIMITIVE_FILE, "lambda_": primitive_config.lambda_, "beta": primitive_config.beta,
        "horizon": primitive_config.horizon, "history": primitive.history,
        "history_variance": primitive_config.history_variance, "history_source": law.history_source,
        "kernel": config.environment["kernel"], "length_scale": config.environment["length_scale"],
    }  # fmt: skip
    skill["control_period_s"] = prior.period
    low, high = (policy.description[f"action_{end}"] for end in ("low", "high"))
    skill["action"] = [
        {"name": f"null-space action of {POSE_NAMES[output]}", "output": output,
         "low": low[i], "high": high[i]}
        for i, output in enumerate(law.outputs)
    ]  # fmt: skip
    files[SKILL_FILE] = json.dumps(skill, indent=2, default=_plain).encode() + b"\n"
    out.mkdir(parents=True)
    for name, content in files.items():
        write_atomically(out / name, content)
    return [out / name for name in files]


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)


def _observation(terms: Any, clip: float, pose_size: int) -> list[dict[str, Any]]:
    """Return the entries of the observation, each clip((value − center) / scale)."""
    if not isinstance(terms, Sequence):
        raise InputError("a policy that observes images cannot be exported: train one with observation=state")
    entries = []
    for term in terms:
        names: Sequence[str] = NAMES.get(term.signal, ())
        names = names[:pose_size] if "pose" in term.signal else names
        size = max(np.size(term.center), np.size(term.scale), len(names) if term.entries is None else 1)
        indices = range(size) if term.entries is None else term.entries
        centers, scales = (np.broadcast_to(values, len(indices)) for values in (term.center, term.scale))
        for index, center, scale in zip(indices, centers, scales, strict=True):
            name = names[index] if names else f"{term.signal}[{index}]"
            entry = {"name": name, "signal": term.signal, "index": index, "center": float(center)}
            entries.append({**entry, "scale": float(scale), "clip": clip})
    return entries


def policy_to_onnx(policy: Policy) -> bytes:
    """Return the content of an ONNX file that computes a policy's action (1, A) for an observation (1, n).

    Raises:
        InputError: If the policy observes images.
    """
    layers, description = policy.layers, policy.description
    if len(description["observation_shape"]) != 1 or "image_shape" in description:
        raise InputError("a policy that observes images cannot be exported: train one with observation=state")
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
    tensors |= {"low": low, "high": high}
    if description.get("squash", "tanh") == "clip":
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
