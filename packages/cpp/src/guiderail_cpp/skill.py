"""Trained skill that is exported: policy, prior knowledge, and the meaning of observation and action."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_prior_knowledge
from guiderail.diagrams.envs.observation import Observed
from guiderail.diagrams.guidance.prior import PriorKnowledge
from guiderail.diagrams.tasks.registry import TASKS
from guiderail.diagrams.tasks.task import Task
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import POSE_NAMES, WRENCH_NAMES
from guiderail.models.policy import Policy
from guiderail.tools.files import check_new, write_atomically
from guiderail.tools.learning.run_folder import RunConfig, RunFolder
from guiderail.tools.pretrained import find_run

NAMES = {"time": ("time [s]",), "phase": ("phase",), "state": ("state",), "wrench": WRENCH_NAMES}
NAMES["center_of_pressure"] = ("center of pressure x [m]", "center of pressure y [m]")
NAMES["mean_contact_point"] = ("mean contact point x [m]", "mean contact point y [m]")
NAMES |= {signal: tuple(f"{signal} {name}" for name in POSE_NAMES) for signal in ("pose", "desired_pose")}
"""Names of a signal's entries with their units; entries of another signal are numbered."""
GUIDED = ("kgrl", "skgrl")  # guidance whose data can be exported


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


def to_json(description: Mapping[str, Any]) -> bytes:
    """Return the content of `skill.json`."""
    return json.dumps(description, indent=2, default=_plain).encode() + b"\n"


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)


def _observation(declared: Observed, clip: float, pose_size: int, observed: int) -> list[dict[str, Any]]:
    """Return the entries of the observation, each clip((value − center) / scale); there are `observed` of them."""
    terms = declared.terms
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
