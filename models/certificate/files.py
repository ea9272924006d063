"""A certificate as files: what the primitive is, what constrains it, what is claimed, and what proves it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from io import BytesIO
from typing import Any

import numpy as np

from guiderail.models.certificate import checker
from guiderail.models.certificate.bounds import Certified
from guiderail.models.certificate.loop import Bounds, SharedControlTemplate
from guiderail.models.common.errors import InputError
from guiderail.models.primitives.kernels import kernel_name

PRIMITIVE, CONSTRAINTS, WITNESS, CERTIFICATE = "primitive.npz", "constraints.npz", "witness.npz", "certificate.json"
FORMAT = "guiderail certificate 3"
ASSUMPTIONS = (
    "actions are numbers in [-1, 1], as the environment and the skill's diagram clip them, held for any time",
    "the skill is executed from its first step to its last, at the period given, and begins at rest within the start",
    "the history is of commands, of one length",
    "the quadratic program is solved whenever it must be: a fallback repeats the last command, and is counted",
    "the impedance saturates at its limits and has the stiffness given; forces are what it pushes with, not impacts",
    "`rest_force` holds while the robot is between the least and the greatest of the commands, and at rest",
)
BUDGET = (
    "`budgeted` holds for sequences whose corrections keep two budgets, each at one step and in all: what they exceed "
    "actions of [-1, 1] by, and what else they do to outputs that no action moves. An adversary found no more than two "
    "thirds of them: that they are kept is not proved"
)

OTHER_CLOCK = (
    "the period is not the one between two inputs of the primitive: it is executed slower or faster than it was shown"
)
CLOCK_AGREES = 1e-6  # of that: how well the two are the same


def certificate_files(
    skill: SharedControlTemplate,
    certified: Certified,
    stiffness: np.ndarray | None,
    limits: np.ndarray | None,
    about: Mapping[str, Any],
) -> dict[str, bytes]:
    """What each file of a certificate holds, by its name.

    Args:
        skill: what was certified.
        certified: what holds of it.
        stiffness, limits: of the impedance that executes it, (6,) each; None where a robot has none.
        about: what else is written down, such as which run it is of.

    Raises:
        InputError: if the primitive's kernel is none that the checker knows.
    """
    primitive = skill.primitive
    kernel: Any = primitive.kernel
    name = kernel_name(kernel)
    if name not in checker.KERNELS:
        raise InputError(f"the checker of certificates has no kernel {kernel}: choose {' or '.join(checker.KERNELS)}")
    reference, constraints = primitive.reference, primitive.constraints
    numbers = {
        "inputs": reference.inputs(np.arange(-primitive.history, primitive.num_steps + primitive.horizon)),
        "means": reference.means,
        "covariances": reference.covariances,
        "length_scale": kernel.length_scale,
        "lambda": primitive.lambda_,
        "beta": primitive.beta,
        "horizon": primitive.horizon,
        "history": primitive.history,
        "history_variance": primitive.history_variance,
        "gains": skill.gains,
        "start": skill.start,
        "start_within": skill.start_within,
    }
    files = {
        PRIMITIVE: _npz(numbers),
        CONSTRAINTS: _npz({"G": constraints.G, "c": constraints.c}),
        WITNESS: _npz({"touched": certified.touched, "multipliers": certified.multipliers} | _prices(certified)),
    }
    claims: dict[str, Any] = {
        "format": FORMAT,
        "about": dict(about),
        "assumes": list(ASSUMPTIONS),
        "digests": {name: hashlib.sha256(content).hexdigest() for name, content in files.items()},
        "kernel": name,
        "period": skill.period,
        "free": _bounds(certified.free),
        "always": _bounds(certified.always),
    }
    regimes = {"always": certified.always}
    if certified.budgeted is not None:
        regimes["budgeted"] = certified.budgeted.bounds
        budget = certified.budgeted.budget
        assumed = {"excess": budget.excess.tolist(), "residue": budget.residue.tolist()}
        claims["budgeted"] = _bounds(certified.budgeted.bounds) | assumed
        claims["assumes"].append(BUDGET)
    clock = np.diff(reference.inputs(np.array([0, primitive.num_steps - 1])))[0] / (primitive.num_steps - 1)
    if abs(skill.period - clock) > CLOCK_AGREES * clock:
        claims["assumes"].append(OTHER_CLOCK)
    if stiffness is not None and limits is not None:
        claims |= {"stiffness": list(map(float, stiffness)), "limits": list(map(float, limits))}
        claims["force"] = float(np.linalg.norm(limits[:3]))
        for name, bounds in regimes.items():
            at_rest = np.minimum(limits, np.asarray(stiffness) * (bounds.upper.max(axis=0) - bounds.lower.min(axis=0)))
            claims[name]["rest_force"] = float(np.linalg.norm(at_rest[:3]))
    claims["digest"] = digest(claims)
    return {**files, CERTIFICATE: json.dumps(claims).encode()}


def _prices(certified: Certified) -> dict[str, np.ndarray]:
    found = certified.budgeted
    return {} if found is None else {"at": found.steps, "of": found.outputs, "prices": found.prices}


def digest(claims: Mapping[str, Any]) -> str:
    """Of everything that a certificate says but its digest."""
    told = json.dumps({key: value for key, value in claims.items() if key != "digest"}, sort_keys=True)
    return hashlib.sha256(told.encode()).hexdigest()


def _bounds(bounds: Bounds) -> dict[str, Any]:
    """Infinite bounds are null: nothing is known."""
    return {
        name: [[float(x) if np.isfinite(x) else None for x in row] for row in getattr(bounds, name)]
        for name in ("lower", "upper", "speed", "acceleration")
    }


def _npz(arrays: Mapping[str, Any]) -> bytes:
    content = BytesIO()
    values: dict[str, Any] = {name: np.asarray(value) for name, value in arrays.items()}
    np.savez_compressed(content, **values)  # most multipliers are zero
    return content.getvalue()
