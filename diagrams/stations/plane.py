"""Plane station: a point robot under position control among walls."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydrake.geometry import AddContactMaterial, Box, Cylinder, ProximityProperties, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, ModelInstanceIndex, PrismaticJoint, SpatialInertia
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.primitives import Adder, Gain, MatrixGain, Multiplexer, Saturation

from guiderail.diagrams.stations.registry import register_station
from guiderail.diagrams.stations.station import (
    Station,
    add_contact_force,
    add_plant,
    check_pose,
    command_timeout,
    export_scene_ports,
    export_station_ports,
    set_at_rest,
    whole_multiple,
)
from guiderail.diagrams.wiring import add_system
from guiderail.models.common.arrays import round_period
from guiderail.models.objects.narrow_passage import PassageGeometry
from guiderail.systems.command_checks import CommandWatchdog

OBSTACLE_Z = -0.035  # height of the visual obstacles [m]; the robot passes above them
OBSTACLE_COLOR = [0.75, 0.25, 0.15, 1.0]


@dataclass(frozen=True)
class PlaneConfig:
    """Parameters of the robot and its time steps.

    The robot is a light ball on two prismatic joints. Each joint has a proportional force with a limit, and viscous
    friction, which the plant integrates implicitly. At the limit the robot moves at `max_speed`: 20 mm in a plant step,
    which is much less than a wall's thickness. Below the limit, position control is critically damped: the robot
    reaches a command within a control step and does not overshoot.
    """

    plant_period: float = round_period(0.002)  # time step of the plant [s]
    substeps: int = 10  # plant steps per control step
    mass: float = 0.001  # mass of the robot [kg]
    max_force: float = 50.0  # largest force of each joint [N]
    max_speed: float = 10.0  # largest speed of each joint [m/s]
    # Friction coefficient between robot and walls; high, so that a robot pressed against a wall does not slide.
    friction: float = 10.0
    stiffness: float = 1e6  # stiffness of the contact [N/m]

    @property
    def control_period(self) -> float:
        """Duration of a control step [s]."""
        return self.substeps * self.plant_period

    @property
    def damping(self) -> float:
        """Damping of each joint [N s/m], with which `max_force` moves it at `max_speed`."""
        return self.max_force / self.max_speed

    @property
    def position_gain(self) -> float:
        """Position gain [N/m] for critical damping of the discrete loop.

        For mass m, damping d, gain k and plant period h, let a = m/(m + d h) and b = k h²/(m + d h). The loop's
        characteristic polynomial is z² − (1 + a − b) z + a; both roots are √a if b = (1 − √a)².
        """
        inertia = self.mass + self.damping * self.plant_period
        return (1 - np.sqrt(self.mass / inertia)) ** 2 * inertia / self.plant_period**2


@register_station(
    "plane",
    workcell_kind="plane",
    time_unit=PlaneConfig.plant_period,
    control_period=PlaneConfig().control_period,
)
class PlaneStation(Station):
    """Point robot under position control in a plane with walls.

    ``desired_pose`` and ``pose`` are the position (x, y) of the robot's center [m]. ``wrench`` (2,) is the force of the
    walls on the robot, averaged over the control step [N], and ``contact_force`` (1,) its norm. ``saturation`` (2,) is
    the force of each joint beyond its limit [N]. ``query`` is the query port of the scene graph, for cameras.

    `walls` and `robot_radius` of the workcell are simulated; `goal`, `goal_radius`, `zone_x`, `obstacle`,
    `obstacle_radius`, `obstacles` and `obstacles_move` are only visual geometry here; a task uses them in its
    constraints, terminations and rewards.
    """

    def __init__(
        self, passage: PassageGeometry, config: PlaneConfig = PlaneConfig(), control_period: float | None = None
    ):
        """Construct the station from the geometry of walls, goal and obstacles.

        Args:
            passage: Geometry of walls, goal and obstacles.
            config: Periods and gains of the station.
            control_period: Whole multiple of the plant's period [s] that replaces the control period of the `config`.

        Raises:
            InputError: If `control_period` is no whole multiple of the plant's period.
        """
        super().__init__()
        if control_period is not None:
            exact = whole_multiple(control_period, config.plant_period)
            config = replace(config, substeps=round(exact / config.plant_period))
        builder = DiagramBuilder()
        self.config = config
        self.control_period = config.control_period
        self.plant, self.scene_graph = add_plant(builder, config.plant_period, contact_model="point")
        self.plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
        self._robot = _add_robot(self.plant, passage, config)
        _add_walls(self.plant, passage, config)
        _add_markings(self.plant, passage)
        self._obstacle_frames = _add_moving_obstacles(self.plant, passage) if passage.obstacles_move else []
        self.plant.Finalize()

        # F = clip(k (x_d - x), ±F_max), against the joints' viscous friction.
        identity = np.eye(2)
        state = self.plant.get_state_output_port(self._robot)
        pose = add_system(builder, "pose", MatrixGain(D=np.eye(2, 4)), state).get_output_port()
        watchdog = CommandWatchdog(config.control_period, command_timeout(config.control_period), 2)
        add_system(builder, "watchdog", watchdog, pose=pose)
        poses = Multiplexer([2, 2])
        add_system(builder, "desired_and_measured_pose", poses, watchdog.get_safe_pose_output_port(), pose)
        gain = MatrixGain(D=config.position_gain * np.hstack([identity, -identity]))
        force = add_system(builder, "position_gain", gain, poses.get_output_port()).get_output_port()
        limit = np.full(2, config.max_force)
        applied = add_system(builder, "force_limit", Saturation(-limit, limit), force).get_output_port()
        builder.Connect(applied, self.plant.get_actuation_input_port(self._robot))
        negative = add_system(builder, "negative_force", Gain(-1.0, 2), applied).get_output_port()
        excess = add_system(builder, "excess_force", Adder(2, 2), force, negative)

        export_station_ports(
            builder,
            watchdog.get_desired_pose_input_port(),
            watchdog.get_command_time_input_port(),
            pose=pose,
            saturation=excess.get_output_port(),
            command_timed_out=watchdog.get_command_timed_out_output_port(),
            **add_contact_force(builder, self.plant, self._robot, config.control_period),
        )
        export_scene_ports(builder, self.plant, self.scene_graph)
        builder.BuildInto(self)

    def set_pose(self, context: Context, pose: np.ndarray) -> None:
        """Put the robot's center at `pose`, (2,) [m], at rest; `context` is the root context."""
        set_at_rest(self.plant, self._robot, context, check_pose(pose, 2))

    def set_obstacles(self, context: Context, obstacles: np.ndarray) -> None:
        """Put the n moving obstacles of the workcell at `obstacles`, (n, 2) [m]; `context` is the root context."""
        plant_context = self.plant.GetMyMutableContextFromRoot(context)
        for frame, (x, y) in zip(self._obstacle_frames, obstacles, strict=True):
            frame.SetPoseInParentFrame(plant_context, RigidTransform([x, y, OBSTACLE_Z]))


def _add_robot(plant: MultibodyPlant, passage: PassageGeometry, config: PlaneConfig) -> ModelInstanceIndex:
    robot = plant.AddModelInstance("robot")
    # The carriage between the joints is nearly massless, so both joints move the same mass.
    carriage = plant.AddRigidBody("carriage", robot, SpatialInertia.SolidSphereWithMass(1e-3 * config.mass, 0.01))
    ball = plant.AddRigidBody("ball", robot, SpatialInertia.SolidSphereWithMass(config.mass, passage.robot_radius))
    x = PrismaticJoint("x", plant.world_frame(), carriage.body_frame(), [1, 0, 0], damping=config.damping)
    y = PrismaticJoint("y", carriage.body_frame(), ball.body_frame(), [0, 1, 0], damping=config.damping)
    for joint in (plant.AddJoint(x), plant.AddJoint(y)):
        plant.AddJointActuator(joint.name(), joint, config.max_force)
    shape = Sphere(passage.robot_radius)
    plant.RegisterCollisionGeometry(ball, RigidTransform(), shape, "ball", _contact(config))
    plant.RegisterVisualGeometry(ball, RigidTransform(), shape, "ball_visual", np.array([0.1, 0.35, 0.8, 1.0]))
    return robot


def _add_walls(plant: MultibodyPlant, passage: PassageGeometry, config: PlaneConfig) -> None:
    # `walls` bound the robot's center, so they are larger than the real walls by the robot's radius.
    for name, lower, upper in zip(("left_wall", "right_wall"), *passage.walls, strict=True):
        size = upper - lower - 2 * passage.robot_radius
        X_WG = RigidTransform([*(lower + upper) / 2, 0.0])
        shape = Box(*size, 0.1)
        plant.RegisterCollisionGeometry(plant.world_body(), X_WG, shape, name, _contact(config))
        plant.RegisterVisualGeometry(plant.world_body(), X_WG, shape, f"{name}_visual", np.array([0.4, 0.4, 0.42, 1.0]))


def _add_markings(plant: MultibodyPlant, passage: PassageGeometry) -> None:
    """Add floor, restricted zone, obstacle and goal as visual geometry."""
    body = plant.world_body()

    def mark(name: str, shape: Any, x: float, y: float, z: float, color: Any) -> None:
        plant.RegisterVisualGeometry(body, RigidTransform([x, y, z]), shape, name, np.array(color))

    mark("floor", Box(3.0, 3.0, 0.001), 0.4, 0.5, -0.06, [0.97, 0.97, 0.95, 1.0])
    mark("zone", Box(1.0, 3.0, 0.001), passage.zone_x + 0.5, 0.5, -0.055, [0.95, 0.72, 0.70, 1.0])
    mark("goal", Cylinder(passage.goal_radius, 0.001), *passage.goal, -0.05, [0.55, 0.80, 0.55, 1.0])
    if not passage.obstacles_move:
        mark("obstacle", _obstacle_shape(passage), *passage.obstacle, OBSTACLE_Z, OBSTACLE_COLOR)


def _add_moving_obstacles(plant: MultibodyPlant, passage: PassageGeometry) -> list[FixedOffsetFrame]:
    """Add visual obstacles, each welded to a frame that can be moved in the context; return the frames."""
    model, frames = plant.AddModelInstance("obstacles"), []
    for number, (x, y) in enumerate(passage.obstacles):
        X_WO = RigidTransform([x, y, OBSTACLE_Z])
        frames.append(plant.AddFrame(FixedOffsetFrame(f"obstacle_mount_{number}", plant.world_frame(), X_WO)))
        body = plant.AddRigidBody(f"obstacle_{number}", model, SpatialInertia.SolidSphereWithMass(1.0, 0.01))
        plant.WeldFrames(frames[-1], body.body_frame())
        plant.RegisterVisualGeometry(body, RigidTransform(), _obstacle_shape(passage), "disc", np.array(OBSTACLE_COLOR))
    return frames


def _obstacle_shape(passage: PassageGeometry) -> Cylinder:
    return Cylinder(passage.obstacle_radius, 0.03)


def _contact(config: PlaneConfig) -> ProximityProperties:
    properties, friction = ProximityProperties(), CoulombFriction(config.friction, config.friction)
    AddContactMaterial(dissipation=0.0, point_stiffness=config.stiffness, friction=friction, properties=properties)
    return properties
