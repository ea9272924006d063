"""The hardware station against a simulated arm at the other end of LCM."""

import os
import subprocess
import sys

import numpy as np
import pytest
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.stations.arm import ArmStation
from guiderail.diagrams.stations.bnc_workcell import BncWorkcell
from guiderail.diagrams.stations.hardware import HardwareStation, SimulatedIiwa, drive_in_step
from guiderail.diagrams.stations.rails import RailsStation
from guiderail.diagrams.stations.station import PLANT_PERIOD, Impedance
from guiderail.models.errors import InputError
from guiderail.tools.operate.serve_iiwa import START

WORKCELL = BncWorkcell()


class OneProcess:
    """Both sides of a bus in memory, stepped in turn."""

    def __init__(self):
        lcm = DrakeLcm("memq://")
        self.robot = SimulatedIiwa(WORKCELL, lcm)
        self.station = HardwareStation(WORKCELL, lcm, robot_timeout=1.0)
        self.robot_simulator, self.simulator = Simulator(self.robot), Simulator(self.station)
        self.robot.set_pose(self.robot_simulator.get_mutable_context(), START)
        self.context = self.simulator.get_mutable_context()
        self.desired = self.station.get_desired_pose_input_port().FixValue(self.context, START)
        self.robot_simulator.Initialize()
        self.station.start(self.simulator)
        self._steps = 0

    def go(self, pose, seconds):
        self.desired.GetMutableData().set_value(pose)
        for _ in range(round(seconds / PLANT_PERIOD)):
            self._steps += 1
            self.robot_simulator.AdvanceTo(self._steps * PLANT_PERIOD)
            self.simulator.AdvanceTo(self._steps * PLANT_PERIOD)

    def __getitem__(self, port):
        return self.station.GetOutputPort(port).Eval(self.context)


def test_starts_by_holding_where_the_robot_is():
    both = OneProcess()
    np.testing.assert_allclose(both["pose"], START, atol=1e-6)
    both.go(np.full(6, np.nan), 0.3)  # no command yet
    np.testing.assert_allclose(both["pose"], START, atol=1e-3)


def test_follows_pushes_and_feels_over_messages():
    both = OneProcess()
    both.go(START + [0.01, 0.0, 0.0, 0.0, 0.0, 0.0], 1.5)
    np.testing.assert_allclose(both["pose"][:3], START[:3] + [0.01, 0, 0], atol=1e-3)
    # Turned by 45°, the mouth stands on the lugs: 10 N of push come back as 10 N.
    lug_top = 0.005975
    turned = np.array([0.0, 0.0, 0.012, np.pi / 4, 0.0, 0.0])
    both.go(turned, 1.0)
    both.go(turned + [0, 0, lug_top - 0.012 - 10.0 / 1500.0, 0, 0, 0], 1.5)
    assert both["wrench"][2] == pytest.approx(10.0, abs=1.5)
    assert both["contact_force"][0] == pytest.approx(10.0, abs=1.5)
    assert both["pose"][2] == pytest.approx(lug_top, abs=5e-4)


def test_two_processes_on_one_machine(monkeypatch):
    monkeypatch.setenv("DRAKE_ALLOW_NETWORK", "lcm")  # with a time to live of zero: no message leaves this machine
    url = f"udpm://239.255.76.67:{20000 + os.getpid() % 20000}?ttl=0"
    call = f"from guiderail.tools.command import main; main(['serve-iiwa', '--url', {url!r}, '--seconds', '1.5'])"
    command = [sys.executable, "-c", call]
    with subprocess.Popen(command) as robot:
        lcm = DrakeLcm(url)
        station = HardwareStation(WORKCELL, lcm, robot_timeout=30.0)
        simulator = Simulator(station)
        context = simulator.get_mutable_context()
        goal = START + [0.0, 0.008, 0.0, 0.0, 0.0, 0.0]
        station.get_desired_pose_input_port().FixValue(context, goal)
        station.start(simulator)
        before = station.get_pose_output_port().Eval(context).copy()
        drive_in_step(simulator, lcm, 1.4, patience=5.0)
        after = station.get_pose_output_port().Eval(context)
        np.testing.assert_allclose(before, START, atol=1e-4)
        assert np.linalg.norm((after - goal)[:3]) < 0.2 * np.linalg.norm((before - goal)[:3])
        robot.terminate()


def test_says_that_no_robot_answers():
    station = HardwareStation(WORKCELL, DrakeLcm("memq://"), robot_timeout=0.1)
    simulator = Simulator(station)
    station.get_desired_pose_input_port().FixValue(simulator.get_mutable_context(), START)
    with pytest.raises(InputError, match="no robot answers"):
        station.start(simulator)


def test_a_real_arm_is_not_put_anywhere():
    station = HardwareStation(WORKCELL, DrakeLcm("memq://"))
    with pytest.raises(InputError, match="move it there"):
        station.set_pose(station.CreateDefaultContext(), START)


def test_all_stations_have_the_same_ports():
    stations = [RailsStation(WORKCELL), ArmStation(WORKCELL), HardwareStation(WORKCELL, DrakeLcm("memq://"))]
    simulated_only = {"query", "body_poses"}
    for station in stations:
        inputs = {station.get_input_port(i).get_name(): station.get_input_port(i).size() for i in range(2)}
        assert inputs == {"desired_pose": 6, "command_time": 1}
        ports = [station.get_output_port(i) for i in range(station.num_output_ports())]
        outputs = {port.get_name(): port.size() for port in ports if port.get_name() not in simulated_only}
        assert outputs == {"pose": 6, "wrench": 6, "contact_force": 1, "saturation": 1, "holding": 1}
        assert station.num_input_ports() == 2


@pytest.mark.parametrize(
    "wrong", [{"stiffness": (1.0,) * 5}, {"limits": (0.0,) * 6}, {"damping_ratio": 0.0}, {"stiffness": (np.nan,) * 6}]
)
def test_refuses_an_impedance_that_makes_no_sense(wrong):
    with pytest.raises(InputError):
        Impedance(**wrong)
