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

    @property
    def rest(self) -> int:
        """Number of poses at rest before the first command, at least two, which its speed and acceleration need."""
        return max(self.primitive.history, 2)


@dataclass(frozen=True)
class Bounds:
    """Bounds of the commands at every step in one regime of `bounds.py`; infinite if a command has no bound."""

    lower: np.ndarray  # smallest command (N, O) [unit of the output]
    upper: np.ndarray  # largest command (N, O) [unit of the output]
    # Largest speed (N, O), the change from the previous command over the period, and largest acceleration (N, O), the
    # change of this speed over the period [unit of the output/s, /s²]. Before the first command is the start, at rest.
    speed: np.ndarray
    acceleration: np.ndarray


def reach(loop: CertifiedLoop) -> tuple[np.ndarray, np.ndarray]:
    """Compute the zonotope of motions without active constraints.

    Returns:
        Center (R + N, O) and generators (R + N, O, B) of the zonotope [unit of the output]. The center is the motion
        without actions and begins with R copies of the start, `loop.rest`. Each entry of each step's action has one
        generator, and so has each output of the start.
    """
    primitive, past, rest = loop.primitive, loop.primitive.history, loop.rest
    steps, outputs = primitive.num_steps, primitive.num_outputs
    moved = np.flatnonzero(loop.gains)
    batch = steps * len(moved) + outputs
    middle, generators = np.zeros((rest + steps, outputs)), np.zeros((rest + steps, outputs, batch))
    middle[:rest], generators[:rest, :, batch - outputs :] = loop.start, np.diag(loop.start_within)
    for n, row in enumerate(range(rest, rest + steps)):
        history_map, action_map, offset = primitive.linear_response(n)
        middle[row] = offset
        if past:
            middle[row] += history_map @ middle[row - past : row].ravel()
            generators[row] = history_map @ generators[row - past : row].reshape(past * outputs, batch)
        generators[row, :, n * len(moved) : (n + 1) * len(moved)] += action_map[:, moved] * loop.gains[moved]
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
