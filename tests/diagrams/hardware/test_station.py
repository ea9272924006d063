"""Hardware station with a simulated arm on LCM."""

import itertools
import os
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from drake import lcmt_iiwa_command, lcmt_iiwa_status, lcmt_panda_command, lcmt_panda_status
from injections.stepped_robot import advance
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from guiderail.diagrams.hardware.driver import find_driver, safety_limits
from guiderail.diagrams.hardware.lcm import IiwaDriver
from guiderail.diagrams.hardware.lcm_simulated import LockstepClock, SimulatedIiwa
from guiderail.diagrams.hardware.station import HardwareStation, tool_jacobian
from guiderail.diagrams.stations.arm import ArmStation
from guiderail.diagrams.stations.gantry import GantryStation
from guiderail.diagrams.stations.station import Impedance
from guiderail.diagrams.tasks.bnc_connector.task import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail.models.control.joint_status import Fault, StatusLimits
from guiderail.systems.torque_safety_limiter import ArmState
from guiderail.tools.hardware.sim_driver import START

WORKCELL = BncWorkcell()
PERIOD = IiwaDriver.period
ALIASES = ("position_measured", "velocity_estimated", "state_estimated", "torque_external", "torque_commanded")


class OneProcess:
    """Station and robot on a bus in memory, stepped in turn."""

    def __init__(self, settled=True):
        self.lcm = lcm = DrakeLcm("memq://")
        self.torques = []
        self.robot = SimulatedIiwa(WORKCELL, lcm)
        limits = replace(safety_limits(self.robot.controller_plant.plant, IiwaDriver), damping_time=0.2, ramp_time=0.1)
        self.station = HardwareStation(WORKCELL, IiwaDriver(lcm), robot_timeout=1.0, limits=limits)
        self.robot_simulator, self.simulator = self.robot.simulator(), Simulator(self.station)
        self.robot.set_pose(self.robot_simulator.get_mutable_context(), START)
        self.context = self.simulator.get_mutable_context()
        self.desired = self.station.get_desired_pose_input_port().FixValue(self.context, START)
        self.commands = []
        lcm.Subscribe("IIWA_COMMAND", lambda message: self.commands.append(lcmt_iiwa_command.decode(message)))
        self.robot_simulator.Initialize()
        self.station.start(self.simulator)
        self._steps = 0
        if settled:
            self.go(START, 0.4)
            assert self.arm_state == ArmState.RUNNING

    @property
    def arm_state(self):
        return ArmState(int(self["arm_state"][0]))

    @property
    def fault(self):
        return Fault(int(self["fault"][0]))

    def go(self, pose, seconds, robot=True):
        """Advance both, or the station only, without statuses."""
        self.desired.GetMutableData().set_value(pose)
        for _ in range(round(seconds / PERIOD)):
            self._steps += 1
            if robot:
                self.robot_simulator.AdvanceTo(self._steps * PERIOD)
            advance(self.simulator, self.station, self._steps * PERIOD)
            self.torques.append(self["iiwa.torque_commanded"].copy())

    def __getitem__(self, port):
        return self.station.GetOutputPort(port).Eval(self.context)


def test_station_starts_by_holding_the_pose():
    both = OneProcess()
    np.testing.assert_allclose(both["pose"], START, atol=1e-6)
    both.go(np.full(6, np.nan), 0.3)  # no command yet
    np.testing.assert_allclose(both["pose"], START, atol=1e-3)


def test_station_follows_and_measures_force():
    both = OneProcess()
    both.go(START + [0.01, 0.0, 0.0, 0.0, 0.0, 0.0], 1.0)
    np.testing.assert_allclose(both["pose"][:3], START[:3] + [0.01, 0, 0], atol=1e-3)
    # Turned by 45°, the mouth rests on the lugs, and a push of 10 N is measured as 10 N.
    lug_top = 0.005975
    turned = np.array([0.0, 0.0, 0.012, np.pi / 4, 0.0, 0.0])
    both.go(turned, 1.75)
    both.go(turned + [0, 0, lug_top - 0.012 - 10.0 / 1500.0, 0, 0, 0], 1.0)
    assert both["wrench"][2] == pytest.approx(10.0, abs=1.5)
    assert both["contact_force"][0] == pytest.approx(10.0, abs=1.5)
    assert both["pose"][2] == pytest.approx(lug_top, abs=5e-4)


def test_station_moves_a_robot_in_another_process(monkeypatch):
    monkeypatch.setenv("DRAKE_ALLOW_NETWORK", "lcm")  # no message leaves this machine with a time to live of zero
    url = f"udpm://239.255.76.67:{20000 + os.getpid() % 20000}?ttl=0"
    call = f"from guiderail.tools.cli.main import main; main(['sim-driver', '--url', {url!r}, '--seconds', '1.5'])"
    command = [sys.executable, "-c", call]
    with subprocess.Popen(command) as robot:
        lcm = DrakeLcm(url)
        station = HardwareStation(WORKCELL, IiwaDriver(lcm), robot_timeout=30.0)
        simulator = Simulator(station)
        context = simulator.get_mutable_context()
        goal = START + [0.0, 0.008, 0.0, 0.0, 0.0, 0.0]
        station.get_desired_pose_input_port().FixValue(context, goal)
        station.start(simulator)
        before = station.get_pose_output_port().Eval(context).copy()
        pace = LockstepClock(station.driver, 5.0)
        pace.begin()
        pace.advance(simulator, station, round(1.4 / PERIOD))
        after = station.get_pose_output_port().Eval(context)
        np.testing.assert_allclose(before, START, atol=1e-4)
        assert np.linalg.norm((after - goal)[:3]) < 0.2 * np.linalg.norm((before - goal)[:3])
        robot.terminate()


def status(both, **changed):
    """Return the next status of the robot at rest, with some fields changed."""
    message = lcmt_iiwa_status()
    positions = both["iiwa.position_measured"].tolist()
    message.utime, message.num_joints = round((both.context.get_time() + PERIOD) * 1e6), 7
    for name in message.__slots__[2:]:
        setattr(message, name, [0.0] * 7)
    message.joint_position_measured = positions
    for name, value in changed.items():
        setattr(message, name, value)
    return message.encode()


NAN7, THREE = [np.nan] * 7, {name: [0.0] * 3 for name in lcmt_iiwa_status.__slots__[2:]}
FAULTY = {
    "NaN in the positions": (Fault.NOT_FINITE, {"joint_position_measured": NAN7}),
    "three joints": (Fault.WRONG_SIZE, {"num_joints": 3} | THREE),
    "an old status": (Fault.OUT_OF_ORDER, {"utime": 1000}),
    "garbage": (Fault.MALFORMED, None),
}


@pytest.fixture(scope="module")
def pushing():
    return OneProcess()


@pytest.mark.parametrize("name", FAULTY)
def test_station_stops_at_a_faulty_status_and_resumes(pushing, name):
    """One faulty status replaces the robot's while the arm moves."""
    both, (fault, changed) = pushing, FAULTY[name]
    side = 0.01 * (-1.0) ** list(FAULTY).index(name)
    goal = START + [side, 0.0, 0.0, 0.0, 0.0, 0.0]
    both.go(goal, 0.06)
    wrong = bytes(range(100)) if changed is None else status(both, **changed)
    both.torques.clear()
    both.lcm.Publish("IIWA_STATUS", wrong)
    both.go(goal, PERIOD, robot=False)
    assert both.fault == fault
    both.go(goal, 0.1)
    assert both.arm_state == ArmState.DAMPING
    assert np.isfinite(both.torques).all()
    assert (np.abs(both.torques) <= both.station.limits.torque).all()
    both.go(goal, 0.25)
    assert (both.arm_state, both.fault) == (ArmState.OFF, fault)
    np.testing.assert_array_equal(both["iiwa.torque_commanded"], 0.0)
    assert both.commands[-1].joint_torque == (0.0,) * 7
    left = np.abs(both["iiwa.velocity_estimated"]).max()
    before = both["pose"].copy()
    both.station.resume(both.context)
    both.go(goal, 0.05)
    assert np.linalg.norm((both["pose"] - before)[:3]) < 1e-3
    both.go(goal, 0.4)
    assert both.arm_state == ArmState.RUNNING
    assert np.linalg.norm((both["pose"] - goal)[:3]) < 0.5 * np.linalg.norm((before - goal)[:3])
    assert np.isfinite(both["wrench"]).all()
    assert left < 0.02


def test_station_stops_and_is_silent_when_statuses_stop():
    both = OneProcess()
    goal = START + [0.01, 0.0, 0.0, 0.0, 0.0, 0.0]
    both.go(goal, 0.06)
    moving = both["iiwa.velocity_estimated"].copy()
    assert np.abs(moving).max() > 0.05
    both.torques.clear()
    both.go(goal, 0.5, robot=False)
    result = next(step for step, torque in enumerate(both.torques) if (torque @ moving < 0.0) or not torque.any())
    assert result * PERIOD <= 0.05
    assert (both.arm_state, both.fault) == (ArmState.OFF, Fault.STALE)
    sent = len(both.commands)
    assert both.commands[-1].joint_torque == (0.0,) * 7
    both.go(goal, 1.0, robot=False)
    assert len(both.commands) == sent
    # After the robot is back nothing is sent until the settling time is over, and then zero torque.
    num_torques = len(both.torques)
    both.robot_simulator.AdvanceTo(both.robot_simulator.get_context().get_time() + PERIOD)
    both.go(goal, 0.2)
    assert len(both.commands) == sent
    both.go(goal, 0.2)
    assert len(both.commands) > sent
    np.testing.assert_array_equal(both.torques[num_torques:], 0.0)
    both.station.resume(both.context)
    both.go(goal, 1.0)
    assert both.arm_state == ArmState.RUNNING
    np.testing.assert_allclose(both["pose"][:3], goal[:3], atol=2e-3)


def test_station_stops_when_another_program_commands():
    both = OneProcess()
    both.lcm.Publish("IIWA_COMMAND", IiwaDriver.encode(np.zeros(7), 77.0))
    both.go(START, 2 * PERIOD)
    assert (both.arm_state, both.fault) == (ArmState.DAMPING, Fault.SECOND_COMMANDER)
    both.go(START, 0.4)
    assert both.arm_state == ArmState.OFF
    both.station.resume(both.context)
    both.go(START, 0.2)
    assert (both.arm_state, both.fault) == (ArmState.RUNNING, Fault.NONE)


def test_station_sends_nothing_during_the_hold_off():
    both = OneProcess(settled=False)
    both.go(START, 0.25)
    assert both.commands == []
    both.go(START, 0.05)
    assert both.commands


def test_station_settles_for_the_hold_off_of_its_driver():
    class LateDriver(IiwaDriver):
        hold_off = 0.6

    driver = LateDriver(DrakeLcm("memq://"))
    assert HardwareStation(WORKCELL, driver).status_limits.settling_time == 0.6
    with pytest.raises(InputError, match=r"accepts no commands for 0.6 s.*not 0.25 s"):
        HardwareStation(WORKCELL, driver, status_limits=StatusLimits((1.0,) * 7))


def test_stop_damps_the_arm():
    both = OneProcess()
    both.station.stop(both.context)
    both.go(START, 0.05)
    assert (both.arm_state, both.fault) == (ArmState.DAMPING, Fault.USER_STOP)
    assert both["command_timed_out"][0] == 1.0


def test_station_without_a_command_resumes_where_the_arm_is():
    both, no_command = OneProcess(), np.full(6, np.nan)
    both.station.stop(both.context)
    both.go(no_command, 0.4)
    moved = START + [0.06, 0.0, 0.05, 0.0, 0.0, 0.0]
    both.robot.set_pose(both.robot_simulator.get_mutable_context(), moved)  # by hand
    both.go(no_command, 0.6)
    both.station.resume(both.context)
    both.go(no_command, 0.6)
    assert both.arm_state == ArmState.RUNNING
    np.testing.assert_allclose(both["pose"], moved, atol=1e-3)


def test_copy_state_from_continues_without_a_gap():
    both = OneProcess()
    goal = START + [0.005, 0.0, 0.0, 0.0, 0.0, 0.0]
    both.go(goal, 0.3)
    other = HardwareStation(WORKCELL, IiwaDriver(both.lcm))
    simulator = Simulator(other)
    context = simulator.get_mutable_context()
    other.get_desired_pose_input_port().FixValue(context, goal)
    both.robot.ForcedPublish(both.robot_simulator.get_context())
    other.start(simulator)
    other.copy_state_from(context, both.station, both.context)
    time = both.robot_simulator.get_context().get_time()
    for step in range(1, 40):
        both.robot_simulator.AdvanceTo(time + step * PERIOD)
        advance(simulator, other, step * PERIOD)
        assert (other.get_arm_state_output_port().Eval(context)[0], other.get_fault_output_port().Eval(context)[0]) == (
            2,
            0,
        )
    np.testing.assert_allclose(other.get_pose_output_port().Eval(context)[:3], goal[:3], atol=1.5e-3)


def test_external_torque_is_that_of_the_surroundings():
    """An iiwa reports this torque, a Franka the opposite."""
    iiwa, panda = lcmt_iiwa_status(), lcmt_panda_status()
    for message in (iiwa, panda):
        message.num_joints = 7
        for name in (name for name in message.__slots__ if name.startswith("joint_")):
            setattr(message, name, [0.0] * 7)
        message.joint_torque_external = [1.0] * 7
    np.testing.assert_array_equal(find_driver("iiwa14").decode(iiwa.encode()).external_torque, [1.0] * 7)
    np.testing.assert_array_equal(find_driver("panda").decode(panda.encode()).external_torque, [-1.0] * 7)
    with pytest.raises(InputError, match="no driver of a robot 'ur5e'"):
        find_driver("ur5e")


@pytest.mark.parametrize("robot", ["iiwa14", "panda"])
def test_limits_are_below_the_drivers_reflex_limits(robot):
    station = HardwareStation(WORKCELL, find_driver(robot)(DrakeLcm("memq://")), robot=robot)
    torque_reflex_limits = np.array(station.driver.torque_reflex_limits)
    assert (np.array(station.limits.torque) < torque_reflex_limits).all()
    assert (np.array(station.limits.external_torque) < torque_reflex_limits).all()
    assert station.HasOutputPort(f"{station.driver.name}.torque_external")


def test_full_wrench_exceeds_limits_of_the_wrist_only():
    """With a stretched tool the impedance's limits exceed those of the torques on joints 4 to 6."""
    station = HardwareStation(WORKCELL, IiwaDriver(DrakeLcm("memq://")))
    load = station.max_torque_shares(station.controller_plant.solve(START, station.controller_plant.posture))
    assert (load[[0, 1, 2, 6]] < 0.7).all()
    assert 1.0 < load[3:6].max() < 1.5


def test_max_torque_shares_bound_all_wrenches():
    station = HardwareStation(
        WORKCELL, IiwaDriver(DrakeLcm("memq://")), impedance=Impedance(limits=(40.0, 30.0, 20.0, 3, 2, 1))
    )
    positions = station.controller_plant.solve(START, station.controller_plant.posture)
    J = np.roll(
        tool_jacobian(station.controller_plant, positions, station.controller_plant.target), 3, axis=0
    )  # force first
    corners = np.array(list(itertools.product(*((-limit, limit) for limit in (40.0, 30.0, 20.0, 1, 2, 3)))))
    worst = np.abs(corners @ J).max(axis=0) / np.array(station.limits.torque)
    np.testing.assert_allclose(station.max_torque_shares(positions), worst)


def test_start_raises_when_no_robot_answers():
    station = HardwareStation(WORKCELL, IiwaDriver(DrakeLcm("memq://")), robot_timeout=0.1)
    simulator = Simulator(station)
    station.get_desired_pose_input_port().FixValue(simulator.get_mutable_context(), START)
    with pytest.raises(InputError, match="no robot answers"):
        station.start(simulator)


def test_set_pose_raises():
    station = HardwareStation(WORKCELL, IiwaDriver(DrakeLcm("memq://")))
    with pytest.raises(InputError, match="move it there"):
        station.set_pose(station.CreateDefaultContext(), START)


def test_heartbeat_is_received_within_a_larger_diagram():
    lcm, builder = DrakeLcm("memq://"), DiagramBuilder()
    station = builder.AddSystem(HardwareStation(WORKCELL, IiwaDriver(lcm), robot_timeout=0.0))
    simulator = Simulator(builder.Build())
    context = station.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    station.get_desired_pose_input_port().FixValue(context, START)
    station.receive(simulator.get_mutable_context())
    assert not station.has_safety_monitor(context)
    lcm.Publish(IiwaDriver.heartbeat_channel(), bytes(17))
    station.receive(simulator.get_mutable_context())
    assert station.has_safety_monitor(context)


def test_stations_have_the_same_ports():
    stations = [
        GantryStation(WORKCELL),
        ArmStation(WORKCELL),
        HardwareStation(WORKCELL, IiwaDriver(DrakeLcm("memq://"))),
    ]
    simulated_only = {"query", "body_poses"}
    robots_own = {"fault", "arm_state"} | {f"iiwa.{name}" for name in ALIASES}
    for station in stations:
        inputs = {station.get_input_port(i).get_name(): station.get_input_port(i).size() for i in range(2)}
        assert inputs == {"desired_pose": 6, "command_time": 1}
        ports = [station.get_output_port(i) for i in range(station.num_output_ports())]
        outputs = {port.get_name(): port.size() for port in ports if port.get_name() not in simulated_only | robots_own}
        assert outputs == {"pose": 6, "wrench": 6, "contact_force": 1, "saturation": 1, "command_timed_out": 1}
        assert station.num_input_ports() == 2


@pytest.mark.parametrize(
    "wrong", [{"stiffness": (1.0,) * 5}, {"limits": (0.0,) * 6}, {"damping_ratio": 0.0}, {"stiffness": (np.nan,) * 6}]
)
def test_impedance_raises_when_a_parameter_is_invalid(wrong):
    with pytest.raises(InputError):
        Impedance(**wrong)


def test_panda_commands_have_the_wall_clock_time():
    """Drake's driver drops commands that are older than 0.1 s by this clock."""
    before = time.time_ns() // 1000
    command = lcmt_panda_command.decode(find_driver("panda").encode(np.arange(7.0), 0.005))
    assert before <= command.utime <= time.time_ns() // 1000
    assert list(command.joint_torque) == list(range(7))


def test_initialization_damps_an_arm_in_motion():
    both = OneProcess()
    plant = both.robot.plant
    robot = plant.GetMyContextFromRoot(both.robot_simulator.get_context())
    both.go(START + [0.10, 0.0, 0.08, 0.0, 0.0, 0.0], 0.2)
    before = np.abs(plant.GetVelocities(robot)).max()
    both.simulator.Initialize()
    both.go(START, 0.1)
    assert (both.arm_state, both.fault) == (ArmState.DAMPING, Fault.INITIALIZED)
    assert np.abs(plant.GetVelocities(robot)).max() < 0.05 * before
    both.go(START, 0.2)
    both.station.resume(both.context)
    both.go(START, 0.2)
    assert both.arm_state == ArmState.RUNNING
