"""Estimator of a robot's joint state that compares status messages with each other, with the clock and with a model.

The hardware station (`StatusWatchdog`) and the safety monitor use it. docs/robot.md derives the thresholds.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from guiderail.models.common.arrays import as_numbers
from guiderail.models.common.errors import InputError
from guiderail_hardware.models.joint_status import (
    Fault,
    JointStatus,
    LastStatus,
    StatusLimits,
    check_content,
    check_status,
    parse_status,
)
from guiderail_hardware.models.message_sequence import RESOLUTION

# Faults with which a status is accepted.
ACCEPTABLE_FAULTS = (Fault.NONE, Fault.DEADLINE_MISSED, Fault.SECOND_COMMANDER)
# Faults after which the message is dropped, and the next message is compared with the last readable status. After any
# other fault, statuses are in doubt until all have been valid for the settling time. A status in doubt is only accepted
# if it agrees with the prediction.
DROPPED_FAULTS = (Fault.NO_STATUS, Fault.MALFORMED, Fault.WRONG_SIZE, Fault.NOT_FINITE)
FRESH_FRACTION = 0.5  # fraction of the maximum age up to which damping with a measured velocity does not oscillate
AGREEMENT = 0.1  # largest difference from the predicted velocity at which a status in doubt is accepted [rad/s]
# Fraction by which the clock offset follows a status that arrives earlier than expected. With 1, all messages after a
# single stray message would be late.
EARLY_FRACTION = 0.2
EARLY_WINDOW = 0.5  # decay time of the sum of offset corrections for early statuses [s]
MAX_EARLY = 1.0 / 3.0  # sum of these corrections above which the robot's clock is too fast, relative to `max_lead`
POSITION_WINDOW = 0.1  # decay time of the difference between positions and integrated velocities [s]
# The same over seconds, for a position that drifts slowly, and the largest difference in position tolerances
DRIFT_WINDOW, MAX_DRIFT = 2.0, 5.0
REACTION_WINDOW = 0.02  # time in which the external torque must explain a change of velocity [s]
MOMENTUM_WINDOW = 0.1  # decay time of the difference between momentum and integrated torques [s]
MIN_MOTION, MIN_SPEED = 1e-4, 0.02  # motion [rad] and speed [rad/s] above which a joint's values must change
MAX_EQUAL_POSITIONS, MAX_EQUAL_VELOCITIES = 2, 4  # number of repetitions of a moving joint's value that is a fault
MAX_EQUAL_STATUSES = 4  # number of repetitions of all values of a joint that is a fault while another joint is moving
MODEL_ERROR, SENSOR_ERROR = 0.3, 0.1  # largest relative error of inertia times acceleration, and of external torque
EXTERNAL_STEP = 2.0  # largest change of the predicted external torque between statuses, in torque tolerances
LAG = 1.0  # largest delay of a velocity's filter [periods]
MAX_ACCELERATION = 10.0  # of a joint without a jump of its velocity [rad/s²]
DELAY = 2.0  # largest time from a command or a contact to its effect on torques [periods]
REACTION = 1.5  # accepted change of velocity that no torque explains, relative to the measured change
MAX_BIAS = 6.0  # largest learned bias of a torque, in torque tolerances
BIAS_TIME, REST_BIAS_TIME = 1.0, 0.05  # time constants of the learned bias with and without commanded torque [s]
REST_SPEED = 0.05  # speed up to which the bias is learned without commanded torque [rad/s]
# Decay time [s] and largest share of statuses with a larger impulse than commanded
SCALE_WINDOW, MAX_EXCESS = 0.1, 0.35
PULSE_WINDOW = 0.02  # decay time of the largest commanded impulse, longer than the delay of its effect [s]
MAX_SCALE_ERROR = 0.35  # largest relative error of a torque in effect
# Signs of another robot or clock on the channel, besides a velocity that does not react. Afterwards a status is only
# accepted if the prediction explains it, until for `SOURCE_TIME` [s] all statuses have come from one source, an arm at
# rest in the last accepted posture.
SOURCE_FAULTS = (Fault.OUT_OF_ORDER, Fault.FUTURE, Fault.CONFLICT)
SOURCE_TIME = 1.0
SOURCE_SPEED, SOURCE_DISTANCE = 0.05, 0.1  # largest speed [rad/s], and distance from the accepted positions [rad]
MAX_PREDICTION_TIME = 0.1  # age of the accepted status above which the velocity is unknown [s]


NUM_SCALARS = 13  # number of scalars of `EstimatorState`, which precede its vectors


class EstimatorState(NamedTuple):  # of which each check makes many copies, which take longer in a dataclass
    """State of the estimator between two checks."""

    check_time: float  # local time of the next check [s]
    receipt_time: float  # local time of the last readable status [s]
    fault: float  # last fault, a code of `Fault`; `NONE` after the settling time
    fault_time: float  # local time of that fault [s]
    doubt_time: float  # local time of the last fault that put statuses in doubt [s]; NaN if none
    # Local time of the last sign of another robot or clock, or of an arm that has moved since then [s]; NaN if none
    source_time: float
    early: float  # sum of the recent corrections of the clock offset for early statuses [s]
    conflicts: float  # `JointStatus.conflicts` of the last status
    foreign_commands: float  # `JointStatus.foreign_commands` of the last status
    last_time: float  # time stamp of the last readable status [s]; NaN before the first
    last_offset: float  # offset from the robot's clock to the local clock after the last readable status [s]
    accepted_time: float  # time stamp of the accepted status [s]; NaN before the first
    accepted_offset: float  # clock offset after the accepted status [s]
    last_values: np.ndarray  # `JointStatus.values` of the last readable status, valid or not, (3n,)
    # `JointStatus.values` of the accepted status, (3n,), with the velocity limited as described in `StateEstimator`;
    # zero before the first accepted status.
    accepted_values: np.ndarray
    velocity: np.ndarray  # velocity estimate from several sources, (n,) [rad/s]; zero where it is unknown
    residual: np.ndarray  # recent difference between positions and integrated velocities, (n,) [rad]
    equal_positions: np.ndarray  # number of consecutive equal positions of each moving joint, (n,)
    equal_velocities: np.ndarray  # number of consecutive equal velocities of each moving joint, (n,)
    # Number of consecutive statuses with equal values of a joint while another joint moves, (n,).
    equal_values: np.ndarray
    # External torque of the prediction, which follows the accepted external torque at a limited rate, (n,) [Nm].
    external: np.ndarray
    torque: np.ndarray  # torques in effect until the next check, (n,) [Nm]
    variation: np.ndarray  # last change of torques and external torques, (n,) [Nm]
    predicted: np.ndarray  # recent impulse of all torques, (n,) [Nms]
    commanded: np.ndarray  # recent impulse of the torques without the external ones, (n,) [Nms]
    measured: np.ndarray  # recent change of momentum, (n,) [Nms]
    reaction: np.ndarray  # recent changes of velocity, (n,) [rad/s], not negative
    # Largest difference of `predicted` and `measured` that errors of the torques explain, (n,) [Nms].
    tolerance: np.ndarray
    bias: np.ndarray  # learned constant error of the torques, (n,) [Nm]
    drift: np.ndarray  # like `residual`, with the decay time `DRIFT_WINDOW`, (n,) [rad]
    swing: np.ndarray  # recent change of the velocity, with the same decay time and without jumps, (n,) [rad/s]
    pulse: np.ndarray  # impulse of the commanded torques since the last status, (n,) [Nms]
    other_pulse: np.ndarray  # impulse of all other torques since the last status, (n,) [Nms]
    pulse_error: np.ndarray  # largest error of the two together, (n,) [Nms]
    largest_pulse: np.ndarray  # size of the largest recent `pulse`, (n,) [Nms]
    excess: np.ndarray  # recent share of statuses with a larger impulse than the torques explain, (n,)

    @classmethod
    def initial(cls, num_joints: int) -> "EstimatorState":
        """Return the state before the first check."""
        scalars = (0.0, 0.0, float(Fault.NO_STATUS), 0.0, np.nan, np.nan, 0.0, 0.0, 0.0, np.nan, 0.0, np.nan, 0.0)
        num_vectors = len(cls._fields) - NUM_SCALARS - 2
        return cls(*scalars, *np.zeros((2, 3 * num_joints)), *np.zeros((num_vectors, num_joints)))

    @classmethod
    def from_vector(cls, vector: np.ndarray, num_joints: int) -> "EstimatorState":
        """Return the state from the result of `vector`."""
        end = NUM_SCALARS + 6 * num_joints
        values, vectors = vector[NUM_SCALARS:end].reshape(2, -1), vector[end:].reshape(-1, num_joints)
        return cls(*vector[:NUM_SCALARS].tolist(), *values, *vectors)

    def vector(self) -> np.ndarray:
        """Return the state as one vector, (13 + 27 n,)."""
        return np.concatenate([self[:NUM_SCALARS], *self[NUM_SCALARS:]])

    def shifted(self, seconds: float) -> "EstimatorState":
        """Return the state with all local times later, after a jump of the local clock [s]."""
        times = ("check_time", "receipt_time", "fault_time", "doubt_time", "source_time")
        names = (*times, "last_offset", "accepted_offset")
        return self._replace(**{name: getattr(self, name) + seconds for name in names})

    def reported_speed(self, period: float) -> float:
        """Return the largest joint speed of the last readable status [rad/s]; NaN without one in three periods [s]."""
        is_fresh = self.check_time - self.receipt_time <= 3.0 * period
        return float(np.abs(np.split(self.last_values, 3)[1]).max()) if is_fresh else np.nan

    @property
    def last(self) -> LastStatus:
        """Last readable status, valid or not."""
        return LastStatus(self.last_time, self.last_offset, self.last_values)

    @property
    def accepted(self) -> LastStatus:
        """Last accepted status."""
        return LastStatus(self.accepted_time, self.accepted_offset, self.accepted_values)


@dataclass(frozen=True)
class Estimate:
    """Result of a check."""

    fault: Fault  # present or recent fault, or `Fault.NONE`
    age: float  # age of the accepted status by the synchronized clocks [s]; infinite before the first
    is_new: bool  # True if a status is accepted at this check
    state: EstimatorState  # state for the next check; has the accepted values and the velocity estimate


class StateEstimator:
    """Estimator of a robot's joint state that checks each status.

    `check_status` compares a status with its predecessor and the clock. A status without such a fault is also compared
    with a model, for each joint:

    - *Equal values*: if the velocity or positions of a joint show motion, consecutive statuses do not have bit-equal
      positions or velocities of the joint. While one joint moves, no other joint repeats all of position, velocity and
      external torque.
    - *Position against velocity*: |Δq − h (v₋ + v) / 2| ≤ h |v − v₋| for two statuses with the velocities v₋ and v and
      the time h between them. The sum of deviations, with a decay, is within the position tolerance. With a slower
      decay, the sum of Δq − h (v₋ + v) / 2 differs from λ Σ (v − v₋), the effect of a velocity filter with a delay λ of
      0 to `LAG` periods, by at most `MAX_DRIFT` of these tolerances; only jumps of the velocity extend this.
    - *Velocity against torque*: with p = Σ h (τ + τ_external − C v) and m = Σ M Δv, both with a decay, and the time h
      between two checks,
      |M⁻¹ (p − m)| ≤ Δv_noise + |M⁻¹| Σ h (tolerance and relative errors of the torques) + min(1.5 Σ |Δv|, Δv_max).
      The last term, with a faster decay, accepts collisions, which change the velocity before the external torque. It
      is zero for a joint that does not react. Δv_noise and Δv_max are `velocity_noise` and `velocity_jump`. A status
      that needs this term is held back: it is not used, and neither are the next ones until the velocity agrees with
      the prediction from torques, which include the external torque of held statuses. After `max_age` it is a fault.

    A fault is reported until all statuses have been valid for the settling time. The velocity estimate is the median of
    three sources: the reported velocity, the change of position, and the last estimate plus the effect of the torques.
    A single wrong source therefore cannot move the estimate out of the interval of the other two sources. While no
    status is accepted, only the third source is used, so that damping ends when the momentum is removed. A status in
    doubt can only reduce the size of the estimate. The arm is controlled with the accepted velocity: the reported
    velocity, limited to the interval of the other two sources, widened by the velocity noise.

    The clocks are synchronized with the first status. Afterwards the clock offset follows early statuses quickly and
    late statuses slowly. After a fault or a timeout the clocks are synchronized again. After a sign of a second robot
    (`SOURCE_FAULTS` or `NOT_REACTING`), statuses are used again when they have come from one source for `SOURCE_TIME`,
    an arm at rest in the last accepted posture. Delays of this program are not attributed to the robot; a delay that is
    too long is reported as `DEADLINE_MISSED`, and so is a jump of the local clock that the robot's clock does not show.
    After a jump the velocity remains known.

    Args:
        limits: Plausibility limits of a status.
        torque_tolerance: Largest error of each joint's torque, (n,) [Nm], positive: friction, gravity compensation,
            sensor.
        period: Period of the check [s], positive.

    Raises:
        InputError: If a torque tolerance is out of range, or missing.
    """

    def __init__(self, limits: StatusLimits, torque_tolerance: Sequence[float], *, period: float):
        self._limits, self._period, n = limits, period, len(limits.velocity)
        self._torque_tolerance = as_numbers(torque_tolerance, "torque_tolerance")
        if self._torque_tolerance.shape != (n,):
            raise InputError(f"a robot with {n} joints needs a torque tolerance for each of them")
        if not ((self._torque_tolerance > 0.0) & (self._torque_tolerance < np.inf)).all():
            raise InputError("the torque tolerances of a robot must be positive and finite")
        self._zeros, self._velocity_noise = np.zeros(n), np.full(n, limits.velocity_noise)
        self._positions, self._velocities, self._torques = slice(0, n), slice(n, 2 * n), slice(2 * n, 3 * n)

    def evaluate(
        self, before: EstimatorState, status: JointStatus | None, now: float, M: np.ndarray, drag: np.ndarray
    ) -> Estimate:
        """Check the newest status.

        Args:
            before: State after the last check.
            status: Newest status, None before the first; a status that `parse_status` refuses is malformed.
            now: Local time [s].
            M: Mass matrix at the accepted positions, (n, n).
            drag: Torques that oppose the estimated velocity in the model (Coriolis, damping), (n,) [Nm].

        Returns:
            The fault, the age of the accepted status and the estimate; `advance` completes the state.
        """
        status = parse_status(status)
        jump = self._clock_jump(before, status, now)
        if jump:
            before = before.shifted(jump)
        state = self._predict(before, now, M, drag)
        is_doubted = np.isfinite(before.doubt_time) or np.isfinite(before.source_time)
        is_trusted = not is_doubted or (status is not None and self._agrees(status, state, now))
        last = before.accepted if is_doubted and is_trusted else before.last
        fault = self._find_fault(before, last, status, now) or (Fault.DEADLINE_MISSED if jump else Fault.NONE)
        if status is None or fault in DROPPED_FAULTS:
            return self._finish(state, before, fault, now)
        values = status.values()
        state = state._replace(conflicts=float(status.conflicts), foreign_commands=float(status.foreign_commands))
        is_reordered = status.time <= last.time and fault in ACCEPTABLE_FAULTS
        if is_reordered or (status.time == last.time and np.array_equal(values, last.values)):
            return self._finish(state, before, fault, now)
        # The return of the first robot is a sign of a second one as well.
        is_other = {fault, self._find_fault(before, before.last, status, now)} & set(SOURCE_FAULTS)
        state, fault = self._check_source(state, values, now, fault, is_trusted=is_trusted, is_other=bool(is_other))
        # The last status had a velocity that the torques do not explain.
        is_held = not is_doubted and 0.0 < before.last_time - before.accepted_time <= self._limits.max_age
        if fault == Fault.CONFLICT and not is_doubted and not is_held:
            # The last statuses may be from a second robot, which does not react to the torques: their effect is added.
            reported = before.last_values[self._velocities]
            state = state._replace(velocity=reported + self._missing_velocity(state, M)[0])
        elapsed, change = status.time - last.time, values - last.values
        is_comparable = 0.0 < elapsed <= self._limits.max_age and fault in ACCEPTABLE_FAULTS
        if (is_doubted and is_trusted) or not is_comparable:
            state = self._restart(state)
        if is_comparable:
            state = self._update_positions(state, values, change, elapsed)
        if is_comparable and not is_doubted and state.torque.any():
            state = self._update_momentum(state, M, change[self._velocities], elapsed)
        else:
            # The momentum sums start again at this status. A bias that is learned from a wrong velocity of a moving arm
            # would cancel the damping.
            speeds = (before.velocity, last.values[self._velocities], values[self._velocities])
            is_resting = np.abs(speeds).max() <= REST_SPEED
            is_learning = is_comparable and is_resting and not state.torque.any() and not before.tolerance.any()
            state = self._update_rest(state, M @ change[self._velocities] if is_learning else state.predicted)
        state = state._replace(pulse=self._zeros, other_pulse=self._zeros, pulse_error=self._zeros)
        deviation, explained, allowed = self._momentum_deviation(state, M)
        is_contradictory = (deviation > allowed).any()
        if is_held:
            # The prediction, unlike the sums of momentum, does not decay.
            deviation = np.abs(values[self._velocities] - state.velocity)
            is_contradictory |= status.time - before.accepted_time > self._limits.max_age
        is_explained = (deviation <= explained).all()
        if not fault:
            fault = self._find_contradiction(state, bool(is_contradictory and not is_explained))
            if fault == Fault.NOT_REACTING:  # another robot does not react to the torques, either
                state = state._replace(source_time=now)
        state, fault = self._synchronize(state, last.offset, now - status.time, now, fault)
        state = state._replace(last_time=status.time, last_values=values, receipt_time=now)
        velocity = values[self._velocities]
        if is_comparable:
            others, margin = (change[self._positions] / elapsed, state.velocity), self._limits.velocity_noise
            values = values.copy()
            values[self._velocities] = np.clip(velocity, np.min(others, 0) - margin, np.max(others, 0) + margin)
            reported, velocity = velocity, np.median((velocity, *others), axis=0)
            if fault == Fault.INCONSISTENT:
                # Two of the three sources are from this status, whose velocity may be outdated.
                is_old = np.abs(np.array((reported, others[0])) - state.velocity).min(axis=0) > AGREEMENT
                velocity = np.where(is_old, state.velocity, velocity)
            if is_doubted:
                # Damping with an outdated velocity would drive the arm. The predicted velocity therefore limits it.
                size = np.minimum(np.abs(velocity), np.abs(state.velocity))
                velocity = np.where(velocity * state.velocity > 0.0, np.sign(velocity) * size, 0.0)
        if fault in (Fault.FROZEN, Fault.INCONSISTENT, Fault.NOT_REACTING) and not is_doubted:
            is_frozen = (change[self._positions] == 0.0) | (fault == Fault.NOT_REACTING)
            if is_explained or not is_held:
                missing, is_missing = self._missing_velocity(state, M)
                state = state._replace(velocity=np.where(is_frozen & is_missing, status.velocities + missing, velocity))
        if fault not in ACCEPTABLE_FAULTS or not is_trusted:
            return self._finish(state, before, fault, now)
        age = max(now - (status.time + last.offset), 0.0) if np.isfinite(last.time) else 0.0
        reach = EXTERNAL_STEP * self._torque_tolerance
        external = np.clip(values[self._torques], before.external - reach, before.external + reach)
        state = state._replace(variation=np.abs(external - before.external), external=external)
        if not is_explained:
            # A collision, or another robot: the external torque decides within `REACTION_WINDOW`.
            missing, is_missing = self._missing_velocity(state, M)
            is_missing &= np.abs(velocity - state.velocity) > AGREEMENT
            if not is_held:
                state = state._replace(velocity=np.where(is_missing, status.velocities + missing, velocity))
            return self._finish(state, before, fault, now)
        state = state._replace(velocity=velocity, accepted_values=values)
        state = state._replace(accepted_time=status.time, accepted_offset=state.last_offset)
        return self._finish(state, before, fault, now, age)

    def advance(self, estimate: Estimate, torque: np.ndarray) -> EstimatorState:
        """Return the state for the next check, until which the torques (n,) [Nm] are in effect.

        A torque that is NaN or infinite counts as zero.
        """
        state = estimate.state
        torque = np.where(np.isfinite(torque), torque, 0.0)
        return state._replace(torque=torque, variation=state.variation + np.abs(torque - state.torque))

    def forget_torque(self, state: EstimatorState) -> EstimatorState:
        """Return the state after a command that was not sent, so that the torques in effect are unknown.

        Until the next status, the prediction assumes zero torque. The velocity is not compared with torques, and no
        bias is learned.
        """
        return state._replace(torque=self._zeros, tolerance=self._period * self._torque_tolerance)

    def _clock_jump(self, before: EstimatorState, status: JointStatus | None, now: float) -> float:
        """Return the time [s] by which the local clock has jumped ahead of the robot's since the last check, or 0.

        A status that is newer than the last one shows how much time has passed. A difference of up to `max_age` is a
        delay of messages and no jump.
        """
        if status is None or check_content(status, len(self._zeros)) or not np.isfinite(before.last_time):
            return 0.0
        passed = status.time - before.last_time
        jump = now - before.receipt_time - passed
        is_jump = 0.0 < passed <= self._limits.max_age and now - before.check_time > self._limits.max_check_interval
        return float(jump) if is_jump and jump > self._limits.max_age else 0.0

    def _predict(self, before: EstimatorState, now: float, M: np.ndarray, drag: np.ndarray) -> EstimatorState:
        """Return the state with the effect of the torques since the last check."""
        step = max(now - before.check_time + self._period, 0.0)
        # The external torque is unknown without a recent status, and may be wrong while statuses are in doubt.
        age = now - step - (before.last_time + before.last_offset)
        is_known = np.isfinite(age) and not np.isfinite(before.doubt_time)
        freshness = np.clip(2.0 - age / self._period, 0.0, 1.0) if is_known else 0.0
        external = freshness * before.external
        net = before.torque + external - drag + before.bias
        error = self._torque_tolerance + MODEL_ERROR * np.abs(net) + SENSOR_ERROR * np.abs(external)
        return before._replace(
            velocity=before.velocity + step * np.linalg.solve(M, net),
            predicted=before.predicted + step * net,
            commanded=before.commanded + step * (net - external),
            tolerance=before.tolerance + step * (error + DELAY * before.variation),
            pulse=before.pulse + step * before.torque,
            other_pulse=before.other_pulse + step * (net - before.torque),
            pulse_error=before.pulse_error + step * error,
            variation=self._zeros,
        )

    def _find_fault(self, before: EstimatorState, last: LastStatus, status: JointStatus | None, now: float) -> Fault:
        fault = check_status(status, last, now, self._limits)
        if not fault and status is not None and np.isfinite(last.time):
            if status.conflicts > before.conflicts:
                return Fault.CONFLICT
            if status.foreign_commands > before.foreign_commands:
                return Fault.SECOND_COMMANDER
            if status.round_trip > self._limits.max_round_trip:
                return Fault.ROUND_TRIP
        if not fault and now - before.check_time > self._limits.max_check_interval:
            return Fault.DEADLINE_MISSED
        return fault

    def _check_source(
        self, state: EstimatorState, values: np.ndarray, now: float, fault: Fault, *, is_trusted: bool, is_other: bool
    ) -> tuple[EstimatorState, Fault]:
        """Return the state after a status that may be from another robot, and the fault.

        After a sign of another robot the fault is repeated until the statuses have come from one source for
        `SOURCE_TIME`. A robot at another posture, or in motion, is therefore never adopted.
        """
        if not (is_other or np.isfinite(state.source_time)):
            return state, fault
        is_moving = (np.abs(values[self._velocities]) > SOURCE_SPEED).any()
        distance = np.abs(values[self._positions] - state.accepted_values[self._positions]).max()
        is_elsewhere = np.isfinite(state.accepted_time) and distance > SOURCE_DISTANCE
        if is_other or (not is_trusted and (is_moving or is_elsewhere)):
            state = state._replace(source_time=now)
        if now - state.source_time > SOURCE_TIME:
            return state._replace(source_time=np.nan), fault
        return state, fault if fault or is_trusted else Fault(int(state.fault)) or Fault.CONFLICT

    def _agrees(self, status: JointStatus, state: EstimatorState, now: float) -> bool:
        """Return True if a status is valid and fresh relative to the accepted one, and its velocity is as predicted."""
        accepted, elapsed = state.accepted, status.time - state.accepted_time
        is_fresh = elapsed > 0.0 and now - (status.time + accepted.offset) <= FRESH_FRACTION * self._limits.max_age
        if not is_fresh or check_status(status, accepted, now, self._limits) != Fault.NONE:
            return False
        values = status.values()
        change = values - accepted.values
        deviation = _beyond(self._difference(values, change, elapsed), LAG * elapsed * np.abs(change[self._velocities]))
        is_moving_as_predicted = np.abs(values[self._velocities] - state.velocity) <= AGREEMENT
        return bool((is_moving_as_predicted & (np.abs(deviation) <= self._limits.position_tolerance)).all())

    def _difference(self, values: np.ndarray, change: np.ndarray, elapsed: float) -> np.ndarray:
        """Return the difference between each position's change and the integrated velocity, (n,) [rad]."""
        mean = values[self._velocities] - 0.5 * change[self._velocities]
        return np.asarray(change[self._positions] - elapsed * mean)

    def _update_positions(
        self, state: EstimatorState, values: np.ndarray, change: np.ndarray, elapsed: float
    ) -> EstimatorState:
        speed, is_equal = np.abs(values[self._velocities]), change == 0.0
        equal_positions = is_equal[self._positions] & (speed * elapsed > MIN_MOTION)
        # If a velocity is frozen close to zero, the positions show that the joint moves.
        moved = (np.abs(change[self._positions]) - 2.0 * RESOLUTION) / elapsed
        equal_velocities = is_equal[self._velocities] & (np.maximum(speed, moved) > MIN_SPEED)
        equal_values = is_equal.reshape(3, -1).all(axis=0) & (speed.max() > MIN_SPEED)
        acceleration, largest = change[self._velocities], MAX_ACCELERATION * self._period
        smooth = np.clip(acceleration, -largest, largest)
        difference, lag = self._difference(values, change, elapsed), LAG * elapsed
        residual = _beyond(difference, lag * np.abs(acceleration))
        drift = _beyond(difference, lag * np.abs(acceleration - smooth))
        return state._replace(
            residual=np.exp(-elapsed / POSITION_WINDOW) * state.residual + residual,
            drift=np.exp(-elapsed / DRIFT_WINDOW) * state.drift + drift,
            swing=np.exp(-elapsed / DRIFT_WINDOW) * state.swing + smooth,
            equal_positions=np.where(equal_positions, state.equal_positions + 1.0, 0.0),
            equal_velocities=np.where(equal_velocities, state.equal_velocities + 1.0, 0.0),
            equal_values=np.where(equal_values, state.equal_values + 1.0, 0.0),
        )

    def _restart(self, state: EstimatorState) -> EstimatorState:
        """Return the state with the comparisons of consecutive statuses reset."""
        zero = self._zeros
        return state._replace(
            residual=zero, drift=zero, swing=zero, equal_positions=zero, equal_velocities=zero, equal_values=zero
        )

    def _update_momentum(
        self, state: EstimatorState, M: np.ndarray, change: np.ndarray, elapsed: float
    ) -> EstimatorState:
        decay, share = np.exp(-elapsed / MOMENTUM_WINDOW), elapsed / (MOMENTUM_WINDOW * BIAS_TIME)
        predicted, measured = decay * state.predicted, decay * (state.measured + M @ change)
        largest = np.maximum(np.abs(state.pulse), np.exp(-elapsed / PULSE_WINDOW) * state.largest_pulse)
        allowed = (1.0 + MAX_SCALE_ERROR) * largest + state.pulse_error + np.abs(M) @ self._velocity_noise
        is_excessive = np.abs(M @ change - state.other_pulse) > allowed
        return state._replace(
            predicted=predicted,
            commanded=decay * state.commanded,
            measured=measured,
            reaction=np.exp(-elapsed / REACTION_WINDOW) * (state.reaction + np.abs(change)),
            tolerance=decay * state.tolerance,
            bias=self._limited_bias(state.bias - share * (predicted - measured)),
            largest_pulse=largest,
            excess=is_excessive + np.exp(-elapsed / SCALE_WINDOW) * (state.excess - is_excessive),
        )

    def _update_rest(self, state: EstimatorState, change: np.ndarray) -> EstimatorState:
        """Return the state with zero momentum sums; the bias is learned from `predicted` minus `change` (n,) [Nms]."""
        bias = self._limited_bias(state.bias - (state.predicted - change) / REST_BIAS_TIME)
        zero = self._zeros
        state = state._replace(bias=bias, predicted=zero, commanded=zero, measured=zero)
        return state._replace(reaction=zero, tolerance=zero, excess=zero)

    def _limited_bias(self, bias: np.ndarray) -> np.ndarray:
        limit = MAX_BIAS * self._torque_tolerance
        return np.clip(bias, -limit, limit)

    def _missing_velocity(self, state: EstimatorState, M: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the velocity change by recent torques that the reported velocity lacks (n,) [rad/s], and a mask (n,).

        The change is computed with and without the external torques, and the smaller result is used. A change in the
        last period is complete: its decay is compensated. The mask is true if both results have the same sign.
        Otherwise, not the velocity but the external torque is wrong.
        """
        sums = np.transpose([state.predicted, state.commanded] - state.measured)
        missing = np.exp(self._period / MOMENTUM_WINDOW) * np.linalg.inv(M) @ sums
        is_missing = np.prod(np.sign(missing), axis=1) > 0.0
        return np.where(is_missing, np.sign(missing[:, 0]) * np.abs(missing).min(axis=1), 0.0), is_missing

    def _momentum_deviation(self, state: EstimatorState, M: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return |M⁻¹ (p − m)|, its limit without and with a collision, each (n,) [rad/s]."""
        inverse, limits = np.linalg.inv(M), self._limits
        deviation = np.abs(inverse @ (state.predicted - state.measured))
        explained = limits.velocity_noise + np.abs(inverse) @ state.tolerance
        return deviation, explained, explained + np.minimum(REACTION * state.reaction, limits.velocity_jump)

    def _find_contradiction(self, state: EstimatorState, is_contradictory: bool) -> Fault:
        counts = (
            (state.equal_positions, MAX_EQUAL_POSITIONS),
            (state.equal_velocities, MAX_EQUAL_VELOCITIES),
            (state.equal_values, MAX_EQUAL_STATUSES),
        )
        if any((count >= limit).any() for count, limit in counts):
            return Fault.FROZEN
        tolerance = self._limits.position_tolerance
        late = LAG * self._period * state.swing
        drift = state.drift - np.clip(state.drift, np.minimum(late, 0.0), np.maximum(late, 0.0))
        if (np.abs(state.residual) > tolerance).any() or (np.abs(drift) > MAX_DRIFT * tolerance).any():
            return Fault.INCONSISTENT
        if is_contradictory or (state.excess > MAX_EXCESS).any():
            return Fault.NOT_REACTING
        return Fault.NONE

    def _synchronize(
        self, state: EstimatorState, offset: float, measured: float, now: float, fault: Fault
    ) -> tuple[EstimatorState, Fault]:
        """Return the state with the clock offset after a status with the offset `measured` [s], and the fault."""
        receipt_age = now - state.receipt_time
        is_synchronized = fault in ACCEPTABLE_FAULTS and np.isfinite(state.last_time)
        is_late = fault == Fault.STALE and receipt_age <= self._limits.max_age
        if not (is_synchronized or is_late):
            return state._replace(last_offset=measured, early=0.0), fault
        delay = measured - offset
        change = min(delay, self._limits.clock_drift * self._period) if delay > 0.0 else EARLY_FRACTION * delay
        early = state.early * np.exp(-receipt_age / EARLY_WINDOW) - min(change, 0.0)
        if early > MAX_EARLY * self._limits.max_lead:
            return state._replace(last_offset=measured, early=0.0), fault or Fault.CLOCK_RATE
        return state._replace(last_offset=offset + change, early=early), fault

    def _finish(
        self, state: EstimatorState, before: EstimatorState, fault: Fault, now: float, age: float | None = None
    ) -> Estimate:
        """Return the result of a check; `age` [s] is that of the status accepted at this check, None without one."""
        is_new = age is not None
        if age is None:
            accepted_at = before.accepted_time + before.accepted_offset
            age = max(now - accepted_at, 0.0) if np.isfinite(accepted_at) else np.inf
        # If the robot's clock is set back after a timeout, its controller has restarted.
        has_restarted = fault == Fault.OUT_OF_ORDER and before.fault == Fault.STALE
        if age > MAX_PREDICTION_TIME or has_restarted or not np.isfinite(state.velocity).all():
            state = state._replace(velocity=self._zeros)
        # Computed and not read from a context, so that the state can be copied to a diagram with another time.
        check_time = now + self._period
        state = state._replace(check_time=check_time)
        if fault:
            state = state._replace(fault=float(fault), fault_time=now)
        elif check_time - state.fault_time > self._limits.settling_time and not np.isfinite(state.source_time):
            state = state._replace(fault=float(Fault.NONE))
        if fault and fault not in DROPPED_FAULTS and fault not in ACCEPTABLE_FAULTS:
            state = state._replace(doubt_time=now)
        elif check_time - state.doubt_time > self._limits.settling_time:
            state = state._replace(doubt_time=np.nan)
        return Estimate(fault or Fault(int(before.fault)), age, is_new, state)


def _beyond(values: np.ndarray, slack: np.ndarray) -> np.ndarray:
    """Return the part of values (n,) that is larger than `slack` (n,), with its sign."""
    return np.asarray(np.sign(values) * np.maximum(np.abs(values) - slack, 0.0))
