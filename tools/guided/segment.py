"""Segments of a motion: demonstrations in a segment's frame, constraints and discrete outputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from guiderail.models.common.arrays import as_numbers, as_whole
from guiderail.models.common.errors import InputError, brief
from guiderail.models.control.motion_constraints import MotionConstraints
from guiderail.models.primitives import Demonstrations, LinearConstraints
from guiderail.models.primitives.demonstrations import MAX_STEPS, DemonstratedBounds, num_periods
from guiderail.models.primitives.poses import Orientation, continued_angles, continued_vectors, pose_rotation

MIN_PERIODS = 4  # minimum duration of a segment's demonstrations [control periods]
MIN_STEPS = 12  # minimum control steps of a segment, for the fit of the Gaussian mixture


class Frame:
    """Frame F of a segment in the world W.

    Args:
        p: Origin p_WF [unit of the outputs]: (3,) with a rotation, otherwise (n,) for the first n of O outputs.
        R: Rotation matrix R_WF (3, 3); the identity by default.

    Raises:
        InputError: If `p` is not a vector of finite numbers, or `R` is not a rotation matrix.

    Attributes:
        p: Origin (n,).
        R: Rotation matrix (3, 3), or None.
    """

    def __init__(self, p: ArrayLike, R: ArrayLike | None = None):
        self.p = as_numbers(p, "a frame's origin")
        self.R = None if R is None else as_numbers(R, "a frame's rotation")
        if self.p.ndim != 1 or not np.isfinite(self.p).all():
            raise InputError(f"a frame's origin must be finite numbers, not {brief(p)}")
        if self.R is not None and not (self.R.shape == (3, 3) and np.allclose(self.R @ self.R.T, np.eye(3), atol=1e-6)):
            raise InputError("a frame's rotation must be an orthonormal matrix (3, 3)")
        if self.R is not None and np.linalg.det(self.R) < 0.0:
            raise InputError("a frame's rotation must not be a reflection: its determinant is -1")

    def to_world(self, output: np.ndarray, orientation: Orientation) -> np.ndarray:
        """Transform an output (O,) from F to W; if F has a rotation, the last three of six entries are an orientation.

        Raises:
            InputError: If the frame does not fit O outputs.
        """
        return self._transformed(output, orientation, is_inverse=False)

    def to_frame(self, output: np.ndarray, orientation: Orientation, near: np.ndarray | None = None) -> np.ndarray:
        """Transform an output (O,) from W to F.

        Args:
            output: Output (O,) in W.
            orientation: Representation of the last three of six entries.
            near: Output (O,) in F. If O is 6, full turns are added to the orientation to bring it nearest to that of
                `near`.

        Raises:
            InputError: If the frame does not fit O outputs.
        """
        return self._transformed(output, orientation, is_inverse=True, near=near)

    def _transformed(
        self, output: np.ndarray, orientation: Orientation, *, is_inverse: bool, near: np.ndarray | None = None
    ) -> np.ndarray:
        size = len(self.p)
        if size > len(output) or (self.R is not None and (size != 3 or len(output) not in (3, 6))):
            raise InputError(
                f"a frame with an origin of {size} numbers{' and a rotation' if self.R is not None else ''} does not "
                f"fit outputs of {len(output)} numbers"
            )
        result = np.array(output, dtype=float)
        if self.R is None:
            result[:size] += -self.p if is_inverse else self.p
        elif is_inverse:
            result[:3] = self.R.T @ (result[:3] - self.p)
        else:
            result[:3] = self.p + self.R @ result[:3]
        if self.R is not None and len(output) == 6:
            rotation = pose_rotation(result[3:], orientation)
            rotation = rotation.from_matrix(self.R.T if is_inverse else self.R) * rotation
            result[3:] = rotation.as_euler("ZYX") if orientation == "euler_zyx" else rotation.as_rotvec()
        if near is not None and len(output) == 6:
            continued = continued_angles if orientation == "euler_zyx" else continued_vectors
            result[3:] = continued(result[None, 3:], near[3:])[0]
        return result


Constraints = LinearConstraints | DemonstratedBounds | MotionConstraints
"""Constraints of a segment, in its frame."""


@dataclass(frozen=True)
class Segment:
    """One part of a motion.

    Attributes:
        demonstrations: Demonstrations in the segment's frame, at least three, or their file.
        frame: (env, observation) → `Frame` or its origin, called when the segment begins; the world by default.
        constraints: Constraints in the frame, or (env, observation) → constraints, called when the segment begins.
        extra: Value for `to_action` that the policy does not change, such as a gripper command, or a function (phase,
            is_held) → value. The phase of the segment is from 0 to 1; is_held is true while the last point is held. By
            default, the value of `discrete`.
        discrete: Discrete outputs recorded with the demonstrations, M arrays (N_m,) or (N_m, D): each control step has
            the most frequent value of the demonstrations at its phase.
        until: (env, observation) → true to end the segment early, called before each step except the first; by default
            the segment ends after `num_steps` and `dwell`.
        num_steps: Control steps, at least 12; by default the mean duration of the demonstrations in periods, plus one.
            Demonstrations of 4 to 10 periods are slowed down to 12 steps.
        dwell: Control steps for which the last point is held after `num_steps`.
        floor: Standard deviation (O,) or scalar whose square is added to every variance [unit of the output].
        name: Name of the segment, in `info`.

    Raises:
        InputError: If an argument is out of range.
    """

    demonstrations: Demonstrations | str | Path
    frame: Callable[[Any, Any], Frame | ArrayLike] | None = None
    constraints: Constraints | Callable[[Any, Any], Constraints] | None = None
    extra: Any = None
    discrete: Sequence[np.ndarray] | None = None
    until: Callable[[Any, Any], bool] | None = None
    num_steps: int | None = None
    dwell: int = 0
    floor: float | np.ndarray = 1e-3
    name: str = ""

    def __post_init__(self) -> None:
        for what, value, least in (("num_steps", self.num_steps, MIN_STEPS), ("dwell", self.dwell, 0)):
            if value is not None:
                as_whole(value, f"{what} of a segment", least, MAX_STEPS)
        if self.discrete is not None and self.extra is not None:
            raise InputError("a segment has extra or discrete, not both")

    @cached_property
    def recorded(self) -> Demonstrations:
        """Demonstrations, read from the segment's file if `demonstrations` is a path."""
        source = self.demonstrations
        return source if isinstance(source, Demonstrations) else Demonstrations.load(source)

    def steps_of(self, period: float | None) -> int:
        """Return the number of control steps.

        Raises:
            InputError: If there is neither `num_steps` nor a positive, finite period [s], or the demonstrations are
                shorter than four periods or longer than `MAX_STEPS`.
        """
        if self.num_steps is not None:
            return int(self.num_steps)
        if period is None:
            raise InputError("give the period of the environment [s], or num_steps of every segment")
        duration = float(np.mean([t[-1] - t[0] for t in self.recorded.times]))
        periods = num_periods(duration, float(period))
        if periods < MIN_PERIODS:
            raise InputError(
                f"demonstrations of {duration:.3g} s are shorter than {MIN_PERIODS} periods of {period:.3g} s: give as "
                "period the duration of a step of the environment [s], or num_steps of the segment"
            )
        return max(periods + 1, MIN_STEPS)

    def discrete_values(self, num_steps: int) -> list[Any] | None:
        """Return the most frequent discrete output of the demonstrations for each control step, or None.

        Raises:
            InputError: Unless each sample of each demonstration has one discrete output, a scalar or (D,).
        """
        if self.discrete is None:
            return None
        times = self.recorded.times
        arrays = [np.asarray(values) for values in self.discrete]
        sizes, widths = [values.shape[:1] for values in arrays], {values.shape[1:] for values in arrays}
        if sizes != [t.shape for t in times] or len(widths) > 1:
            raise InputError("discrete outputs must have a value for each sample of each demonstration")
        values = []
        for phase in np.linspace(0.0, 1.0, num_steps):
            at = [int(np.argmin(np.abs((t - t[0]) / (t[-1] - t[0]) - phase))) for t in times]
            unique, counts = np.unique([a[k] for a, k in zip(arrays, at, strict=True)], axis=0, return_counts=True)
            values.append(unique[np.argmax(counts)])
        return values


def as_bool(value: Any, what: str) -> bool:
    """Return `value`, a result of the function named `what`, as a bool; raise an InputError if it is an array."""
    if np.ndim(value):
        raise InputError(f"{what} must return True or False, not {brief(value)}")
    return bool(value)


def cut_demonstrations(demonstrations: Demonstrations, cuts: Sequence[Sequence[int]]) -> list[Demonstrations]:
    """Cut demonstrations at events into segments; the sample at a cut belongs to the segments on both sides.

    Args:
        demonstrations: M demonstrations.
        cuts: Increasing sample indices of the events, M lists of equal length K, as `find_events` returns them.

    Returns:
        K + 1 `Demonstrations` of M parts each; the times of each part begin at 0.

    Raises:
        InputError: If there is not one list for each demonstration, the lists differ in length, or a part has fewer
            than two samples.
    """
    lists = [list(each) for each in cuts]
    if len(lists) != demonstrations.num_demonstrations or len({len(each) for each in lists}) != 1:
        raise InputError("cuts need one list for each demonstration, all of one length")
    parts: list[tuple[list[np.ndarray], list[np.ndarray]]] = [([], []) for _ in range(len(lists[0]) + 1)]
    for m, (t, y, at) in enumerate(zip(demonstrations.times, demonstrations.outputs, lists, strict=True)):
        edges = [0, *at, len(t) - 1]
        if min(np.diff(edges)) < 1:
            raise InputError(f"the cuts of demonstration {m} must be increasing indices inside it, not {brief(at)}")
        for (times, outputs), first, last in zip(parts, edges[:-1], edges[1:], strict=True):
            times.append(t[first : last + 1] - t[first])
            outputs.append(y[first : last + 1])
    return [Demonstrations(times, outputs, demonstrations.names) for times, outputs in parts]


def find_events(signals: Sequence[np.ndarray], conditions: Sequence[Callable[[np.ndarray], bool]]) -> list[list[int]]:
    """Return the sample indices of events, one list for each of M recordings.

    An event is the first sample after the previous event at which its condition holds.

    Args:
        signals: M arrays (N_m, S), such as outputs and a gripper.
        conditions: Conditions on a sample (S,), in the order of the events; the first may hold at sample 0, where
            `cut_demonstrations` cannot cut.

    Raises:
        InputError: If an event does not occur in a recording.
    """
    event_lists = []
    for m, signal in enumerate(signals):
        at, events = -1, []
        for number, condition in enumerate(conditions):
            at = next((k for k in range(at + 1, len(signal)) if as_bool(condition(signal[k]), "a condition")), -1)
            if at < 0:
                raise InputError(f"event {number} does not occur in recording {m}")
            events.append(at)
        event_lists.append(events)
    return event_lists
