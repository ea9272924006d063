"""Hardware station on LCM with a simulated arm: control, stops, limits and refused arguments."""

import itertools
import multiprocessing
import os
import time
from dataclasses import replace

import numpy as np
import pytest
from drake import lcmt_iiwa_command, lcmt_iiwa_status, lcmt_panda_command, lcmt_panda_status
from injections.stepped_robot import advance
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from guiderail.diagrams.stations.arm import ArmStation
from guiderail.diagrams.stations.gantry import GantryStation
from guiderail.diagrams.stations.station import Impedance
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail.tools.cli.main import main
from guiderail_hardware.drivers.driver import find_driver, safety_limits
from guiderail_hardware.drivers.lcm import HEARTBEAT_FORMAT, IiwaDriver
from guiderail_hardware.drivers.lcm_simulated import LockstepClock, SimulatedIiwa
from guiderail_hardware.models.joint_status import Fault, StatusLimits
from guiderail_hardware.models.state_estimator import SOURCE_TIME
from guiderail_hardware.robot.sim_driver import START
from guiderail_hardware.station import HardwareStation, tool_jacobian
from guiderail_hardware.systems.torque_safety_limiter import ArmState

WORKCELL = BncWorkcell()
PERIOD = IiwaDriver.period
ALIASES = ("position_measured", "velocity_estimated", "state_estimated", "torque_external", "torque_commanded")


class QuickDriver(IiwaDriver):
    """Driver whose robot accepts commands soon."""

    hold_off = 0.05


class Loop:
    """Station and simulated robot in one process, on a bus in memory, stepped in turn."""

    def __init__(self, is_settled=True, impedance=None, driver=QuickDriver):
        self.lcm = lcm = DrakeLcm("memq://")
        self.torques = []
        self.robot = SimulatedIiwa(WORKCELL, lcm)
        limits = replace(safety_limits(self.robot.controller_plant.plant, IiwaDriver), damping_time=0.1, ramp_time=0.1)
        self.station = HardwareStation(
            WORKCELL, driver(lcm), impedance or Impedance(), robot_timeout=1.0, limits=limits
        )
        self.robot_simulator, self.simulator = self.robot.simulator(), Simulator(self.station)
        self.robot.set_pose(self.robot_simulator.get_mutable_context(), START)
        self.context = self.simulator.get_mutable_context()
        self.desired = self.station.get_desired_pose_input_port().FixValue(self.context, START)
        self.commands = []
        lcm.Subscribe("IIWA_COMMAND", lambda message: self.commands.append(lcmt_iiwa_command.decode(message)))
        self.robot_simulator.Initialize()
        self.station.start(self.simulator)
        self._steps = 0
        if is_settled:
            self.advance(START, 0.2)
            assert self.arm_state == ArmState.RUNNING

    @property
    def arm_state(self):
        return ArmState(int(self["arm_state"][0]))

    @property
    def fault(self):
        return Fault(int(self["fault"][0]))

    def advance(self, pose, seconds, has_robot=True):
        """Command a pose and advance; without the robot, the station receives no statuses."""
        self.desired.GetMutableData().set_value(pose)
        for _ in range(round(seconds / PERIOD)):
            self._steps += 1
            if has_robot:
                self.robot_simulator.AdvanceTo(self._steps * PERIOD)
            advance(self.simulator, self.station, self._steps * PERIOD)
            self.torques.append(self["iiwa.torque_commanded"].copy())

    def __getitem__(self, port):
        return self.station.GetOutputPort(port).Eval(self.context)


def test_station_tracks_poses_and_measures_the_force():
    loop = Loop()
    np.testing.assert_allclose(loop["pose"], START, atol=1e-6)
    loop.advance(np.full(6, np.nan), 0.1)  # NaN: no command
    np.testing.assert_allclose(loop["pose"], START, atol=1e-3)
    loop.advance(START + [0.01, 0.0, 0.0, 0.0, 0.0, 0.0], 0.6)
    np.testing.assert_allclose(loop["pose"][:3], START[:3] + [0.01, 0, 0], atol=1e-3)
    # At a yaw of 45°, the plug's mouth rests on the lugs. The command is 10 N / (1500 N/m) below their top.
    lug_top = 0.005975  # height of the mouth on the lugs [m]
    rotated = np.array([0.0, 0.0, 0.012, np.pi / 4, 0.0, 0.0])
    loop.advance(rotated, 1.2)
    loop.advance(rotated + [0, 0, lug_top - 0.012 - 10.0 / 1500.0, 0, 0, 0], 0.7)
    assert loop["wrench"][2] == pytest.approx(10.0, abs=1.5)
    assert loop["impedance_force"][0] == pytest.approx(10.0, abs=1.5)
    assert loop["pose"][2] == pytest.approx(lug_top, abs=5e-4)


def test_station_moves_a_robot_in_another_process(forkserver):
    # With a time to live of zero, no message leaves this machine.
    url = f"udpm://239.255.76.67:{20000 + os.getpid() % 20000}?ttl=0"
    robot = multiprocessing.get_context("forkserver").Process(
        target=main, args=(["sim-driver", "--url", url, "--seconds", "1.5"],)
    )
    robot.start()
    station = HardwareStation(WORKCELL, IiwaDriver(DrakeLcm(url)), robot_timeout=30.0)
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    goal = START + [0.0, 0.008, 0.0, 0.0, 0.0, 0.0]
    station.get_desired_pose_input_port().FixValue(context, goal)
    station.start(simulator)
    before = station.get_pose_output_port().Eval(context).copy()
    clock = LockstepClock(station.driver, 5.0)
    clock.begin()
    clock.advance(simulator, station, round(1.4 / PERIOD))
    after = station.get_pose_output_port().Eval(context)
    np.testing.assert_allclose(before, START, atol=1e-4)
    assert np.linalg.norm((after - goal)[:3]) < 0.2 * np.linalg.norm((before - goal)[:3])
    robot.kill()
    robot.join()


def encoded_status(loop, **changed):
    """Return the encoded next status of the robot at rest, with some fields changed."""
    message = lcmt_iiwa_status()
    positions = loop["iiwa.position_measured"].tolist()
    message.utime, message.num_joints = round((loop.context.get_time() + PERIOD) * 1e6), 7
    for name in message.__slots__[2:]:
        setattr(message, name, [0.0] * 7)
    message.joint_position_measured = positions
    for name, value in changed.items():
        setattr(message, name, value)
    return message.encode()


NAN7, THREE = [np.nan] * 7, {name: [0.0] * 3 for name in lcmt_iiwa_status.__slots__[2:]}
# Expected faults, and changed fields of a status; None for a message that is no status.
FAULTY = {
    "NaN in the positions": (Fault.NOT_FINITE, {"joint_position_measured": NAN7}),
    "three joints": (Fault.WRONG_SIZE, {"num_joints": 3} | THREE),
    "an old status": (Fault.OUT_OF_ORDER, {"utime": 1000}),
    "garbage": (Fault.MALFORMED, None),
}


@pytest.fixture(scope="module")
def shared_loop():
    return Loop()


@pytest.mark.parametrize("name", FAULTY)
def test_station_stops_at_a_faulty_status_and_resumes(shared_loop, name):
    """While the arm moves, a faulty status replaces one status of the robot."""
    loop, (fault, changed) = shared_loop, FAULTY[name]
    x = 0.01 * (-1.0) ** list(FAULTY).index(name)  # alternates, so that the arm moves in every case [m]
    goal = START + [x, 0.0, 0.0, 0.0, 0.0, 0.0]
    loop.advance(goal, 0.06)
    message = bytes(range(100)) if changed is None else encoded_status(loop, **changed)
    loop.torques.clear()
    loop.lcm.Publish("IIWA_STATUS", message)
    loop.advance(goal, PERIOD, has_robot=False)
    assert loop.fault == fault
    loop.advance(goal, 0.05)
    assert loop.arm_state == ArmState.DAMPING
    assert np.isfinite(loop.torques).all()
    assert (np.abs(loop.torques) <= loop.station.limits.torque).all()
    loop.advance(goal, 0.1)
    assert (loop.arm_state, loop.fault) == (ArmState.OFF, fault)
    np.testing.assert_array_equal(loop["iiwa.torque_commanded"], 0.0)
    assert loop.commands[-1].joint_torque == (0.0,) * 7
    assert np.abs(loop["iiwa.velocity_estimated"]).max() < 0.02
    loop.advance(goal, SOURCE_TIME)  # the replaced status looks like one of a second robot
    before = loop["pose"].copy()
    loop.station.resume(loop.context)
    loop.advance(goal, 0.05)
    assert np.linalg.norm((loop["pose"] - before)[:3]) < 1e-3
    loop.advance(goal, 0.25)
    assert loop.arm_state == ArmState.RUNNING
    assert np.linalg.norm((loop["pose"] - goal)[:3]) < 0.5 * np.linalg.norm((before - goal)[:3])
    assert np.isfinite(loop["wrench"]).all()


def test_station_stops_and_sends_nothing_when_statuses_stop():
    loop = Loop(driver=IiwaDriver, is_settled=False)
    loop.advance(START, 0.4)
    goal = START + [0.01, 0.0, 0.0, 0.0, 0.0, 0.0]
    loop.advance(goal, 0.06)
    velocity = loop["iiwa.velocity_estimated"].copy()
    assert np.abs(velocity).max() > 0.05
    loop.torques.clear()
    loop.advance(goal, 0.25, has_robot=False)
    steps = next(step for step, torque in enumerate(loop.torques) if (torque @ velocity < 0.0) or not torque.any())
    assert steps * PERIOD <= 0.05  # until torques decelerate the arm or are zero [s]
    assert (loop.arm_state, loop.fault) == (ArmState.OFF, Fault.STALE)
    num_commands = len(loop.commands)
    assert loop.commands[-1].joint_torque == (0.0,) * 7
    loop.advance(goal, 0.3, has_robot=False)
    assert len(loop.commands) == num_commands
    # When the robot sends statuses again, nothing is sent during the settling time, and zero torque afterwards.
    num_torques = len(loop.torques)
    loop.robot_simulator.AdvanceTo(loop.robot_simulator.get_context().get_time() + PERIOD)
    loop.advance(goal, 0.2)
    assert len(loop.commands) == num_commands
    loop.advance(goal, 0.2)
    assert len(loop.commands) > num_commands
    np.testing.assert_array_equal(loop.torques[num_torques:], 0.0)
    loop.station.resume(loop.context)
    loop.advance(goal, 0.5)
    assert loop.arm_state == ArmState.RUNNING
    np.testing.assert_allclose(loop["pose"][:3], goal[:3], atol=2e-3)


def test_station_stops_when_another_program_commands():
    loop = Loop()
    loop.lcm.Publish("IIWA_COMMAND", IiwaDriver.encode(np.zeros(7), 77.0))
    loop.advance(START, 2 * PERIOD)
    assert (loop.arm_state, loop.fault) == (ArmState.DAMPING, Fault.SECOND_COMMANDER)
    loop.advance(START, 0.2)
    assert loop.arm_state == ArmState.OFF
    loop.station.resume(loop.context)
    loop.advance(START, 0.15)
    assert (loop.arm_state, loop.fault) == (ArmState.RUNNING, Fault.NONE)


def test_station_sends_nothing_during_the_hold_off():
    loop = Loop(is_settled=False, driver=IiwaDriver)
    loop.advance(START, 0.25)
    assert loop.commands == []
    loop.advance(START, 0.05)
    assert loop.commands


def test_settling_time_equals_the_hold_off_of_the_driver():
    class LateDriver(IiwaDriver):
        hold_off = 0.6

    driver = LateDriver(DrakeLcm("memq://"))
    assert HardwareStation(WORKCELL, driver).status_limits.settling_time == 0.6
    with pytest.raises(InputError, match=r"accepts no commands for 0.6 s.*not 0.25 s"):
        HardwareStation(WORKCELL, driver, status_limits=StatusLimits((1.0,) * 7))


def test_station_resumes_at_the_measured_pose_without_commands():
    loop, no_command = Loop(), np.full(6, np.nan)
    loop.station.stop(loop.context)
    loop.advance(no_command, 0.05)
    assert (loop.arm_state, loop.fault) == (ArmState.DAMPING, Fault.USER_STOP)
    assert loop["command_timed_out"][0] == 1.0
    loop.advance(no_command, 0.15)
    displaced = START + [0.06, 0.0, 0.05, 0.0, 0.0, 0.0]
    loop.robot.set_pose(loop.robot_simulator.get_mutable_context(), displaced)  # the arm is moved by hand
    loop.advance(no_command, 0.3)
    loop.station.resume(loop.context)
    loop.advance(no_command, 0.3)
    assert loop.arm_state == ArmState.RUNNING
    np.testing.assert_allclose(loop["pose"], displaced, atol=1e-3)


def tank_energy(station, context):
    tank = station.GetSubsystemByName("tank")
    return tank.get_energy_output_port().Eval(tank.GetMyContextFromRoot(context))[0]


@pytest.mark.parametrize("new_motion", ["resume", "take_over"])
def test_new_motion_begins_with_a_full_energy_tank(new_motion):
    """With an empty tank the reference would not move, so that the arm would stand still without a fault."""
    loop = Loop(impedance=Impedance().with_max_force(30.0))
    station, context = loop.station, loop.context
    full, tank = tank_energy(station, context), station.GetSubsystemByName("tank")
    content = tank.GetMyMutableContextFromRoot(context).get_mutable_discrete_state()
    content.get_mutable_vector(tank._content).SetAtIndex(0, 0.0)
    assert tank_energy(station, context) == 0.0 < full
    if new_motion == "resume":
        station.stop(context)
        loop.advance(START, 0.3)
        station.resume(context)
    else:
        other, station = station, station.clone(WORKCELL)
        simulator = Simulator(station)
        station.get_desired_pose_input_port().FixValue(simulator.get_mutable_context(), START)
        station.take_over(simulator, other, context)
        context = simulator.get_context()
    assert tank_energy(station, context) == full


def test_copy_state_from_continues_the_motion():
    loop = Loop()
    goal = START + [0.005, 0.0, 0.0, 0.0, 0.0, 0.0]
    loop.advance(goal, 0.3)
    station = HardwareStation(WORKCELL, QuickDriver(loop.lcm))
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    station.get_desired_pose_input_port().FixValue(context, goal)
    loop.robot.ForcedPublish(loop.robot_simulator.get_context())
    station.start(simulator)
    station.copy_state_from(context, loop.station, loop.context)
    time = loop.robot_simulator.get_context().get_time()
    for step in range(1, 40):
        loop.robot_simulator.AdvanceTo(time + step * PERIOD)
        advance(simulator, station, step * PERIOD)
        assert station.get_arm_state_output_port().Eval(context)[0] == ArmState.RUNNING
        assert station.get_fault_output_port().Eval(context)[0] == Fault.NONE
    np.testing.assert_allclose(station.get_pose_output_port().Eval(context)[:3], goal[:3], atol=1.5e-3)


def test_external_torque_has_the_same_sign_for_all_robots():
    """The status has the torque of the environment on the joints; a Franka reports the opposite."""
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
def test_limits_are_below_the_reflex_limits_of_the_driver(robot):
    station = HardwareStation(WORKCELL, find_driver(robot)(DrakeLcm("memq://")), robot=robot)
    torque_reflex_limits = np.array(station.driver.torque_reflex_limits)
    assert (np.array(station.limits.torque) < torque_reflex_limits).all()
    assert (np.array(station.limits.external_torque) < torque_reflex_limits).all()
    assert station.HasOutputPort(f"{station.driver.name}.torque_external")


def test_largest_wrench_exceeds_only_limits_of_joints_4_to_6():
    station = HardwareStation(WORKCELL, IiwaDriver(DrakeLcm("memq://")))
    shares = station.max_torque_shares(station.controller_plant.solve(START, station.controller_plant.posture))
    assert (shares[[0, 1, 2, 6]] < 0.7).all()
    assert 1.0 < shares[3:6].max() < 1.5


def test_max_torque_shares_bound_all_wrenches():
    station = HardwareStation(
        WORKCELL, IiwaDriver(DrakeLcm("memq://")), impedance=Impedance(limits=(40.0, 30.0, 20.0, 3, 2, 1))
    )
    positions = station.controller_plant.solve(START, station.controller_plant.posture)
    J = np.roll(
        tool_jacobian(station.controller_plant, positions, station.controller_plant.target), 3, axis=0
    )  # rows: force, then torque
    corners = np.array(list(itertools.product(*((-limit, limit) for limit in (40.0, 30.0, 20.0, 1, 2, 3)))))
    worst = np.abs(corners @ J).max(axis=0) / np.array(station.limits.torque)
    np.testing.assert_allclose(station.max_torque_shares(positions), worst)


def test_start_raises_when_no_robot_answers():
    station = HardwareStation(WORKCELL, IiwaDriver(DrakeLcm("memq://")), robot_timeout=0.1)
    simulator = Simulator(station)
    station.get_desired_pose_input_port().FixValue(simulator.get_mutable_context(), START)
    with pytest.raises(InputError, match="no robot answers"):
        station.start(simulator)


def test_set_pose_raises_on_hardware():
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
    lcm.Publish(IiwaDriver.heartbeat_channel(), bytes(HEARTBEAT_FORMAT.size))
    station.receive(simulator.get_mutable_context())
    assert station.has_safety_monitor(context)


def test_stations_have_the_same_ports():
    stations = [
        GantryStation(WORKCELL),
        ArmStation(WORKCELL),
        HardwareStation(WORKCELL, IiwaDriver(DrakeLcm("memq://"))),
    ]
    # Ports of simulated stations only, and of the hardware station only.
    one_kind_only = {"query", "body_poses", "contact_results", "fault", "arm_state"} | {
        f"iiwa.{name}" for name in ALIASES
    }
    for station in stations:
        inputs = {station.get_input_port(i).get_name(): station.get_input_port(i).size() for i in range(2)}
        assert inputs == {"desired_pose": 6, "command_time": 1}
        ports = [station.get_output_port(i) for i in range(station.num_output_ports())]
        outputs = {port.get_name(): port.size() for port in ports if port.get_name() not in one_kind_only}
        assert outputs.pop("impedance_force") == 1
        assert outputs == {"pose": 6, "wrench": 6, "contact_force": 1, "saturation": 1, "command_timed_out": 1}
        assert station.num_input_ports() == 2


@pytest.mark.parametrize(
    "options", [{"stiffness": (1.0,) * 5}, {"limits": (0.0,) * 6}, {"damping_ratio": 0.0}, {"stiffness": (np.nan,) * 6}]
)
def test_impedance_raises_when_a_parameter_is_invalid(options):
    with pytest.raises(InputError):
        Impedance(**options)


def test_panda_commands_have_the_wall_clock_time():
    """Drake's driver for the Franka drops commands that are older than 0.1 s by the wall clock."""
    before = time.time_ns() // 1000
    command = lcmt_panda_command.decode(find_driver("panda").encode(np.arange(7.0), 0.005))
    assert before <= command.utime <= time.time_ns() // 1000
    assert list(command.joint_torque) == list(range(7))


def test_initialization_damps_an_arm_in_motion():
    loop = Loop()
    plant = loop.robot.plant
    robot = plant.GetMyContextFromRoot(loop.robot_simulator.get_context())
    loop.advance(START + [0.10, 0.0, 0.08, 0.0, 0.0, 0.0], 0.2)
    before = np.abs(plant.GetVelocities(robot)).max()
    loop.simulator.Initialize()
    loop.advance(START, 0.08)
    assert (loop.arm_state, loop.fault) == (ArmState.DAMPING, Fault.INITIALIZED)
    assert np.abs(plant.GetVelocities(robot)).max() < 0.05 * before
    loop.advance(START, 0.2)
    loop.station.resume(loop.context)
    loop.advance(START, 0.15)
    assert loop.arm_state == ArmState.RUNNING
