"""Files of a certificate: the primitive, its constraints, the certified bounds, and the data that prove them."""

import hashlib
import hmac
import json
from collections.abc import Mapping
from io import BytesIO
from typing import Any, cast

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.control.wrench import impact_ratio
from guiderail.models.primitives.kernels import kernel_name
from guiderail_studies.certificate import checker
from guiderail_studies.certificate.bounds import CertifiedBounds
from guiderail_studies.certificate.loop import Bounds, CertifiedLoop

PRIMITIVE, CONSTRAINTS, WITNESS, CERTIFICATE = "primitive.npz", "constraints.npz", "witness.npz", "certificate.json"
FORMAT = "guiderail certificate 7"
OUTWARD = 1e-5  # margin of all claims for the rounding of primitive and checker, relative to the largest value
# The checker has digests of these sentences in `ASSUMED`.
ASSUMPTIONS = (
    "actions are numbers in [-1, 1], as the environment and the skill's diagram clip them, held for any time",
    "the skill is executed from its first step to its last with the given period, and begins at rest within the start",
    "the history consists of commands, and its length is constant",
    "the quadratic program is solved if a constraint is active: a fallback is within the constraints and is counted",
    "the impedance has the given stiffness and saturates at its limits; `force` and `rest_force` are its own",
    "`rest_force` holds for a robot at rest between the least and the greatest command",
    "`impacts` are of contacts of 1, 2, 4 and 8 times `contact_stiffness`, to which the impedance limits the approach "
    "speed, without the controller's delay, joint friction, and a contact that adds energy",
)
STIFFNESS_RATIOS = (1.0, 2.0, 4.0, 8.0)  # contacts with claimed impacts, relative to `contact_stiffness`
BUDGET = (
    "`budgeted` holds for sequences whose corrections satisfy two budgets, each at one step and in total: their excess "
    "over actions of [-1, 1], and their displacement of outputs that no action moves. A search of 100,000 steps needed "
    "at most two thirds of them; that they are satisfied is not proven, and a longer search can exceed them"
)
OTHER_CLOCK = (
    "the period differs from the clock of the primitive: it is executed slower or faster than it was demonstrated"
)
CLOCK_TOLERANCE = 1e-6  # largest relative difference of period and clock without `OTHER_CLOCK`


def certificate_files(
    loop: CertifiedLoop,
    certified: CertifiedBounds,
    stiffness: np.ndarray | None,
    limits: np.ndarray | None,
    contact_stiffness: float,
    about: Mapping[str, Any],
    key: bytes | None = None,
) -> dict[str, bytes]:
    """Return the content of each file of a certificate by its name.

    Args:
        loop: Certified loop.
        certified: Bounds of the loop.
        stiffness: Stiffness (6,) [N/m, Nm/rad] of the impedance that executes the commands; None if the robot has no
            impedance.
        limits: Limits (6,) of the impedance's wrench [N, Nm]; None if the robot has no impedance.
        contact_stiffness: Stiffness of a contact for which the impedance limits the approach speed [N/m]; 0 if it does
            not.
        about: Texts that identify the skill, by name: the task, and further texts such as the run.
        key: Key of the signature; None for no signature. The checker rejects a key of fewer than 16 bytes.

    Raises:
        InputError: If the checker does not support the primitive's kernel, or the primitive's time steps are not equal.
    """
    name = _checked_kernel(loop)
    primitive_arrays, constraint_arrays = _subject_arrays(loop)
    clock = float(primitive_arrays["clock"])
    witness = {"active": certified.can_be_active, "multipliers": certified.multipliers}
    if certified.budgeted is not None:
        witness |= {f"lagrange_{k}": getattr(certified.budgeted, k) for k in ("steps", "outputs", "multipliers")}
    files = {PRIMITIVE: _npz(primitive_arrays), CONSTRAINTS: _npz(constraint_arrays), WITNESS: _npz(witness)}
    claims: dict[str, Any] = {
        "format": FORMAT,
        "about": dict(about),
        "assumes": list(ASSUMPTIONS),
        "digests": {file: hashlib.sha256(content).hexdigest() for file, content in files.items()},
        "kernel": name,
        "period": float(loop.period),
        "free": _as_lists(certified.free),
        "always": _as_lists(certified.always),
        "budgeted": None,
        "impedance": None,
    }
    regimes = {"always": certified.always}
    if certified.budgeted is not None:
        regimes["budgeted"] = certified.budgeted.bounds
        budget = certified.budgeted.budget
        assumed = {"excess": budget.excess.tolist(), "residue": budget.residue.tolist()}
        claims["budgeted"] = _as_lists(certified.budgeted.bounds) | assumed
        claims["assumes"].append(BUDGET)
    if abs(loop.period - clock) > CLOCK_TOLERANCE * clock:
        claims["assumes"].append(OTHER_CLOCK)
    if stiffness is not None and limits is not None:
        rest_force = {}
        for regime, bounds in regimes.items():
            largest = np.asarray(stiffness) * (bounds.upper.max(axis=0) - bounds.lower.min(axis=0))
            rest_force[regime] = (1.0 + OUTWARD) * float(np.linalg.norm(np.minimum(limits, largest)[:3]))
        force = (1.0 + OUTWARD) * float(np.linalg.norm(limits[:3]))
        ratios = STIFFNESS_RATIOS if contact_stiffness else ()
        claims["impedance"] = {
            "stiffness": list(map(float, stiffness)),
            "limits": list(map(float, limits)),
            "contact_stiffness": float(contact_stiffness),
            "force": force,
            "rest_force": rest_force,
            "impacts": [force * impact_ratio(ratio) for ratio in ratios],
        }
    return {**files, CERTIFICATE: seal(claims, key)}


def seal(claims: Mapping[str, Any], key: bytes | None = None) -> bytes:
    """Return the text of claims with their digest, which needs no key, and with a signature if a key is given."""
    content = {name: value for name, value in claims.items() if name not in ("digest", "signature")}
    content["digest"] = hashlib.sha256(checker.canonical(content).encode()).hexdigest()
    if key is not None:
        content["signature"] = hmac.new(key, content["digest"].encode(), hashlib.sha256).hexdigest()
    return checker.canonical(content).encode()


def compare_subject(
    files: Mapping[str, bytes],
    loop: CertifiedLoop,
    stiffness: np.ndarray | None,
    limits: np.ndarray | None,
    contact_stiffness: float,
    about: Mapping[str, Any],
) -> str | None:
    """Return the name of the first difference between a certificate and a skill, or None.

    All inputs of the checker except the budget are compared: the skill's description, kernel, period, impedance,
    primitive, gains, start and constraints. `files` contains the files of a certificate that the checker accepts, by
    name; the other arguments describe the skill as in `certificate_files`.

    Raises:
        InputError: If the skill cannot be certified, as in `certificate_files`.
    """
    claims = json.loads(files[CERTIFICATE])
    claimed = {name: claims[name] for name in ("about", "kernel", "period")}
    claimed |= {name: (claims["impedance"] or {}).get(name) for name in ("stiffness", "limits", "contact_stiffness")}
    own: dict[str, Any] = {"about": dict(about), "kernel": _checked_kernel(loop), "period": float(loop.period)}
    own |= {"stiffness": stiffness, "limits": limits}
    own |= {name: list(map(float, own[name])) for name in ("stiffness", "limits") if own[name] is not None}
    own["contact_stiffness"] = None if stiffness is None else float(contact_stiffness)
    different = [name for name, value in own.items() if claimed[name] != value]
    for file, arrays in zip((PRIMITIVE, CONSTRAINTS), _subject_arrays(loop), strict=True):
        with np.load(BytesIO(files[file])) as written:
            different += [name for name, value in arrays.items() if not np.array_equal(written[name], value)]
    return next(iter(different), None)


def _checked_kernel(loop: CertifiedLoop) -> str:
    """Return the name of the primitive's kernel; raise an InputError if the checker does not support it."""
    kernel: Any = loop.primitive.kernel
    name = kernel_name(kernel)
    if name is None or name not in checker.KERNELS:
        raise InputError(f"the checker of certificates has no kernel {kernel}: choose {' or '.join(checker.KERNELS)}")
    return name


def _subject_arrays(loop: CertifiedLoop) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the arrays of the primitive and its loop, and the arrays of its constraints at every step.

    Raises:
        InputError: If the primitive's time steps are not equal.
    """
    primitive, kernel = loop.primitive, cast(Any, loop.primitive.kernel)
    reference = primitive.reference
    if not reference.uniform:
        raise InputError("a certificate needs a primitive with an even clock: resample the demonstrations")
    arrays = {
        "clock": float((reference.times[-1] - reference.times[0]) / (primitive.num_steps - 1)),
        "means": reference.means,
        "covariances": reference.covariances,
        "length_scale": float(kernel.length_scale),
        "lambda": primitive.lambda_,
        "beta": primitive.beta,
        "horizon": primitive.horizon,
        "history": primitive.history,
        "history_variance": primitive.history_variance,
        "gains": np.asarray(loop.gains, dtype=float),
        "start": np.asarray(loop.start, dtype=float),
        "start_within": np.asarray(loop.start_within, dtype=float),
    }
    G, c = primitive.constraints.window(np.arange(primitive.num_steps))
    return arrays, {"G": G, "c": c}


def _as_lists(bounds: Bounds) -> dict[str, Any]:
    """Return bounds, widened by the margin `OUTWARD`, as lists with None for an infinite bound."""
    lists = {}
    for name in ("lower", "upper", "speed", "acceleration"):
        values = getattr(bounds, name)
        margin = OUTWARD * np.abs(np.where(np.isfinite(values), values, 0.0)).max(axis=0)
        widened = values - margin if name == "lower" else values + margin
        lists[name] = [[float(x) if np.isfinite(x) else None for x in row] for row in widened]
    return lists


def _npz(arrays: Mapping[str, Any]) -> bytes:
    content = BytesIO()
    values: dict[str, Any] = {name: np.asarray(value) for name, value in arrays.items()}
    np.savez_compressed(content, **values)  # most multipliers are zero
    return content.getvalue()
