"""Driver on ROS 2, between two processes over DDS on the loopback interface."""

import os
import time
from importlib.util import find_spec
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.stations.arm import ArmControllerPlant
from guiderail.diagrams.stations.station import Impedance
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail.models.robots.inverse_kinematics import pose_error
from guiderail_hardware.drivers import ros2
from guiderail_hardware.drivers.ros2 import Ros2Address, Ros2Driver, bounded_target
from guiderail_hardware.models.joint_status import Fault, LastStatus, StatusLimits, check_status
from guiderail_hardware.models.robot_impedance import RobotImpedance
from guiderail_hardware.robot.sim_driver import START
from guiderail_hardware.station import HardwareStation
from guiderail_hardware.systems.torque_safety_limiter import ArmState

needs_middleware = pytest.mark.skipif(
    find_spec("cyclonedds") is None, reason="Cyclone DDS is an extra: pip install 'guiderail[ros2]'"
)
LIMITS = StatusLimits.at_rate([2.0] * 7, 0.05)
IMPEDANCE = RobotImpedance(
    RigidTransform([0.0, 0.0, 0.1]), np.diag([1500.0] * 3 + [30.0] * 3), np.diag([100.0] * 3 + [2.0] * 3),
    np.array([9.0, 9.0, 15.0, 3.0, 3.0, 3.0]), np.zeros(7), 0.5, np.zeros(3), 1e-3 * np.eye(3),
)  # fmt: skip
IMPEDANCE_Z = 1500.0  # stiffness of the station's impedance along z [N/m]
DOMAINS = count(os.getpid() * 17)
DURATION = 1.2  # time for which a driver is read [s]


@pytest.fixture
def connect(monkeypatch, forkserver):
    """Return a function that starts a robot's process and opens a driver, in a domain of their own."""
    from ros2_robot import RobotProcess, use_loopback

    monkeypatch.setitem(os.environ, "CYCLONEDDS_URI", "")
    monkeypatch.setattr(ros2, "MAX_WRENCH_AGE", LIMITS.max_age)  # six periods of this robot, as for statuses
    use_loopback()
    robots, domain = [], 20 + next(DOMAINS) % 200  # another one in each test: killed processes stay known for a while

    def start(options="", **faults):
        address = f"{domain}?{options}"
        robots.append(RobotProcess(address, **faults))
        driver = Ros2Driver(address)
        driver.robot_process = robots[-1]
        return driver

    yield start
    for robot in robots:
        robot.kill()


def watch(driver, duration=DURATION, until=lambda fault: bool(fault)):
    """Read a driver as a station does; return the first fault for which `until` is true, and the number of statuses."""
    last, number, fault = LastStatus(np.nan, 0.0, np.zeros(21)), 0, Fault.NONE
    end = time.monotonic() + 30.0
    while driver.read() is None or not driver.read().is_readable:
        assert time.monotonic() < end
        time.sleep(0.01)
    end = time.monotonic() + duration
    while time.monotonic() < end:
        driver.receive(0.02)
        status, now = driver.read(), time.time()
        fault = check_status(status, last, now, LIMITS)
        if until(fault):
            return fault, number
        if status.is_readable and not status.time <= last.time:
            offset = now - status.time if np.isnan(last.time) else last.offset
            last, number = LastStatus(status.time, offset, status.values()), number + 1
    return fault, number


@needs_middleware
def test_driver_reads_joints_by_name_and_the_wrench_as_joint_torques(connect):
    driver = connect(reversed=True)
    driver.configure(IMPEDANCE)
    fault, number = watch(driver, 1.0)
    assert fault == Fault.NONE
    assert number > 5
    status = driver.read()
    np.testing.assert_allclose(status.positions, [0.0, 0.2, 0.0, -2.1, 0.0, 2.3, 0.0], atol=0.06)
    # Force along z of the base: no torque about the vertical first axis, and the power of a lift at the second.
    assert abs(status.external_torque[0]) < 1e-9
    assert abs(status.external_torque[1]) > 1.0


@needs_middleware
def test_loss_latency_and_reordering_are_no_fault(connect):
    driver = connect(loss=0.1, latency=0.04, jitter=0.9)
    fault, number = watch(driver)
    assert fault == Fault.NONE
    assert number > 10


@needs_middleware
def test_silence_of_the_robot_is_found(connect):
    assert watch(connect(silent_after=1.0), 10.0)[0] == Fault.STALE


@needs_middleware
def test_second_robot_and_second_commander_are_counted(connect):
    first = connect()
    first.configure(IMPEDANCE)
    watch(first, 0.5)
    second = connect()
    second.configure(IMPEDANCE)
    end = time.monotonic() + 30.0
    while not first.read().conflicts:
        assert time.monotonic() < end
        time.sleep(0.01)
    watch(second, 0.2, until=lambda fault: False)
    while not first.num_foreign_commands:
        assert time.monotonic() < end
        if second.read().is_readable:
            second.write_pose(RigidTransform([0.4, 0.0, 0.4]), 0.0)
        first.read()
        time.sleep(0.02)
    assert second.num_foreign_commands == 0


@needs_middleware
def test_target_arrives_with_a_bounded_force_after_the_controller_is_activated(connect):
    driver = connect("controller=cartesian_impedance&hold=joint_hold")
    driver.configure(IMPEDANCE)
    watch(driver, 0.5)
    assert any(check.name == "controller" and check.passed for check in driver.check_setup())
    actual = driver._calc_pose_at(driver.read().positions)
    driver.write_pose(RigidTransform(actual.rotation(), actual.translation() + [1.0, 0.0, 0.0]), 0.0)
    time.sleep(0.3)
    driver.stop()
    time.sleep(0.3)
    received = driver.robot_process.end()
    assert received["switched"] == [["cartesian_impedance"], ["joint_hold"]]
    assert received["targets"] >= 2
    assert np.linalg.norm(np.array(received["last"]) - actual.translation()) < 0.02


@needs_middleware
def test_driver_raises_when_the_controller_manager_refuses(connect):
    driver = connect("controller=cartesian_impedance", refuses=True)
    driver.configure(IMPEDANCE)
    watch(driver, 0.5)
    with pytest.raises(InputError, match="refuses to activate cartesian_impedance"):
        driver.write_pose(RigidTransform([0.4, 0.0, 0.4]), 0.0)


def test_target_is_bounded_in_the_direction_of_the_error():
    actual = RigidTransform(RotationMatrix.MakeXRotation(0.3), [0.4, 0.1, 0.3])
    desired = RigidTransform(RotationMatrix.MakeXRotation(0.5), [0.5, 0.1, 0.3])
    bounded = bounded_target(desired, actual, IMPEDANCE)
    moved = bounded.translation() - actual.translation()
    np.testing.assert_allclose(moved, [9.0 / 1500.0, 0.0, 0.0], atol=1e-12)
    assert bounded_target(actual, actual, IMPEDANCE).IsNearlyEqualTo(actual, 1e-15)


@pytest.mark.parametrize(
    ("address", "message"),
    [("lab", "begins with its domain"), ("0?topic=x", "no option 'topic'"), ("0?frame=world", "base or tool")],
)
def test_address_is_refused_when_a_part_is_invalid(address, message):
    with pytest.raises(InputError, match=message):
        Ros2Address.parse(address)


def test_address_names_topics_on_the_bus():
    address = Ros2Address.parse("7/left?target=/global/target&wrench=ft")
    assert (address.domain, address.topic(address.joints)) == (7, "rt/left/joint_states")
    assert (address.topic(address.target), address.topic(address.wrench)) == ("rt/global/target", "rt/left/ft")
    assert address.service("switch_controller")[0] == "rq/left/controller_manager/switch_controllerRequest"


@pytest.mark.parametrize("handle", [5, -5])
def test_own_target_is_not_foreign_whatever_the_sign_of_its_handle(handle):
    """The middleware gives the sender of a sample without a sign, the handle of a writer with one."""
    driver = object.__new__(Ros2Driver)
    infos = [SimpleNamespace(publication_handle=sender % 2**64) for sender in (handle, handle, 7)]
    taken = [SimpleNamespace(sample_info=info) for info in infos]
    target = SimpleNamespace(instance_handle=handle)
    driver._bus = SimpleNamespace(targets=None, target=target, take=lambda reader: taken)
    driver.num_foreign_commands = 0
    driver._count_foreign_commands()
    assert driver.num_foreign_commands == 1


POSITIONS = np.array([0.0, 0.2, 0.0, -2.1, 0.0, 2.3, 0.0])


class ListBus:
    """Bus of a driver in this process, with lists of messages in place of the middleware."""

    def __init__(self):
        from guiderail_hardware.drivers import ros2_messages

        self.messages, self.joints, self.wrench, self.targets, self.sent = ros2_messages, [], [], [], []
        self.target = SimpleNamespace(write=self.sent.append, instance_handle=1)

    def take(self, reader):
        taken, reader[:] = list(reader), []
        return taken

    def measure(self, stamp, positions=POSITIONS, sender=5, velocities=(0.0,) * 7, has_wrench=True):
        m, info = self.messages, SimpleNamespace(publication_handle=sender)
        header = m.Header(m.Time(int(stamp), round(1e9 * (stamp % 1.0))), "base")
        if has_wrench:
            self.wrench.append(m.WrenchStamped(header))
        names = [f"panda_joint{number + 1}" for number in range(len(positions))]
        message = m.JointState(header, names, list(positions), list(velocities), [])
        self.joints.append(SimpleNamespace(**vars(message), sample_info=info))


def position(target):
    p = target.pose.position
    return np.array([p.x, p.y, p.z])


@pytest.fixture
def commanded(monkeypatch):
    """Return a driver that has sent a target, its bus, a clock, and the tool's position."""
    now = [100.0]
    monkeypatch.setattr(ros2, "clock", SimpleNamespace(monotonic=lambda: now[0], time=lambda: now[0]))
    bus = ListBus()
    driver = Ros2Driver("0", bus=bus)
    driver.configure(IMPEDANCE)
    bus.measure(1)
    driver.read()
    driver.write_pose(RigidTransform([0.4, 0.0, 0.4]), 0.0)
    return driver, bus, now, position(bus.sent[0])


@needs_middleware
def test_driver_sends_no_target_beside_a_wrong_pose(commanded):
    driver, bus, now, start = commanded
    number, now[0] = len(bus.sent), now[0] + 0.005
    bus.measure(2, POSITIONS + 1.0)
    driver.read()
    driver.write_pose(RigidTransform([0.4, 0.0, 0.4]), 0.0)
    assert len(bus.sent) == number
    driver.stop()
    np.testing.assert_array_equal(position(bus.sent[-1]), start)


@needs_middleware
def test_stop_keeps_the_target_when_joint_states_are_old(commanded):
    driver, bus, now, _ = commanded
    number, now[0] = len(bus.sent), now[0] + 0.05
    driver.stop()
    assert len(bus.sent) == number


NAN = np.array([0.0, 0.0, np.nan, 0.0, 0.0, 0.0, 0.0])
# Changes of the second joint state, and the expected faults.
FAULTY = {
    "none": ({}, Fault.NONE),
    "future": ({"stamp": 11.1}, Fault.FUTURE),
    "past": ({"stamp": 0.5}, Fault.OUT_OF_ORDER),
    "NaN": ({"velocities": NAN}, Fault.NOT_FINITE),
    "jump": ({"positions": POSITIONS + 1.0}, Fault.POSITION_JUMP),
    "missing joint": ({"positions": POSITIONS[:6], "velocities": NAN[:6]}, Fault.MALFORMED),
    "missing wrench": ({"has_wrench": False}, Fault.MALFORMED),
}


@needs_middleware
@pytest.mark.parametrize("name", FAULTY)
def test_fault_of_a_joint_state_is_found(name, commanded):
    driver, bus, now, _ = commanded
    (changed, expected), first = FAULTY[name], driver.read()
    last = LastStatus(first.time, now[0] - first.time, first.values())
    now[0] += 0.11  # longer than the maximum age of a wrench
    bus.measure(**{"stamp": 1.1} | changed)
    assert check_status(driver.read(), last, now[0], LIMITS) == expected


@needs_middleware
@pytest.mark.parametrize(
    ("second", "conflicts"),
    [({"stamp": 2, "sender": 6}, 2), ({"stamp": 1, "positions": POSITIONS + 1e-6}, 1), ({"stamp": 1}, 0)],
    ids=["sender", "time", "repeated"],
)
def test_contradictory_joint_states_are_counted(second, conflicts, commanded):
    driver, bus, *_ = commanded
    bus.measure(**second)
    bus.measure(3)
    assert driver.read().conflicts == conflicts


class FollowingRobot:
    """Arm that follows targets without delay, over DDS in this process; a plane below the tool stops it."""

    def __init__(self, address, model, positions):
        self._bus = ros2.Ros2Bus(Ros2Address.parse(address), robot_side=True)
        self._model, self._context = model, model.plant.CreateDefaultContext()
        self.positions, self.time, self.plane, self.force, self.is_silent = positions, 1.0, -np.inf, 0.0, False
        self._velocities = np.zeros(7)

    def pose(self):
        self._model.plant.SetPositions(self._context, self.positions)
        return self._model.tool_center.CalcPoseInWorld(self._context)

    def advance(self, period):
        self.time += period
        targets = self._bus.take(self._bus.targets)
        before = self.positions
        if targets:
            p, q = targets[-1].pose.position, targets[-1].pose.orientation
            rotation = RotationMatrix(Quaternion([q.w, q.x, q.y, q.z]))
            target, X = RigidTransform(rotation, [p.x, p.y, p.z]), self.pose()
            error = pose_error(target, X)
            self.force = max(0.0, IMPEDANCE_Z * (self.plane - p.z)) if X.translation()[2] <= self.plane else 0.0
            if X.translation()[2] + 0.2 * error[5] < self.plane:
                error[5] = 5.0 * (self.plane - X.translation()[2])
            plant, world = self._model.plant, self._model.plant.world_frame()
            J = plant.CalcJacobianSpatialVelocity(
                self._context, JacobianWrtVariable.kV, self._model.tool_center, np.zeros(3), world, world
            )
            self.positions = before + np.linalg.pinv(J) @ (0.2 * error)
        self._velocities = (self.positions - before) / period
        if self.is_silent:
            return
        m = self._bus.messages
        header = m.Header(m.Time(int(self.time), round(1e9 * (self.time % 1.0))), "base")
        self._bus.wrench.write(m.WrenchStamped(header, m.Wrench(m.Vector3(0.0, 0.0, self.force))))
        names = [f"panda_joint{number}" for number in range(1, 8)]
        self._bus.joints.write(m.JointState(header, names, self.positions.tolist(), self._velocities.tolist(), []))


@needs_middleware
def test_station_presses_with_the_bounded_force_and_stops_when_the_robot_is_silent(monkeypatch):
    from ros2_robot import use_loopback

    monkeypatch.setitem(os.environ, "CYCLONEDDS_URI", "")
    monkeypatch.setattr(ros2, "MAX_WRENCH_AGE", 60.0)  # this robot has a clock of its own
    use_loopback()
    address = str(20 + next(DOMAINS) % 200)
    model = ArmControllerPlant(BncWorkcell(), "panda")
    impedance = Impedance().with_max_force(18.0)
    robot = FollowingRobot(address, model, model.solve(START, model.posture))
    driver = Ros2Driver(address)
    station = HardwareStation(BncWorkcell(), driver, impedance, robot="panda")
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    station.get_desired_pose_input_port().FixValue(context, START)
    end = time.monotonic() + 30.0
    while driver.read() is None or not driver.read().is_readable:
        assert time.monotonic() < end
        robot.advance(0.005)
        time.sleep(0.01)
    station.start(simulator)
    height = robot.pose().translation()[2]
    robot.plane = height - 0.003

    def advance(seconds):
        for _ in range(round(seconds / station.period)):
            robot.advance(station.period)
            last, patience = driver.num_statuses, time.monotonic() + (0.0 if robot.is_silent else 2.0)
            while driver.num_statuses == last:
                station.receive(context)
                if time.monotonic() >= patience:
                    break
            simulator.AdvanceTo(context.get_time() + station.period)

    def state():
        return ArmState(int(station.get_arm_state_output_port().Eval(context)[0]))

    advance(0.8)
    reason = Fault(int(station.get_fault_output_port().Eval(context)[0])).description
    assert state() == ArmState.RUNNING, reason
    assert abs(robot.pose().translation()[2] - height) < 1e-3
    station.get_desired_pose_input_port().FixValue(context, START - [0.0, 0.0, 0.05, 0.0, 0.0, 0.0])
    advance(0.6)
    assert state() == ArmState.RUNNING, Fault(int(station.get_fault_output_port().Eval(context)[0])).description
    assert 0.5 * impedance.limits[2] < robot.force <= 1.01 * impedance.limits[2]
    robot.is_silent = True
    advance(0.1)
    assert state() == ArmState.DAMPING
    assert int(station.get_fault_output_port().Eval(context)[0]) == Fault.STALE
