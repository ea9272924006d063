"""Connection to a simulated driver: options, addresses, imported modules, and the end of its process."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from ipaddress import ip_address
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.primitives import ConstantVectorSource

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.diagrams.tasks.registry import TASKS, environment_id
from guiderail.models.common.errors import InputError
from guiderail.tools.cli.main import main
from guiderail_hardware.drivers.clock import WallClock
from guiderail_hardware.drivers.lcm import IiwaDriver
from guiderail_hardware.robot.connection import (
    SIMULATED,
    DriverEndedError,
    RobotConnection,
    _loopback_address,
    subprocess_tied_to_parent,
    watch_process,
)
from guiderail_hardware.robot.executor import recordings_folder
from guiderail_hardware.robot.preflight import start_simulator
from guiderail_hardware.station import HardwareStation

USER_MODULE = """
from guiderail.diagrams.tasks.bnc_connector import BncConnector
from guiderail.diagrams.tasks.registry import register_task


@register_task("user/Connector")
class UserConnector(BncConnector):
    pass
"""


def test_sim_driver_and_monitor_import_the_modules_of_the_run(tmp_path, monkeypatch):
    file, codes, tasks = tmp_path / "user_module.py", [], []
    TASKS.get("BncConnector")  # registers the package's tasks before their entries are copied below
    file.write_text(USER_MODULE)

    @contextmanager
    def subprocess_tied_to_parent(code):
        codes.append(code)
        yield

    def run_sim_driver(url, seconds, command_timeout, task, **options):
        tasks.append(type(EnvConfig.resolve(task, {}).declared).__name__)
        return True

    def run_safety_monitor(url, robot, task, rate, log):
        run_sim_driver(url, 0.0, 0.0, task)

    monkeypatch.setattr("guiderail_hardware.robot.connection.subprocess_tied_to_parent", subprocess_tied_to_parent)
    monkeypatch.setattr("guiderail_hardware.robot.sim_driver.run_sim_driver", run_sim_driver)
    monkeypatch.setattr("guiderail_hardware.robot.sim_driver.run_safety_monitor", run_safety_monitor)
    with RobotConnection(sim=True).simulated_driver("user/Connector", "memq://", [str(file)]):
        pass
    try:
        for command in (["sim-driver"], ["safety-monitor"], None):
            monkeypatch.setattr(TASKS, "_entries", {**TASKS._entries})
            monkeypatch.setattr("guiderail.tools.imports._IMPORTED_FILES", {})
            TASKS._entries.pop("user/Connector", None)  # the module is not imported yet, as in a new process
            if command is None:
                exec(codes[0], {})
                continue
            with pytest.raises(SystemExit) as end:
                main([*command, "--task", "user/Connector", "--import", str(file)])
            assert end.value.code == 0
    finally:
        gymnasium.registry.pop(environment_id("user/Connector"), None)
        TASKS._entries.pop("user/Connector", None)
    assert tasks == ["UserConnector"] * 3


def test_driver_selects_robot_and_lockstep():
    assert RobotConnection(sim=True, robot="panda", driver="fci").synchronous
    expected = {"fci": "panda", "rtde": "ur5e", "iiwa14": "iiwa14", "": "iiwa14"}
    assert {driver: RobotConnection(driver=driver, robot_url="192.0.2.1").robot for driver in expected} == expected
    assert not RobotConnection(robot="panda", driver="fci", robot_url="192.0.2.1").synchronous
    assert not RobotConnection(sim=True).synchronous


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"synchronous": True}, "does not wait"),
        ({"sim": True, "robot": "panda"}, "have a simulated robot"),
        ({"sim": True, "robot": "pnda"}, "did you mean panda"),
        ({"rate": 0.0}, "from 0.001 to 1, not 0.0"),
        ({"rate": 1e-9, "sim": True}, "from 0.001 to 1, not 1e-09"),
        ({"rate": 0.5}, "--rate is for a simulated driver, --sim"),
        ({"rate": 0.5, "sim": True, "synchronous": True}, "leave --rate out"),
        ({"rate": 0.5, "sim": True, "driver": "fci"}, "leave --rate out"),
        (
            {"sim": True, "driver": "fci", "scenario": Path("connector.scenario.yaml")},
            "has only the task's surroundings",
        ),
        (
            {"sim": True, "driver": "fci", "joint_friction": -0.1},
            "joint_friction must be at least 0 and finite, not -0.1",
        ),
        ({"sim": True, "joint_friction": "0.1"}, "joint_friction must be at least 0 and finite, not '0.1'"),
        ({"sim": True, "rate": "0.2"}, "the rate .* is from 0.001 to 1, not '0.2'"),
    ],
)
def test_connection_raises_when_options_are_invalid(options, message):
    with pytest.raises(InputError, match=message):
        RobotConnection(**options)


@pytest.mark.parametrize(("run", "folder"), [("runs/peg", "runs/peg/hardware"), ("pretrained:clamp", "clamp/hardware")])
def test_recordings_are_in_a_folder_of_the_run(run, folder):
    assert recordings_folder(Path(run)) == Path(folder)


def test_simulated_driver_has_an_address_of_its_protocol():
    urls = [RobotConnection(sim=True, driver=name).environment_options("hardware")["robot_url"] for name in SIMULATED]
    assert [url.partition(":")[0] for url in urls] == ["udpm", _loopback_address(os.getpid())]


def test_clock_raises_when_the_simulated_driver_has_ended():
    clock = WallClock(IiwaDriver("memq://"))
    with subprocess_tied_to_parent("raise SystemExit(3)") as process:
        watch_process(clock, process)
        process.wait()
        with pytest.raises(DriverEndedError, match=r"the simulated driver has ended .exit code 3.: start again"):
            clock.advance(Simulator(ConstantVectorSource([0.0])), SimpleNamespace(), 1)


def test_start_raises_when_the_driver_ends_before_a_status():
    station = HardwareStation(BncWorkcell(), IiwaDriver("memq://"), robot_timeout=60.0)
    clock, start = WallClock(station.driver), time.monotonic()
    with subprocess_tied_to_parent("raise SystemExit(3)") as process:
        watch_process(clock, process)
        with pytest.raises(DriverEndedError, match="exit code 3"):
            start_simulator(station, clock, None)
    assert time.monotonic() - start < 30.0


def test_invalid_scenario_is_refused_before_the_driver_starts(tmp_path, monkeypatch):
    monkeypatch.setattr("guiderail_hardware.robot.connection.subprocess_tied_to_parent", None)
    file = tmp_path / "a.yaml"
    text = "model_drivers: {iiwa14: !IiwaDriver {control_mode: torque_only}}\n"
    file.write_text(text + "directives: [{add_model: {name: box, file: 'package://nope/box.sdf'}}]\n")
    connection = RobotConnection.from_scenario(file)
    with pytest.raises(InputError, match="unknown package 'nope'"), connection.simulated_driver("BncConnector", ""):
        pass


def test_loopback_addresses_of_processes_differ():
    pids = [*range(1, 2000), 2**22 - 255, 2**22 - 1, 2**22]  # Linux's largest process number is 2**22
    addresses = {_loopback_address(pid) for pid in pids}
    assert len(addresses) == len(pids)
    assert all(ip_address(address).is_loopback for address in addresses)


SIMULATED_DRIVER = """
from guiderail_hardware.robot.connection import RobotConnection

with RobotConnection(sim=True, synchronous=True).simulated_driver("BncConnector", "memq://"):
    print("started", flush=True)
    input()
"""


def test_simulated_driver_exits_when_the_parent_is_killed():
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with subprocess.Popen([sys.executable, "-c", SIMULATED_DRIVER], **pipes) as parent:
        assert parent.stdout.readline() == b"started\n"
        parent.kill()
        # Parent and child have the same standard output, which is closed when both have ended.
        assert parent.communicate(timeout=50)[0] == b""


def start_child(connection):
    """Start a child whose standard output is a connection, and wait."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell ignores it in background jobs
    os.dup2(connection.fileno(), 1)
    with subprocess_tied_to_parent("import time; time.sleep(60)"):
        connection.send("started")
        time.sleep(60)


@pytest.mark.parametrize("end_signal", [signal.SIGTERM, signal.SIGINT])
def test_child_exits_when_the_parent_ends(end_signal, forkserver):
    context = multiprocessing.get_context("forkserver")
    connection, child_end = context.Pipe()
    parent = context.Process(target=start_child, args=(child_end,), daemon=True)
    parent.start()
    child_end.close()
    assert connection.recv() == "started"
    os.kill(parent.pid, end_signal)
    assert connection.poll(50)
    with pytest.raises((EOFError, ConnectionResetError)):  # parent and child have closed the connection
        connection.recv()


def test_child_is_ended_and_its_pipe_closed_after_the_block():
    with subprocess_tied_to_parent("import time; time.sleep(60)") as process:
        assert process.poll() is None
    assert process.poll() is not None
    assert process.stdin.closed
