"""Simulated robot, safety monitor and hardware station, stepped in turn in one process."""

from guiderail_hardware.drivers.driver import safety_limits
from guiderail_hardware.drivers.lcm import IiwaDriver
from guiderail_hardware.drivers.lcm_simulated import SimulatedIiwa
from guiderail_hardware.monitor import SafetyMonitor


class SteppedRobotClock:
    """Clock of a hardware station that steps a simulated robot before each step of the station.

    Attributes:
        happens: Injected events: functions, by the number of the step at which they are called.
        is_silent: True while the robot is not stepped.
        clock: Wall clock time [s] passed to the station; None to pass none.
    """

    clock: float | None = None
    check_robot = None

    def __init__(self, workcell, lcm, start, has_monitor=True):
        self.robot = SimulatedIiwa(workcell, lcm)
        plant = self.robot.controller_plant.plant
        if has_monitor:
            self.monitor = SafetyMonitor(
                IiwaDriver(lcm), plant, safety_limits(plant, IiwaDriver), clock=lambda: self.step * IiwaDriver.period
            )
        self.simulator = self.robot.simulator()
        self.robot.set_pose(self.simulator.get_mutable_context(), start)
        self.simulator.Initialize()
        self.step, self.happens, self.is_silent = 0, {}, False

    def receive(self):
        if hasattr(self, "monitor"):
            self.monitor.receive()

    def begin(self):
        pass

    def advance(self, simulator, station, steps):
        start = simulator.get_context().get_time()
        for step in range(steps):
            self.step += 1
            self.happens.get(self.step, lambda: None)()
            if not self.is_silent:
                self.simulator.AdvanceTo(self.step * IiwaDriver.period)
                self.receive()
            if self.clock is not None:
                self.clock += IiwaDriver.period
            advance(simulator, station, start + (step + 1) * IiwaDriver.period, self.clock)


def advance(simulator, station, time, clock=None):
    """Advance a hardware station to `time` [s] after it has received the newest status."""
    simulator.AdvancePendingEvents()
    station.receive(simulator.get_mutable_context(), clock)
    simulator.AdvanceTo(time)
