"""A station and a simulated robot at the two ends of a bus on which anything may happen, stepped in turn."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from drake import lcmt_iiwa_command, lcmt_iiwa_status
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.hardware.monitor import MonitorState, SafetyMonitor
from guiderail.diagrams.hardware.driver import safety_limits
from guiderail.diagrams.hardware.lcm.driver import IiwaDriver
from guiderail.diagrams.hardware.lcm.simulated import SimulatedIiwa
from guiderail.diagrams.hardware.station import HardwareStation
from guiderail.diagrams.tasks.bnc_connector.workcell import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail.models.control.joint_status import Fault
from guiderail.systems.torque_safety_limiter import ArmState
from guiderail.tools.hardware.sim_driver import START

PERIOD = IiwaDriver.period
STOPPED_WITHIN = 0.05  # [s] of a fault's detection
STANDSTILL = 0.05  # [rad/s] of the fastest joint, which was up to 1 rad/s fast
UNSEEN = 0.15  # [rad/s], where it was stopped without a status to go by
RADIUS, TURN, FREQUENCY = 0.01, 0.15, 1.0  # [m], [rad], [Hz] of the motion during which faults happen
WORDS = IiwaDriver.heartbeat_channel()

Relay = Callable[[bytes], list[bytes]]


def passes(message: bytes) -> list[bytes]:
    """What a sound bus does."""
    return [message]


@dataclass
class Seen:
    """What happened after a fault, as it is seen on the robot's side."""

    detected: float | None = None  # [s] after its beginning
    fault: str = ""
    fastest: float = 0.0  # [rad/s] of a joint when it was detected
    after: float = 0.0  # [rad/s], the fastest from `STOPPED_WITHIN` after the detection on
    wrong: list[str] = field(default_factory=list)


class Bus:
    """Both ends, and what lies between them.

    Attributes:
        on_status, on_command: what the bus does to a message.
        has_robot, has_controller: whether the two are stepped at all.
        torques: that arrived at the robot since `torques.clear()`.
    """

    def __init__(self) -> None:
        workcell = BncWorkcell()
        self.near_robot, self.near_station = DrakeLcm("memq://"), DrakeLcm("memq://")
        self.robot = SimulatedIiwa(workcell, self.near_robot)
        limits = safety_limits(self.robot.controller_plant.plant, IiwaDriver)
        limits = dataclasses.replace(limits, damping_time=0.2, ramp_time=0.1)
        self.limits = np.array(limits.torque)
        self.station = HardwareStation(workcell, IiwaDriver(self.near_station), robot_timeout=1.0, limits=limits)
        self.deputy = SafetyMonitor(IiwaDriver(self.near_robot), self.robot.controller_plant.plant, limits)
        self.on_status = self.on_command = passes
        self.has_robot = self.has_controller = self.has_safety_monitor = True
        self.torques: list[np.ndarray] = []
        self.step = 0
        self._statuses: list[bytes] = []
        self._words: list[bytes] = []
        self._commands: list[bytes] = []
        self.near_robot.Subscribe(IiwaDriver.status_channel, self._statuses.append)
        self.near_robot.Subscribe(WORDS, self._words.append)
        self.near_robot.Subscribe(IiwaDriver.command_channel, self._arrive)
        self.near_station.Subscribe(IiwaDriver.command_channel, self._commands.append)
        self.robot_simulator = self.robot.simulator()
        self._pristine = self.robot.CreateDefaultContext()
        self.robot_time = 0  # steps since it was started
        self.start_robot()
        self.simulator = Simulator(self.station)
        self.start_controller()

    # Both programs, and that they are started anew.

    def start_robot(self) -> None:
        """The robot begins where it was, its clock at zero."""
        context = self.robot_simulator.get_mutable_context()
        plant = self.robot.plant
        state = plant.GetPositions(plant.GetMyContextFromRoot(context)) if self.step else None
        context.SetTimeStateAndParametersFrom(self._pristine)
        if state is None:
            self.robot.set_pose(context, START)
        else:
            plant.SetPositions(plant.GetMyMutableContextFromRoot(context), state)
        self.robot_simulator.Initialize()
        self.robot_time, self.has_robot = 0, True
        self._settle(self.near_robot)
        self._relay_statuses()

    def start_controller(self) -> None:
        """A program that knows nothing of what was."""
        context = self.simulator.get_mutable_context()
        context.SetTime(0.0)
        self.station.get_desired_pose_input_port().FixValue(context, START)
        self.robot.ForcedPublish(self.robot_simulator.get_context())
        self._settle(self.near_robot)
        self._relay_statuses(settle=False)
        self.station.start(self.simulator)
        self.has_controller, self._station_step = True, 0

    # What is seen.

    @property
    def velocities(self) -> np.ndarray:
        """Of the joints, truly, (7,)."""
        plant = self.robot.plant
        return plant.GetVelocities(plant.GetMyContextFromRoot(self.robot_simulator.get_context()))

    @property
    def phase(self) -> ArmState:
        """What the station does."""
        return ArmState(int(self.station.get_arm_state_output_port().Eval(self.simulator.get_context())[0]))

    @property
    def fault(self) -> Fault:
        """What the station says."""
        return Fault(int(self.station.get_fault_output_port().Eval(self.simulator.get_context())[0]))

    @property
    def is_detected(self) -> bool:
        """Whether somebody stops the arm now."""
        is_stopping = self.has_controller and self.phase in (ArmState.DAMPING, ArmState.OFF)
        return (
            is_stopping
            or (self.has_controller and self.fault != Fault.NONE)
            or self.deputy.state > MonitorState.WATCHING
        )

    # How time passes.

    def go(self, seconds: float) -> None:
        """Both for some time."""
        for _ in range(round(seconds / PERIOD)):
            self.one()

    def one(self) -> None:
        """One period."""
        self.step += 1
        if self.has_robot:
            self.robot_time += 1
            self.robot_simulator.AdvanceTo(self.robot_time * PERIOD)
            self._settle(self.near_robot)
        self._relay_statuses()
        if self.has_controller:
            self._station_step += 1
            context = self.simulator.get_mutable_context()
            self.station.get_desired_pose_input_port().FixValue(context, self.desired())
            self.simulator.AdvancePendingEvents()
            self.station.receive(context, self.step * PERIOD)
            self.simulator.AdvanceTo(self._station_step * PERIOD)
            self._settle(self.near_station)
        commands, self._commands[:] = list(self._commands), []
        for message in commands:
            self._send(self.near_robot, IiwaDriver.command_channel, self.on_command(message))

    def desired(self) -> np.ndarray:
        """Where the tool is told to be now: on a circle, turning to and fro."""
        phase = 2.0 * np.pi * FREQUENCY * self.step * PERIOD
        return START + [RADIUS * np.cos(phase), RADIUS * np.sin(phase), 0.0, TURN * np.sin(phase), 0.0, 0.0]

    def _relay_statuses(self, settle: bool = True) -> None:
        statuses, self._statuses[:] = list(self._statuses), []
        words, self._words[:] = list(self._words), []
        for message in statuses:
            self._send(self.near_station, IiwaDriver.status_channel, self.on_status(message), settle)
        # What a deputy says goes the same way as the statuses, and is lost with them.
        if self.has_safety_monitor and self.on_status(b""):
            self._send(self.near_station, WORDS, words[-1:], settle)

    def _send(self, lcm: DrakeLcm, channel: str, messages: list[bytes], settle: bool = True) -> None:
        for message in messages:
            lcm.Publish(channel, message)
            # A program that is held up hears nothing.
            if lcm is self.near_robot or (settle and self.has_controller):
                self._settle(lcm)

    def _settle(self, lcm: DrakeLcm) -> None:
        while lcm.HandleSubscriptions(0):
            pass

    def _arrive(self, message: bytes) -> None:
        try:
            command = lcmt_iiwa_command.decode(message)
        except ValueError:
            return
        self.torques.append(np.array(command.joint_torque))

    # What is done about it.

    def run_in(self, seconds: float = 0.15) -> None:
        """Until the arm follows."""
        for _ in range(round(3.0 / PERIOD)):
            if self.phase == ArmState.RUNNING and self.fault == Fault.NONE:
                break
            if self.phase == ArmState.OFF:
                with contextlib.suppress(InputError):  # while something is wrong still
                    self.station.resume(self.simulator.get_mutable_context())
            self.one()
        else:
            raise AssertionError(f"the arm does not go on: {self.phase.name}, {self.fault.name}")
        self.go(seconds)

    def watch(self, seconds: float, mend: Callable[[], None], lasts: float, standstill: float = STANDSTILL) -> Seen:
        """What comes of a fault that has just begun.

        Args:
            seconds: to watch.
            mend: ends the fault.
            lasts: after how long [s].
            standstill: what counts as such [rad/s].
        """
        seen, begun, self.torques = Seen(), self.step, []
        is_mended = False
        while (self.step - begun) * PERIOD < seconds:
            if not is_mended and (self.step - begun) * PERIOD >= lasts - 1e-9:
                mend()
                is_mended = True
            self.one()
            now, speed = (self.step - begun) * PERIOD, float(np.abs(self.velocities).max())
            if seen.detected is None and self.is_detected:
                seen.detected, seen.fastest = now, speed
                seen.fault = self.fault.name if self.has_controller else "MONITOR_STOP"
            # A program that was started anew moves the arm again; one that goes on must be told to.
            is_anew = (
                self.has_controller and self.phase in (ArmState.RAMPING, ArmState.RUNNING) and not self.is_detected
            )
            if (
                seen.detected is not None
                and self.has_robot
                and not is_anew
                and now - seen.detected > STOPPED_WITHIN - 1e-9
            ):
                seen.after = max(seen.after, speed)
        if not is_mended:
            mend()
        for torque in self.torques:
            if len(torque) != len(self.limits) or not (np.abs(torque) <= self.limits + 1e-12).all():
                seen.wrong.append(f"sent {torque}")
        if seen.after > standstill:
            seen.wrong.append(f"{seen.after:.3f} rad/s after {STOPPED_WITHIN} s")
        return seen


def changed(message: bytes, **fields: object) -> bytes:
    """A status with other values."""
    status = lcmt_iiwa_status.decode(message)
    for name, value in fields.items():
        setattr(status, name, value)
    return status.encode()
