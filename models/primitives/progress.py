"""Progress of a movement primitive along its demonstrations: by the clock, or by how well the robot follows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.transforms import POSE_SIZE, pose_difference


@dataclass(frozen=True)
class StateProgress:
    """Progress that waits while the robot does not follow its commands.

    Progress s is a step of the reference. In control step k it increases by one if the measured pose is near the last
    command, and is constant otherwise (phase stopping, after Ijspeert et al., 2002):

        s_{k+1} = s_k + 1  if ‖y − x‖ ≤ tolerance  or  k + 1 − s_k > max_lag,  else  s_k

    for the position and, for poses (6,), for the angles. Progress never decreases and is at most `max_lag` steps behind
    the clock. A contact that keeps the robot from its command by design, such as pressing in a search, therefore delays
    the motion by at most `max_lag` steps. The tolerance should cover the deviations that contact and tracking cause
    while nothing blocks the robot.

    Raises:
        InputError: If an argument is out of range.
    """

    tolerance: tuple[float, float]  # tolerances of the position [unit of the output] and of the angles [rad], positive
    max_lag: int  # largest number of steps behind the clock, not negative; with 0, progress follows the clock

    def __post_init__(self) -> None:
        if len(self.tolerance) != 2 or not all(0.0 < one < np.inf for one in self.tolerance):
            raise InputError(f"the tolerance of progress is two positive numbers, not {brief(self.tolerance)}")
        if int(self.max_lag) != self.max_lag or self.max_lag < 0:
            raise InputError(f"the largest lag of progress is a number of steps from 0, not {brief(self.max_lag)}")

    def next_step(self, step: int, clock: int, command: np.ndarray, pose: np.ndarray) -> int:
        """Return the step of the next command.

        Args:
            step: Step of the last command.
            clock: Number of the next control step, from 0.
            command: Last command (O,).
            pose: Measured pose (O,); NaN counts as not near.
        """
        is_pose = len(command) == POSE_SIZE
        error = pose_difference(command, pose) if is_pose else command - pose
        position, angles = (error[:3], error[3:]) if is_pose else (error, error[:0])
        is_near = all(np.sqrt(e @ e) <= tol for e, tol in zip((position, angles), self.tolerance, strict=True))
        return step + 1 if is_near or clock - step > self.max_lag else step
