"""Workcell with a tool on a gantry, simulated by MuJoCo."""

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.geometry import FramePoseVector
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, RigidBody
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from guiderail.models.common.errors import InputError, brief, import_extra
from guiderail.models.common.transforms import POSE_SIZE, WRENCH_SIZE
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import check_period, input_getter, output_getter
from guiderail.systems.support.drake_multibody import pose_to_transform

if TYPE_CHECKING:
    import mujoco

MAX_JOINT_SPEED = 1e3  # joint speed above which a simulation counts as diverged [m/s, rad/s]


class DivergedError(RuntimeError):
    """Error for a diverged state of the physics engine, or for a full contact or constraint buffer."""


class MovedBodies(NamedTuple):
    """Bodies of a plant that the MuJoCo model also contains: fixture, tool, and the workpiece fixed to the tool."""

    fixture: RigidBody
    tool: RigidBody
    workpiece: RigidBody


class _Nominal(NamedTuple):
    """Nominal values of the model parameters that `set_contact` scales; the names are MuJoCo's."""

    timestep: float
    geom_friction: np.ndarray
    jnt_stiffness: np.ndarray
    dof_damping: np.ndarray
    geom_solref: np.ndarray


class MujocoGantry(LeafSystem):
    """Simulate a MuJoCo model of a tool with the six joints x, y, z, Rz, Ry, Rx in a target frame T.

        M q'' + c = clip(K (x_d − q) − D q', ± limits) + J^T f,  τ y' = w − y

    q is the pose of the tool, M and c are its inertia and bias forces, and x_d is the desired pose. K, D and the limits
    are parameters of the six motors. The engine computes the contact forces f. w is the wrench of f on the tool, at the
    tool center in the axes of T, and y is the filtered wrench. A static plant defines the pose of the fixture, and the
    pose of the workpiece relative to the tool, including their offsets. Before every update, the bodies of the model
    are placed at these poses.

    .. pydrake_system::

        name: MujocoGantry
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
    (6,), the forces and torques of the six motors in the order of the pose. Positions, velocities and warm start of the
    engine and the state of the filter are declared discrete state.

    The engine's automatic reset after a divergence is disabled, because it would move the tool to the target.

    Args:
        model: MuJoCo model with bodies `fixture` and `workpiece`, whose first six joints and motors move the tool; this
            system writes to it.
        plant: Finalized plant without joints, registered as a source of geometry.
        moved: Bodies of the plant that the model also contains.
        X_WT: Pose of the target frame in the world of the plant. The target frame is the world of the model.
        period: Update period [s], positive, an integer multiple of the model's step.
        time_constant: τ of the wrench filter [s], not negative, finite; 0 disables it.

    Raises:
        InputError: If a number is out of range, or the model's step does not divide the period.
        DivergedError: At an update, if the engine diverges, or its contact or constraint buffer is full.
    """

    def __init__(
        self,
        model: "mujoco.MjModel",
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
        step = float(model.opt.timestep)
        self._num_steps = round(period / step)
        if abs(self._num_steps * step - period) > 1e-9:
            raise InputError(f"MuJoCo's step of {step} s does not divide the period of {period} s")
        self._mujoco = import_extra("mujoco")
        model.opt.disableflags |= int(self._mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        # Scratch memory: every update first writes all values that it reads, so `_data` keeps no state between updates.
        self.model, self._data = model, self._mujoco.MjData(model)
        # Warnings of divergence and of a full buffer: the engine ignores contacts and constraints that exceed a buffer.
        failures = ("BADQPOS", "BADQVEL", "BADQACC", "BADCTRL", "CONTACTFULL", "CNSTRFULL")
        self._failures = [self._mujoco.mjtWarning.__members__[f"mjWARN_{name}"].value for name in failures]
        # Stored parts of the engine's state, including the warm start, so that a restored state continues identically.
        self._parts = self._mujoco.mjtState.mjSTATE_INTEGRATION
        self._time_constant = time_constant
        self._X_WT, self._X_TW = X_WT, X_WT.inverse()
        self._fixture, self._workpiece = (model.body(name).id for name in ("fixture", "workpiece"))
        self._moved = MovedBodies(*(int(body.index()) for body in moved))
        frames = [(i, plant.GetBodyFrameIdIfExists(BodyIndex(i))) for i in range(1, plant.num_bodies())]
        self._frames = [(body, frame) for body, frame in frames if frame is not None]  # only bodies with geometry
        size = self._mujoco.mj_stateSize(model, self._parts)
        self._physics = slice(0, size)
        self._filtered = slice(size, size + 6)
        # The state of the engine starts with time, positions and velocities.
        self._positions = slice(1, 1 + POSE_SIZE)
        self._velocities = slice(1 + model.nq, 1 + model.nq + POSE_SIZE)
        poses = plant.get_body_poses_output_port()
        self._desired_pose_port = self.DeclareVectorInputPort("desired_pose", POSE_SIZE)
        self._nominal_body_poses_port = self.DeclareAbstractInputPort("nominal_body_poses", poses.Allocate())
        self._nominal = _Nominal(step, *(getattr(model, name).copy() for name in _Nominal._fields[1:]))
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
    get_impedance_wrench_output_port = output_getter("impedance_wrench", "forces and torques of the six motors, (6,)")
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
        self._mujoco.mj_resetData(self.model, self._data)
        self._data.qpos[:POSE_SIZE] = pose
        return np.concatenate([self._engine_state(), np.zeros(6)])

    def _engine_state(self) -> np.ndarray:
        state = np.empty(self._physics.stop)
        self._mujoco.mj_getState(self.model, self._data, state, self._parts)
        return state

    def _values(self, context: Context) -> np.ndarray:
        return context.get_discrete_state().value(self._state)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        model, data = self.model, self._data
        state = self._values(context)
        self._place(self._nominal_body_poses_port.Eval(context))
        num_substeps = self._scale_contact(*context.get_numeric_parameter(self._factors).value())
        self._mujoco.mj_setState(model, data, state[self._physics].copy(), self._parts)
        data.ctrl[:POSE_SIZE] = self._desired_pose_port.Eval(context)
        # Warning counts start at 1, because at 0 the engine would write a log file to the working directory at the
        # first warning.
        for warning in self._failures:
            data.warning[warning].number = 1
        filtered = state[self._filtered]
        decay = np.exp(-model.opt.timestep / self._time_constant) if self._time_constant > 0.0 else 0.0
        for _ in range(num_substeps * self._num_steps):
            self._mujoco.mj_step(model, data)
            self._check_warnings()
            newest = self._contact_wrench()
            filtered = newest + decay * (filtered - newest)
        next_state = np.concatenate([self._engine_state(), filtered])
        if not np.isfinite(next_state).all():
            raise DivergedError("the simulation failed in MuJoCo: its state is not finite")
        if np.abs(data.qvel).max() > MAX_JOINT_SPEED:
            raise DivergedError(
                f"the simulation failed in MuJoCo: a joint is faster than {MAX_JOINT_SPEED:g} m/s or rad/s"
            )
        discrete_state.set_value(self._state, next_state)

    def _check_warnings(self) -> None:
        numbers = self._data.warning.number[self._failures]
        if numbers.max() > 1:
            warning = self._failures[int(numbers.argmax())]
            about = int(self._data.warning[warning].lastinfo)
            raise DivergedError(f"the simulation failed in MuJoCo: {self._mujoco.mju_warningText(warning, about)}")

    def _place(self, poses: list[RigidTransform]) -> None:
        X_TFixture = self._X_TW @ poses[self._moved.fixture]
        X_PWorkpiece = poses[self._moved.tool].InvertAndCompose(poses[self._moved.workpiece])
        for body, X in ((self._fixture, X_TFixture), (self._workpiece, X_PWorkpiece)):
            self.model.body_pos[body] = X.translation()
            self.model.body_quat[body] = X.rotation().ToQuaternion().wxyz()

    def _scale_contact(self, friction: float, modulus: float) -> int:
        """Scale the model's contact parameters and return the number of substeps that replace one step.

        With the substeps, the engine can integrate stiffer springs. The time constant of a contact is at least two
        substeps. The damping of stiffer springs is increased so that their damping ratio is constant.
        """
        model, nominal = self.model, self._nominal
        num_substeps = max(math.ceil(math.sqrt(modulus) - 1e-9), 1)
        model.opt.timestep = nominal.timestep / num_substeps
        model.geom_friction[:] = nominal.geom_friction * friction
        model.jnt_stiffness[:] = nominal.jnt_stiffness * modulus
        model.dof_damping[:] = nominal.dof_damping * math.sqrt(max(modulus, 1.0))
        constants = nominal.geom_solref[:, 0] / math.sqrt(modulus)
        model.geom_solref[:, 0] = np.maximum(constants, 2.0 * model.opt.timestep)
        return num_substeps

    def _contact_wrench(self) -> np.ndarray:
        """Return the wrench of the generalized contact forces.

        The prismatic joints are along the axes of T. For a torque t, the generalized force of a hinge about an axis a
        is a · t.
        """
        generalized, axes = self._data.qfrc_constraint[:POSE_SIZE], self._data.xaxis[3:POSE_SIZE]
        return np.concatenate([generalized[:3], np.linalg.solve(axes, generalized[3:])])

    def _impedance_wrench(self, context: Context) -> np.ndarray:
        model, state = self.model, self._values(context)
        springs, dampers = model.actuator_gainprm[:POSE_SIZE, 0], -model.actuator_biasprm[:POSE_SIZE, 2]
        spring_force = springs * (self._desired_pose_port.Eval(context) - state[self._positions])
        limits = model.actuator_forcerange[:POSE_SIZE]
        return np.clip(spring_force - dampers * state[self._velocities], limits[:, 0], limits[:, 1])

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
