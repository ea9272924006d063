"""`guiderail certify`: what a skill can command at all, whatever its policy does, as a file that anybody can check."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from guiderail.diagrams.make import known
from guiderail.diagrams.stations.station import Impedance
from guiderail.models.certificate import checker
from guiderail.models.certificate.bounds import Bounds, Skill, certify
from guiderail.models.certificate.files import CERTIFICATE, certificate_files
from guiderail.models.errors import InputError
from guiderail.tools.files import write_atomically
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.tasks import changed_environment, check_environment

CERTIFIED = {"kgrl": False, "skgrl": True}  # guidance whose law this is, and whether it has a history


def certify_skill(
    of: str, environment: Mapping[str, Any], *, out: Path | None = None, start_within: float | None = None
) -> dict[str, Any]:
    """Writes a certificate and has it checked, in a process of its own.

    Args:
        of: a run's folder, or the name of a task.
        environment: arguments of the environment that are other ones than the run's or the task's.
        out: the folder that is written; `certificate` in the run unless given.
        start_within: how far beside its start, in any output, the robot may begin, in the outputs' units; what the
            environment draws unless given.

    Returns:
        Numbers of both regimes, the files' folder, and the checker's word.

    Raises:
        InputError: if there is no such run or task, or its guidance follows no law that is certified.
    """
    task, arguments, about = _what(of, environment)
    options = check_environment(task, arguments)
    guidance = str(options["guidance"])
    if guidance not in CERTIFIED or options.get("adaptive_history") or options.get("history_source") == "measured":
        raise InputError(
            f"guidance={guidance!r} follows no law that is certified: it takes {' or '.join(CERTIFIED)}, with a "
            "history of commands and of one length"
        )
    if out is None:
        if not Path(of).is_dir():
            raise InputError("say where the certificate of a task goes with --out")
        out = Path(of) / "certificate"
    demonstrated = known(task, **options).demonstrations
    assert demonstrated is not None  # both kinds of guidance need them
    primitive = demonstrated.primitive(history=CERTIFIED[guidance])
    start = primitive.constraints.nearest(primitive.reference.means[0])
    within = float(options.get("start_beside", 0.0)) if start_within is None else start_within
    if not (np.isfinite(within) and within >= 0.0):
        raise InputError(f"the robot begins within a distance that is not negative, not {within}")
    skill = Skill(
        primitive,
        demonstrated.null_space_gains(primitive),
        demonstrated.control_period,
        start,
        np.full(primitive.num_outputs, within),
    )
    certified = certify(skill)
    pushes = Impedance() if primitive.num_outputs == len(Impedance().stiffness) else None
    stiffness = None if pushes is None else options.get("stiffness_factor", 1.0) * np.array(pushes.stiffness)
    limits = None if pushes is None else np.array(pushes.limits)
    for name, content in certificate_files(skill, certified, stiffness, limits, about).items():
        write_atomically(out / name, content)
    word = subprocess.run([sys.executable, checker.__file__, str(out)], capture_output=True, text=True)
    found: dict[str, Any] = {
        "certificate": str(out / CERTIFICATE),
        "checker": (word.stdout or word.stderr).strip(),
        "steps": primitive.num_steps,
        "steps_that_constraints_can_touch": int(certified.touched.sum()),
    }
    for regime, bounds in (("while_free", certified.free), ("always", certified.always)):
        found |= {f"{regime}_{name}": value for name, value in _largest(bounds).items()}
    if limits is not None:
        found["force"] = float(np.linalg.norm(limits[:3]))
    return found


def _what(of: str, environment: Mapping[str, Any]) -> tuple[str, dict[str, Any], dict[str, Any]]:
    """Task, arguments, and what a certificate says that it is of."""
    if not Path(of).is_dir():
        return of, dict(environment), {"task": of, "environment": {k: str(v) for k, v in environment.items()}}
    config = RunFolder(Path(of)).config()
    content = (Path(of) / "config.yaml").read_bytes()
    about = {"task": config.task, "config.yaml": hashlib.sha256(content).hexdigest()}
    return config.task, changed_environment(config.task, config.environment, environment), about


def _largest(bounds: Bounds) -> dict[str, list[float | None]]:
    """The least, the greatest, the fastest of each output over all steps; None where nothing is known."""
    extremes = {
        "lower": bounds.lower.min(axis=0),
        "upper": bounds.upper.max(axis=0),
        "speed": bounds.speed.max(axis=0),
        "acceleration": bounds.acceleration.max(axis=0),
    }
    return {name: [float(x) if np.isfinite(x) else None for x in values] for name, values in extremes.items()}
