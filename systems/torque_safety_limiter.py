"""Lets an arm's torques through while all is well, and brings the arm to rest where it isn't."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    EventStatus,
    InputPort,
    LeafSystem,
    OutputPort,
)

from guiderail.models.common.errors import InputError
from guiderail.models.control.joint_status import FAULT_DESCRIPTIONS, Fault, damping_torque
from guiderail.systems.support.caching import declare_cache, declare_plant_context
from guiderail.systems.support.sampling import check_period

# Entries of the state.
_PHASE, _FAULT, _PHASE_TIME, _AUTHORITY = range(4)
# For how long no torque is said once more before a silent robot is sent nothing [s].
ZERO_TORQUE_TIME = 0.05


class ArmState(IntEnum):
    """What a guarded arm does: wait for its robot, take over, follow, come to rest, be free of torque."""

    WAITING = 0
    RAMPING = 1
    RUNNING = 2
    DAMPING = 3
    OFF = 4


@dataclass(frozen=True)
class SafetyLimits:
    """What a guarded arm keeps to, and how it stops and starts.

    Args:
        velocity: of each joint (n,) [rad/s], positive.
        torque: that is sent to each joint (n,) [Nm], positive.
        external_torque: with which the surroundings may load each joint (n,) [Nm], positive.
        force: on the tool [N], positive.
        lower, upper: corners of the box in which the tool centre stays, in the target's axes (3,) [m].
        damping_time: for which a stop damps before there is no torque [s], positive.
        decay_time: with which damping takes the joints' speed away [s], at least two periods.
        ramp_time: in which the arm takes over [s], positive.
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
                raise InputError(f"an arm's limits and times must be positive, not {value}")
        if not (np.array(self.lower) < np.array(self.upper)).all():
            raise InputError(f"a workspace from {self.lower} to {self.upper} holds nothing")


MAX_VELOCITY_AGE = 0.1  # [s] after which nobody knows how fast an arm is


class TorqueSafetyLimiter(LeafSystem):
    """Passes wanted torques on while nothing is wrong; otherwise the arm is brought to rest, and then has no torque.

        τ = clip(a f τ_wanted + (1 − a) τ_damping)

    a is the authority, which grows from 0 to 1 in the ramp time. f is 1 for a status that is a period
    old at most, and 0 for one that is two periods old: what was wanted of an arm that isn't seen, or is seen too late,
    would drive it ever faster. τ_damping (`damping_torque`)
    takes away all joints' speed with the decay time; where no status comes any more, what was seen last is taken away
    once, and with it what the arm was given since: a period of what was wanted is more than standstill allows.

    A limit that is passed, or a fault of the status, stops the arm at once and is remembered; it goes on when `resume`
    is called. At first it waits until the status is sound, and takes over by itself. A robot that comes back
    after a silence with a clock that is behind was started anew, and what it had of speed is gone: it is left without
    torque. What is sent is always finite and within the torque limits. Where a robot stays silent nothing is sent to it
    any more, nor right after it is back.

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
        - status_is_new
        - command_timed_out
        output_ports:
        - safe_torque
        - fault
        - arm_state
        - blend_factor
        - is_sending
        - not_following

    ``torque`` and ``safe_torque`` are (n,) [Nm], ``estimated_state`` (2n,), ``external_torque`` (n,) [Nm], ``wrench`` (6,), force
    first. ``pose`` and ``desired_pose`` are (6,), of which the positions are watched. ``status_fault``, ``status_age``
    and ``status_is_new`` are (1,), a `StatusWatchdog`'s. ``command_timed_out`` is (1,): 1 while a command watchdog holds.

    ``fault`` is (1,), a code of `Fault`: why the arm is stopped, or 0. ``arm_state`` is (1,), a number of `ArmState`, and
    ``blend_factor`` (1,). ``is_sending`` is (1,): 1 while commands may go out. ``not_following`` is (1,): 1 while the arm
    isn't told to go where it is commanded, as it is stopped, takes over, or a command watchdog holds.
    """

    def __init__(self, plant: MultibodyPlant, limits: SafetyLimits, *, period: float):
        """
        Args:
            plant: the arm with what it carries and nothing else, finalized; only its inertia is used.
            limits: of what is measured and sent.
            period: at which the phase changes [s], positive: how often torques are sent.

        Raises:
            InputError: if an argument is out of range.
        """
        super().__init__()
        check_period(period)
        num_joints = plant.num_positions()
        if len(limits.velocity) != num_joints:
            raise InputError(f"an arm of {num_joints} joints has not {len(limits.velocity)} limits")
        if limits.decay_time < 2.0 * period:
            raise InputError(f"an arm can't come to rest within {limits.decay_time} s at a period of {period} s")
        self._plant, self._limits, self._period, self._num_joints = plant, limits, period, num_joints
        self._torque_limits = np.array(limits.torque)

        self._torque_port = self.DeclareVectorInputPort("torque", num_joints)
        self._estimated_state_port = self.DeclareVectorInputPort("estimated_state", 2 * num_joints)
        self._external_torque_port = self.DeclareVectorInputPort("external_torque", num_joints)
        self._wrench_port = self.DeclareVectorInputPort("wrench", 6)
        self._pose_port = self.DeclareVectorInputPort("pose", 6)
        self._desired_pose_port = self.DeclareVectorInputPort("desired_pose", 6)
        self._status_fault_port = self.DeclareVectorInputPort("status_fault", 1)
        self._status_age_port = self.DeclareVectorInputPort("status_age", 1)
        self._status_is_new_port = self.DeclareVectorInputPort("status_is_new", 1)
        self._command_timed_out_port = self.DeclareVectorInputPort("command_timed_out", 1)
        self._memory = self.DeclareDiscreteState(4)
        self._given = self.DeclareDiscreteState(num_joints)  # momentum since the last status [Nms]

        memory, fault = {self.discrete_state_ticket(self._memory)}, {self._status_fault_port.ticket()}
        measured = {
            port.ticket()
            for port in (
                self._estimated_state_port,
                self._external_torque_port,
                self._wrench_port,
                self._pose_port,
                self._desired_pose_port,
            )
        }
        self._plant_context = declare_plant_context(
            self, plant, self._set_plant_state, prerequisites_of_calc={self._estimated_state_port.ticket()}
        )
        self._found = declare_cache(
            self,
            "found",
            self._find_fault,
            prerequisites_of_calc=memory
            | fault
            | measured
            | {self._torque_port.ticket(), self._status_age_port.ticket()},
        )
        found = {self._found.ticket()}
        self._safe_torque_port = self.DeclareVectorOutputPort(
            "safe_torque",
            num_joints,
            self._calc_safe_torque,
            prerequisites_of_calc=found
            | memory
            | fault
            | {self._torque_port.ticket(), self._estimated_state_port.ticket()}
            | {self._status_age_port.ticket(), self._status_is_new_port.ticket()}
            | {self.discrete_state_ticket(self._given)},
        )
        self._fault_port = self.DeclareVectorOutputPort(
            "fault", 1, self._calc_fault, prerequisites_of_calc=found | memory
        )
        self._arm_state_port = self.DeclareVectorOutputPort(
            "arm_state", 1, self._calc_phase, prerequisites_of_calc=memory
        )
        self._blend_factor_port = self.DeclareVectorOutputPort(
            "blend_factor", 1, self._calc_authority, prerequisites_of_calc=memory
        )
        self._is_sending_port = self.DeclareVectorOutputPort(
            "is_sending", 1, self._calc_sending, prerequisites_of_calc=memory | fault
        )
        self._not_following_port = self.DeclareVectorOutputPort(
            "not_following",
            1,
            self._calc_not_following,
            prerequisites_of_calc=memory | {self._command_timed_out_port.ticket()},
        )
        self.DeclareInitializationDiscreteUpdateEvent(self._forget)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def get_torque_input_port(self) -> InputPort:
        """The wanted torques, (n,) [Nm]."""
        return self._torque_port

    def get_estimated_state_input_port(self) -> InputPort:
        """Joint positions and velocities, (2n,) [rad, rad/s]."""
        return self._estimated_state_port

    def get_external_torque_input_port(self) -> InputPort:
        """With which the surroundings load the joints, (n,) [Nm]."""
        return self._external_torque_port

    def get_wrench_input_port(self) -> InputPort:
        """Of the surroundings on the tool, (6,), force first."""
        return self._wrench_port

    def get_pose_input_port(self) -> InputPort:
        """Where the tool centre is, (6,)."""
        return self._pose_port

    def get_desired_pose_input_port(self) -> InputPort:
        """Where it is told to be, (6,)."""
        return self._desired_pose_port

    def get_status_fault_input_port(self) -> InputPort:
        """What is wrong with the status, (1,)."""
        return self._status_fault_port

    def get_status_age_input_port(self) -> InputPort:
        """How old the status is, (1,) [s]."""
        return self._status_age_port

    def get_status_is_new_input_port(self) -> InputPort:
        """1 where a status has just come, (1,)."""
        return self._status_is_new_port

    def get_command_timed_out_input_port(self) -> InputPort:
        """1 while a command watchdog holds, (1,)."""
        return self._command_timed_out_port

    def get_safe_torque_output_port(self) -> OutputPort:
        """What may be sent, (n,) [Nm]."""
        return self._safe_torque_port

    def get_fault_output_port(self) -> OutputPort:
        """Why the arm is stopped, (1,): a code of `Fault`."""
        return self._fault_port

    def get_arm_state_output_port(self) -> OutputPort:
        """What the arm does, (1,): a number of `ArmState`."""
        return self._arm_state_port

    def get_blend_factor_output_port(self) -> OutputPort:
        """The share of the wanted torques, (1,), from 0 to 1."""
        return self._blend_factor_port

    def get_is_sending_output_port(self) -> OutputPort:
        """1 while commands may go out, (1,)."""
        return self._is_sending_port

    def get_not_following_output_port(self) -> OutputPort:
        """1 while the arm isn't told to go where it is commanded, (1,)."""
        return self._not_following_port

    def stop(self, context: Context) -> None:
        """Stops the arm because somebody asks for it; `context` is this system's."""
        phase = context.get_discrete_state(self._memory).value()[_PHASE]
        if phase == ArmState.WAITING:
            # Of an arm that was never taken over no speed is believed yet, and there is no last command to take back.
            context.SetDiscreteState(self._memory, [ArmState.OFF, Fault.USER_STOP, np.inf, 0.0])
        elif phase in (ArmState.RAMPING, ArmState.RUNNING):
            context.SetDiscreteState(self._memory, [ArmState.DAMPING, Fault.USER_STOP, 0.0, 0.0])

    def resume(self, context: Context) -> None:
        """Goes on after a stop, from where the arm is; `context` is this system's.

        Raises:
            InputError: if the arm is not stopped, not yet at rest, or something is wrong still.
        """
        phase = context.get_discrete_state(self._memory).value()[_PHASE]
        if phase != ArmState.OFF:
            raise InputError(
                f"only an arm that is stopped can go on, and this one is {ArmState(int(phase)).name.lower()}"
            )
        found = self._found.Eval(context)
        if found:
            raise InputError(f"the arm can't go on yet: {FAULT_DESCRIPTIONS[found]}")
        context.SetDiscreteState(self._memory, [ArmState.RAMPING, Fault.NONE, 0.0, 0.0])

    def _set_plant_state(self, context: Context, plant_context: Context) -> None:
        self._plant.SetPositionsAndVelocities(plant_context, self._estimated_state_port.Eval(context))

    def _memory_of(self, context: Context) -> np.ndarray:
        return context.get_discrete_state(self._memory).value()

    def _find_fault(self, context: Context) -> Fault:
        """What is wrong now."""
        limits, n = self._limits, self._num_joints
        status_fault = Fault(int(self._status_fault_port.Eval(context)[0]))
        if status_fault:
            return status_fault
        # Asked this way round, what is no number is never within a limit.
        if not self._status_age_port.Eval(context)[0] <= np.inf:
            return Fault.STALE
        state = self._estimated_state_port.Eval(context)
        if not np.isfinite(state).all():
            return Fault.NOT_FINITE
        if not (np.abs(state[n:]) <= limits.velocity).all():
            return Fault.VELOCITY_LIMIT
        places = [self._pose_port.Eval(context)[:3]]
        if self._memory_of(context)[_PHASE] in (ArmState.RAMPING, ArmState.RUNNING):
            places.append(self._desired_pose_port.Eval(context)[:3])
        for place in places:
            if not ((place >= limits.lower) & (place <= limits.upper)).all():
                return Fault.WORKSPACE_LIMIT
        if not np.linalg.norm(self._wrench_port.Eval(context)[:3]) <= limits.force:
            return Fault.FORCE_LIMIT
        if not (np.abs(self._external_torque_port.Eval(context)) <= limits.external_torque).all():
            return Fault.EXTERNAL_TORQUE_LIMIT
        if not np.isfinite(self._torque_port.Eval(context)).all():
            return Fault.TORQUE_NOT_FINITE
        return Fault.NONE

    def _forget(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        discrete_state.set_value(self._memory, [ArmState.WAITING, Fault.NONE, 0.0, 0.0])
        discrete_state.set_value(self._given, np.zeros(self._num_joints))
        return EventStatus.Succeeded()

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        phase, fault, phase_time, blend_factor = self._memory_of(context)
        phase_time += self._period
        found = self._found.Eval(context)
        given = self._given_until_now(context)
        if phase in (ArmState.RAMPING, ArmState.RUNNING) and not found:
            push = self._safe_torque_port.Eval(context)
            push = push + self._freshness(context) * self._external_torque_port.Eval(context)
            given = given + self._period * push
        discrete_state.set_value(self._given, given)
        if phase == ArmState.WAITING:
            if not found:
                phase, phase_time = ArmState.RAMPING, 0.0
        elif phase in (ArmState.RAMPING, ArmState.RUNNING):
            if found:
                phase, fault, phase_time, blend_factor = ArmState.DAMPING, found, 0.0, 0.0
            else:
                blend_factor = min(blend_factor + self._period / self._limits.ramp_time, 1.0)
                if phase == ArmState.RAMPING and blend_factor == 1.0:
                    phase, phase_time = ArmState.RUNNING, 0.0
        elif phase == ArmState.DAMPING and (phase_time >= self._limits.damping_time or self._is_started_anew(context)):
            phase, phase_time = ArmState.OFF, 0.0
        discrete_state.set_value(self._memory, [phase, fault, phase_time, blend_factor])
        return EventStatus.Succeeded()

    def _calc_safe_torque(self, context: Context, output: BasicVector) -> None:
        phase, _, phase_time, blend_factor = self._memory_of(context)
        is_active = phase in (ArmState.RAMPING, ArmState.RUNNING)
        torque = np.zeros(self._num_joints)
        if is_active and not self._found.Eval(context):
            torque = blend_factor * self._freshness(context) * self._torque_port.Eval(context)
            if blend_factor < 1.0:
                torque = torque + (1.0 - blend_factor) * self._damping_torque(context, np.inf)
        elif is_active:
            torque = self._damping_torque(context, 0.0)
        elif phase == ArmState.DAMPING and not self._is_started_anew(context):
            torque = self._damping_torque(context, phase_time + self._period)
        torque = np.where(np.isfinite(torque), torque, 0.0)
        output.SetFromVector(np.clip(torque, -self._torque_limits, self._torque_limits))

    def _is_started_anew(self, context: Context) -> bool:
        """Whether a robot for whose silence the arm is stopped speaks again, by a clock that is behind the one before.

        One that is ahead proves nothing: statuses that were delayed for a while look so when they come in time again.
        """
        status_fault = self._status_fault_port.Eval(context)[0]
        return bool(self._memory_of(context)[_FAULT] == Fault.STALE and status_fault == Fault.OUT_OF_ORDER)

    def _freshness(self, context: Context) -> float:
        return float(np.clip(2.0 - self._status_age_port.Eval(context)[0] / self._period, 0.0, 1.0))

    def _given_until_now(self, context: Context) -> np.ndarray:
        """What the arm was given since the last status, (n,) [Nms]: nothing where that one is new."""
        is_new = self._status_is_new_port.Eval(context)[0] > 0.0
        return np.zeros(self._num_joints) if is_new else context.get_discrete_state(self._given).value().copy()

    def _damping_torque(self, context: Context, elapsed: float) -> np.ndarray:
        """What takes the speed away that was seen last, `elapsed` being for how long the arm has been damped [s].

        Nothing where that speed was old when the damping began: whoever was held up himself knows no speed, and
        somebody else may have stopped the arm meanwhile. Nothing either where it, its age or the posture is no number.
        """
        age = float(self._status_age_port.Eval(context)[0])
        state = self._estimated_state_port.Eval(context)
        if (np.isfinite(elapsed) and not age - elapsed <= MAX_VELOCITY_AGE) or not np.isfinite(state).all():
            return np.zeros(self._num_joints)
        M = self._plant.CalcMassMatrix(self._plant_context.Eval(context))
        v = state[self._num_joints :]
        if np.isfinite(elapsed):
            v = v + np.linalg.solve(M, self._given_until_now(context))
        elapsed = min(age, elapsed)
        return damping_torque(M, v, self._limits.decay_time, period=self._period, elapsed=elapsed)

    def _calc_fault(self, context: Context, output: BasicVector) -> None:
        phase, fault, _, _ = self._memory_of(context)
        is_stopped = phase in (ArmState.DAMPING, ArmState.OFF)
        output.SetAtIndex(0, float(fault if is_stopped else self._found.Eval(context)))

    def _calc_phase(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self._memory_of(context)[_PHASE])

    def _calc_authority(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self._memory_of(context)[_AUTHORITY])

    def _calc_sending(self, context: Context, output: BasicVector) -> None:
        phase, _, phase_time, _ = self._memory_of(context)
        is_sending = phase in (ArmState.RAMPING, ArmState.RUNNING, ArmState.DAMPING)
        if phase == ArmState.OFF:
            is_sending = phase_time <= ZERO_TORQUE_TIME or self._status_fault_port.Eval(context)[0] == Fault.NONE
        output.SetAtIndex(0, float(is_sending))

    def _calc_not_following(self, context: Context, output: BasicVector) -> None:
        holds = self._command_timed_out_port.Eval(context)[0] > 0.0
        output.SetAtIndex(0, float(holds or self._memory_of(context)[_PHASE] != ArmState.RUNNING))
