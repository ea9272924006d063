"""Probing motion that makes contact parameters identifiable: press, slide and wiggle on the rim and in the hole.

It is a demonstration, so that the environment, a robot's executor and the force bound treat it as any other motion.
"""

from __future__ import annotations

import shlex
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

DURATION = 3.0  # [s]
# Times [s] and heights of the command above the rim [m]: approach, press on the rim, lift, press into the hole, lift.
TIMES = (0.0, 0.25, 0.45, 0.5, 1.0, 1.2, 1.3, 1.5, 2.75, DURATION)
HEIGHTS = (2 * MM, 2 * MM, -5 * MM, -3.5 * MM, -3.5 * MM, 1.5 * MM, 1.5 * MM, -4 * MM, -4 * MM, 3 * MM)
SHIFT = (1.1, 1.3)  # start and end of the motion from the rim to the hole [s]
SLIDE = (0.5, 0.75, 1 * MM)  # start [s], end [s] and amplitude [m] of a motion along y on the rim
SPIRAL = (1.5, 2.2, 0.6 * MM, 0.25 * MM)  # start [s], end [s], radius [m] and pitch [m] of a search for the hole
WIGGLES = ((0.75, 1.0), (2.25, 2.75))  # starts and ends, on the rim and in the hole [s]
WIGGLE = (0.6 * MM, 0.06, 0.25)  # amplitudes along x [m] and about z [rad], period [s]
PRIOR_STD = (1e-3, 1e-3, 1e-3, 0.02, 0.02, 0.02)  # standard deviation that a single demonstration needs [m], [rad]
NOMINAL = {"disturbances.friction_factor": (1.0, 1.0), "disturbances.modulus_factor": (1.0, 1.0)}  # not a run's range
PLACED = {"fixture_offset": "none", "offset_range": None}  # options of a fixture where the motion expects it


def probing_motion(height: float, turn: float, radius: float) -> Demonstrations:
    """Return the probing motion of a workpiece at a `turn` about z [rad] that is placed above its fixture.

    It begins at `radius` [m] along x, where the workpiece stands on the rim at `height` [m], and then enters the hole.
    The command is at most 5 mm below the rim; the force limit of the environment bounds the resulting force.
    """
    times = CONTROL_PERIOD * np.arange(round(DURATION / CONTROL_PERIOD) + 1)
    poses = np.zeros((len(times), POSE_SIZE))
    poses[:, 0], poses[:, 2] = np.interp(times, SHIFT, (radius, 0.0)), height + np.interp(times, TIMES, HEIGHTS)
    poses[:, 3] = turn
    start, end, amplitude = SLIDE
    at = (times >= start) & (times < end)
    poses[at, 1] = amplitude * np.sin(2.0 * np.pi * (times[at] - start) / (end - start))
    start, end, largest, pitch = SPIRAL
    at = (times >= start) & (times < end)
    distances = largest * np.sqrt((times[at] - start) / (end - start))  # constant speed
    angles = 2.0 * np.pi * distances / pitch
    poses[at, 0], poses[at, 1] = distances * np.cos(angles), distances * np.sin(angles)
    amplitude, rotation, period = WIGGLE
    for start, end in WIGGLES:
        at = (times >= start) & (times < end)
        wave = np.sin(2.0 * np.pi * (times[at] - start) / period)
        poses[at, 0] += amplitude * wave
        poses[at, 3] += rotation * wave
    return Demonstrations([times], [poses], POSE_NAMES)


def write_probe(task: str, environment: Mapping[str, Any], path: Path) -> Path:
    """Write the probing motion of a task to a file of demonstrations, .npz or .csv.

    Raises:
        InputError: If the task has no rim or takes no demonstrations from a file, or the file cannot be written.
    """
    made = EnvConfig.resolve(task, dict(environment)).declared
    contact = made.rim_contact() if hasattr(made, "rim_contact") else None
    if contact is None:
        raise InputError(f"{task} has no rim to probe: calibrate from episodes of the policy, without --probe")
    if "demonstrations" not in environment:
        raise InputError(
            f"{task} takes no demonstrations from a file, as a probing motion is: calibrate from episodes of the "
            "policy, without --probe"
        )
    probing_motion(contact.height, float(contact.turn), contact.radius).save(path)
    return path


def probe_options(probe: Path, environment: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options with which an environment follows a probing motion without a policy, on a placed fixture.

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
        **{name: value for name, value in PLACED.items() if name in environment},
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
    nominal = {name: value for name, value in NOMINAL.items() if name in base}
    recorded = {**base, **probe_options(path, base), **nominal}
    options = beyond_defaults(config.task, check_environment(config.task, recorded))
    given = " ".join(f"--env {shlex.quote(f'{name}={_text(value)}')}" for name, value in options.items())
    command = f"guiderail evaluate {config.task} --policy zero {given} --baselines none --episodes 5 --steps recordings"
    return {"probe": str(path), "record": command}


def _text(value: Any) -> str:
    """Return the value of an option as it is typed on the command line."""
    if value is None:
        return "null"
    if isinstance(value, tuple | list):
        return f"[{','.join(map(_text, value))}]"
    return str(value).lower() if isinstance(value, bool) else str(value)
