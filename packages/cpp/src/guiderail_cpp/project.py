"""`guiderail export RUN --target cpp`: a folder with a C++ library, the data of a skill, and a test that replays it."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Any

import numpy as np
from safetensors.numpy import save

from guiderail.diagrams.guidance.primitive import make_law
from guiderail.diagrams.guidance.prior import PriorKnowledge
from guiderail.diagrams.stations.impedance_control import (
    MIN_INERTIA,
    MIN_MASS,
    WRENCH_RATE,
)
from guiderail.diagrams.tasks.options import CONTACT_MEMORY, MIN_CONTACT_FORCE
from guiderail.models.control.wrench import MovingInertia
from guiderail.models.laws.primitive import SKILL_FILE
from guiderail.models.policy import Policy
from guiderail.models.templates import load_template
from guiderail_cpp.arrays import Arrays, frozen, primitive_arrays
from guiderail_cpp.recording import record_skill, signal_sizes
from guiderail_cpp.skill import GUIDED, Exporter, TrainedSkill, to_json
from guiderail_cpp.templates import template_arrays

EXPORTED = {"history.adaptive": False}
"""Options whose other values the C++ library does not implement."""
TEMPLATES = ("sct", "none")  # guidance by a template
DATA_FILE, RECORDING_FILE = "skill.safetensors", "test/recording.safetensors"
VELOCITY_TEMPLATE = "end_effector_velocity"  # input mapping of the guidance `none`
NO_LIMIT = 1e300  # number for infinity, which the state of a robot cannot exceed


def _project_files(skill: TrainedSkill) -> dict[str, bytes]:
    """Return the files of a C++ project: library, data, recorded steps, and a program that replays them."""
    arrays, texts, signals = skill_arrays(skill)
    recording = record_skill(skill, signals)
    description = skill.description | {"data": DATA_FILE, "signals": signals}
    if skill.prior.template is not None:
        description["frames"] = list(skill.prior.template.template.frames)
    written = {
        DATA_FILE: save(frozen(arrays), metadata=texts),
        RECORDING_FILE: save(frozen(recording)),
        SKILL_FILE: to_json(description),
    }
    package = files("guiderail_cpp")
    return written | _copied(package / "files", "") | _copied(package / "include", "include/")


export_cpp = Exporter((*GUIDED, *TEMPLATES), EXPORTED, _project_files)
"""Write the skill of a run as a C++ project; a call has the arguments of `guiderail_cpp.skill.Exporter`."""


def _copied(folder: Traversable, prefix: str) -> dict[str, bytes]:
    """Return the content of all files in a folder, by their path after `prefix`."""
    copied: dict[str, bytes] = {}
    for item in folder.iterdir():
        if item.is_dir():
            copied |= _copied(item, f"{prefix}{item.name}/")
        else:
            copied[prefix + item.name] = item.read_bytes()
    return dict(sorted(copied.items()))


def skill_arrays(skill: TrainedSkill) -> tuple[Arrays, dict[str, str], dict[str, int]]:
    """Return the arrays of a skill, its texts, and the sizes of the signals that its policy observes by name."""
    guidance, prior = skill.config.environment["guidance"], skill.prior
    arrays = {
        "period": np.array([prior.period]),
        "duration": np.array([prior.period * skill.num_steps]),
        "observation/min_force": np.array([MIN_CONTACT_FORCE]),
        "observation/contact_samples": np.array([CONTACT_MEMORY / skill.prior.period]),
        "action_repeat": np.array([float(skill.config.action_repeat)]),
    }
    arrays |= _guidance_arrays(guidance, prior) | _force_arrays(skill) | policy_arrays(skill.policy)
    observed, signals = _observation_arrays(skill.description["observation"])
    texts = {f"signal_{index}": name for index, name in enumerate(signals)}
    for name, default in (("activation", "relu"), ("squash", "tanh")):
        texts[name] = skill.policy.description.get(name, default)
    return arrays | observed, texts, signals


def _guidance_arrays(guidance: str, prior: PriorKnowledge) -> Arrays:
    if guidance in GUIDED:
        return primitive_arrays(make_law(prior, history=guidance == "skgrl"))
    placed = prior.template
    assert placed is not None
    is_constrained = placed.is_constrained(guidance == "sct")
    template = placed.template if is_constrained else placed.template.without_active_constraints()
    arrays = template_arrays(template, placed.frames)
    if guidance == "none":
        arrays |= template_arrays(load_template(VELOCITY_TEMPLATE), {}, "mapping/")
    limit = placed.max_tracking_error if is_constrained else np.inf
    return arrays | {"template/max_tracking_error": np.array([min(limit, NO_LIMIT)])}


def _force_arrays(skill: TrainedSkill) -> Arrays:
    """Return the arrays of the task's force bound, if any: the governor's, and the limits of a template's states."""
    impedance = skill.task.impedance()
    if impedance is None or impedance.bound is None:
        return {}
    stiffness = np.array(impedance.stiffness)
    mass = np.repeat([MIN_MASS, MIN_INERTIA], 3)
    arrays = governor_arrays(
        stiffness,
        2.0 * impedance.damping_ratio * np.sqrt(stiffness * mass),
        # A lever of 0: the rotation is not limited, because the robot's moment of inertia is not known here.
        np.append(impedance.bound.numbers, [impedance.bound.contact_stiffness, 0.0]),
        MovingInertia(MIN_MASS, MIN_INERTIA),
        skill.prior.period,
    )
    if skill.prior.template is not None:
        template = skill.prior.template.template
        if template.limits_wrench:
            limits = [np.minimum(impedance.bound.numbers, template.max_wrench(i)) for i in range(len(template.states))]
            arrays["phase_limit/limits"] = np.array(limits)
            arrays["phase_limit/max_change"] = WRENCH_RATE * skill.prior.period
    return arrays


def governor_arrays(
    stiffness: np.ndarray, damping: np.ndarray, bound: np.ndarray, inertia: MovingInertia, step: float
) -> Arrays:
    """Return the arrays of a reference governor; `bound` (10,) is a `WrenchBound` with stiffness and lever."""
    return {
        "governor/stiffness": stiffness, "governor/damping": damping, "governor/bound": bound,
        "governor/mass": np.array([inertia.mass]), "governor/moment": np.array([inertia.moment]),
        "governor/step": np.array([step]),
    }  # fmt: skip


def policy_arrays(policy: Policy) -> Arrays:
    """Return the arrays of a policy; weights are of single precision."""
    arrays: Arrays = {}
    for index, (weight, bias) in enumerate(policy.layers):
        arrays |= {f"policy/weight_{index}": weight, f"policy/bias_{index}": bias}
    limits = (np.asarray(policy.description[f"action_{end}"], np.float32) for end in ("low", "high"))
    return arrays | dict(zip(("policy/low", "policy/high"), limits, strict=True))


def _observation_arrays(entries: list[Mapping[str, Any]]) -> tuple[Arrays, dict[str, int]]:
    """Return the arrays of the observation's entries, and the sizes of the observed signals by name."""
    sizes = signal_sizes(entries)
    names = list(sizes)
    rows = [
        [names.index(entry["signal"]), *(float(entry[key]) for key in ("index", "center", "scale", "clip"))]
        for entry in entries
    ]
    return {"observation/entries": np.array(rows), "observation/sizes": np.array(list(sizes.values()))}, sizes
