"""Safety monitor: damps the arm to rest when torque commands stop arriving."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from guiderail.diagrams.hardware.driver import Driver
from guiderail.models.control.joint_status import MAX_MISSED_MESSAGES, Heartbeat, JointStatus, damping_torque
from guiderail.systems.torque_safety_limiter import ZERO_TORQUE_TIME, SafetyLimits


class MonitorState(IntEnum):
    """State of a safety monitor: no commands; commands arrive; damping the arm; commanding zero torque."""

    IDLE = 0
    WATCHING = 1
    DAMPING = 2
    RESTING = 3


class SafetyMonitor:
    """Watch the statuses and commands of a robot, and damp the arm to rest when commands stop.

    A driver without a command timeout repeats the last torque if the commanding program is killed or its commands are
    lost. The monitor therefore runs on the driver's machine, in a process of its own. All its times are
    timestamps of the robot's statuses. It sends a heartbeat with every status, so that a commanding program stops if
    the monitor stops the arm or has exited.

    Attributes:
        state: Current state.
    """

    def __init__(self, driver: Driver, plant: MultibodyPlant, limits: SafetyLimits, max_silence: float | None = None):
        """Construct the monitor.

        Args:
            driver: The monitor's own connection to the robot.
            plant: Controller plant of the arm and its tool, finalized; only its inertia is used.
            limits: Torque limits, and durations of the phases of a stop.
            max_silence: Largest accepted time between commands [s]; default: `MAX_MISSED_MESSAGES` driver periods.
        """
        driver.check_usable()
        self.state = MonitorState.IDLE
        self._driver, self._plant, self._limits = driver, plant, limits
        self._max_silence = MAX_MISSED_MESSAGES * driver.period if max_silence is None else max_silence
        self._context = plant.CreateDefaultContext()
        # Times by the robot's clock [s]: last status, last command, last change of state.
        self._now = self._commanded_at = self._entered_at = -np.inf
        self._has_torque = False  # the last command was not zero
        self._num_heartbeats = 0
        driver.add_listener(self._on_status, self._on_command)

    def _on_command(self, torque: np.ndarray) -> None:
        self._commanded_at, self._has_torque = self._now, bool(np.any(torque))
        if self.state == MonitorState.IDLE:
            self.state = MonitorState.WATCHING

    def _on_status(self, status: JointStatus) -> None:
        if not status.is_readable or not np.isfinite(status.values()).all():
            return
        if len(status.positions) != self._plant.num_positions() or len(status.velocities) != len(status.positions):
            return
        if self._now - self._max_silence <= status.time < self._now:
            return  # drop an out-of-order status
        if self.state == MonitorState.WATCHING and (status.time < self._now or not np.isfinite(self._now)):
            # The robot's clock was set back, or this is its first status.
            self._commanded_at = status.time
            if self._now - status.time > self._max_silence and self._has_torque:
                # A torque command sent before the restart of the robot may still arrive.
                self.state, self._entered_at = MonitorState.DAMPING, status.time
        self._now = status.time
        self._update_state()
        is_stopping = self.state in (MonitorState.DAMPING, MonitorState.RESTING)
        if is_stopping:
            self._driver.write(self._torque(status), self._now)
        self._num_heartbeats += 1
        self._driver.write_heartbeat(Heartbeat(self._num_heartbeats, is_stopping))

    def _update_state(self) -> None:
        if self.state == MonitorState.WATCHING and self._now - self._commanded_at > self._max_silence:
            self.state, self._entered_at = (
                MonitorState.DAMPING if self._has_torque else MonitorState.IDLE,
                self._now,
            )
        if self.state in (MonitorState.DAMPING, MonitorState.RESTING) and self._now < self._entered_at:
            self._entered_at = self._now
        if self.state == MonitorState.DAMPING and self._now - self._entered_at >= self._limits.damping_time:
            self.state, self._entered_at = MonitorState.RESTING, self._now
        if self.state == MonitorState.RESTING and self._now - self._entered_at > ZERO_TORQUE_TIME:
            self.state = MonitorState.IDLE

    def _torque(self, status: JointStatus) -> np.ndarray:
        if self.state != MonitorState.DAMPING:
            return np.zeros(len(status.positions))
        self._plant.SetPositions(self._context, status.positions)
        M = self._plant.CalcMassMatrix(self._context)
        limits = np.array(self._limits.torque)
        damping = damping_torque(M, status.velocities, self._limits.decay_time, period=self._driver.period)
        return np.clip(damping, -limits, limits)
