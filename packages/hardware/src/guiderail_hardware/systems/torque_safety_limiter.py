"""Limiter of joint torques that brings the arm to rest on any fault."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.errors import InputError
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail_hardware.models.joint_status import STATUS_FAULTS, Fault, damping_torque, is_hold_ineffective

# Indices into the discrete state [value of `ArmState`; code of the `Fault` that caused the last stop; time since the
# last change to DAMPING or OFF in s; blend factor from 0 to 1; largest joint speed at the beginning of the stop in
# rad/s; 1 if the driver does not hold the arm although it was asked to].
_ARM_STATE, _BLEND_FACTOR = 0, 3

REST_SPEED, REST_TIME = 0.15, 0.15  # largest joint speed [rad/s], for this time [s] before an arm resumes
ZERO_TORQUE_TIME = 0.05  # shortest time for which zero torque is sent after damping, even with a status fault [s]


class ArmState(IntEnum):
    """Lifecycle state of an arm: waiting for its status, ramping up, running, coming to rest, without torque."""

    WAITING = 0
    RAMPING = 1
    RUNNING = 2
    DAMPING = 3
    OFF = 4


CONTROLLED = ArmState.RAMPING, ArmState.RUNNING  # states in which the arm follows commanded torques
STOPPED = ArmState.DAMPING, ArmState.OFF


@dataclass(frozen=True)
class SafetyLimits:
    """Limits of an arm, and durations of its stop and its start.

    Args:
        velocity: Velocity limit of each joint (n,) [rad/s], positive.
        torque: Limit of the torque sent to each joint (n,) [Nm], positive.
        external_torque: Limit of the external torque of each joint (n,) [Nm], positive.
        force: Limit of the force on the tool [N], positive.
        lower, upper: Corners of the workspace of the tool center in the target frame (3,) [m], finite.
        damping_time: Duration of damping in a stop, before zero torque is sent [s], positive.
        decay_time: Decay time of the joint velocities during damping [s], at least two periods.
        ramp_time: Time in which the blend factor increases to 1 [s], positive.

    Raises:
        InputError: If a limit or a time is out of range, the numbers of joints differ, or the workspace is empty.
    """

    velocity: tuple[float, ...]
    torque: tuple[float, ...]
    external_torque: tuple[float, ...]
    force: float = 60.0
    lower: tuple[float, float, float] = (-0.2, -0.2, -0.1)
    upper: tuple[float, float, float] = (0.2, 0.2, 0.3)
    damping_time: float = 0.2
    decay_time: float = 0.02
    ramp_time: float = 0.5

    def __post_init__(self) -> None:
        if not len(self.velocity) == len(self.torque) == len(self.external_torque):
            raise InputError("an arm's limits of velocity, torque and external torque need a number for each joint")
        times = (self.damping_time, self.decay_time, self.ramp_time)
        for value in (*self.velocity, *self.torque, *self.external_torque, self.force, *times):
            if not 0.0 < value < np.inf:
                raise InputError(f"an arm's limits and times must be positive and finite, not {value}")
        if not len(self.lower) == len(self.upper) == 3:
            raise InputError(f"a workspace has corners of three numbers, not {self.lower} and {self.upper}")
        if not (self.lower < np.array(self.upper)).all():
            raise InputError(f"a workspace from {self.lower} to {self.upper} is empty")
        if not np.isfinite([self.lower, self.upper]).all():
            raise InputError(f"a workspace must be finite, not from {self.lower} to {self.upper}")


class TorqueSafetyLimiter(LeafSystem):
    """Pass commanded torques through; on any fault, damp the arm to rest and then command zero torque.

        τ = clip(a f τ_commanded + (1 − a) τ_damping)

    The blend factor a increases from 0 to 1 in the ramp time. The freshness f falls from 1 at a status age of one
    period to 0 at two periods, because torques computed from an old state could accelerate the arm. With τ_damping
    (`damping_torque`), the velocity decays with the decay time; the inertia is that of the last accepted positions. The
    velocity is estimated from several sources, and predicted while no status is accepted.

    A limit violation or a fault of the status stops the arm at once. The fault is stored until `resume` is called. At
    the start, the limiter waits until no fault is present and then ramps up without `resume`. If an initialization
    occurs while the arm is controlled, the arm is stopped with `Fault.INITIALIZED`, because a driver may repeat the
    last torque forever. An initialization does not end a stop. An earlier context must not be restored while the arm is
    controlled.

    The output is always finite and within the torque limits. At zero torque, the robot only compensates its weight.
    After damping, zero torque is sent for `ZERO_TORQUE_TIME`, and then only while there is no status fault. If the
    driver can hold the arm by itself (brakes, position control), ``is_holding`` requests this after a fault of
    `STATUS_FAULTS`, and ``safe_torque`` is zero meanwhile. A driver that refuses (`refuse_hold`), or whose arm does not
    become slower (`is_hold_ineffective`), does not hold the arm: it is damped by torques.

    .. pydrake_system::

        name: TorqueSafetyLimiter
        input_ports:
        - torque
        - estimated_state
        - external_torque
        - wrench
        - pose
        - desired_pose
        - status_fault
        - status_age
        - velocity
        - reported_speed
        - command_timed_out
        output_ports:
        - safe_torque
        - fault
        - arm_state
        - blend_factor
        - is_sending
        - is_holding
        - not_following

    ``torque`` (commanded) and ``safe_torque`` are (n,) [Nm], ``estimated_state`` is (2n,) [rad, rad/s], and
    ``external_torque`` is (n,) [Nm], with joints in the order of the plant's positions. ``wrench`` is (6,), force
    first. ``pose`` and ``desired_pose`` are (6,); their positions are checked. ``status_fault`` (1,), ``status_age``
    (1,) [s], ``velocity`` (n,) [rad/s] and ``reported_speed`` (1,) [rad/s] are outputs of a `StatusWatchdog`; an
    unknown fault code counts as `Fault.MALFORMED`. ``command_timed_out`` is (1,), from a `CommandWatchdog`.

    ``fault`` is (1,). While the arm is stopped, it is the code of the `Fault` that stopped the arm, otherwise the code
    of the present fault. ``arm_state`` is (1,), a value of `ArmState`. ``blend_factor`` is (1,). ``is_sending`` (1,) is
    1 while commands are sent. ``is_holding`` (1,) is 1 while the driver has to hold the arm instead. ``not_following``
    (1,) is 1 while the desired pose is not followed: the arm is not in the state RUNNING, or no valid command is
    available.

    Args:
        plant: Finalized model of only the arm and its payload; provides the inertia.
        limits: Limits of measured and sent values.
        period: Period of the torque commands [s], positive.
        can_hold: True if the driver can hold the arm.

    Raises:
        InputError: If an argument is out of range.
    """

    def __init__(self, plant: MultibodyPlant, limits: SafetyLimits, *, period: float, can_hold: bool = False):
        super().__init__()
        num_joints = plant.num_positions()
        if len(limits.velocity) != num_joints:
            raise InputError(f"an arm of {num_joints} joints needs as many limits, not {len(limits.velocity)}")
        if limits.decay_time < 2.0 * period:
            raise InputError(f"decay_time must be at least two periods of {period} s, not {limits.decay_time} s")
        self._plant, self._limits, self._period, self._num_joints = plant, limits, period, num_joints
        self._torque_limits, self._can_hold = np.array(limits.torque), can_hold

        self._torque_port = self.DeclareVectorInputPort("torque", num_joints)
        self._estimated_state_port = self.DeclareVectorInputPort("estimated_state", 2 * num_joints)
        self._external_torque_port = self.DeclareVectorInputPort("external_torque", num_joints)
        self._wrench_port = self.DeclareVectorInputPort("wrench", 6)
        self._pose_port = self.DeclareVectorInputPort("pose", 6)
        self._desired_pose_port = self.DeclareVectorInputPort("desired_pose", 6)
        self._status_fault_port = self.DeclareVectorInputPort("status_fault", 1)
        self._status_age_port = self.DeclareVectorInputPort("status_age", 1)
        self._velocity_port = self.DeclareVectorInputPort("velocity", num_joints)
        self._reported_speed_port = self.DeclareVectorInputPort("reported_speed", 1)
        self._command_timed_out_port = self.DeclareVectorInputPort("command_timed_out", 1)
        self._state = self.DeclareDiscreteState([ArmState.WAITING, Fault.NONE, 0.0, 0.0, 0.0, 0.0])
        self._rest_time = self.DeclareDiscreteState([np.inf])  # time since a joint was faster than `REST_SPEED` [s]

        self._plant_context = declare.plant_context(
            self, plant, self._estimated_state_port.Eval, [self._estimated_state_port]
        )
        measured = [self._estimated_state_port, self._external_torque_port, self._wrench_port, self._pose_port]
        commanded = [self._desired_pose_port, self._torque_port]
        status = [self._status_fault_port, self._status_age_port]
        self._present_fault = declare.cache(
            self, "present_fault", self._find_fault, [self._state, *measured, *commanded, *status]
        )
        fault_and_state = [self._present_fault, self._state]
        inputs = [self._torque_port, self._estimated_state_port, self._status_age_port, self._velocity_port]
        declare.output(self, "safe_torque", num_joints, self._safe_torque, [*fault_and_state, *inputs])
        declare.scalar_output(self, "fault", self._fault, fault_and_state)
        declare.part_output(self, "arm_state", self._state, lambda state: state[_ARM_STATE])
        declare.part_output(self, "blend_factor", self._state, lambda state: state[_BLEND_FACTOR])
        declare.scalar_output(self, "is_sending", self._is_sending, [self._state, self._status_fault_port])
        declare.scalar_output(self, "is_holding", self._is_holding, fault_and_state)
        declare.scalar_output(self, "not_following", self._not_following, [self._state, self._command_timed_out_port])
        declare.update(self, period, self._update, self._stop_at_initialization)

    get_torque_input_port = input_getter("torque", "commanded torques, (n,) [Nm]")
    get_estimated_state_input_port = input_getter("estimated_state", "joint state, (2n,) [rad, rad/s]")
    get_external_torque_input_port = input_getter("external_torque", "external joint torques, (n,) [Nm]")
    get_wrench_input_port = input_getter("wrench", "wrench of the environment on the tool, (6,), force first")
    get_pose_input_port = input_getter("pose", "pose of the tool center, (6,)")
    get_desired_pose_input_port = input_getter("desired_pose", "desired pose of the tool center, (6,)")
    get_status_fault_input_port = input_getter("status_fault", "status fault, (1,), a code of `Fault`")
    get_status_age_input_port = input_getter("status_age", "age of the status, (1,) [s]")
    get_velocity_input_port = input_getter("velocity", "velocity for damping, (n,) [rad/s]")
    get_reported_speed_input_port = input_getter("reported_speed", "largest reported joint speed, (1,) [rad/s]")
    get_command_timed_out_input_port = input_getter("command_timed_out", "flag that no command is valid, (1,)")
    get_safe_torque_output_port = output_getter("safe_torque", "limited torques, (n,) [Nm]")
    get_fault_output_port = output_getter("fault", "fault, (1,), a code of `Fault`")
    get_arm_state_output_port = output_getter("arm_state", "arm state, (1,), a value of `ArmState`")
    get_blend_factor_output_port = output_getter("blend_factor", "blend factor, (1,), from 0 to 1")
    get_is_sending_output_port = output_getter("is_sending", "flag that commands are sent, (1,)")
    get_is_holding_output_port = output_getter("is_holding", "flag that the driver holds the arm, (1,)")
    get_not_following_output_port = output_getter("not_following", "flag that the desired pose is not followed, (1,)")

    def stop(self, context: Context, fault: Fault = Fault.USER_STOP) -> None:
        """Stop the arm with a fault unless the arm is already stopped; `context` is this system's."""
        arm_state = self._state_of(context)[_ARM_STATE]
        if arm_state == ArmState.WAITING:
            # Nothing to damp: no velocity has been accepted and no torque has been sent.
            context.SetDiscreteState(self._state, [ArmState.OFF, fault, np.inf, 0.0, 0.0, 0.0])
        elif arm_state in CONTROLLED:
            context.SetDiscreteState(self._state, [ArmState.DAMPING, fault, 0.0, 0.0, self._speed(context), 0.0])

    def damp_again(self, context: Context) -> None:
        """Restart the damping of a stopped arm, after commands could not be sent; `context` is this system's."""
        arm_state, fault, *_, is_refused = self._state_of(context)
        if arm_state in STOPPED:
            context.SetDiscreteState(self._state, [ArmState.DAMPING, fault, 0.0, 0.0, self._speed(context), is_refused])

    def refuse_hold(self, context: Context) -> None:
        """Damp a stopped arm by torques, because the driver refuses to hold it; `context` is this system's."""
        arm_state, fault, state_time, *rest, _ = self._state_of(context)
        if arm_state in STOPPED:
            context.SetDiscreteState(self._state, [arm_state, fault, state_time, *rest, 1.0])

    def resume(self, context: Context) -> None:
        """Resume after a stop, from the present pose of the arm; `context` is this system's.

        Raises:
            InputError: If the arm is not stopped, damping has not ended, the arm moves, or a fault is present.
        """
        arm_state = self._state_of(context)[_ARM_STATE]
        if arm_state != ArmState.OFF:
            raise InputError(f"only a stopped arm can resume, and this arm is {ArmState(int(arm_state)).name.lower()}")
        fault = self._present_fault.Eval(context)
        if fault:
            raise InputError(f"the arm can't resume yet: {fault.description}")
        # Otherwise statuses of another robot, which moves, could be followed.
        if context.get_discrete_state().value(self._rest_time).item() < REST_TIME - 1e-9:
            raise InputError("the arm can't resume yet: it moves, although no torque is commanded; hold it still")
        context.SetDiscreteState(self._state, [ArmState.RAMPING, Fault.NONE, 0.0, 0.0, 0.0, 0.0])

    def _state_of(self, context: Context) -> np.ndarray:
        return context.get_discrete_state().value(self._state)

    def _find_fault(self, context: Context) -> Fault:
        """Return the first fault that is present, or `Fault.NONE`."""
        # The limit checks have the form `not value <= limit`, so that NaN is also a fault.
        limits, n = self._limits, self._num_joints
        code = self._status_fault_port.Eval(context)[0]
        # An unknown code, such as NaN, is also a fault.
        status_fault = next((fault for fault in Fault if fault == code), Fault.MALFORMED)
        if status_fault:
            return status_fault
        if np.isnan(self._status_age_port.Eval(context)[0]):
            return Fault.STALE
        joint_state = self._estimated_state_port.Eval(context)
        if not np.isfinite(joint_state).all():
            return Fault.NOT_FINITE
        if not (np.abs(joint_state[n:]) <= limits.velocity).all():
            return Fault.VELOCITY_LIMIT
        positions = [self._pose_port.Eval(context)[:3]]
        if self._state_of(context)[_ARM_STATE] in CONTROLLED:
            positions.append(self._desired_pose_port.Eval(context)[:3])
        for position in positions:
            if not ((position >= limits.lower) & (position <= limits.upper)).all():
                return Fault.WORKSPACE_LIMIT
        if not np.linalg.norm(self._wrench_port.Eval(context)[:3]) <= limits.force:
            return Fault.FORCE_LIMIT
        if not (np.abs(self._external_torque_port.Eval(context)) <= limits.external_torque).all():
            return Fault.EXTERNAL_TORQUE_LIMIT
        if not np.isfinite(self._torque_port.Eval(context)).all():
            return Fault.TORQUE_NOT_FINITE
        return Fault.NONE

    def _stop_at_initialization(self, context: Context, discrete_state: DiscreteValues) -> None:
        if self._state_of(context)[_ARM_STATE] in CONTROLLED:
            speed = self._speed(context)
            discrete_state.set_value(self._state, [ArmState.DAMPING, Fault.INITIALIZED, 0.0, 0.0, speed, 0.0])

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        arm_state, fault, state_time, blend_factor, speed, is_refused = self._state_of(context)
        state_time += self._period
        present_fault = self._present_fault.Eval(context)
        if arm_state == ArmState.WAITING:
            if not present_fault:
                arm_state = ArmState.RAMPING
        elif arm_state in CONTROLLED:
            if present_fault:
                arm_state, fault, state_time, blend_factor = ArmState.DAMPING, present_fault, 0.0, 0.0
                speed, is_refused = self._speed(context), 0.0
            else:
                blend_factor = min(blend_factor + self._period / self._limits.ramp_time, 1.0)
                if arm_state == ArmState.RAMPING and blend_factor == 1.0:
                    arm_state = ArmState.RUNNING
        elif self._is_holding(context) and is_hold_ineffective(
            self._reported_speed_port.Eval(context)[0], speed, state_time
        ):
            arm_state, state_time, is_refused = ArmState.DAMPING, 0.0, 1.0
        elif arm_state == ArmState.DAMPING and state_time >= self._limits.damping_time:
            arm_state, state_time = ArmState.OFF, 0.0
        discrete_state.set_value(self._state, [arm_state, fault, state_time, blend_factor, speed, is_refused])
        rest_time = context.get_discrete_state().value(self._rest_time).item() + self._period
        # The estimated velocity is zero while it is unknown, for example while statuses are in doubt.
        speed = np.fmax(self._speed(context), self._reported_speed_port.Eval(context)[0])
        discrete_state.set_value(self._rest_time, [rest_time if speed <= REST_SPEED else 0.0])

    def _safe_torque(self, context: Context) -> np.ndarray:
        arm_state, _, _, blend_factor, *_ = self._state_of(context)
        is_active = arm_state in CONTROLLED
        torque = np.zeros(self._num_joints)
        if self._is_holding(context):
            return torque
        if is_active and not self._present_fault.Eval(context):
            torque = blend_factor * self._freshness(context) * self._torque_port.Eval(context)
            if blend_factor < 1.0:  # not while RUNNING, to avoid the evaluation of the inertia
                torque = torque + (1.0 - blend_factor) * self._damping_torque(context)
        elif is_active or arm_state == ArmState.DAMPING:
            torque = self._damping_torque(context)
        torque = np.where(np.isfinite(torque), torque, 0.0)
        return np.clip(torque, -self._torque_limits, self._torque_limits)

    def _speed(self, context: Context) -> float:
        """Return the speed of the fastest joint [rad/s]; 0 if it is unknown."""
        return float(np.nan_to_num(np.abs(self._velocity_port.Eval(context)), posinf=0.0).max())

    def _freshness(self, context: Context) -> float:
        return float(np.clip(2.0 - self._status_age_port.Eval(context)[0] / self._period, 0.0, 1.0))

    def _damping_torque(self, context: Context) -> np.ndarray:
        """Return the torque (n,) [Nm] that damps the velocity; zero if velocity or joint state is not finite."""
        velocity = self._velocity_port.Eval(context)
        if not np.isfinite(velocity).all() or not np.isfinite(self._estimated_state_port.Eval(context)).all():
            return np.zeros(self._num_joints)
        M = self._plant.CalcMassMatrix(self._plant_context.Eval(context))
        return damping_torque(M, velocity, self._limits.decay_time, period=self._period)

    def _fault(self, context: Context) -> float:
        arm_state, fault, *_ = self._state_of(context)
        is_stopped = arm_state in STOPPED
        return float(fault if is_stopped else self._present_fault.Eval(context))

    def _is_sending(self, context: Context) -> float:
        arm_state, _, state_time, *_ = self._state_of(context)
        is_sending = arm_state in (*CONTROLLED, ArmState.DAMPING)
        if arm_state == ArmState.OFF:
            is_sending = state_time <= ZERO_TORQUE_TIME or self._status_fault_port.Eval(context)[0] == Fault.NONE
        return float(is_sending)

    def _is_holding(self, context: Context) -> float:
        arm_state, fault, *_, is_refused = self._state_of(context)
        if arm_state in CONTROLLED:
            fault, is_refused = self._present_fault.Eval(context), False
        return float(self._can_hold and not is_refused and arm_state != ArmState.WAITING and fault in STATUS_FAULTS)

    def _not_following(self, context: Context) -> float:
        has_timed_out = self._command_timed_out_port.Eval(context)[0] > 0.0
        return float(has_timed_out or self._state_of(context)[_ARM_STATE] != ArmState.RUNNING)
