"""Certificates of skills: proven bounds on their commands for any policy, written as files and checked."""

from __future__ import annotations

import hashlib
import itertools
import json
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_prior_knowledge
from guiderail.diagrams.stations.options import Disturbances
from guiderail.diagrams.stations.station import Impedance
from guiderail.models.common.arrays import as_whole
from guiderail.models.common.errors import InputError, brief
from guiderail.models.control.wrench import impact_ratio
from guiderail.tools.environments import changed_environment, check_environment
from guiderail.tools.files import write_atomically
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.pretrained import find_run
from guiderail.tools.tables import write_table
from guiderail_studies.certificate import checker
from guiderail_studies.certificate.adversary import QUANTITIES, Adversary, AttackResult
from guiderail_studies.certificate.bounds import CertifiedBounds, certify
from guiderail_studies.certificate.files import CERTIFICATE, STIFFNESS_RATIOS, certificate_files, compare_subject
from guiderail_studies.certificate.lagrange_bounds import Budget
from guiderail_studies.certificate.loop import Bounds, CertifiedLoop

GUIDANCE = ("kmp", "kgrl", "skgrl")  # guidance that can be certified
SEARCH_STEPS = 100_000  # steps of the adversary that determines the budgets
BUDGET_MARGIN = 1.5  # ratio of the budgets to the worst corrections of the adversary
# Amounts added to the budget of the excess, at one step and in total; see `Budget.excess`.
MIN_EXCESS = ((0.01,), (0.1,))
MIN_KEY_BYTES = 16  # shortest key that the checker accepts
ROUNDING = 1.0 + 1e-6  # tolerance factor: an adversary may reach an exact bound up to rounding


def certify_skill(
    subject: str,
    environment: Mapping[str, Any],
    *,
    out: Path | None = None,
    start_within: float | None = None,
    attack: int = 0,
    key: Path | None = None,
) -> dict[str, Any]:
    """Write a certificate and check it in a separate process.

    Args:
        subject: Folder of a run, `pretrained:NAME`, or name of a task.
        environment: Options that replace options of the run's or the task's environment.
        out: Folder to write; `certificate` in the run's folder by default.
        start_within: Largest start offset of the robot in any output [unit of the output]; by default the task's
            declared offset plus the error of the pose measurement.
        attack: Number of steps in which an adversary tries to leave the bounds; the results are written to
            `attack.csv`.
        key: File of the key that signs the certificate; None: no signature.

    Returns:
        Path of the certificate, verdict of the checker, and extreme bounds of each regime (until a constraint becomes
        active, always, and within the budgets); after an attack also the rows of `attack.csv` and the share of the
        budgets that corrections used.

    Raises:
        InputError: If there is no such run or task, its guidance cannot be certified, or an argument is invalid.
    """
    as_whole(attack, "the number of steps of an attack", 0)
    skill = _find_skill(subject, environment, start_within)
    signing_key = _read_key(key)
    if out is None:
        if not Path(subject).is_dir():
            raise InputError("a certificate of a task or of pretrained:NAME needs a folder: name it with --out")
        out = Path(subject) / "certificate"
    loop, primitive = skill.loop, skill.loop.primitive
    budget = None
    if primitive.history:
        worst = _search_budget(loop)
        budget = Budget(BUDGET_MARGIN * worst.excess + np.array(MIN_EXCESS), BUDGET_MARGIN * worst.residue)
    certified = certify(loop, budget)
    files = certificate_files(loop, certified, *skill.impedance, skill.about, signing_key)
    for name, content in files.items():
        write_atomically(out / name, content)
    start_time = time.perf_counter()
    verdict = _run_checker(out, key)
    seconds = time.perf_counter() - start_time
    result: dict[str, Any] = {
        "certificate": str(out / CERTIFICATE),
        "checker": verdict,
        "checker_seconds": round(seconds, 1),
        "start_within": loop.start_within.tolist(),
        "steps": primitive.num_steps,
        "constrained_steps": int(certified.can_be_active.sum()),
    }
    regimes = {"while_free": certified.free, "always": certified.always}
    if certified.budgeted is not None:
        regimes["budgeted"] = certified.budgeted.bounds
    for regime, bounds in regimes.items():
        result |= {f"{regime}_{name}": value for name, value in _extremes(bounds).items()}
    _, limits, contact = skill.impedance
    if limits is not None:
        result["force"] = force = float(np.linalg.norm(limits[:3]))
        if contact:
            names = {ratio: f"impact_at_{ratio * contact / 1e3:.0f}_N_per_mm" for ratio in STIFFNESS_RATIOS}
            result |= {name: force * impact_ratio(ratio) for ratio, name in names.items()}
    if attack:
        result |= _attack(loop, certified, attack, out)
    return result


def verify_certificate(
    subject: str,
    environment: Mapping[str, Any],
    folder: Path,
    *,
    start_within: float | None = None,
    key: Path | None = None,
) -> dict[str, Any]:
    """Check a certificate, and compare its assumptions with a skill.

    The checker proves that the bounds follow from the primitive, the constraints, the impedance and the budget in the
    files. This function also computes primitive, constraints and impedance from the skill, and compares them with the
    files. It then repeats the search for the worst corrections, which must not exceed the budget.

    Args:
        subject: Folder of a run, `pretrained:NAME`, or name of a task.
        environment: As in `certify_skill`.
        folder: Folder of the certificate.
        start_within: As in `certify_skill`.
        key: File of the key that signed the certificate; None: the signature is not checked.

    Returns:
        The certificate's path and the verdict, "yes" or "no" with the reason.

    Raises:
        InputError: As in `certify_skill`, or if the folder has no certificate.
    """
    _read_key(key)
    skill = _find_skill(subject, environment, start_within)
    if not (folder / CERTIFICATE).is_file():
        raise InputError(f"there is no {CERTIFICATE} in {folder}: name the folder of a certificate")
    verdict = _run_checker(folder, key)
    if verdict == "yes":
        files = {name: (folder / name).read_bytes() for name in (CERTIFICATE, *checker.ARRAYS)}
        different = compare_subject(files, skill.loop, *skill.impedance, skill.about)
        if different is not None:
            if different == "about":
                different = _different_option(json.loads(files[CERTIFICATE])["about"], skill.about)
            verdict = f"no: the certificate's {different} is not that of {subject}"
        elif (budgeted := json.loads(files[CERTIFICATE])["budgeted"]) is not None:
            worst = _search_budget(skill.loop)
            for name in checker.BUDGETS:
                if not (getattr(worst, name) <= np.array(budgeted[name])).all():  # NaN exceeds every budget
                    verdict = f"no: corrections of {subject} exceed the certificate's budget of {name}"
    return {"certificate": str(folder / CERTIFICATE), "checker": verdict}


@dataclass(frozen=True)
class _Skill:
    """Subject of a certificate."""

    loop: CertifiedLoop  # primitive in its feedback loop
    # Stiffness of the impedance and limits of its wrench, or None and None; stiffness of the contact [N/m] for which it
    # limits the approach speed, or 0.
    impedance: tuple[np.ndarray | None, np.ndarray | None, float]
    about: dict[str, Any]  # description of the run or task, stored in the certificate


def _find_skill(subject: str, environment: Mapping[str, Any], start_within: float | None) -> _Skill:
    """Return the skill of a run or a task; raise an InputError if its guidance cannot be certified."""
    task, arguments, about = _find_subject(subject, environment)
    options = check_environment(task, arguments)
    config, guidance = EnvConfig.resolve(task, options), str(options["guidance"])
    if guidance not in GUIDANCE or options.get("history.adaptive") or options.get("history.source") == "measured":
        raise InputError(
            f"guidance={guidance!r} cannot be certified: use {' or '.join(GUIDANCE)}, with a "
            "history of fixed length that contains commands (neither history.adaptive nor history.source=measured)"
        )
    loop = _make_loop(config, start_within)
    impedance = config.declared.impedance()
    if impedance is None and loop.primitive.num_outputs == len(Impedance().stiffness):
        impedance = Impedance()
    if impedance is None:
        return _Skill(loop, (None, None, 0.0), about)
    stiffness = options.get("disturbances.stiffness_factor", 1.0) * np.array(impedance.stiffness)
    contact_stiffness = 0.0 if impedance.bound is None else impedance.bound.contact_stiffness
    return _Skill(loop, (stiffness, np.array(impedance.limits), contact_stiffness), about)


def _search_budget(loop: CertifiedLoop) -> AttackResult:
    """Return the worst corrections that an adversary finds in `SEARCH_STEPS` steps of a loop with a history."""
    every_step = np.ones(loop.primitive.num_steps, bool)
    return Adversary(loop, every_step, seed=SEARCH_STEPS, attacks_budgets=True).attack(SEARCH_STEPS)


def _run_checker(folder: Path, key: Path | None) -> str:
    """Run the checker in a separate process and return its output."""
    command = [sys.executable, checker.__file__, str(folder), *([] if key is None else [str(key)])]
    process = subprocess.run(command, capture_output=True, text=True)
    return (process.stdout or process.stderr).strip()


def _read_key(key: Path | None) -> bytes | None:
    """Return the content of a key file; raise an InputError if it cannot be read or is too short."""
    if key is None:
        return None
    try:
        content = checker.content(key)
    except OSError as error:
        raise InputError(f"the key {key} can't be read ({error.strerror or error}): check the path") from error
    if len(content) < MIN_KEY_BYTES:
        raise InputError(f"a key needs at least {MIN_KEY_BYTES} bytes: create one with head -c 32 /dev/urandom > {key}")
    return content


def _make_loop(config: EnvConfig, start_within: float | None) -> CertifiedLoop:
    """Build the feedback loop of an environment's primitive; raise an InputError if an option cannot be certified."""
    demonstrated = make_prior_knowledge(config).primitive
    assert demonstrated is not None  # all of `GUIDANCE` require demonstrations
    if demonstrated.motion is not None or demonstrated.progress is not None:
        raise InputError(
            "a certificate covers only linear constraints and progress=clock: leave out progress, max_speed, "
            "max_acceleration, joint_margin and shapes"
        )
    has_actions = config.guidance != "kmp"
    primitive = demonstrated.primitive(history=config.guidance == "skgrl", constrained=has_actions)
    # A reset starts at the demonstrations, not at the via-points that the primitive passes through.
    reference = config.reference()
    assert reference is not None
    start = primitive.constraints.nearest(reference.means[0])
    within = _declared_start(config, len(start)) if start_within is None else np.full(len(start), start_within)
    if not (np.isfinite(within).all() and (within >= 0.0).all()):
        raise InputError(f"the start offset must be finite and not negative, not {within.tolist()}")
    gains = demonstrated.null_space_gains(primitive) if has_actions else np.zeros(primitive.num_outputs)
    return CertifiedLoop(primitive, gains, demonstrated.control_period, start, within)


def _attack(loop: CertifiedLoop, certified: CertifiedBounds, steps: int, out: Path) -> dict[str, Any]:
    """Attack the bounds with an adversary; write and return a table of its worst values."""
    can_be_corrected = _find_corrected_steps(loop, certified)
    adversary = Adversary(loop, can_be_corrected)
    worst = adversary.attack(steps)
    bounds = certified.always if certified.budgeted is None else certified.budgeted.bounds
    certified_values = {
        "pose": np.maximum(bounds.upper - adversary.middle, adversary.middle - bounds.lower),
        "speed": bounds.speed,
        "acceleration": bounds.acceleration,
    }
    rows: list[dict[str, Any]] = []
    for quantity, is_corrected, output in itertools.product(QUANTITIES, (False, True), range(len(loop.gains))):
        steps_of_kind = can_be_corrected == is_corrected
        if steps_of_kind.any():
            bound = certified_values[quantity][steps_of_kind, output]
            value = worst.largest[quantity][steps_of_kind, output]
            rows.append(
                {
                    "quantity": quantity,
                    "output": output,
                    "constraint": "can be active" if is_corrected else "never active",
                    "bound": float(bound.max()),
                    "worst_found": float(value.max()),
                    "ratio": float(bound.max() / value.max()) if value.max() > 0.0 else None,
                    "violations": int((~(value <= bound * ROUNDING)).sum()),  # NaN counts as a violation
                }
            )
    write_table(out / "attack", rows)
    result = {"attack": rows, "attack_steps": worst.steps, "attack_corrected": worst.corrected}
    if certified.budgeted is not None:
        budget = certified.budgeted.budget
        used = max(_used_share(worst.excess, budget.excess), _used_share(worst.residue, budget.residue))
        result["budget_spent"] = float(used)
    return result


def _find_corrected_steps(loop: CertifiedLoop, certified: CertifiedBounds) -> np.ndarray:
    """Return the mask (N,) of steps whose command, speed or acceleration can depend on a correction."""
    active = certified.can_be_active
    if loop.primitive.history:
        return np.logical_or.accumulate(active)
    return active | np.append(False, active[:-1]) | np.append([False, False], active[:-2])


def _declared_start(config: EnvConfig, size: int) -> np.ndarray:
    """Return the largest measured start offset (O,): the offset of a reset plus the error of the pose measurement."""
    declared = config.declared.prior().start_within
    try:
        within = np.array(np.broadcast_to(declared, size), dtype=float)
    except (TypeError, ValueError):
        raise InputError(
            f"start_within of {config.task} must return a number or {size} numbers, not {brief(declared)}"
        ) from None
    disturbances = config.parts["disturbances"]
    if isinstance(disturbances, Disturbances):
        errors = disturbances.errors
        within[:3] += disturbances.pose_bias
        within += np.repeat(errors.calibration_error, 3) + 0.5 * np.repeat(errors.pose_resolution, 3)
    return within


def _used_share(spent: np.ndarray, budget: np.ndarray) -> float:
    return float(np.max(np.divide(spent, budget, out=np.zeros_like(spent), where=budget > 0.0), initial=0.0))


def _find_subject(subject: str, environment: Mapping[str, Any]) -> tuple[str, dict[str, Any], dict[str, Any]]:
    """Return the task, the options of its environment, and the description of a certificate's subject."""
    folder = find_run(subject)
    if not folder.is_dir():
        about = {"task": subject, "environment": {key: str(value) for key, value in environment.items()}}
        return subject, dict(environment), about
    config = RunFolder(folder).config()
    config.refuse_changed_task(folder, "certify the task by its name")
    content = (folder / "config.yaml").read_bytes()
    about = {"task": config.task, "config.yaml": hashlib.sha256(content).hexdigest()}
    return config.task, changed_environment(config.task, config.environment, environment), about


def _different_option(claimed: Mapping[str, Any], own: Mapping[str, Any]) -> str:
    """Return the name of the first difference between the descriptions of two subjects."""
    for a, b in ((claimed, own), (claimed.get("environment", {}), own.get("environment", {}))):
        for name in sorted({*a, *b} - {"environment"}):
            if a.get(name) != b.get(name):
                return name
    return "about"


def _extremes(bounds: Bounds) -> dict[str, list[float | None]]:
    """Return the extreme bounds of each output over all steps; None if an output is not bounded."""
    extremes = {
        "lower": bounds.lower.min(axis=0),
        "upper": bounds.upper.max(axis=0),
        "speed": bounds.speed.max(axis=0),
        "acceleration": bounds.acceleration.max(axis=0),
    }
    return {name: [float(x) if np.isfinite(x) else None for x in values] for name, values in extremes.items()}
