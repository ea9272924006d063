"""Workcell with a tool on a gantry, simulated by a physics engine other than Drake."""

import math
from typing import NamedTuple, Protocol

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.geometry import FramePoseVector
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, RigidBody
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from guiderail.diagrams.stations.gantry import joint_damping
from guiderail.diagrams.stations.station import Impedance
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.transforms import POSE_SIZE, WRENCH_SIZE
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import check_period, input_getter, output_getter
from guiderail.systems.support.drake_multibody import pose_to_transform

MAX_JOINT_SPEED = 1e3  # joint speed above which a simulation counts as diverged [m/s, rad/s]


class DivergedError(RuntimeError):
    """Error for a diverged state of the physics engine, or for a full contact or constraint buffer."""


class MovedBodies(NamedTuple):
    """Bodies of a plant that the engine's model also contains: fixture, tool, and the workpiece fixed to the tool."""

    fixture: RigidBody
    tool: RigidBody
    workpiece: RigidBody


class Input(NamedTuple):
    """Constant input of an engine during one update."""

    desired_pose: np.ndarray  # desired pose of the tool center, (6,) [m, rad]
    X_TFixture: RigidTransform  # pose of the fixture in the target frame
    X_PWorkpiece: RigidTransform  # pose of the workpiece relative to the tool center
    friction: float  # factor of all friction coefficients
    modulus: float  # factor of the stiffness of contacts and springs


class Engine(Protocol):
    """Physics engine with a model of a tool on the joints x, y, z, Rz, Ry, Rx in the target frame.

    It keeps no state between updates: everything that it needs is in the state vector.
    """

    name: str  # name in messages
    time_step: float  # nominal time step [s]
    state_size: int  # size of the state vector
    positions: slice  # part of the state with the pose of the tool center, (6,)
    speeds: slice  # part of the state with the velocities of all joints, the time derivative of the pose first

    def at_rest(self, pose: np.ndarray) -> np.ndarray:
        """Return the state with the tool at rest at `pose` (6,)."""

    def advance(self, state: np.ndarray, given: Input, num_steps: int) -> tuple[np.ndarray, np.ndarray, float]:
        """Return the state after `num_steps` nominal time steps.

        Returns:
            State; contact wrench on the tool (N, 6) in each of the actual time steps, at the tool center in the axes
            of T, force first; the actual time step [s].

        Raises:
            DivergedError: If the engine reports a failure.
        """


class EngineGantry(LeafSystem):
    """Simulate an engine's model of a tool with the six joints x, y, z, Rz, Ry, Rx in a target frame T.

        M q'' + c = clip(K (x_d − q) − D q', ± limits) + J^T f,  τ y' = w − y

    q is the pose of the tool, M and c are its inertia and bias forces, and x_d is the desired pose. K, D and the limits
    are those of an impedance. The engine computes the contact forces f. w is the wrench of f on the tool, at the
    tool center in the axes of T, and y is the filtered wrench. A static plant defines the pose of the fixture, and the
    pose of the workpiece relative to the tool, including their offsets. In every update, the bodies of the engine's
    model are placed at these poses.

    .. pydrake_system::

        name: EngineGantry
        input_ports:
        - desired_pose
        - nominal_body_poses
        output_ports:
        - pose
        - state
        - wrench
        - impedance_wrench
        - body_poses
        - geometry_poses

    ``desired_pose`` and ``pose`` are X_TP as (6,) [x y z Rz Ry Rx] in meters and radians. ``nominal_body_poses`` is the
    output of the static plant. ``body_poses`` contains the same poses, except that tool and workpiece have their
    simulated poses. ``state`` is (12,), the pose and its time derivative. ``geometry_poses`` contains the poses of all
    frames with geometry. ``wrench`` is the filtered wrench y, (6,), force first, in N and Nm. ``impedance_wrench`` is
    (6,), the forces and torques of the six joints in the order of the pose. The state of the engine and of the filter
    is declared discrete state.

    Args:
        engine: Physics engine; this system writes to its model.
        impedance: Impedance that the engine's model has.
        plant: Finalized plant without joints, registered as a source of geometry.
        moved: Bodies of the plant that the model also contains.
        X_WT: Pose of the target frame in the world of the plant. The target frame is the world of the model.
        period: Update period [s], positive, an integer multiple of the engine's step.
        time_constant: τ of the wrench filter [s], not negative, finite; 0 disables it.

    Raises:
        InputError: If a number is out of range, or the engine's step does not divide the period.
        DivergedError: At an update, if the engine diverges, or its contact or constraint buffer is full.
    """

    def __init__(
        self,
        engine: Engine,
        impedance: Impedance,
        plant: MultibodyPlant,
        moved: MovedBodies,
        X_WT: RigidTransform,
        period: float,
        time_constant: float,
    ):
        super().__init__()
        check_period(period)
        if not 0.0 <= time_constant < np.inf:
            raise InputError(f"a wrench sensor's time constant must be finite and not negative, not {time_constant} s")
        step = engine.time_step
        self._num_steps = round(period / step)
        if abs(self._num_steps * step - period) > 1e-9:
            raise InputError(f"{engine.name}'s step of {step} s does not divide the period of {period} s")
        self.engine = engine
        self._stiffness, self._damping = np.array(impedance.stiffness), joint_damping(impedance)
        self._limits = np.array(impedance.limits)
        self._time_constant = time_constant
        self._X_WT, self._X_TW = X_WT, X_WT.inverse()
        self._moved = MovedBodies(*(int(body.index()) for body in moved))
        frames = [(i, plant.GetBodyFrameIdIfExists(BodyIndex(i))) for i in range(1, plant.num_bodies())]
        self._frames = [(body, frame) for body, frame in frames if frame is not None]  # only bodies with geometry
        self._physics = slice(0, engine.state_size)
        self._filtered = slice(engine.state_size, engine.state_size + 6)
        self._positions = engine.positions
        self._velocities = slice(engine.speeds.start, engine.speeds.start + POSE_SIZE)
        poses = plant.get_body_poses_output_port()
        self._desired_pose_port = self.DeclareVectorInputPort("desired_pose", POSE_SIZE)
        self._nominal_body_poses_port = self.DeclareAbstractInputPort("nominal_body_poses", poses.Allocate())
        self._factors = self.DeclareNumericParameter(BasicVector(np.ones(2)))
        self._state = self.DeclareDiscreteState(self._at_rest(np.zeros(POSE_SIZE)))
        body_poses = declare.tickets(self, [self._state, self._nominal_body_poses_port])
        declare.part_output(self, "pose", self._state, lambda state: state[self._positions], POSE_SIZE)
        declare.part_output(
            self, "state", self._state, lambda state: [*state[self._positions], *state[self._velocities]], 2 * POSE_SIZE
        )
        declare.part_output(self, "wrench", self._state, lambda state: state[self._filtered], WRENCH_SIZE)
        declare.output(
            self, "impedance_wrench", WRENCH_SIZE, self._impedance_wrench, [self._state, self._desired_pose_port]
        )
        self._body_poses_port = self.DeclareAbstractOutputPort(
            "body_poses", poses.Allocate, self._calc_body_poses, prerequisites_of_calc=body_poses
        )
        self.DeclareAbstractOutputPort(
            "geometry_poses",
            lambda: Value(FramePoseVector()),
            self._calc_geometry_poses,
            prerequisites_of_calc=body_poses,
        )
        declare.update(self, period, self._update)

    get_desired_pose_input_port = input_getter("desired_pose", "desired pose of the tool center, (6,)")
    get_nominal_body_poses_input_port = input_getter("nominal_body_poses", "body poses of the static plant")
    get_pose_output_port = output_getter("pose", "pose of the tool center, (6,)")
    get_state_output_port = output_getter("state", "pose of the tool center and its velocity, (12,)")
    get_wrench_output_port = output_getter("wrench", "filtered wrench on the tool, (6,), force first")
    get_impedance_wrench_output_port = output_getter("impedance_wrench", "forces and torques of the six joints, (6,)")
    get_body_poses_output_port = output_getter("body_poses", "poses of all bodies of the plant")
    get_geometry_poses_output_port = output_getter("geometry_poses", "poses of all frames with geometry")

    def set_pose(self, context: Context, pose: np.ndarray) -> None:
        """Set the tool to `pose` (6,) [m, rad] at rest; `context` is this system's."""
        context.SetDiscreteState(self._state, self._at_rest(pose))

    def set_contact(self, context: Context, friction: float, modulus: float) -> None:
        """Scale all friction coefficients and the stiffness of contacts and springs; `context` is this system's.

        `friction` and `modulus` are the factors. If `modulus` is above 1, the time step of the engine is divided by
        √modulus, rounded up.

        Raises:
            InputError: If a factor is not finite, the friction is negative, or the modulus is not positive.
        """
        if not 0.0 <= friction < math.inf:
            raise InputError(f"the factor of the friction must be finite and not negative, not {brief(friction)}")
        if not 0.0 < modulus < math.inf:
            raise InputError(f"the factor of the contact stiffness must be finite and positive, not {brief(modulus)}")
        context.get_mutable_numeric_parameter(self._factors).SetFromVector([friction, modulus])

    def _at_rest(self, pose: np.ndarray) -> np.ndarray:
        return np.concatenate([self.engine.at_rest(pose), np.zeros(6)])

    def _values(self, context: Context) -> np.ndarray:
        return context.get_discrete_state().value(self._state)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        state, poses = self._values(context), self._nominal_body_poses_port.Eval(context)
        given = Input(
            self._desired_pose_port.Eval(context),
            self._X_TW @ poses[self._moved.fixture],
            poses[self._moved.tool].InvertAndCompose(poses[self._moved.workpiece]),
            *context.get_numeric_parameter(self._factors).value(),
        )
        physics, wrenches, step = self.engine.advance(state[self._physics].copy(), given, self._num_steps)
        filtered = state[self._filtered]
        decay = np.exp(-step / self._time_constant) if self._time_constant > 0.0 else 0.0
        for newest in wrenches:
            filtered = newest + decay * (filtered - newest)
        next_state = np.concatenate([physics, filtered])
        if not np.isfinite(next_state).all():
            raise DivergedError(f"the simulation failed in {self.engine.name}: its state is not finite")
        if np.abs(physics[self.engine.speeds]).max() > MAX_JOINT_SPEED:
            raise DivergedError(
                f"the simulation failed in {self.engine.name}: a joint is faster than {MAX_JOINT_SPEED:g} m/s or rad/s"
            )
        discrete_state.set_value(self._state, next_state)

    def _impedance_wrench(self, context: Context) -> np.ndarray:
        state = self._values(context)
        spring_force = self._stiffness * (self._desired_pose_port.Eval(context) - state[self._positions])
        return np.clip(spring_force - self._damping * state[self._velocities], -self._limits, self._limits)

    def _calc_body_poses(self, context: Context, output: AbstractValue) -> None:
        poses = list(self._nominal_body_poses_port.Eval(context))
        X_PWorkpiece = poses[self._moved.tool].InvertAndCompose(poses[self._moved.workpiece])
        X_WP = self._X_WT @ pose_to_transform(self._values(context)[self._positions])
        poses[self._moved.tool], poses[self._moved.workpiece] = X_WP, X_WP @ X_PWorkpiece
        output.set_value(poses)

    def _calc_geometry_poses(self, context: Context, output: AbstractValue) -> None:
        poses, vector = self._body_poses_port.Eval(context), FramePoseVector()
        for body, frame in self._frames:
            vector.set_value(frame, poses[body])
        output.set_value(vector)
