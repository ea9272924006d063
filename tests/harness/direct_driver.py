"""Driver of a simulated robot in the same process, with `read` and `write` only."""

from functools import cache

import numpy as np
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.stations.arm import ArmControllerPlant
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail_hardware.drivers.driver import Driver
from guiderail_hardware.models.joint_status import JointStatus
from guiderail_hardware.station import HardwareStation

START = np.array([0.0, 0.0, 0.02, np.pi / 2, 0.0, 0.0])


@cache
def model_at_start():
    """Return the model of the arm, its joint positions at `START`, and a context, which take most of the time."""
    model = ArmControllerPlant(BncWorkcell())
    return model, model.solve(START, model.posture), model.plant.CreateDefaultContext()


class DirectDriver(Driver):
    """Joints without gravity and friction that are integrated when a torque is written."""

    name = "direct"
    torque_reflex_limits = (60.0,) * 7
    has_command_timeout = True

    def __init__(self, url=""):
        super().__init__(url)
        self.model, positions, self._context = model_at_start()
        self.positions = positions.copy()
        self.velocities, self.time, self.torques = np.zeros(7), 0.0, []

    def read(self):
        return JointStatus(self.time, self.positions.copy(), self.velocities.copy(), np.zeros(7))

    def write(self, torque, time):
        plant = self.model.plant
        plant.SetPositions(self._context, self.positions)
        M = plant.CalcMassMatrix(self._context)
        self.velocities = self.velocities + self.period * np.linalg.solve(M, torque)
        self.torques.append(torque)

    def elapse(self):
        self.positions, self.time = self.positions + self.period * self.velocities, self.time + self.period


def start_station(driver):
    """Start a station of the connector's workcell with a driver at `START`; return the station and its simulator."""
    station = HardwareStation(BncWorkcell(), driver)
    simulator = Simulator(station)
    station.get_desired_pose_input_port().FixValue(simulator.get_mutable_context(), START)
    station.start(simulator)
    return station, simulator
