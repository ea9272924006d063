"""Drivers: a user's driver with only `read` and `write`, registration, and refused drivers and robots."""

import re
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from direct_driver import START, DirectDriver, start_station
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.stations.arm import ArmControllerPlant
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail.models.robots.robot import find_robot
from guiderail_hardware.drivers.clock import WallClock
from guiderail_hardware.drivers.driver import DRIVERS, PoseDriver, find_driver, register_driver, safety_limits
from guiderail_hardware.drivers.fci import FciDriver
from guiderail_hardware.drivers.lcm import IiwaDriver, PandaDriver
from guiderail_hardware.drivers.rtde import RtdeDriver
from guiderail_hardware.monitor import SafetyMonitor
from guiderail_hardware.station import HardwareStation
from guiderail_hardware.systems.torque_safety_limiter import ArmState


@pytest.fixture
def registered():
    register_driver("direct_arm", DirectDriver)
    yield
    DRIVERS._entries.pop("direct_arm")


def test_station_moves_a_robot_with_only_read_and_write():
    driver = DirectDriver()
    station = HardwareStation(BncWorkcell(), driver)
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    goal = START + [0.01, 0.0, 0.0, 0.0, 0.0, 0.0]
    station.get_desired_pose_input_port().FixValue(context, START)
    station.start(simulator)
    for step in range(1, 600):
        driver.elapse()
        simulator.AdvancePendingEvents()
        station.receive(context)
        simulator.AdvanceTo(step * driver.period)
        if step == 200:
            assert station.get_arm_state_output_port().Eval(context)[0] == ArmState.RUNNING
            station.get_desired_pose_input_port().FixValue(context, goal)
    np.testing.assert_allclose(station.get_pose_output_port().Eval(context)[:3], goal[:3], atol=5e-4)
    assert (np.abs(driver.torques) <= station.limits.torque).all()


def test_wall_clock_steps_once_per_new_status():
    driver = DirectDriver()
    (station, simulator), clock = start_station(driver), WallClock(driver)
    clock.begin()
    driver.elapse()
    num_statuses = driver.num_statuses
    clock.advance(simulator, station, 3)
    assert driver.num_statuses == num_statuses + 1
    assert simulator.get_context().get_time() == 3 * driver.period


def test_driver_is_found_by_name_when_registered(registered):
    assert find_driver("direct_arm") is DirectDriver
    plant = ArmControllerPlant(BncWorkcell()).plant
    assert (np.array(safety_limits(plant, DirectDriver).torque) <= 0.9 * 60.0).all()


@pytest.mark.parametrize(
    ("attribute", "value", "message"),
    [
        ("name", None, "the driver Incomplete needs a text as its name"),
        ("name", "", "needs a text as its name"),
        ("torque_reflex_limits", None, "needs a positive number of each joint .* as its torque_reflex_limits"),
        ("torque_reflex_limits", (), "as its torque_reflex_limits"),
        ("torque_reflex_limits", (np.nan,) * 7, "as its torque_reflex_limits"),
        ("torque_reflex_limits", (-1.0,) * 7, "as its torque_reflex_limits"),
        ("torque_reflex_limits", 60.0, "as its torque_reflex_limits"),
        ("has_command_timeout", None, "needs True or False as its has_command_timeout"),
        ("period", 0.0, "needs a positive time .* as its period"),
        ("hold_off", np.nan, "needs a time that is not negative .* as its hold_off"),
    ],
)
def test_driver_is_refused_when_an_attribute_is_invalid(attribute, value, message):
    class Incomplete(DirectDriver):
        pass

    setattr(Incomplete, attribute, value)
    with pytest.raises(InputError, match=message):
        HardwareStation(BncWorkcell(), Incomplete())


def test_driver_is_refused_when_super_init_is_not_called():
    class Incomplete(DirectDriver):
        def __init__(self, url=""):
            pass

    with pytest.raises(InputError, match=r"Incomplete must call super\(\).__init__\(url\) in its constructor"):
        HardwareStation(BncWorkcell(), Incomplete())


@pytest.mark.parametrize(
    ("driver", "module", "extra"), [(FciDriver, "franky", "fci"), (RtdeDriver, "rtde_control", "rtde")]
)
def test_driver_needs_a_host_and_its_client(driver, module, extra, monkeypatch):
    with pytest.raises(InputError, match="--robot-url"):
        driver()
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=rf"guiderail\[{extra}\]"):
        driver("192.0.2.1")


def raise_no_port(url):
    raise OSError("no such port")


@pytest.mark.parametrize(
    ("factory", "message"),
    [
        (raise_no_port, "the driver refused can't be opened: OSError: no such port"),
        (lambda: None, "the driver refused can't be opened: TypeError"),
        (lambda url: url, "the driver refused is no Driver"),
    ],
)
def test_driver_is_refused_when_opening_fails(monkeypatch, factory, message):
    monkeypatch.setitem(DRIVERS._entries, "refused", factory)
    with pytest.raises(InputError, match=message):
        HardwareStation(BncWorkcell(), "refused", robot_url="")


def test_register_driver_raises_when_the_driver_is_a_number():
    with pytest.raises(InputError, match="'number' is registered with a subclass of Driver, not with 3"):
        register_driver("number", 3)


USER_MODEL = replace(find_robot("iiwa14"), name="mine", flange_frame="iiwa_link_7")  # a user's model of the same arm


@pytest.mark.parametrize(
    ("driver", "robot", "message"),
    [
        (IiwaDriver, "ur5e", "robot='ur5e' has 6 joints, and IiwaDriver moves an arm of 7"),
        (RtdeDriver, "panda", "robot='panda' has 7 joints, and RtdeDriver moves an arm of 6"),
        (PandaDriver, "iiwa14", "robot='iiwa14' has other joints, .* than 'panda', the arm of PandaDriver"),
        (FciDriver, "iiwa14", "robot='iiwa14' has other joints, .* than 'panda', the arm of FciDriver"),
        (FciDriver, replace(find_robot("panda"), flange_frame="panda_link7"), "another flange"),
        (FciDriver, replace(find_robot("panda"), name="mine"), None),
        (IiwaDriver, USER_MODEL, None),
    ],
)
def test_robot_is_refused_when_the_driver_moves_another_arm(driver, robot, message):
    connection = {"client": object()} if issubclass(driver, PoseDriver) else {}
    driver = driver("192.0.2.1" if connection else "memq://", **connection)
    if message is None:
        HardwareStation(BncWorkcell(), driver, robot=robot)
    else:
        with pytest.raises(InputError, match=message):
            HardwareStation(BncWorkcell(), driver, robot=robot)


def test_safety_monitor_raises_when_commands_are_not_readable():
    driver = DirectDriver()
    plant = driver.model.plant
    with pytest.raises(InputError, match="cannot be watched"):
        SafetyMonitor(driver, plant, safety_limits(plant, driver))


def test_every_driver_of_the_package_is_an_entry_point():
    package = Path(__file__).parents[2]
    points = tomllib.loads((package / "pyproject.toml").read_text())["project"]["entry-points"]["guiderail"]
    declared = {name.removeprefix("driver:") for name in points if name.startswith("driver:")}
    sources = (path.read_text() for path in (package / "src/guiderail_hardware/drivers").glob("*.py"))
    registered = {
        name for source in sources for name in re.findall(r'^@register_driver\("(\w+)"\)', source, re.MULTILINE)
    }
    assert declared == registered
    for name, place in points.items():
        if name.startswith("driver:"):
            module, _, attribute = place.partition(":")
            assert f"class {attribute}(" in (package / "src" / f"{module.replace('.', '/')}.py").read_text()
