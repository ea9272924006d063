"""What a policy's action of ±1 is worth, per output (design: "Units of an action").

The null-space projector is about the posterior's variance, so that a raw action of size one moves a demonstration in
millimetres by next to nothing. A policy acts in [−1, 1]; the gain behind it is computed. Without active constraints the
loop history → next point is linear, and both numbers that describe a gain follow from it exactly, for the hold that is
used:

- authority: where a constant ±1 ends up, in demonstration standard deviations;
- exploration RMS: what white actions stir up, in the same unit.
"""

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.primitives.lc_ns_kmp import LcNsKmp
from guiderail.models.primitives.reference import ReferenceTrajectory


def unit_authority(primitive: LcNsKmp, outputs: np.ndarray | None = None) -> np.ndarray:
    """RMS over the motion of what a constant raw action of one in an output does to that output [output], (O,).

    An output that is not explored (see `outputs`) has authority zero.
    """
    action_dims = _explored(primitive, outputs)
    response = _constant_response(primitive)
    authority = np.sqrt(np.mean(np.einsum("noo->no", response) ** 2, axis=0))
    return np.where(action_dims, authority, 0.0)


def authority_gains(primitive: LcNsKmp, action_scale: float = 1.0, outputs: np.ndarray | None = None) -> np.ndarray:
    """Gains (O,) with which a constant ±1 action ends up √3 κ demonstration standard deviations away.

    √3 because that is KGRL's own relation: uniform actions in ±1 then have an RMS of κ standard deviations. Both are
    taken as RMS over the whole motion, so that the wide regions, where there is something to explore, decide. The hold
    does not enter: a constant action is constant at any hold.

    Args:
        primitive: whose loop is calibrated.
        action_scale: κ, positive.
        outputs: indices of the outputs that are explored; all unless given. The others get a gain of zero.

    Raises:
        InputError: if κ is not positive, an index does not exist, or the primitive has no null space (β = 0).
    """
    _check_kappa(action_scale)
    action_dims = _explored(primitive, outputs)
    authority = unit_authority(primitive, outputs)
    _refuse_deaf(primitive, authority[action_dims])
    target = np.sqrt(3) * action_scale * deviation(primitive.reference)
    return np.divide(target, authority, out=np.zeros_like(target), where=action_dims)


def rms_gains(
    primitive: LcNsKmp, action_scale: float = 1.0, action_repeat: int = 1, outputs: np.ndarray | None = None
) -> np.ndarray:
    """Gains (O,) with which uniform white actions in ±1 stir up an RMS of κ demonstration standard deviations.

    This is what exploration strategies must share before their smoothness is compared. Outputs are coupled through the
    demonstrations' correlations; the gains solve for all of them together.

    Args:
        primitive: whose loop is calibrated.
        action_scale: κ, positive.
        hold: control steps an action lasts, at least 1.
        outputs: indices of the outputs that are explored; all unless given. The others get a gain of zero.

    Raises:
        InputError: as `authority_gains`, or if the demonstrations' correlations leave no gains that reach κ everywhere.
    """
    _check_kappa(action_scale)
    action_dims = np.flatnonzero(_explored(primitive, outputs))
    power = _white_power(primitive, action_repeat)[np.ix_(action_dims, action_dims)]
    _refuse_deaf(primitive, np.sqrt(power.diagonal()))
    squared = np.linalg.solve(power, (action_scale * deviation(primitive.reference)[action_dims]) ** 2)
    if (squared <= 0).any():
        raise InputError("the outputs are too correlated to explore all of them alike: name fewer in outputs=")
    gains = np.zeros(primitive.num_outputs)
    gains[action_dims] = np.sqrt(squared)
    return gains


def exploration_rms(primitive: LcNsKmp, gains: np.ndarray, action_repeat: int = 1) -> np.ndarray:
    """RMS over the motion, in demonstration standard deviations, of uniform white actions in ±1 times `gains`, (O,)."""
    return np.sqrt(_white_power(primitive, action_repeat) @ np.asarray(gains, dtype=float) ** 2) / deviation(
        primitive.reference
    )


def authority(primitive: LcNsKmp, gains: np.ndarray) -> np.ndarray:
    """Where a constant ±1 action times `gains` ends up, in demonstration standard deviations, (O,)."""
    return unit_authority(primitive) * np.asarray(gains, dtype=float) / deviation(primitive.reference)


def deviation(reference: ReferenceTrajectory) -> np.ndarray:
    """RMS over the motion of the demonstrations' standard deviations, (O,)."""
    return np.sqrt(np.mean(reference.standard_deviations**2, axis=0))


def _check_kappa(action_scale: float) -> None:
    if not (np.isfinite(action_scale) and action_scale > 0):
        raise InputError(
            f"action_scale is how many standard deviations are explored and must be positive, not {action_scale}"
        )


def _refuse_deaf(primitive: LcNsKmp, response: np.ndarray) -> None:
    if not (response > 0).all():
        raise InputError(f"null-space actions do nothing to this primitive (beta = {primitive.beta}): use beta > 0")


def _explored(primitive: LcNsKmp, outputs: np.ndarray | None) -> np.ndarray:
    mask = np.zeros(primitive.num_outputs, dtype=bool)
    if outputs is not None and np.asarray(outputs).dtype == bool:
        outputs = np.flatnonzero(outputs)
    indices = np.arange(primitive.num_outputs) if outputs is None else np.asarray(outputs, dtype=int)
    if not len(indices) or indices.min() < 0 or indices.max() >= primitive.num_outputs:
        raise InputError(f"action_dims must be among 0 … {primitive.num_outputs - 1}: {indices.tolist()}")
    mask[indices] = True
    return mask


def _closed_loop(primitive: LcNsKmp, actions: np.ndarray) -> np.ndarray:
    """Deviations (N, O, B) from the action-free motion under raw actions (N, O, B), with commanded history."""
    steps, outputs, batch = actions.shape
    history = primitive.history
    past = np.zeros((history + steps, outputs, batch))
    for n in range(steps):
        history_map, action_map, _ = primitive.linear_response(n)
        past[history + n] = action_map @ actions[n]
        if history:
            past[history + n] += history_map @ past[n : n + history].reshape(-1, batch)
    return past[history:]


def _constant_response(primitive: LcNsKmp) -> np.ndarray:
    """(N, O, O): what a constant raw action of one in output j does to output i."""
    actions = np.broadcast_to(np.eye(primitive.num_outputs), (primitive.num_steps,) + (primitive.num_outputs,) * 2)
    return _closed_loop(primitive, actions)


def _white_power(primitive: LcNsKmp, action_repeat: int) -> np.ndarray:
    """(O, O): mean square of output i over the motion per squared gain of output j, uniform white actions, held."""
    if int(action_repeat) != action_repeat or action_repeat < 1:
        raise InputError(f"action_repeat is how many control steps an action lasts, at least 1, not {action_repeat}")
    steps, outputs = primitive.num_steps, primitive.num_outputs
    decisions = -(-steps // action_repeat)
    pulses = np.repeat(np.eye(decisions), action_repeat, axis=0)[:steps]
    power = np.zeros((outputs, outputs))
    for j in range(outputs):
        actions = np.zeros((steps, outputs, decisions))
        actions[:, j] = pulses
        power[:, j] = np.mean(np.sum(_closed_loop(primitive, actions) ** 2, axis=2), axis=0)
    return power / 3
