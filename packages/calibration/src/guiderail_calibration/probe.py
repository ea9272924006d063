"""Probing motion that makes contact parameters identifiable: press, slide, wiggle and lift on the rim of a fixture.

It is a demonstration, so that the environment, a robot's executor and the force bound treat it as any other motion.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.stations.station import CONTROL_PERIOD
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import MM, POSE_NAMES, POSE_SIZE
from guiderail.models.primitives import Demonstrations
from guiderail.tools.environments import beyond_defaults, check_environment
from guiderail.tools.evaluation.subject import find_subject

DURATION = 1.94  # [s]
# Times [s] and heights of the command above the rim [m]: approach, press, press harder, hold, lift.
TIMES = (0.0, 0.22, 0.4, 0.6, 0.7, 1.66, DURATION)
HEIGHTS = (2 * MM, 2 * MM, -2 * MM, -5 * MM, -3.5 * MM, -3.5 * MM, 3 * MM)
SLIDE = (0.7, 1.16, 1 * MM)  # start [s], end [s] and radius [m] of a circle on the rim
WIGGLE = (1.16, 1.66, 0.6 * MM, 0.06, 0.25)  # start and end [s], amplitude along x [m] and about z [rad], period [s]
PRIOR_STD = (1e-3, 1e-3, 1e-3, 0.02, 0.02, 0.02)  # standard deviation that a single demonstration needs [m], [rad]


def probing_motion(height: float, turn: float) -> Demonstrations:
    """Return the probing motion on a rim at a `height` [m] with the workpiece at a `turn` about z [rad].

    The command is at most 5 mm below the rim; the force limit of the environment bounds the resulting force.
    """
    times = CONTROL_PERIOD * np.arange(round(DURATION / CONTROL_PERIOD) + 1)
    poses = np.zeros((len(times), POSE_SIZE))
    poses[:, 2], poses[:, 3] = height + np.interp(times, TIMES, HEIGHTS), turn
    start, end, radius = SLIDE
    at = (times >= start) & (times < end)
    angle = 2.0 * np.pi * (times[at] - start) / (end - start)
    poses[at, 0], poses[at, 1] = radius * np.sin(angle), radius * (1.0 - np.cos(angle))
    start, end, amplitude, rotation, period = WIGGLE
    at = (times >= start) & (times < end)
    wave = np.sin(2.0 * np.pi * (times[at] - start) / period)
    poses[at, 0] += amplitude * wave
    poses[at, 3] += rotation * wave
    return Demonstrations([times], [poses], POSE_NAMES)


def write_probe(task: str, environment: Mapping[str, Any], path: Path) -> Path:
    """Write the probing motion of a task to a file of demonstrations, .npz or .csv.

    Raises:
        InputError: If the task has no rim, or the file cannot be written.
    """
    made = EnvConfig.resolve(task, dict(environment)).make_task()
    contact = made.rim_contact() if hasattr(made, "rim_contact") else None
    if contact is None:
        raise InputError(f"{task} has no rim to probe: calibrate from episodes of the policy, without --probe")
    probing_motion(contact.height, float(contact.turn)).save(path)
    return path


def probe_options(probe: Path) -> dict[str, Any]:
    """Return the options of an environment that follows a probing motion without a policy.

    Raises:
        InputError: If there is no such file.
    """
    if not probe.is_file():
        raise InputError(f"there is no probing motion {probe}: write it with guiderail probe RUN --out {probe}")
    return {
        "guidance": "kmp",
        "demonstrations": str(probe.resolve()),
        "num_demonstrations": None,
        "prior_std": PRIOR_STD,
    }


def record_options(run: Path | str, environment: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Write the probing motion for a run's task, and return the file and the command that records it in simulation.

    Raises:
        InputError: If there is no such run, the task has no rim, or the file cannot be written.
    """
    subject = find_subject(run, None, environment)
    config = subject.config
    assert config is not None  # a run has one
    base = subject.changed_environment(dict(environment))
    write_probe(config.task, base, path)
    options = beyond_defaults(config.task, check_environment(config.task, {**base, **probe_options(path)}))
    given = " ".join(f"--env {name}={_text(value)}" for name, value in options.items() if value is not None)
    command = f"guiderail evaluate {config.task} --policy zero {given} --baselines none --episodes 5 --steps recordings"
    return {"probe": str(path), "record": command}


def _text(value: Any) -> str:
    """Return the value of an option as it is typed on the command line."""
    if isinstance(value, tuple | list):
        return f"[{','.join(map(_text, value))}]"
    return str(value).lower() if isinstance(value, bool) else str(value)
