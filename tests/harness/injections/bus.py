"""Bus with injected faults between a hardware station and a simulated robot, which are stepped in turn."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from drake import lcmt_iiwa_command, lcmt_iiwa_status
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail_hardware.drivers.driver import safety_limits
from guiderail_hardware.drivers.lcm import IiwaDriver
from guiderail_hardware.drivers.lcm_simulated import SimulatedIiwa
from guiderail_hardware.models.joint_status import Fault
from guiderail_hardware.monitor import MonitorState, SafetyMonitor
from guiderail_hardware.robot.sim_driver import START
from guiderail_hardware.station import HardwareStation
from guiderail_hardware.systems.torque_safety_limiter import CONTROLLED, STOPPED, ArmState

PERIOD = IiwaDriver.period
STOPPED_WITHIN = 0.05  # time from the detection of a fault to standstill [s]
STANDSTILL = 0.05  # largest joint speed of a stopped arm; the motion reaches 1 rad/s [rad/s]
STANDSTILL_WITHOUT_STATUS = 0.15  # largest joint speed if no status arrived during the stop [rad/s]
RADIUS, ROTATION, FREQUENCY = 0.01, 0.15, 1.0  # amplitudes and frequency of the arm's motion [m], [rad], [Hz]
HEARTBEAT_CHANNEL = IiwaDriver.heartbeat_channel()

Relay = Callable[[bytes], list[bytes]]


def relay_unchanged(message: bytes) -> list[bytes]:
    """Return the messages that arrive on a bus without faults: the sent message."""
    return [message]


@dataclass
class Observation:
    """Observed effect of a fault on the arm."""

    detected: float | None = None  # time from the beginning of the fault to its detection [s]
    fault: str = ""
    fastest: float = 0.0  # speed of the fastest joint at the detection [rad/s]
    after: float = 0.0  # largest speed from `STOPPED_WITHIN` after the detection [rad/s]
    failures: list[str] = field(default_factory=list)


class HoldingDriver(IiwaDriver):
    """Driver of a robot that can hold its position by itself.

    Attributes:
        bus: Bus whose `on_hold` replaces the robot's brakes.
    """

    can_hold = True
    bus: Bus

    def hold(self) -> bool:
        """Call the bus's function."""
        return self.bus.on_hold()


class Bus:
    """Simulated robot, safety monitor and hardware station, and the bus between them.

    Attributes:
        on_sensor: Function from a status to the messages that the driver sends to station and safety monitor.
        on_status: Function from a message of the driver to the messages that arrive at the station.
        on_command: Function from a command to the messages that arrive at the robot.
        on_heartbeat: Function from a heartbeat of the monitor to the messages that arrive at the station.
        has_robot: True while the robot is stepped.
        has_controller: True while the station is stepped.
        has_safety_monitor: True while the monitor checks statuses and its heartbeats are relayed.
        on_hold: Function that is called in place of the robot's brakes, if the driver can hold the arm.
        station_clock_error: Error of the station's clock [s].
        monitor_clock_error: Error of the monitor's clock [s].
        torques: Torques received by the robot since the list was cleared, each (7,) [Nm].
    """

    def __init__(self, driver: type[IiwaDriver] = IiwaDriver) -> None:
        """Construct the bus with the drivers of the given type."""
        workcell = BncWorkcell()
        self._arm, self.near_robot, self.near_station = (DrakeLcm("memq://") for _ in range(3))
        self.robot = SimulatedIiwa(workcell, self._arm)
        limits = safety_limits(self.robot.controller_plant.plant, IiwaDriver)
        limits = dataclasses.replace(limits, damping_time=0.2, ramp_time=0.1)
        self.limits = np.array(limits.torque)
        self._driver = driver
        self.station_clock_error = self.monitor_clock_error = 0.0
        self.on_hold: Callable[[], bool] = lambda: False
        self.station = HardwareStation(workcell, self._open(self.near_station), robot_timeout=1.0, limits=limits)
        self._stop_limits = limits
        self.on_sensor = self.on_status = self.on_command = self.on_heartbeat = relay_unchanged
        self.has_robot = self.has_controller = self.has_safety_monitor = True
        self.torques: list[np.ndarray] = []
        self.step = 0
        self.start_monitor()
        self._statuses: list[bytes] = []
        self._heartbeats: list[bytes] = []
        self._commands: list[bytes] = []
        self._measured: list[bytes] = []
        self._arm.Subscribe(IiwaDriver.status_channel, self._measured.append)
        self.near_robot.Subscribe(IiwaDriver.status_channel, self._statuses.append)
        self.near_robot.Subscribe(HEARTBEAT_CHANNEL, self._heartbeats.append)
        self.near_robot.Subscribe(IiwaDriver.command_channel, self._receive_command)
        self.near_station.Subscribe(IiwaDriver.command_channel, self._commands.append)
        self.robot_simulator = self.robot.simulator()
        self._default_context = self.robot.CreateDefaultContext()
        self.robot_time = 0  # steps since the robot was started
        self.start_robot()
        self.simulator = Simulator(self.station)
        self.start_controller()

    def _open(self, lcm: DrakeLcm) -> IiwaDriver:
        driver = self._driver(lcm)
        if isinstance(driver, HoldingDriver):
            driver.bus = self
        return driver

    # Starts of the programs.

    def start_robot(self) -> None:
        """Start the robot at its last joint positions, with its clock at zero."""
        context = self.robot_simulator.get_mutable_context()
        plant = self.robot.plant
        positions = plant.GetPositions(plant.GetMyContextFromRoot(context)) if self.step else None
        context.SetTimeStateAndParametersFrom(self._default_context)
        if positions is None:
            self.robot.set_pose(context, START)
        else:
            plant.SetPositions(plant.GetMyMutableContextFromRoot(context), positions)
        self.robot_simulator.Initialize()
        self.robot_time, self.has_robot = 0, True
        self._relay_statuses()

    def start_monitor(self) -> None:
        """Start the safety monitor without any earlier state."""
        plant, clock = self.robot.controller_plant.plant, lambda: self.step * PERIOD + self.monitor_clock_error
        self.monitor = SafetyMonitor(self._open(self.near_robot), plant, self._stop_limits, clock=clock)
        self.has_safety_monitor = True

    def start_controller(self) -> None:
        """Start the station without any earlier state."""
        context = self.simulator.get_mutable_context()
        context.SetTime(0.0)
        self.station.get_desired_pose_input_port().FixValue(context, START)
        self.robot.ForcedPublish(self.robot_simulator.get_context())
        self._relay_statuses(deliver=False)
        self.station.start(self.simulator)
        self.has_controller, self._station_step = True, 0

    # Observations.

    @property
    def velocities(self) -> np.ndarray:
        """True joint velocities, (7,) [rad/s]."""
        plant = self.robot.plant
        return plant.GetVelocities(plant.GetMyContextFromRoot(self.robot_simulator.get_context()))

    @property
    def arm_state(self) -> ArmState:
        """The station's arm state."""
        return ArmState(int(self.station.get_arm_state_output_port().Eval(self.simulator.get_context())[0]))

    @property
    def fault(self) -> Fault:
        """The station's fault."""
        return Fault(int(self.station.get_fault_output_port().Eval(self.simulator.get_context())[0]))

    @property
    def is_detected(self) -> bool:
        """True if the station or the safety monitor is stopping the arm."""
        is_stopping = self.has_controller and self.arm_state in STOPPED
        return (
            is_stopping
            or (self.has_controller and self.fault != Fault.NONE)
            or self.monitor.state > MonitorState.WATCHING
        )

    # Time.

    def advance(self, seconds: float) -> None:
        """Advance all programs by `seconds` [s]."""
        for _ in range(round(seconds / PERIOD)):
            self.step_once()

    def step_once(self) -> None:
        """Advance all programs by a period."""
        self.step += 1
        if self.has_robot:
            self.robot_time += 1
            self.robot_simulator.AdvanceTo(self.robot_time * PERIOD)
        self._relay_statuses()
        if self.has_controller:
            self._station_step += 1
            context = self.simulator.get_mutable_context()
            self.station.get_desired_pose_input_port().FixValue(context, self.desired())
            self.simulator.AdvancePendingEvents()
            self.station.receive(context, self.step * PERIOD + self.station_clock_error)
            self.simulator.AdvanceTo(self._station_step * PERIOD)
            self._deliver(self.near_station)
        commands, self._commands[:] = list(self._commands), []
        for message in commands:
            self._send(self.near_robot, IiwaDriver.command_channel, self.on_command(message))

    def desired(self) -> np.ndarray:
        """Return the desired pose: on a circle, with an oscillating rotation."""
        phase = 2.0 * np.pi * FREQUENCY * self.step * PERIOD
        return START + [RADIUS * np.cos(phase), RADIUS * np.sin(phase), 0.0, ROTATION * np.sin(phase), 0.0, 0.0]

    def _relay_statuses(self, deliver: bool = True) -> None:
        self._deliver(self._arm)
        measured, self._measured[:] = list(self._measured), []
        for message in measured:
            self._send(self.near_robot, IiwaDriver.status_channel, self.on_sensor(message))
        if self.has_safety_monitor:
            self.monitor.check()
        self._deliver(self.near_robot)
        statuses, self._statuses[:] = list(self._statuses), []
        heartbeats, self._heartbeats[:] = list(self._heartbeats), []
        for message in statuses:
            self._send(self.near_station, IiwaDriver.status_channel, self.on_status(message), deliver)
        # Heartbeats are relayed like the statuses, and are lost with them.
        if self.has_safety_monitor and self.on_status(b""):
            relayed = [message for heartbeat in heartbeats[-1:] for message in self.on_heartbeat(heartbeat)]
            self._send(self.near_station, HEARTBEAT_CHANNEL, relayed, deliver)

    def _send(self, lcm: DrakeLcm, channel: str, messages: list[bytes], deliver: bool = True) -> None:
        for message in messages:
            lcm.Publish(channel, message)
            # A paused station receives no message.
            if lcm is self.near_robot or (deliver and self.has_controller):
                self._deliver(lcm)

    def deliver(self) -> None:
        """Deliver all pending messages."""
        for lcm in (self._arm, self.near_robot, self.near_station):
            self._deliver(lcm)

    def _deliver(self, lcm: DrakeLcm) -> None:
        while lcm.HandleSubscriptions(0):
            pass

    def set_torque(self, torque: np.ndarray) -> None:
        """Command torques (7,) [Nm] to the robot, past bus and monitor."""
        self._arm.Publish(IiwaDriver.command_channel, IiwaDriver.encode(torque, self.step * PERIOD))

    def _receive_command(self, message: bytes) -> None:
        self._arm.Publish(IiwaDriver.command_channel, message)
        try:
            command = lcmt_iiwa_command.decode(message)
        except ValueError:
            return
        self.torques.append(np.array(command.joint_torque))

    # Checks.

    def run_until_following(self, seconds: float = 0.15) -> None:
        """Advance until the arm follows its command, and then for `seconds` [s]."""
        for _ in range(round(3.0 / PERIOD)):
            if self.arm_state == ArmState.RUNNING and self.fault == Fault.NONE:
                break
            if self.arm_state == ArmState.OFF:
                with contextlib.suppress(InputError):  # the fault persists
                    self.station.resume(self.simulator.get_mutable_context())
            self.step_once()
        else:
            raise AssertionError(f"the arm does not resume: {self.arm_state.name}, {self.fault.name}")
        self.advance(seconds)

    def observe(
        self, seconds: float, repair: Callable[[], None], duration: float, standstill: float = STANDSTILL
    ) -> Observation:
        """Observe the effect of a fault that has just begun.

        Args:
            seconds: Duration of the observation [s].
            repair: Function that ends the fault.
            duration: Duration of the fault [s].
            standstill: Largest joint speed of a stopped arm [rad/s].
        """
        observation, begin, self.torques = Observation(), self.step, []
        is_repaired = False
        while (self.step - begin) * PERIOD < seconds:
            if not is_repaired and (self.step - begin) * PERIOD >= duration - 1e-9:
                repair()
                is_repaired = True
            self.step_once()
            elapsed, speed = (self.step - begin) * PERIOD, float(np.abs(self.velocities).max())
            if observation.detected is None and self.is_detected:
                observation.detected, observation.fastest = elapsed, speed
                observation.fault = self.fault.name if self.has_controller else "MONITOR_STOP"
            # A restarted station moves the arm again without `resume`: the speed of this motion is not counted.
            is_moving_again = self.has_controller and self.arm_state in CONTROLLED and not self.is_detected
            if (
                observation.detected is not None
                and self.has_robot
                and not is_moving_again
                and elapsed - observation.detected > STOPPED_WITHIN - 1e-9
            ):
                observation.after = max(observation.after, speed)
        if not is_repaired:
            repair()
        for torque in self.torques:
            if len(torque) != len(self.limits) or not (np.abs(torque) <= self.limits + 1e-12).all():
                observation.failures.append(f"sent {torque}")
        if observation.after > standstill:
            observation.failures.append(f"{observation.after:.3f} rad/s after {STOPPED_WITHIN} s")
        return observation


def with_fields(message: bytes, **fields: object) -> bytes:
    """Return a status message in which the given fields are replaced."""
    status = lcmt_iiwa_status.decode(message)
    for name, value in fields.items():
        setattr(status, name, value)
    return status.encode()
