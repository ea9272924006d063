"""Gains from a policy's action in [−1, 1] to null-space units, per output.

The null-space projector is about as large as the posterior variance. If demonstrations vary by millimeters, a raw
action of size one therefore barely moves the output. Without active constraints, the map from history and action to the
next point is linear. Two measures of a gain are computed exactly from this map, for a given action repeat:

- authority: displacement by a constant action of ±1, in demonstration standard deviations;
- exploration RMS: root mean square of the displacement by uniform white actions in ±1, in the same unit.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from guiderail.models.common.arrays import as_numbers
from guiderail.models.common.errors import InputError, brief
from guiderail.models.primitives.lc_ns_kmp import LcNsKmp
from guiderail.models.primitives.reference import ReferenceTrajectory


def unit_authority(primitive: LcNsKmp, outputs: np.ndarray | None = None) -> np.ndarray:
    """Compute the displacement (O,) of each output by a constant raw action of one in the same output.

    The displacement [unit of the output] is the RMS over the motion. `outputs` are indices or a mask of the explored
    outputs, all by default. The result is zero for the outputs that are not explored.
    """
    explored = _explored_mask(primitive, outputs)
    # Displacement of output i by a constant raw action of one in output j, (N, O, O).
    response = _closed_loop(primitive, np.tile(np.eye(primitive.num_outputs), (primitive.num_steps, 1, 1)))
    authority = np.sqrt(np.mean(np.einsum("noo->no", response) ** 2, axis=0))
    return np.where(explored, authority, 0.0)


def authority_gains(primitive: LcNsKmp, action_scale: float = 1.0, outputs: np.ndarray | None = None) -> np.ndarray:
    """Compute gains (O,) with which a constant action of ±1 moves outputs by √3 κ demonstration standard deviations.

    The RMS of uniform actions in ±1 is 1/√3. The factor √3 therefore leads to an RMS displacement of κ standard
    deviations by uniform actions, if outputs are not coupled and a command depends on one action only, as in KGRL.
    Displacement and standard deviation are RMS over the whole motion, so that regions in which the demonstrations vary
    widely have the most influence. The result does not depend on the action repeat, because the action is constant.

    Args:
        primitive: Primitive to calibrate.
        action_scale: κ, positive.
        outputs: Indices or mask of the explored outputs, all by default; the others get a gain of zero.

    Raises:
        InputError: If κ is not positive, there is no explored output, an index does not exist, a mask does not have O
            entries, or the primitive has no null space (β = 0).
    """
    check_action_scale(action_scale)
    explored = _explored_mask(primitive, outputs)
    authority = unit_authority(primitive, outputs)
    _check_response(primitive, authority[explored])
    target = np.sqrt(3) * action_scale * deviation(primitive.reference)
    return np.divide(target, authority, out=np.zeros_like(target), where=explored)


def rms_gains(
    primitive: LcNsKmp, action_scale: float = 1.0, action_repeat: int = 1, outputs: np.ndarray | None = None
) -> np.ndarray:
    """Compute gains (O,) with which uniform white actions in ±1 cause an RMS of κ demonstration standard deviations.

    The smoothness of exploration strategies can only be compared at equal RMS. Outputs are coupled through the
    demonstrations' correlations, so that one system of equations determines all gains.

    Args:
        primitive: Primitive to calibrate.
        action_scale: κ, positive.
        action_repeat: Control steps per action, at least 1.
        outputs: Indices or mask of the explored outputs, all by default; the others get a gain of zero.

    Raises:
        InputError: As `authority_gains`; also if the outputs are so correlated that no gains reach κ in all of them.
    """
    check_action_scale(action_scale)
    explored = np.flatnonzero(_explored_mask(primitive, outputs))
    power = _white_power(primitive, action_repeat)[np.ix_(explored, explored)]
    _check_response(primitive, np.sqrt(power.diagonal()))
    squared = np.linalg.solve(power, (action_scale * deviation(primitive.reference)[explored]) ** 2)
    if (squared <= 0).any():
        raise InputError("the outputs are too correlated for an equal RMS in all of them: name fewer in outputs=")
    gains = np.zeros(primitive.num_outputs)
    gains[explored] = np.sqrt(squared)
    return gains


def exploration_rms(primitive: LcNsKmp, gains: np.ndarray, action_repeat: int = 1) -> np.ndarray:
    """Compute the RMS displacement (O,) by white actions times gains (O,), in demonstration standard deviations.

    The actions are uniform in ±1. Each action lasts `action_repeat` control steps.
    """
    power = _white_power(primitive, action_repeat) @ np.square(gains)
    return np.sqrt(power) / deviation(primitive.reference)


def authority(primitive: LcNsKmp, gains: np.ndarray) -> np.ndarray:
    """Compute the displacement (O,), in demonstration standard deviations, by a constant action of ±1 times `gains`."""
    return unit_authority(primitive) * np.asarray(gains, dtype=float) / deviation(primitive.reference)


def residual_gains(
    reference: ReferenceTrajectory, action_scale: float, groups: Iterable[Sequence[int]] = ()
) -> np.ndarray:
    """Compute the displacement (O,) of a residual command by an action of one, equal for all outputs of a group.

    The displacement [unit of the output] is √3 κ times the RMS of the demonstrations' standard deviations over the
    motion and the group. A null-space action of one causes the same displacement on average, but its displacement
    depends on time and direction.

    Args:
        reference: Reference trajectory of the demonstrations.
        action_scale: κ, positive.
        groups: Indices of the outputs of each group; one group of all outputs by default. An output in no group gets a
            displacement of zero.
    """
    check_action_scale(action_scale)
    variances = np.mean(reference.standard_deviations**2, axis=0)
    gains = np.zeros(len(variances))
    for outputs in groups or (range(len(variances)),):
        group = _checked_outputs(outputs, len(variances), "a group of outputs")
        gains[group] = np.sqrt(3.0) * action_scale * np.sqrt(variances[group].mean())
    return gains


def deviation(reference: ReferenceTrajectory) -> np.ndarray:
    """Compute the RMS over the motion of the demonstrations' standard deviations, (O,) [unit of the output]."""
    return np.sqrt(np.mean(reference.standard_deviations**2, axis=0))


def check_action_scale(action_scale: float) -> None:
    """Raise an InputError if κ is not a positive number."""
    scale = as_numbers(action_scale, "action_scale")
    if scale.ndim or not 0.0 < scale < np.inf:
        raise InputError(
            "action_scale is a number of demonstration standard deviations and must be positive, not "
            f"{brief(action_scale)}"
        )


def _check_response(primitive: LcNsKmp, response: np.ndarray) -> None:
    if not (response > 0).all():
        raise InputError(f"null-space actions do not move this primitive (beta = {primitive.beta}): use beta > 0")


def _explored_mask(primitive: LcNsKmp, outputs: np.ndarray | None) -> np.ndarray:
    everything = np.arange(primitive.num_outputs)
    return np.isin(everything, everything if outputs is None else _checked_outputs(outputs, len(everything), "outputs"))


def _checked_outputs(outputs: ArrayLike | Sequence[int], num_outputs: int, what: str) -> np.ndarray:
    """Return indices of outputs (n,), at least one, from indices or a mask."""
    indices = as_numbers(outputs, what)
    is_mask = np.asarray(outputs).dtype == bool
    if is_mask and indices.shape == (num_outputs,):
        indices = np.flatnonzero(indices)
    elif is_mask or indices.ndim != 1 or not np.isin(indices, np.arange(num_outputs)).all():
        indices = np.empty(0)
    if not indices.size:
        raise InputError(
            f"{what} must be indices among 0 … {num_outputs - 1}, at least one, or a mask of {num_outputs} outputs, "
            f"not {brief(outputs)}"
        )
    return indices.astype(int)


def _closed_loop(primitive: LcNsKmp, actions: np.ndarray) -> np.ndarray:
    """Compute the displacements (N, O, B) that raw actions (N, O, B) cause; the history consists of past commands."""
    steps, outputs, batch = actions.shape
    history = primitive.history
    past = np.zeros((history + steps, outputs, batch))
    for n in range(steps):
        history_map, action_map, _ = primitive.linear_response(n)
        past[history + n] = action_map @ actions[n]
        if history:
            past[history + n] += history_map @ past[n : n + history].reshape(-1, batch)
    return past[history:]


def _white_power(primitive: LcNsKmp, action_repeat: int) -> np.ndarray:
    """Compute the mean square displacement (O, O) of output i by uniform white raw actions in ±1 in output j."""
    steps, outputs = primitive.num_steps, primitive.num_outputs
    num_actions = -(-steps // action_repeat)
    pulses = np.repeat(np.eye(num_actions), action_repeat, axis=0)[:steps]
    power = np.zeros((outputs, outputs))
    for j in range(outputs):
        actions = np.zeros((steps, outputs, num_actions))
        actions[:, j] = pulses
        power[:, j] = np.mean(np.sum(_closed_loop(primitive, actions) ** 2, axis=2), axis=0)
    return power / 3
