"""Geometry of the plane with a narrow passage (thesis, figures 4.3 and 5.3), and its demonstrations."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from guiderail.models.control.command_filters import KeepOut
from guiderail.models.primitives import Demonstrations, LinearConstraints

NUM_STEPS = 400  # points of a demonstration
PATH = Path(__file__).with_name("narrow_passage.npz")  # nine demonstrations (research/generate/narrow_passage.py)


@dataclass(frozen=True)
class PassageGeometry:
    """Positions and sizes [m] of walls, restricted zone, obstacles and goal.

    The walls bound the position of the robot's center. The obstacles are discs on the path of the demonstrations. The
    robot can pass through an obstacle, at a cost.

    Attributes:
        start: Start (x, y) of the robot.
        goal: Goal (x, y) of the robot.
        goal_radius: Distance within which the goal is reached.
        wall_y: Lower and upper face of the two walls.
        gap_x: Left and right side of the gap between the walls.
        wall_length: Length of each wall, beyond the reach of the robot.
        zone_x: Lower bound of x in the restricted zone.
        obstacle: Center of the obstacle.
        obstacle_radius: Radius of an obstacle.
        second_obstacle: Center of a second obstacle, or None.
        obstacles_move: True if the positions of the obstacles are sampled in every episode.
        obstacle_margin: Distance from an obstacle within which it has a cost.
        robot_radius: Radius of the robot; the simulated walls are smaller than `walls` by this radius.
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
        """Centers (n, 2) [m] of the obstacles."""
        return np.array([self.obstacle] if self.second_obstacle is None else [self.obstacle, self.second_obstacle])

    @property
    def walls(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower corners (2, 2) and upper corners (2, 2) [m] of the two walls, for the robot's center."""
        (bottom, top), (left, right) = self.wall_y, self.gap_x
        lower = np.array([[left - self.wall_length, bottom], [right, bottom]])
        upper = np.array([[left, top], [right + self.wall_length, top]])
        return lower, upper

    @property
    def constraints(self) -> LinearConstraints:
        """Linear constraint x ≤ zone_x, as g = [−1, 0], c = −zone_x."""
        return LinearConstraints(np.array([[-1.0, 0.0]]), np.array([-self.zone_x]))

    def keep_out(self, margin: float = 0.02) -> KeepOut:
        """Return the keep-out region of safe residual RL: walls and zone, enlarged by `margin` [m] (section 4.4.1).

        Raises:
            InputError: If the margin is negative or not finite.
        """
        lower, upper = self.walls
        return KeepOut(lower, upper, self.constraints, margin)

    def goal_distance(self, pose: np.ndarray) -> float:
        """Return the distance of the robot's center `pose` (2,) from the goal [m]."""
        return float(np.hypot(pose[0] - self.goal[0], pose[1] - self.goal[1]))

    def at_goal(self, pose: np.ndarray) -> bool:
        """Return True if the robot's center `pose` (2,) [m] is less than `goal_radius` from the goal."""
        return self.goal_distance(pose) < self.goal_radius

    def in_passage(self, pose: np.ndarray) -> bool:
        """Return True if the robot is so close to the walls along y that they may block it, at any x.

        The robot's center `pose` (2,) [m] is then less than 5 cm before the walls, between them, or less than 2 cm
        behind them.
        """
        return bool(self.wall_y[0] - 0.05 < pose[1] < self.wall_y[1] + 0.02)

    def obstacle_distance(self, pose: np.ndarray, obstacle: Sequence[float] | np.ndarray | None = None) -> float:
        """Return the distance d_t [m] of the robot's center from an obstacle's edge, negative inside (equation 4.24).

        `pose` (2,) is the robot's center [m]. `obstacle` (2,) is the obstacle's center [m], by default `self.obstacle`.
        """
        x, y = self.obstacle if obstacle is None else obstacle
        return float(np.hypot(pose[0] - x, pose[1] - y)) - self.obstacle_radius

    def obstacle_cost(self, pose: np.ndarray, obstacle: Sequence[float] | np.ndarray | None = None) -> float:
        """Return the cost r_o of one obstacle as a reward, zero or negative (equation 4.24).

        The arguments are those of `obstacle_distance`: `pose` (2,) and `obstacle` (2,) [m].
        """
        return -100.0 * max(self.obstacle_margin - self.obstacle_distance(pose, obstacle), 0.0)


def action_cost(displacement: np.ndarray) -> float:
    """Return the cost r_a of a control step's displacement (2,) [m], as a reward, zero or negative (equation 4.23)."""
    return -10.0 * float(displacement @ displacement)


def load_demonstrations() -> Demonstrations:
    """Load the nine demonstrations of 400 positions [m] each."""
    return Demonstrations.load(PATH)
