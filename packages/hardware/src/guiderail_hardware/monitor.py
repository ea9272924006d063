"""Safety monitor: damps the arm to rest when torque commands stop arriving or the robot's status is wrong."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable
from dataclasses import replace
from enum import IntEnum

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from guiderail_hardware.drivers.driver import Driver, status_limits, torque_tolerance
from guiderail_hardware.models.joint_dynamics import JointDynamics
from guiderail_hardware.models.joint_status import (
    MAX_MISSED_MESSAGES,
    STATUS_FAULTS,
    Fault,
    Heartbeat,
    damping_torque,
    is_hold_ineffective,
)
from guiderail_hardware.models.message_sequence import CommandSequence
from guiderail_hardware.models.round_trip import to_microseconds
from guiderail_hardware.models.state_estimator import Estimate, EstimatorState, StateEstimator
from guiderail_hardware.systems.torque_safety_limiter import ZERO_TORQUE_TIME, SafetyLimits


class MonitorState(IntEnum):
    """State of a safety monitor: idle without commands, watching commands, damping the arm, or sending zero torque."""

    IDLE = 0
    WATCHING = 1
    DAMPING = 2
    RESTING = 3


MAX_REPEATS = 2  # largest number of repetitions of the monitor's torque between two checks

# Faults after which the monitor stops the arm.
STOP_FAULTS = frozenset({*STATUS_FAULTS, Fault.SECOND_COMMANDER} - {Fault.NO_STATUS})


class SafetyMonitor:
    """Monitor of a robot's statuses and commands that damps the arm to rest when commands stop or a status is wrong.

    A driver without a command timeout repeats the last torque if the commanding program is killed or its commands are
    lost. The monitor therefore runs on the driver's machine, in a separate process. It checks statuses with the same
    `StateEstimator` as the station, but with its own clock. It sends a heartbeat with every check, so that a commanding
    program stops if the monitor stops the arm or has exited. The heartbeat reports the newest command, from which the
    commanding program measures the round trip. Commands of two programs are a fault as well
    (`CommandSequence`): the arm is damped, and then has zero torque until only one program sends commands. During a
    stop the monitor sends torques even if no status arrives, so that the driver never repeats an old torque. If the
    status is wrong and the driver can hold the arm, the monitor calls `Driver.hold` instead. An exception of the driver
    does not end the monitor (`DriverGuard`): a status that cannot be read is wrong, and a command that fails is sent
    again at the next check.

    Attributes:
        state: Current state.
        fault: Fault of the last check.
    """

    def __init__(
        self,
        driver: Driver,
        plant: MultibodyPlant,
        limits: SafetyLimits,
        clock: Callable[[], float] = time.monotonic,
    ):
        """Construct the monitor.

        Args:
            driver: The monitor's own connection to the robot.
            plant: Controller plant of the arm and its tool, finalized; its dynamics and velocity limits are used.
            limits: Limits of the arm; only torque limits, damping time and decay time are used.
            clock: Function that returns the local time [s].

        Raises:
            InputError: If the driver cannot receive in this environment, or cannot read other programs' commands.
        """
        driver.check_usable()
        self.state, self.fault = MonitorState.IDLE, Fault.NO_STATUS
        self._driver, self._plant, self._limits, self._clock = driver, plant, limits, clock
        self._guard = driver.guard
        self._dynamics = JointDynamics(plant)
        self._context = plant.CreateDefaultContext()
        self._estimator = StateEstimator(status_limits(plant, driver), torque_tolerance(limits), period=driver.period)
        self._estimated = EstimatorState.initial(plant.num_positions())
        self._torque_limits = np.array(limits.torque)
        self._command: np.ndarray | None = None  # torques that the driver repeats
        self._commands = CommandSequence(driver.period)
        # Local times [s]: last command, last change of state, last check.
        self._commanded_at = self._entered_at = self._checked_at = -np.inf
        self._sender = secrets.randbits(48)
        self._num_heartbeats = self._num_repeats = 0  # heartbeats sent; repetitions of the torque since the last check
        self._can_hold, self._initial_speed = driver.can_hold, 0.0  # largest joint speed when the stop began [rad/s]
        self._command_stamp = -1  # time stamp of the newest command [µs], reported in heartbeats
        driver.add_listener(self._on_command)

    def receive(self, timeout: float = 0.0) -> None:
        """Receive messages, waiting at most `timeout` [s] if there are none, and check the newest status."""
        self._guard.receive(timeout)
        self.check()

    def check(self) -> None:
        """Check the newest status and the commands, stop the arm if needed, and send a heartbeat.

        Without a new status, the check is skipped until one period has passed since the last check.
        """
        status, now = self._guard.read(), self._clock()
        is_due = now - self._checked_at >= 0.99 * self._driver.period
        if not is_due and (status is None or status.time == self._estimated.last_time):
            return
        self._checked_at, self._num_repeats = now, 0
        if status is not None:
            # The driver counts every other program's commands as foreign; here only contradictory commands count.
            status = replace(status, foreign_commands=self._commands.num_conflicts)
        self._plant.SetPositions(self._context, self._estimated.accepted_values[: self._plant.num_positions()])
        self._plant.SetVelocities(self._context, self._estimated.velocity)
        M, drag = self._dynamics.evaluate(self._context)
        estimate = self._estimator.evaluate(self._estimated, status, now, M, drag)
        self.fault = estimate.fault
        self._update_state(now)
        is_stopping, is_failing = self._is_stopping, False
        # The heartbeat precedes the torque, so that the commanding program attributes the torque to this monitor.
        self._num_heartbeats += 1
        self._guard.write_heartbeat(Heartbeat(self._num_heartbeats, is_stopping, self._sender, self._command_stamp))
        is_held = self._is_holding and self._guard.hold()
        if self._is_holding and not (is_held and self._is_effective(estimate, now)):
            is_held = self._can_hold = False
            self.state, self._entered_at = MonitorState.DAMPING, now
        if is_held:
            self._command = np.zeros(len(M))
        elif is_stopping:
            self._command = self._torque(estimate, M)
            if not self._guard.write(self._command, now):
                is_failing = True
                self.state, self._entered_at = MonitorState.DAMPING, now  # until commands can be sent again
        command = np.zeros(len(M)) if self._command is None else self._command
        self._estimated = self._estimator.advance(estimate, command)
        if is_failing:
            self._estimated = self._estimator.forget_torque(self._estimated)

    @property
    def _is_stopping(self) -> bool:
        return self.state in (MonitorState.DAMPING, MonitorState.RESTING)

    @property
    def _is_holding(self) -> bool:
        return self._is_stopping and self._can_hold and self.fault in STATUS_FAULTS

    def _is_effective(self, estimate: Estimate, now: float) -> bool:
        # The reported velocities: the prediction is wrong if the driver repeats its last torque.
        speed = estimate.state.reported_speed(self._driver.period)
        return not is_hold_ineffective(speed, self._initial_speed, now - self._entered_at)

    def _on_command(self, torque: np.ndarray, command_time: float) -> None:
        if torque.shape != self._torque_limits.shape:
            return
        self._commanded_at, self._command_stamp = self._clock(), to_microseconds(command_time)
        heartbeats = self._guard.read_heartbeats()
        # While another monitor stops the arm, the command may be a command of that monitor.
        if not any(heartbeat.is_stopping and heartbeat.sender != self._sender for heartbeat in heartbeats):
            self._commands.add(torque, command_time, self._commanded_at)
        if self._is_stopping and self._command is not None and not self._is_holding:
            # The robot executes the last command, so the torque is sent again. The number of repetitions is limited,
            # because two monitors could answer each other endlessly.
            if self._num_repeats < MAX_REPEATS:
                self._num_repeats += 1
                self._guard.write(self._command, self._commanded_at)
            return
        self._command, self._guard.has_torque = torque, True
        if self.state == MonitorState.IDLE:
            self.state = MonitorState.WATCHING

    def _update_state(self, now: float) -> None:
        is_silent = now - self._commanded_at > MAX_MISSED_MESSAGES * self._driver.period
        has_fault = self.fault in STOP_FAULTS
        if self.state == MonitorState.WATCHING and (is_silent or has_fault):
            has_torque = self._command is not None and bool(np.any(self._command))
            if has_torque or self.fault == Fault.SECOND_COMMANDER:
                self.state, self._entered_at = MonitorState.DAMPING, now
                self._can_hold = self._driver.can_hold
                self._initial_speed = float(np.abs(self._estimated.velocity).max())
            elif is_silent:
                self.state = MonitorState.IDLE
        if self.state == MonitorState.DAMPING and now - self._entered_at >= self._limits.damping_time:
            self.state, self._entered_at = MonitorState.RESTING, now
        is_over = now - self._entered_at > ZERO_TORQUE_TIME and self.fault != Fault.SECOND_COMMANDER
        if self.state == MonitorState.RESTING and is_over:
            self.state = MonitorState.IDLE

    def _torque(self, estimate: Estimate, M: np.ndarray) -> np.ndarray:
        if self.state != MonitorState.DAMPING:
            return np.zeros(len(M))
        velocity = estimate.state.velocity
        damping = damping_torque(M, velocity, self._limits.decay_time, period=self._driver.period)
        return np.clip(damping, -self._torque_limits, self._torque_limits)
