"""Export of a trained skill to files for other programs: the policy as ONNX, a description, and the guidance's data."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_prior_knowledge
from guiderail.diagrams.envs.observation import Observed
from guiderail.diagrams.guidance.primitive import make_law
from guiderail.diagrams.tasks.registry import TASKS
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import POSE_NAMES
from guiderail.models.laws.primitive import PRIMITIVE_FILE, SKILL_FILE
from guiderail.models.policy import Ensemble, Policy
from guiderail.models.primitives.kernels import DEFAULT_KERNEL
from guiderail.tools.evaluation.subject import refuse_guidance_change
from guiderail.tools.files import check_new, write_atomically
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.pretrained import find_run

if TYPE_CHECKING:
    from guiderail.diagrams.guidance.prior import PriorKnowledge
    from guiderail.diagrams.tasks.task import Task
    from guiderail.tools.learning.run_folder import RunConfig

WRENCH_NAMES = ("Fx [N]", "Fy [N]", "Fz [N]", "Mx [Nm]", "My [Nm]", "Mz [Nm]")
NAMES = {"time": ("time [s]",), "phase": ("phase",), "state": ("state",), "wrench": WRENCH_NAMES}
NAMES["center_of_pressure"] = ("center of pressure x [m]", "center of pressure y [m]")
NAMES["mean_contact_point"] = ("mean contact point x [m]", "mean contact point y [m]")
NAMES |= {signal: tuple(f"{signal} {name}" for name in POSE_NAMES) for signal in ("pose", "desired_pose")}
"""Names of a signal's entries with their units; entries of another signal are numbered."""
EXPORTED = {"kernel": DEFAULT_KERNEL, "history.source": "commanded", "history.adaptive": False}
"""Options whose other values the loop of a skill without an environment does not implement."""
GUIDED = ("kgrl", "skgrl")  # guidance whose data can be exported
POLICY_FILE = "policy.onnx"


@dataclass(frozen=True)
class TrainedSkill:
    """Policy of a run with the task and the prior knowledge that its guidance is built from.

    Attributes:
        config: Configuration of the run.
        policy: Deterministic policy.
        task: Task.
        num_steps: Control steps of an episode.
        prior: Prior knowledge of the task.
        description: Meaning of observation and action, and settings of the guidance, as written to `skill.json`.
    """

    config: RunConfig
    policy: Policy
    task: Task
    num_steps: int
    prior: PriorKnowledge
    description: dict[str, Any]


def load_skill(run: Path | str, guidance: Sequence[str], exported: Mapping[str, Any]) -> TrainedSkill:
    """Load the policy of a run and describe its observation, action and guidance.

    Args:
        run: Folder of a run, or `pretrained:NAME`.
        guidance: Kinds of guidance that can be exported.
        exported: Options of which only one value can be exported, with this value.
    """
    folder = RunFolder(find_run(run))
    config, policy = folder.config(), Policy.load(folder.path)
    kind = config.environment.get("guidance")
    if config.task not in TASKS.names() or kind not in guidance:
        raise InputError(
            f"the guidance of a run to export is {' or '.join(guidance)}: evaluate this policy with guiderail evaluate"
        )
    if len(policy.description["observation_shape"]) != 1 or "image_shape" in policy.description:
        raise InputError("a policy that observes images cannot be exported: train one with observation=state")
    resolved = EnvConfig.resolve(config.task, config.environment)
    task, prior = resolved.declared, make_prior_knowledge(resolved)
    description: dict[str, Any] = {"task": config.task, "environment": dict(config.environment)}
    description["action_repeat"] = config.action_repeat
    observed = math.prod(policy.description["observation_shape"])
    description["observation"] = _observation(Observed.of(task.observe()), task.clip, prior.pose_size, observed)
    if len(description["observation"]) != observed:
        raise InputError(f"the entries of {config.task}'s observation have no known names: this run cannot be exported")
    for option, value in exported.items():
        if (given := config.environment.get(option, value)) != value:
            raise InputError(f"{option}={given} cannot be exported, only {option}={value}: train with this value")
    names = [f"input {index}" for index in range(len(policy.description["action_low"]))]
    if kind in GUIDED:
        primitive = prior.primitive
        assert primitive is not None
        if primitive.motion is not None or primitive.progress is not None:
            raise InputError("constraints of the motion and progress=state cannot be exported: train without them")
        names = [f"null-space action of {POSE_NAMES[output]}" for output in primitive.explored_outputs]
    low, high = (policy.description[f"action_{end}"] for end in ("low", "high"))
    description["control_period_s"] = prior.period
    description["action"] = [
        {"name": name, "low": low[index], "high": high[index]} for index, name in enumerate(names)
    ]  # fmt: skip
    return TrainedSkill(config, policy, task, resolved.num_steps, prior, description)


@dataclass(frozen=True)
class Exporter:
    """Format of exported skills; a call writes the skill of a run into a new folder and returns the paths of its files.

    Attributes:
        guidance: Kinds of guidance that can be exported.
        exported: Options of which only one value can be exported, with this value.
        files: Function from a skill to the contents of its files, by their path in the folder.
    """

    guidance: Sequence[str]
    exported: Mapping[str, Any]
    files: Callable[[TrainedSkill], Mapping[str, bytes]]

    def __call__(self, run: Path | str, out: Path) -> list[Path]:
        """Write the skill of a run, its folder or `pretrained:NAME`, into the folder `out`, which must not exist."""
        check_new(out, "folder")
        files = self.files(load_skill(run, self.guidance, self.exported))
        paths = [out / name for name in files]
        for path, content in zip(paths, files.values(), strict=True):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, content)
        return paths


def _onnx_files(skill: TrainedSkill) -> dict[str, bytes]:
    """Return the policy, the meaning of its observation and action, and the data of its guidance.

    `policy.onnx` is the deterministic policy: observation (1, n) → action (1, A), both float32. `skill.json` lists the
    entries of both in their order, with names, units, centers and scales, and the settings of the guidance.
    `primitive.npz` has the reference, constraints and gains of a movement primitive.
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
    files = {POLICY_FILE: policy_to_onnx(skill.policy), PRIMITIVE_FILE: buffer.getvalue()}
    return files | {SKILL_FILE: to_json(description)}


export_skill = Exporter(GUIDED, EXPORTED, _onnx_files)
"""Write the skill of a run as ONNX, JSON and NumPy files."""


def write_ensemble(runs: Sequence[str | Path], out: Path) -> Ensemble:
    """Write the mean of several runs' policies as a run folder with the configuration of the first run.

    The folder has no table of episodes and no checkpoint. Commands evaluate it like a run.
    """
    if len(runs) < 2:
        raise InputError("an ensemble has the policies of several runs: name at least two")
    folders = [RunFolder(find_run(run)) for run in runs]
    configs = [folder.config() for folder in folders]
    for config in configs[1:]:
        refuse_guidance_change(configs[0].environment, config.environment)
    try:
        ensemble = Ensemble([Policy.load(folder.path) for folder in folders])
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{error}: give runs of the same task and options") from error
    folder = RunFolder(out)
    with folder.locked():
        folder.create(configs[0])
        ensemble.save(out, write=write_atomically)
    return ensemble


def to_json(description: Mapping[str, Any]) -> bytes:
    """Return the content of `skill.json`."""
    return json.dumps(description, indent=2, default=_plain).encode() + b"\n"


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)


def _observation(declared: Observed, clip: float, pose_size: int, observed: int) -> list[dict[str, Any]]:
    """Return the entries of the observation, each clip((value − center) / scale); there are `observed` of them."""
    terms = declared.terms
    if declared.camera is not None:
        raise InputError("a policy that observes images cannot be exported: train one with observation=state")
    sizes = [_size(term, pose_size) for term in terms]
    if sizes.count(1) and observed > sum(sizes):  # one signal whose size neither its name nor its scale tells
        unknown = [i for i, term in enumerate(terms) if term.signal not in NAMES and sizes[i] == 1]
        if len(unknown) == 1:
            sizes[unknown[0]] += observed - sum(sizes)
    entries = []
    for term, size in zip(terms, sizes, strict=True):
        names = NAMES.get(term.signal, ())
        indices = range(size) if term.entries is None else term.entries
        centers, scales = (np.broadcast_to(values, len(indices)) for values in (term.center, term.scale))
        for index, center, scale in zip(indices, centers, scales, strict=True):
            name = names[index] if names else f"{term.signal}[{index}]"
            entry = {"name": name, "signal": term.signal, "index": index, "center": float(center)}
            entries.append({**entry, "scale": float(scale), "clip": clip})
    return entries


def _size(term: Any, pose_size: int) -> int:
    """Return the number of a term's entries, as far as its name, center and scale tell."""
    if term.entries is not None:
        return len(term.entries)
    known = len(NAMES.get(term.signal, ())[: pose_size if "pose" in term.signal else None])
    return max(np.size(term.center), np.size(term.scale), known)


def policy_to_onnx(policy: Policy) -> bytes:
    """Return the content of an ONNX file that computes a policy's action (1, A) for an observation (1, n)."""
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
