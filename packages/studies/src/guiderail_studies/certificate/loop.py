"""Feedback loop of a primitive, the subject of a certificate, and its motions without active constraints."""

from dataclasses import dataclass

import numpy as np

from guiderail.models.primitives.constraints import TOLERANCE
from guiderail.models.primitives.lc_ns_kmp import LcNsKmp


@dataclass(frozen=True)
class CertifiedLoop:
    """Feedback loop of a primitive: the next command depends on the action and, with a history, on past commands."""

    primitive: LcNsKmp  # movement primitive
    gains: np.ndarray  # null-space action per unit of the action (O,); zero for outputs that no action moves
    period: float  # time between two commands [s]
    start: np.ndarray  # output at which the robot begins (O,) [unit of the output]
    start_within: np.ndarray  # largest offset of the robot from `start` (O,) [unit of the output]


@dataclass(frozen=True)
class Bounds:
    """Bounds of the commands at every step in one regime of `bounds.py`; infinite if a command has no bound."""

    lower: np.ndarray  # smallest command (N, O) [unit of the output]
    upper: np.ndarray  # largest command (N, O) [unit of the output]
    speed: np.ndarray  # largest speed (N, O) from the previous step to this step [unit of the output/s]
    acceleration: np.ndarray  # largest acceleration (N, O) over this step and the two before it [unit of the output/s²]


def reach(loop: CertifiedLoop) -> tuple[np.ndarray, np.ndarray]:
    """Compute the zonotope of motions without active constraints.

    Returns:
        Center (P + N, O) and generators (P + N, O, B) of the zonotope [unit of the output]. The center is the motion
        without actions and begins with P copies of the start. Each entry of each step's action has one generator; with
        a history, so has each output of the start.
    """
    primitive, past = loop.primitive, loop.primitive.history
    steps, outputs = primitive.num_steps, primitive.num_outputs
    moved = np.flatnonzero(loop.gains)
    batch = steps * len(moved) + (outputs if past else 0)
    middle, generators = np.zeros((past + steps, outputs)), np.zeros((past + steps, outputs, batch))
    if past:
        middle[:past] = loop.start
        generators[:past, :, batch - outputs :] = np.diag(loop.start_within)
    for n in range(steps):
        history_map, action_map, offset = primitive.linear_response(n)
        middle[past + n] = offset
        if past:
            middle[past + n] += history_map @ middle[n : past + n].ravel()
            generators[past + n] = history_map @ generators[n : past + n].reshape(past * outputs, batch)
        generators[past + n, :, n * len(moved) : (n + 1) * len(moved)] += action_map[:, moved] * loop.gains[moved]
    return middle, generators


def single_output_bounds(loop: CertifiedLoop) -> tuple[np.ndarray, np.ndarray]:
    """Return lower and upper bounds (N, O) from the constraints on a single output, widened by `TOLERANCE`.

    The bounds [unit of the output] are infinite if no constraint applies to this output alone.
    """
    primitive = loop.primitive
    G, c = primitive.constraints.window(np.arange(primitive.num_steps))
    is_single = ((G != 0.0).sum(axis=2) == 1)[..., None]
    bound = c[..., None] / np.where(G == 0.0, 1.0, G)
    lower = np.where(is_single & (G > 0.0), bound, -np.inf).max(axis=1, initial=-np.inf)
    upper = np.where(is_single & (G < 0.0), bound, np.inf).min(axis=1, initial=np.inf)
    return lower - TOLERANCE, upper + TOLERANCE
