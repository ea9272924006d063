"""BncConnector: insert, align and lock a bayonet connector whose place is not exactly known (4.4.2, 5.4.2)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Literal

import numpy as np
from pydantic import Field
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.framework import Context

from guiderail.diagrams.cameras import Camera, look_from_front
from guiderail.diagrams.observation import Observed
from guiderail.diagrams.options import Number, Options
from guiderail.diagrams.scene import ARM_VIEW, Scene, box_edges, in_frame, viewpoint
from guiderail.diagrams.stations.bnc_workcell import HALF_TURN, HALF_TURN_OF_WRENCH, BncWorkcell
from guiderail.diagrams.stations.station import CONTROL_PERIOD, Station
from guiderail.diagrams.task import Symmetry
from guiderail.diagrams.tasks.bnc_rewards import reward_terms
from guiderail.diagrams.tasks.bnc_uncertainty import LARGEST_GRASP_ANGLE, BncUncertainty
from guiderail.diagrams.tasks.insertion import InsertionTask
from guiderail.diagrams.tasks.registry import register_task
from guiderail.diagrams.tasks.task import Choice, Threshold
from guiderail.models.demonstrations import bnc_connector as demonstrations
from guiderail.models.keep_out import KeepOut
from guiderail.models.pose_coordinates import POSE_SIZE
from guiderail.models.primitives import LinearConstraints, ReferenceTrajectory
from guiderail.models.units import DEGREE, MM
from guiderail.systems.episode_monitor import Condition
from guiderail.systems.reward_system import RewardTerm

NUM_STEPS, COMPONENTS = demonstrations.NUM_STEPS, 16
# How well a hand repeats itself: added to the demonstrations' covariance as a standard deviation.
FLOOR = np.array([0.05 * MM, 0.05 * MM, 0.1 * MM, 0.2 * DEGREE, 0.05 * DEGREE, 0.05 * DEGREE])

# ρ [m², rad²]. The thesis's 1e-8 is (0.1 mm)², much for demonstrations that vary by a millimetre.
RHO = 1e-11
ALIGNMENT = 2.0 * MM  # |x|, |y| of every command: equation 4.26
COLLISION_FORCE = 35.0  # [N], of the impedance
TOOL_VIEW = ((0.62, -0.085, 0.19), (0.55, 0.0, 0.172))
LOCKED_STEPS = 3  # control steps for which the plug must be locked before that counts

# What a policy sees, [time, pose, wrench], is centred and scaled by these. The wrench's torques are small, and they
# are what tells on which side of the rim the plug sits: 0.02 Nm at 4 N.
HALF = 0.5 * (NUM_STEPS * CONTROL_PERIOD)
POSE_CENTRE = np.array([0.0, 0.0, 5.0 * MM, 45.0 * DEGREE, 0.0, 0.0])
POSE_SCALE = np.array([2.0 * MM, 2.0 * MM, 8.0 * MM, 45.0 * DEGREE, 1.5 * DEGREE, 1.5 * DEGREE])
WRENCH_SCALE = np.array([5.0, 5.0, 8.0, 0.02, 0.02, 0.2])


@lru_cache(maxsize=1)
def reference_trajectory() -> ReferenceTrajectory:
    """What the five demonstrations have in common: Gaussian mixture and regression, fitted once a process."""
    return ReferenceTrajectory.from_demonstrations(demonstrations.load(), components=COMPONENTS, floor=FLOOR)


class BncOptions(Options):
    """Of the connector."""

    uncertainty: Literal["calibration", "disc", "known"] = Field("calibration", description="where the jack may be")
    grasp_angle: Number = Field(0.0, ge=0, le=LARGEST_GRASP_ANGLE, description="largest tilt of the plug [degrees]")


@register_task("BncConnector")
class BncConnector(InsertionTask):
    """Insert, align and lock: "sparse" is the thesis's reward (4.27, 4.28), "shaped" adds the depth gained."""

    Options = BncOptions
    options: BncOptions
    workpiece, fixture = "plug", "jack"
    rewards = ("sparse", "shaped")
    defaults = {"guidance": "skgrl", "station": "rails", "hold": 10, "explored": (0, 1), "history_variance": RHO}
    num_steps = NUM_STEPS
    collision = Threshold("contact_force", COLLISION_FORCE)
    isotropic_groups = ((0, 1, 2), (3, 4, 5))  # outputs of one unit, which residual learning moves alike

    def __init__(self, options: BncOptions, choice: Choice):
        super().__init__(options, choice)
        self.offsets = BncUncertainty(options.uncertainty, options.grasp_angle)
        self._workcell = BncWorkcell()

    def world(self) -> BncWorkcell:
        """A jack in the world, a plug in the tool."""
        return self._workcell

    def reference(self) -> ReferenceTrajectory:
        """Of the five demonstrations."""
        return reference_trajectory()

    def constraints(self) -> LinearConstraints:
        """|x|, |y| ≤ 2 mm, equation 4.26."""
        bound = np.array([ALIGNMENT, ALIGNMENT, np.inf, np.inf, np.inf, np.inf])
        return LinearConstraints.box(-bound, bound)

    def keep_out(self) -> KeepOut:
        """No walls are known: what safe residual learning is projected to is the alignment alone."""
        return KeepOut(np.empty((0, POSE_SIZE)), np.empty((0, POSE_SIZE)), self.constraints(), margin=0.0)

    def observed(self) -> Sequence[Observed]:
        """Time, pose and wrench."""
        return (
            Observed("time", HALF, HALF),
            Observed("pose", POSE_CENTRE, POSE_SCALE),
            Observed("wrench", 0.0, WRENCH_SCALE),
        )

    def reward_terms(self, num_actions: int) -> list[RewardTerm]:
        """Of actions, forces and the end; of depth where the reward is shaped."""
        return reward_terms(self.choice.reward, num_actions)

    def conditions(self) -> list[Condition]:
        """Locked for a while, or pushed too hard."""
        return [Condition("success", {"plug": 6}, self._workcell.locks, steps=LOCKED_STEPS), self.force_limit()]

    def symmetry(self) -> Symmetry:
        """Half a turn about the jack's axis."""
        explored = self.choice.values["explored"]
        action = HALF_TURN if explored is None else HALF_TURN[list(explored)]
        return Symmetry((1.0, *HALF_TURN, *HALF_TURN_OF_WRENCH), tuple(action))

    def move(self, station: Station, context: Context, fixture: np.ndarray, workpiece: np.ndarray) -> None:
        """Moves the jack by (x, y), and the plug by (x, y) and by its tilt about x and y where it has one."""
        plant_context = station.plant.GetMyMutableContextFromRoot(context)
        tilt = RotationMatrix(RollPitchYaw(*workpiece[2:], 0.0)) if len(workpiece) > 2 else RotationMatrix()
        self._workcell.set_jack_offset(station.plant, plant_context, RigidTransform([*fixture, 0.0]))
        self._workcell.set_grasp_offset(station.plant, plant_context, RigidTransform(tilt, [*workpiece[:2], 0.0]))

    def start(self, rng: np.random.Generator) -> np.ndarray:
        """Where the demonstrations start, inside the constraints."""
        return self.constraints().nearest(reference_trajectory().means[0])

    def camera(self) -> Camera:
        """Looks slightly down at the jack."""
        X_WC = look_from_front(np.array(self._workcell.p_WJ) + [0.0, 0.0, 0.02], distance=0.11, height=0.05)
        return Camera((640, 480), np.deg2rad(30.0), X_WC)

    def scene(self) -> Scene:
        """The demonstrations, and the square that commands stay in."""
        to_world = in_frame(self._workcell.X_WT)
        near = viewpoint(*to_world(np.array([[0.025, -0.035, 0.026], [0.0, 0.0, 0.012]])))
        return Scene(
            to_world=to_world,
            demonstrations=tuple(demonstrations.load().outputs),
            constraint=tuple(to_world(edge) for edge in box_edges(ALIGNMENT, 0.0, 0.015)),
            viewpoint=near,
            arm_views={"the tool": TOOL_VIEW, "the connector": near, "the arm": ARM_VIEW},
            line_radius=0.0001,
        )
