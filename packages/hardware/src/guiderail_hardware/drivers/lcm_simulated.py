"""Simulated driver: an iiwa and its driver in Drake, commanded by another process over LCM."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from pydrake.lcm import DrakeLcm, DrakeLcmInterface
from pydrake.manipulation import BuildIiwaControl
from pydrake.manipulation import IiwaDriver as IiwaDriverConfig
from pydrake.multibody.parsing import ModelDirective
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.lcm import LcmInterfaceSystem

from guiderail.diagrams.stations.arm import ArmControllerPlant, ArmModel, add_arm
from guiderail.diagrams.stations.station import add_workcell_plant
from guiderail.diagrams.stations.workcell import Workcell
from guiderail.models.robots.catalog import IIWA14
from guiderail_hardware.drivers.clock import Clock
from guiderail_hardware.drivers.lcm import (
    HEAD_FORMAT,
    HEAD_SIZE,
    MICROSECOND,
    IiwaDriver,
    LcmDriver,
    MessageCounter,
    check_handlers,
)
from guiderail_hardware.models.joint_status import MAX_MISSED_MESSAGES, MAX_SENDERS
from guiderail_hardware.robot.scenario import follow_directives

ACKNOWLEDGED = "_TAKEN"  # suffix of the channel on which a `LockstepClock` acknowledges a status
REPEAT_INTERVAL = 0.05  # wall clock time after which an unacknowledged status is sent again [s]
CHECK_INTERVAL = 1.0  # wall clock time after which a silent robot's program is checked again [s]


class SimulatedIiwa(Diagram):
    """Simulation of an iiwa and its driver: receives joint torques on LCM and sends joint states.

    Attributes:
        controller_plant: The arm as its controller models it.
        arm: The arm in the simulated plant.
    """

    def __init__(
        self,
        workcell: Workcell,
        lcm: DrakeLcmInterface,
        time_step: float = IiwaDriver.period,
        directives: Sequence[ModelDirective] = (),
    ):
        """Construct the diagram.

        Args:
            workcell: Fixture in the world and held workpiece.
            lcm: The bus.
            time_step: Time step of the plant [s], a divisor of the status period.
            directives: Model directives of the surroundings.

        Raises:
            InputError: If the time step is not positive, or the directives cannot be followed.
        """
        super().__init__()
        builder = DiagramBuilder()
        builder.AddNamedSystem("lcm", LcmInterfaceSystem(lcm))

        def add(plant: MultibodyPlant) -> ArmModel:
            arm = add_arm(plant, workcell, IIWA14, as_rigid=True)
            follow_directives(plant, directives)
            return arm

        self.plant, self.scene_graph, self.arm = add_workcell_plant(builder, workcell, time_step, add)
        self.controller_plant = ArmControllerPlant(workcell, IIWA14)
        BuildIiwaControl(
            builder,
            lcm,
            self.plant,
            self.arm.model,
            IiwaDriverConfig(control_mode="torque_only", lcm_status_period=IiwaDriver.period),
            self.controller_plant.plant,
        )
        builder.BuildInto(self)

    def simulator(self) -> Simulator:
        """Return a simulator of this diagram that is not initialized.

        The only continuous state is the driver's low-pass filter. Each evaluation of its derivative computes the
        contact, the most expensive part, so the integrator evaluates it only once per plant step.
        """
        simulator = Simulator(self)
        ResetIntegratorFromFlags(simulator, "explicit_euler", self.plant.time_step())
        simulator.get_mutable_integrator().set_fixed_step_mode(True)
        return simulator

    def set_pose(self, context: Context, pose: np.ndarray) -> None:
        """Put the arm at rest with its tool center at `pose`, (6,); `context` is the root context."""
        self.controller_plant.place(self.plant, self.arm.model, context, pose)


class LockstepClock(Clock):
    """Clock that advances a hardware station in lockstep with a simulated driver: one step per new status.

    Before each step the status of the previous step is acknowledged. `serve_in_lockstep` waits for this
    acknowledgement; if a status was sent twice, the second acknowledgement has no effect. The robot therefore stands
    still while this program computes, and the result of a run does not depend on the speed of either process.
    """

    def __init__(self, driver: LcmDriver, command_timeout: float, period: float | None = None):
        """Construct the clock.

        Args:
            driver: Driver whose statuses advance the station.
            command_timeout: Longest wait of a step for its status [s of wall clock time]. After that the step is made
                without a status, which the station's watchdog detects.
            period: Period of a step [s]; the driver's by default.

        Raises:
            InputError: If the driver cannot receive in this environment.
        """
        driver.check_usable()
        self._driver, self._timeout, self._period = driver, command_timeout, period or driver.period
        self._channel = driver.status_channel + ACKNOWLEDGED
        self._used = b""
        self._has_timed_out = False

    def begin(self) -> None:
        """Prepare to advance a simulator that has just been initialized with the newest status."""
        self._driver.guard.receive()
        self._used = self._driver.statuses.head

    def _wait_for_step(self) -> None:
        # If the robot is silent, wait for the full timeout only once, not in every step.
        timeout = self._period if self._has_timed_out else self._timeout
        statuses, end = self._driver.statuses, time.monotonic() + timeout
        self._acknowledge()
        while statuses.head == self._used and (left := end - time.monotonic()) > 0.0:
            repeats = statuses.repeats
            self._driver.guard.receive(min(left, CHECK_INTERVAL))
            if self.check_robot is not None:
                self.check_robot()
            if statuses.head == self._used and statuses.repeats > repeats:
                self._acknowledge()  # the acknowledgement may have been lost
        self._has_timed_out = statuses.head == self._used
        self._used = statuses.head

    def _acknowledge(self) -> None:
        self._driver.lcm.Publish(self._channel, self._used)


def serve_in_lockstep(
    simulator: Simulator,
    robot_lcm: DrakeLcm,
    lcm: DrakeLcm,
    seconds: float,
    command_timeout: float,
    after_status: Callable[[], object] = lambda: None,
) -> float:
    """Simulate an arm for another process, and wait after each step until its status is acknowledged.

    Neither process runs ahead of the other, on a machine of any speed. A `LockstepClock` acknowledges each status;
    before its first acknowledgement, a command counts as an acknowledgement. The arm has a separate bus, so that no
    message arrives within a step. Commands therefore apply from the next step on, independently of timing.

    Args:
        simulator: Simulator of the arm, initialized.
        robot_lcm: Bus of the arm and its safety monitor, in memory.
        lcm: Bus shared with the other process.
        seconds: Simulated time to run [s].
        command_timeout: Longest wall clock time to wait for an acknowledgement [s]; ten times as long for the first.
        after_status: Function that is called before and after every step, such as `SafetyMonitor.check`.

    Returns:
        The simulated time of the end [s]; less than `seconds` if acknowledgements stopped.

    Raises:
        InputError: If messages cannot be received in this environment.
    """
    check_handlers()
    acknowledgements, commands = MessageCounter(), list[bytes]()
    lcm.Subscribe(IiwaDriver.status_channel + ACKNOWLEDGED, acknowledgements.add)
    lcm.Subscribe(IiwaDriver.command_channel, commands.append)
    # A heartbeat is sent before its status, so that the other process has both when the status arrives.
    heartbeat_channels = map(IiwaDriver.heartbeat_channel, range(MAX_SENDERS))
    outgoing = dict.fromkeys((*heartbeat_channels, IiwaDriver.status_channel), b"")
    for channel in outgoing:
        robot_lcm.Subscribe(channel, partial(outgoing.__setitem__, channel))
    period, steps, repeats = IiwaDriver.period, 0, max(1, round(command_timeout / REPEAT_INTERVAL))

    def is_acknowledged() -> bool:
        if not acknowledgements.count:
            return bool(commands)
        if len(acknowledgements.head) != HEAD_SIZE:
            return False
        status_time = struct.unpack(HEAD_FORMAT, acknowledgements.head)[1]
        return abs(status_time * MICROSECOND - steps * period) < 0.5 * period

    def handle_messages() -> None:
        while robot_lcm.HandleSubscriptions(0):
            pass
        after_status()
        while robot_lcm.HandleSubscriptions(0):
            pass

    def send() -> None:
        for channel, message in outgoing.items():
            if message:
                lcm.Publish(channel, message)

    simulator.get_system().ForcedPublish(simulator.get_context())
    handle_messages()
    send()
    while steps * period < seconds:
        for _ in range(repeats if steps else 10 * repeats):
            # A command arrives before the acknowledgement of the same step.
            while lcm.HandleSubscriptions(round(1000 * REPEAT_INTERVAL)) and not is_acknowledged():
                pass
            if is_acknowledged():
                break
            # Send again: a datagram may be lost, and the other process may have subscribed late.
            send()
        else:
            break
        for message in commands:
            robot_lcm.Publish(IiwaDriver.command_channel, message)
        commands.clear()
        handle_messages()
        steps += 1
        simulator.AdvanceTo(steps * period)
        handle_messages()
        send()
    return steps * period


def serve_in_real_time(
    simulator: Simulator,
    seconds: float,
    after_status: Callable[[], None],
    rate: float = 1.0,
    log: Callable[[str], None] = print,
) -> None:
    """Simulate an arm in real time; like a real robot, it does not wait for commands.

    Contact makes the simulation slower. If the simulation falls so far behind that its statuses count as old, the delay
    is reported once, so that the cause is not sought in the commanding program.

    Args:
        simulator: Simulator of the arm, initialized.
        seconds: Simulated time to run [s].
        after_status: Function that is called after every step, such as `SafetyMonitor.receive`.
        rate: Rate of the robot's clock relative to the wall clock.
        log: Function that shows a message.

    Raises:
        InputError: If messages cannot be received in this environment.
    """
    check_handlers()
    period, max_delay = IiwaDriver.period, MAX_MISSED_MESSAGES * IiwaDriver.period
    simulator.set_target_realtime_rate(rate)
    start, is_reported = time.monotonic(), False
    for step in range(1, round(seconds / period) + 1):
        simulator.AdvanceTo(step * period)
        after_status()
        delay = (time.monotonic() - start) * rate - step * period
        if delay > max_delay and not is_reported:
            log(
                f"this machine is too slow, or too busy, for a simulated robot at {rate:g} times real time: it "
                f"is {delay:.2f} s behind; give a smaller --rate, or --synchronous"
            )
            is_reported = True
