"""Pouring station: an arm under Cartesian position control with a thermos and balls, and a mug on a table.

`PouringConfig` is the workcell that the task Pouring returns; only that task calls `make_mug` and `set_mug`.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from pydrake.geometry import Box, Cylinder
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, Frame, ModelInstanceIndex, RigidBody, WeldJoint
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.primitives import MatrixGain, StateInterpolatorWithDiscreteDerivative

from guiderail.diagrams.stations.registry import register_station
from guiderail.diagrams.stations.station import (
    ControllerPlant,
    Station,
    add_plant,
    export_scene_ports,
    export_station_ports,
)
from guiderail.diagrams.wiring import add_system
from guiderail.models.common.arrays import round_period
from guiderail.models.common.errors import InputError
from guiderail.models.objects.pouring import MUG, THERMOS, Ball, Vessel, add_ball, add_shape, add_vessel
from guiderail.models.robots import DEFAULT_ROBOT
from guiderail.models.robots.mounting import add_drives, add_robot
from guiderail.models.robots.robot import Robot, find_robot
from guiderail.systems.cartesian_position_controller import CartesianPositionController, SpeedLimits
from guiderail.systems.poses import MeasuredPose, RelativePoses
from guiderail.systems.wrench_sensors import WrenchSensor
from guiderail.systems.wrench_signals import ContactDetector

# Pose in the middle of the workspace, so that inverse kinematics finds the same branch for all poses.
MID_POURING_POSE = np.array([-0.02, -0.15, 0.15, 0.0, 0.0, -0.8])

# Above the speed of every guidance, so that the controller does not slow down a guided motion.
SPEED_LIMITS = SpeedLimits(translational=0.5, rotational=2.0)

WRENCH_TIME_CONSTANT = 0.02  # time constant of the wrench sensor's low-pass filter [s]

METAL = (0.55, 0.58, 0.62, 1.0)
WOOD = (0.80, 0.68, 0.50, 1.0)
BLUE = (0.25, 0.40, 0.65, 0.35)
CHINA = (0.92, 0.92, 0.88, 0.45)
ORANGE = (0.95, 0.55, 0.10, 1.0)


@dataclass(frozen=True)
class PouringConfig:
    """Parameters of the scene and its time steps."""

    mug: Vessel = MUG  # dimensions of the mug
    thermos: Vessel = THERMOS  # dimensions of the thermos
    ball: Ball = field(default_factory=Ball)  # parameters of a ball
    num_balls: int = 2  # number of balls
    p_WStand: tuple[float, float, float] = (0.76, 0.18, 0.0)  # point of the table's surface under the nominal mug [m]
    # Height of a stand under the mug [m]; the stand leaves room for the wrist when the thermos is low.
    stand_height: float = 0.06
    # Distance of the thermos's axis from the flange [m]; the axes of thermos and flange are perpendicular.
    grip: float = 0.08
    grip_height: float = 0.045  # distance of the grip from the thermos's tip [m]
    plant_period: float = round_period(0.005)  # time step of the plant [s]
    substeps: int = 2  # plant steps per control step
    robot: Robot | str = DEFAULT_ROBOT  # the arm, or its name; its data need drives and a level posture

    @cached_property
    def arm(self) -> Robot:
        """Data of the arm.

        Raises:
            InputError: If the data have no drives or no level posture.
        """
        robot = find_robot(self.robot)
        if robot.drives is None or robot.level_posture is None:
            raise InputError(f"robot {robot.name!r} can't pour: its data have no drives or no level posture")
        return robot

    @property
    def control_period(self) -> float:
        """Duration of a control step [s]."""
        return self.substeps * self.plant_period

    def stack(self) -> np.ndarray:
        """Return the positions of the balls in the upright thermos, in the frame of its tip, (n, 3) [m].

        The balls touch the left and right wall alternately, each as low as possible.
        """
        radius = self.ball.diameter / 2
        offset = self.thermos.inner_diameter / 2 - radius
        # Each ball touches the previous ball or, directly below it, the ball before the previous one.
        step = max(np.sqrt(max(self.ball.diameter**2 - (2 * offset) ** 2, 0.0)), radius)
        i = np.arange(self.num_balls)
        return np.stack([offset * (-1.0) ** i, 0.0 * i, -self.thermos.depth + radius + i * step], axis=1)

    @cached_property
    def X_WT(self) -> RigidTransform:
        """Pose of the target frame T, the tip frame of the nominal mug; commanded and measured poses are X_TP."""
        x, y, z = self.p_WStand
        return RigidTransform([x, y, z + self.stand_height + self.mug.height])

    @cached_property
    def X_FlangeP(self) -> RigidTransform:
        """Pose of the thermos's tip P in the flange's frame; the axes of thermos and flange are perpendicular."""
        X_FlangeTurned = RigidTransform(RotationMatrix.MakeZRotation(self.arm.tool_turn), [0.0, 0.0, 0.0])
        R = RotationMatrix(np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]))
        return X_FlangeTurned @ RigidTransform(R, [self.grip_height, 0.0, self.grip])


@register_station(
    "pouring",
    workcell_kind="pouring",
    time_unit=PouringConfig.plant_period,
    control_period=PouringConfig().control_period,
)
class PouringStation(Station):
    """Arm under Cartesian position control that holds a thermos with balls, and a mug on a table.

    .. pydrake_system::

        name: PouringStation
        input_ports:
        - desired_pose
        - command_time (optional)
        output_ports:
        - pose
        - wrench
        - contact_force
        - saturation
        - command_timed_out
        - tip_in_mug
        - balls_in_mug
        - balls_in_thermos
        - collision
        - touched
        - query

    ``desired_pose`` and ``pose`` are X_TP of the thermos's tip P, (6,) [x y z Rz Ry Rx] in meters and radians; T is the
    tip of the nominal mug. ``wrench`` (6,) is the wrench of balls and surroundings on the thermos at P in the axes of
    T, without the thermos's weight and inertia; ``contact_force`` (1,) is the largest contact force of arm or thermos
    with table or mug [N]; ``saturation`` (1,) is 1 while the controller cannot follow.

    ``tip_in_mug`` is the tip's pose in the actual mug's frame, (6,), position and rotation vector; ``balls_in_mug`` and
    ``balls_in_thermos`` are the poses of all n balls in the vessels' tip frames, (6 n,), in the same form.
    ``collision`` (1,) is 1 while the arm or the thermos touches table or mug; ``touched`` (1,) is 1 from the first
    plant step with such a contact.
    """

    wraps_angles = True

    def __init__(self, config: PouringConfig, control_period: float | None = None):
        """Construct the station; a `control_period` [s] replaces that of the `config`.

        Raises:
            InputError: If the data of the robot have no drives or no level posture.
        """
        super().__init__()
        if control_period is not None:
            config = replace(config, substeps=round(control_period / config.plant_period))
        builder = DiagramBuilder()
        self.config = config
        self.control_period = config.control_period
        self.plant, self.scene_graph = plant, _ = add_plant(
            builder, config.plant_period, contact_model="point", penetration_allowance=1e-3
        )
        self.arm, self._tip, wrist = add_arm_with_thermos(plant, config)
        self._mount = plant.AddFrame(FixedOffsetFrame("mug_mount", plant.world_frame(), config.X_WT))
        self._mug = add_vessel(plant, "mug", config.mug, CHINA)
        _add_stand(plant, self._mug, config)
        plant.WeldFrames(self._mount, self._mug.body_frame())
        self._balls = [add_ball(plant, f"ball_{i}", config.ball, ORANGE) for i in range(config.num_balls)]
        x, y, z = config.p_WStand
        X_WTable = RigidTransform([x + 0.1, y - 0.1, z - 0.05])  # the table begins next to the arm's base
        add_shape(plant.world_body(), "table", X_WTable, Box(1.0, 1.6, 0.1), WOOD)
        plant.Finalize()
        thermos = plant.GetBodyByName("thermos")

        model = MultibodyPlant(0.0)
        _, tip, _ = add_arm_with_thermos(model, config)
        target = model.AddFrame(FixedOffsetFrame("target", model.world_frame(), config.X_WT))
        model.Finalize()
        self._controller_plant = ControllerPlant(model, target, tip, np.array(config.arm.level_posture))
        posture = self._controller_plant.posture = self._controller_plant.solve(
            MID_POURING_POSE, self._controller_plant.posture
        )
        controller = CartesianPositionController(
            model, target, tip, posture=posture, period=config.control_period, speed_limits=SPEED_LIMITS
        )
        builder.AddNamedSystem("controller", controller)
        # Without a desired velocity, the drives' damping would oppose the motion, and the arm would lag by centimeters.
        n, body_poses = config.arm.num_joints, plant.get_body_poses_output_port()
        drives = StateInterpolatorWithDiscreteDerivative(n, config.control_period, suppress_initial_transient=True)
        add_system(builder, "drives", drives, controller.get_joint_positions_output_port())
        positions = MatrixGain(np.eye(n, 2 * n))
        add_system(builder, "positions", positions, plant.get_state_output_port(self.arm))
        measured = add_system(builder, "pose", MeasuredPose(plant, thermos, config.X_WT), body_poses=body_poses)
        links = [plant.get_body(index) for index in plant.GetBodyIndices(self.arm)]
        period = config.plant_period
        contact_detector = ContactDetector(plant, [*links, thermos], [plant.world_body(), self._mug], period)
        contact_results = plant.get_contact_results_output_port()
        add_system(builder, "contact_detector", contact_detector, contact_results=contact_results)
        axes = config.X_WT.rotation()
        sensor = WrenchSensor(plant, wrist, [thermos], self._tip, axes, config.control_period, WRENCH_TIME_CONSTANT)
        builder.AddNamedSystem("wrench_sensor", sensor)
        sensor.connect(builder, plant)
        relative_poses = [
            ("tip_in_mug", RelativePoses(plant, [thermos], self._mug)),
            ("balls_in_mug", RelativePoses(plant, self._balls, self._mug)),
            ("balls_in_thermos", RelativePoses(plant, self._balls, thermos)),
        ]

        builder.Connect(positions.get_output_port(), controller.get_positions_input_port())
        builder.Connect(drives.get_output_port(), plant.get_desired_state_input_port(self.arm))
        export_station_ports(
            builder,
            controller.get_desired_pose_input_port(),
            controller.get_command_time_input_port(),
            pose=measured.get_pose_output_port(),
            wrench=sensor.get_wrench_output_port(),
            contact_force=contact_detector.get_contact_force_output_port(),
            saturation=controller.get_stuck_output_port(),
            command_timed_out=controller.get_command_timed_out_output_port(),
        )
        for name, system in relative_poses:
            add_system(builder, name, system, body_poses=body_poses)
            builder.ExportOutput(system.get_relative_poses_output_port(), name)
        builder.ExportOutput(contact_detector.get_collision_output_port(), "collision")
        builder.ExportOutput(contact_detector.get_has_collided_output_port(), "touched")
        export_scene_ports(builder, self.plant, self.scene_graph)
        builder.BuildInto(self)

    def set_mug(self, root_context: Context, X_TMug: RigidTransform) -> None:
        """Move the mug and its stand so that the tip frame of the mug is at X_TMug."""
        context = self.plant.GetMyMutableContextFromRoot(root_context)
        self._mount.SetPoseInParentFrame(context, self.config.X_WT @ X_TMug)

    def set_pose(self, context: Context, pose: np.ndarray) -> None:
        """Put the arm at rest with the tip at `pose`, (6,), and the balls into the thermos, which must be upright.

        `context` is the root context.
        """
        self._controller_plant.place(self.plant, self.arm, context, pose)
        plant_context = self.plant.GetMyMutableContextFromRoot(context)
        X_WP = self._tip.CalcPoseInWorld(plant_context)
        for ball, p_PB in zip(self._balls, self.config.stack(), strict=True):
            self.plant.SetFloatingBaseBodyPoseInWorldFrame(plant_context, ball, RigidTransform(X_WP @ p_PB))


def add_arm_with_thermos(plant: MultibodyPlant, config: PouringConfig) -> tuple[ModelInstanceIndex, Frame, WeldJoint]:
    """Add the arm at the world's origin, a hand and the thermos; return arm, tip and wrist."""
    arm = add_robot(plant, config.arm)
    thermos = add_vessel(plant, "thermos", config.thermos, BLUE)
    wrist = plant.WeldFrames(arm.flange, thermos.body_frame(), config.X_FlangeP)
    # The hand is a cylinder from the flange to the thermos's wall; it is part of the thermos's body.
    length = config.grip - config.thermos.outer_radius
    X_PHand = config.X_FlangeP.inverse() @ RigidTransform([0.0, 0.0, length / 2])
    add_shape(thermos, "hand", X_PHand, Cylinder(0.03, length), METAL)
    for model in (arm.model, thermos.model_instance()):
        # Without gravity, as on a real arm under position control, where integral action compensates gravity.
        plant.set_gravity_enabled(model, False)
    if config.arm.drives is not None:
        add_drives(arm.actuators, config.arm.drives)
    return arm.model, thermos.body_frame(), wrist


def _add_stand(plant: MultibodyPlant, mug: RigidBody, config: PouringConfig) -> None:
    """Add the stand under the mug; it is part of the mug's body and moves with it."""
    if config.stand_height > 0:
        X_MG = RigidTransform([0.0, 0.0, -config.mug.height - config.stand_height / 2])
        add_shape(mug, "stand", X_MG, Cylinder(config.mug.outer_radius, config.stand_height), WOOD)


def make_mug(inner_diameter: float, depth: float, ball: Ball) -> Vessel:
    """Return a mug with these dimensions [m].

    Raises:
        InputError: If the balls do not fit into the mug, or the mug is too large for the arm.
    """
    narrowest, shallowest = 1.25 * ball.diameter, 1.5 * ball.diameter
    if not narrowest <= inner_diameter <= 0.2 or not shallowest <= depth <= 0.25:
        raise InputError(
            f"a mug of {inner_diameter} m inner diameter and {depth} m depth is too small for the balls or too large "
            f"for the arm: stay within {narrowest:.3g} to 0.2 m and {shallowest:.3g} to 0.25 m"
        )
    return Vessel(inner_diameter=inner_diameter, depth=depth)
