"""A simulated robot, its deputy and whoever drives it, stepped in turn in one process."""

from guiderail.diagrams.hardware.monitor import SafetyMonitor
from guiderail.diagrams.hardware.driver import safety_limits
from guiderail.diagrams.hardware.lcm.driver import IiwaDriver
from guiderail.diagrams.hardware.lcm.simulated import SimulatedIiwa


class Together:
    """A pace: steps both in turn; at some step something may happen.

    Attributes:
        clock: on the wall [s], where the station is told the time; it passes as the robot's does, and whatever else
            takes time adds to it.
    """

    clock: float | None = None

    def __init__(self, workcell, lcm, start, deputy=True):
        self.robot = SimulatedIiwa(workcell, lcm)
        plant = self.robot.controller_plant.plant
        if deputy:
            self.deputy = SafetyMonitor(IiwaDriver(lcm), plant, safety_limits(plant, IiwaDriver))
        self.simulator = self.robot.simulator()
        self.robot.set_pose(self.simulator.get_mutable_context(), start)
        self.simulator.Initialize()
        self.step, self.happens, self.is_silent = 0, {}, False

    def on_episode_start(self):
        pass

    def advance(self, simulator, station, steps):
        start = simulator.get_context().get_time()
        for step in range(steps):
            self.step += 1
            self.happens.get(self.step, lambda: None)()
            if not self.is_silent:
                self.simulator.AdvanceTo(self.step * IiwaDriver.period)
            if self.clock is not None:
                self.clock += IiwaDriver.period
                simulator.AdvancePendingEvents()
                station.receive(simulator.get_mutable_context(), self.clock)
            simulator.AdvanceTo(start + (step + 1) * IiwaDriver.period)
