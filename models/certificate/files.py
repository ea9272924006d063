"""Files of a certificate: the primitive, its constraints, the certified bounds, and the data that prove them."""

import hashlib
import json
from collections.abc import Mapping
from io import BytesIO
from typing import Any

import numpy as np

from guiderail.models.certificate import checker
from guiderail.models.certificate.bounds import CertifiedBounds
from guiderail.models.certificate.loop import Bounds, CertifiedLoop
from guiderail.models.common.errors import InputError
from guiderail.models.primitives.kernels import kernel_name

PRIMITIVE, CONSTRAINTS, WITNESS, CERTIFICATE = "primitive.npz", "constraints.npz", "witness.npz", "certificate.json"
FORMAT = "guiderail certificate 3"
# The checker has digests of these sentences in `ASSUMED`.
ASSUMPTIONS = (
    "actions are numbers in [-1, 1], as the environment and the skill's diagram clip them, held for any time",
    "the skill is executed from its first step to its last with the given period, and begins at rest within the start",
    "the history consists of commands, and its length is constant",
    "the quadratic program is solved if a constraint is active: a fallback repeats the last command and is counted",
    "the impedance has the given stiffness and saturates at its limits; forces are its own, without impacts",
    "`rest_force` holds for a robot at rest between the least and the greatest command",
)
BUDGET = (
    "`budgeted` holds for sequences whose corrections satisfy two budgets, each at one step and in total: their excess "
    "over actions of [-1, 1], and their displacement of outputs that no action moves. An adversary reached at most two "
    "thirds of them; that they are satisfied is not proven"
)
OTHER_CLOCK = (
    "the period differs from the clock of the primitive: it is executed slower or faster than it was demonstrated"
)
CLOCK_TOLERANCE = 1e-6  # relative difference of period and clock


def certificate_files(
    loop: CertifiedLoop,
    certified: CertifiedBounds,
    stiffness: np.ndarray | None,
    limits: np.ndarray | None,
    about: Mapping[str, Any],
) -> dict[str, bytes]:
    """Return the content of each file of a certificate by its name.

    Args:
        loop: Certified loop.
        certified: Bounds of the loop.
        stiffness: Stiffness (6,) of the impedance that executes it; None if the robot has none.
        limits: Limits (6,) of the impedance's wrench; None if the robot has none.
        about: Further information, such as the run that the certificate is about.

    Raises:
        InputError: If the checker does not know the primitive's kernel.
    """
    primitive = loop.primitive
    kernel: Any = primitive.kernel
    name = kernel_name(kernel)
    if name not in checker.KERNELS:
        raise InputError(f"the checker of certificates has no kernel {kernel}: choose {' or '.join(checker.KERNELS)}")
    reference, constraints = primitive.reference, primitive.constraints
    arrays = {
        "inputs": reference.inputs(np.arange(-primitive.history, primitive.num_steps + primitive.horizon)),
        "means": reference.means,
        "covariances": reference.covariances,
        "length_scale": kernel.length_scale,
        "lambda": primitive.lambda_,
        "beta": primitive.beta,
        "horizon": primitive.horizon,
        "history": primitive.history,
        "history_variance": primitive.history_variance,
        "gains": loop.gains,
        "start": loop.start,
        "start_within": loop.start_within,
    }
    witness = {"active": certified.can_be_active, "multipliers": certified.multipliers}
    if certified.budgeted is not None:
        witness |= {f"lagrange_{key}": getattr(certified.budgeted, key) for key in ("steps", "outputs", "multipliers")}
    files = {
        PRIMITIVE: _npz(arrays),
        CONSTRAINTS: _npz({"G": constraints.G, "c": constraints.c}),
        WITNESS: _npz(witness),
    }
    claims: dict[str, Any] = {
        "format": FORMAT,
        "about": dict(about),
        "assumes": list(ASSUMPTIONS),
        "digests": {file: hashlib.sha256(content).hexdigest() for file, content in files.items()},
        "kernel": name,
        "period": loop.period,
        "free": _as_lists(certified.free),
        "always": _as_lists(certified.always),
    }
    regimes = {"always": certified.always}
    if certified.budgeted is not None:
        regimes["budgeted"] = certified.budgeted.bounds
        budget = certified.budgeted.budget
        assumed = {"excess": budget.excess.tolist(), "residue": budget.residue.tolist()}
        claims["budgeted"] = _as_lists(certified.budgeted.bounds) | assumed
        claims["assumes"].append(BUDGET)
    clock = np.diff(reference.inputs(np.array([0, primitive.num_steps - 1])))[0] / (primitive.num_steps - 1)
    if abs(loop.period - clock) > CLOCK_TOLERANCE * clock:
        claims["assumes"].append(OTHER_CLOCK)
    if stiffness is not None and limits is not None:
        claims |= {"stiffness": list(map(float, stiffness)), "limits": list(map(float, limits))}
        claims["force"] = float(np.linalg.norm(limits[:3]))
        for regime, bounds in regimes.items():
            at_rest = np.minimum(limits, np.asarray(stiffness) * (bounds.upper.max(axis=0) - bounds.lower.min(axis=0)))
            claims[regime]["rest_force"] = float(np.linalg.norm(at_rest[:3]))
    claims["digest"] = digest(claims)
    return {**files, CERTIFICATE: json.dumps(claims).encode()}


def digest(claims: Mapping[str, Any]) -> str:
    """Compute the digest of the content of `certificate.json` except for the digest itself."""
    content = json.dumps({key: value for key, value in claims.items() if key != "digest"}, sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()


def _as_lists(bounds: Bounds) -> dict[str, Any]:
    """Return bounds as lists, None for an infinite bound."""
    return {
        name: [[float(x) if np.isfinite(x) else None for x in row] for row in getattr(bounds, name)]
        for name in ("lower", "upper", "speed", "acceleration")
    }


def _npz(arrays: Mapping[str, Any]) -> bytes:
    content = BytesIO()
    values: dict[str, Any] = {name: np.asarray(value) for name, value in arrays.items()}
    np.savez_compressed(content, **values)  # most multipliers are zero
    return content.getvalue()
