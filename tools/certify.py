"""`guiderail certify`: what a skill can command at all, whatever its policy does, as a file that anybody can check."""

from __future__ import annotations

import hashlib
import itertools
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_prior_knowledge
from guiderail.diagrams.stations.station import Impedance
from guiderail.models.certificate import checker
from guiderail.models.certificate.adversary import QUANTITIES, Adversary
from guiderail.models.certificate.bounds import Certified, certify
from guiderail.models.certificate.files import CERTIFICATE, certificate_files
from guiderail.models.certificate.lagrange_bounds import Budget
from guiderail.models.certificate.loop import Bounds, SharedControlTemplate
from guiderail.models.common.errors import InputError, brief
from guiderail.tools.environments import changed_environment, check_environment
from guiderail.tools.files import write_atomically
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.tables import write_table

CERTIFIED = ("kmp", "kgrl", "skgrl")  # guidance whose law this is
SEARCH = 100_000  # steps of the adversary whose worst corrections make the budgets
MARGIN = 1.5  # of the budgets, over what it found
ALIKE = 1.0 + 1e-6  # rounding, where an adversary reaches a bound that is exact
LEAST_EXCESS = ((0.01,), (0.1,))  # of them, in actions: at one step, and in all


def certify_skill(
    of: str,
    environment: Mapping[str, Any],
    *,
    out: Path | None = None,
    start_within: float | None = None,
    attack: int = 0,
) -> dict[str, Any]:
    """Writes a certificate and has it checked, in a process of its own.

    Args:
        of: a run's folder, or the name of a task.
        environment: arguments of the environment that are other ones than the run's or the task's.
        out: the folder that is written; `certificate` in the run unless given.
        start_within: how far beside its start, in any output, the robot may begin, in the outputs' units; what the
            task declares unless given, and the error of a measured pose, with which a history begins.
        attack: how many steps an adversary tries to leave the bounds; none for 0. What it found is written beside
            them, in `attack.csv`.

    Returns:
        Numbers of the regimes, the files' folder, and the checker's word; of an attack the table's rows, and which
        part of its budgets corrections spent.

    Raises:
        InputError: if there is no such run or task, or its guidance follows no law that is certified.
    """
    task, arguments, about = _what(of, environment)
    options = check_environment(task, arguments)
    guidance = str(options["guidance"])
    if attack < 0:
        raise InputError(f"an attack has a number of steps, not {attack}")
    if guidance not in CERTIFIED or options.get("adaptive_history") or options.get("history_source") == "measured":
        raise InputError(
            f"guidance={guidance!r} follows no law that is certified: it takes {' or '.join(CERTIFIED)}, with a "
            "history of commands and of one length (neither adaptive_history nor history_source=measured)"
        )
    if out is None:
        if not Path(of).is_dir():
            raise InputError("say where the certificate of a task goes with --out")
        out = Path(of) / "certificate"
    demonstrated = make_prior_knowledge(task, **options).demonstrations
    assert demonstrated is not None  # both kinds of guidance need them
    acted = guidance != "kmp"
    primitive = demonstrated.primitive(history=guidance == "skgrl", constrained=acted)
    # A reset goes by what was demonstrated, whatever via-points the primitive passes through.
    start = primitive.constraints.nearest(EnvConfig.resolve(task, options).make_task().reference().means[0])
    within = _declared_start(task, options, len(start)) if start_within is None else np.full(len(start), start_within)
    if not (np.isfinite(within).all() and (within >= 0.0).all()):
        raise InputError(f"the robot begins within a distance that is not negative, not {within.min()}")
    skill = SharedControlTemplate(
        primitive,
        demonstrated.null_space_gains(primitive) if acted else np.zeros(primitive.num_outputs),
        demonstrated.control_period,
        start,
        within,
    )
    budget = None
    if primitive.history:
        spent = Adversary(skill, np.ones(primitive.num_steps, bool), seed=SEARCH, spends=True).attack(SEARCH)
        budget = Budget(MARGIN * spent.excess + np.array(LEAST_EXCESS), MARGIN * spent.residue)
    certified = certify(skill, budget)
    pushes = Impedance() if primitive.num_outputs == len(Impedance().stiffness) else None
    stiffness = None if pushes is None else options.get("stiffness_factor", 1.0) * np.array(pushes.stiffness)
    limits = None if pushes is None else np.array(pushes.limits)
    for name, content in certificate_files(skill, certified, stiffness, limits, about).items():
        write_atomically(out / name, content)
    begin = time.perf_counter()
    word = subprocess.run([sys.executable, checker.__file__, str(out)], capture_output=True, text=True)
    seconds = time.perf_counter() - begin
    found: dict[str, Any] = {
        "certificate": str(out / CERTIFICATE),
        "checker": (word.stdout or word.stderr).strip(),
        "checker_seconds": round(seconds, 1),
        "start_within": within.tolist(),
        "steps": primitive.num_steps,
        "steps_that_constraints_can_touch": int(certified.touched.sum()),
    }
    regimes = {"while_free": certified.free, "always": certified.always}
    if certified.budgeted is not None:
        regimes["budgeted"] = certified.budgeted.bounds
    for regime, bounds in regimes.items():
        found |= {f"{regime}_{name}": value for name, value in _largest(bounds).items()}
    if limits is not None:
        found["force"] = float(np.linalg.norm(limits[:3]))
    if attack:
        found |= _attacked(skill, certified, attack, out)
    return found


def _attacked(skill: SharedControlTemplate, certified: Certified, steps: int, out: Path) -> dict[str, Any]:
    """What an adversary came to against each bound, as a table in the folder."""
    can_be_corrected = corrected_steps(skill, certified)
    adversary = Adversary(skill, can_be_corrected)
    worst = adversary.attack(steps)
    bounds = certified.always if certified.budgeted is None else certified.budgeted.bounds
    claimed = {
        "pose": np.maximum(bounds.upper - adversary.middle, adversary.middle - bounds.lower),
        "speed": bounds.speed,
        "acceleration": bounds.acceleration,
    }
    rows: list[dict[str, Any]] = []
    for quantity, constrained, output in itertools.product(QUANTITIES, (False, True), range(len(skill.gains))):
        at = can_be_corrected == constrained
        if at.any():
            bound, most = claimed[quantity][at, output].max(), worst.most[quantity][at, output].max()
            rows.append(
                {
                    "quantity": quantity,
                    "output": output,
                    "constraint": "can be active" if constrained else "never active",
                    "bound": float(bound),
                    "worst_found": float(most),
                    "ratio": float(bound / most) if most > 0.0 else None,
                    "left": int((worst.most[quantity][at, output] > claimed[quantity][at, output] * ALIKE).sum()),
                }
            )
    write_table(out / "attack", rows)
    found = {"attack": rows, "attack_steps": worst.steps, "attack_corrected": worst.corrected}
    if certified.budgeted is not None:
        budget = certified.budgeted.budget
        found["budget_spent"] = float(max(_part(worst.excess, budget.excess), _part(worst.residue, budget.residue)))
    return found


def corrected_steps(skill: SharedControlTemplate, certified: Certified) -> np.ndarray:
    """(N,), at which steps a command, its speed or its acceleration can depend on a correction."""
    touched = certified.touched
    if skill.primitive.history:
        return np.logical_or.accumulate(touched)
    return touched | np.append(False, touched[:-1]) | np.append([False, False], touched[:-2])


def _declared_start(task: str, options: Mapping[str, Any], size: int) -> np.ndarray:
    """(O,), how far beside its start the environment's history may begin: a reset's draw, and a pose's error."""
    declared = EnvConfig.resolve(task, options).make_task().start_within()
    try:
        within = np.array(np.broadcast_to(declared, size), dtype=float)
    except (TypeError, ValueError):
        raise InputError(f"start_within of {task} is a number, or {size} of them, not {brief(declared)}") from None
    within[:3] += float(options.get("pose_bias", 0.0))
    return within


def _part(found: np.ndarray, budget: np.ndarray) -> float:
    return float(np.max(np.divide(found, budget, out=np.zeros_like(found), where=budget > 0.0), initial=0.0))


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
