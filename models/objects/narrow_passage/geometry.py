"""The planar world with a narrow passage (thesis, figures 4.3 and 5.3)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from guiderail.models.control.keep_out import KeepOut
from guiderail.models.primitives import LinearConstraints


@dataclass(frozen=True)
class PassageGeometry:
    """Where things are, in metres, for the centre of the robot: walls are where the centre can't go.

    Attributes:
        start, goal: (x, y) of where the robot starts, and where it should arrive.
        goal_radius: the goal is reached within this distance.
        wall_y: the lower and the upper face of the two walls.
        gap_x: the left and the right side of the gap between them.
        wall_length: how far the walls extend to the left and to the right; nothing gets around them.
        zone_x: the restricted zone is x ≥ zone_x.
        obstacle, obstacle_radius: the disc that was put on the path after the demonstrations; it costs, but it does not
            block.
        second_obstacle: another such disc, where there is one.
        obstacles_move: whether episodes differ in where the discs are.
        obstacle_margin: the distance from a disc within which it costs.
        robot_radius: of the robot itself; its walls are that much smaller than the centre's.
    """

    start: tuple[float, float] = (0.30, 0.05)
    goal: tuple[float, float] = (0.40, 0.95)
    goal_radius: float = 0.05
    wall_y: tuple[float, float] = (0.50, 0.60)
    gap_x: tuple[float, float] = (0.32, 0.38)
    wall_length: float = 5.0
    zone_x: float = 0.60
    obstacle: tuple[float, float] = (0.56, 0.27)
    obstacle_radius: float = 0.03
    second_obstacle: tuple[float, float] | None = None
    obstacles_move: bool = False
    obstacle_margin: float = 0.04
    robot_radius: float = 0.015

    @property
    def obstacles(self) -> np.ndarray:
        """Where the discs are, (n, 2)."""
        return np.array([self.obstacle] if self.second_obstacle is None else [self.obstacle, self.second_obstacle])

    @property
    def walls(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corners (2, 2) of the boxes that the robot's centre can't enter."""
        (bottom, top), (left, right) = self.wall_y, self.gap_x
        lower = np.array([[left - self.wall_length, bottom], [right, bottom]])
        upper = np.array([[left, top], [right + self.wall_length, top]])
        return lower, upper

    @property
    def constraints(self) -> LinearConstraints:
        """x ≤ zone_x, as g = [−1, 0], c = −zone_x."""
        return LinearConstraints(np.array([[-1.0, 0.0]]), np.array([-self.zone_x]))

    def keep_out(self, margin: float = 0.02) -> KeepOut:
        """The active constraints of safe residual learning: stop `margin` before walls and zone (section 4.4.1)."""
        lower, upper = self.walls
        return KeepOut(lower, upper, self.constraints, margin)

    def at_goal(self, pose: np.ndarray) -> bool:
        """True within `goal_radius` of the goal."""
        return bool(np.hypot(pose[0] - self.goal[0], pose[1] - self.goal[1]) < self.goal_radius)

    def in_passage(self, pose: np.ndarray) -> bool:
        """True in the gap and just before it, where a robot that doesn't advance is blocked by the walls."""
        return bool(self.wall_y[0] - 0.05 < pose[1] < self.wall_y[1] + 0.02)

    def obstacle_distance(self, pose: np.ndarray, obstacle: Sequence[float] | np.ndarray | None = None) -> float:
        """d_t of equation 4.24: from the robot's centre to the edge of an obstacle, negative inside.

        Args:
            pose: (2,) of the robot.
            obstacle: (x, y) where that is, if not where the first one usually is.
        """
        x, y = self.obstacle if obstacle is None else obstacle
        return float(np.hypot(pose[0] - x, pose[1] - y)) - self.obstacle_radius

    def obstacle_cost(self, pose: np.ndarray, obstacle: Sequence[float] | np.ndarray | None = None) -> float:
        """r_o of equation 4.24, of one obstacle."""
        return -100.0 * max(self.obstacle_margin - self.obstacle_distance(pose, obstacle), 0.0)


def action_cost(displacement: np.ndarray) -> float:
    """r_a of equation 4.23, of the robot's displacement (2,) in a control step."""
    return -10.0 * float(displacement @ displacement)
