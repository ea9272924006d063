"""Process behind LeRobot's simulated robot, tested with a double of LeRobot's interface.

`make lerobot` tests the robot with the real library.
"""

import importlib.util
import signal
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

FILE = Path(__file__).parents[2] / "src/lerobot_robot_guiderail/robot.py"


@pytest.fixture
def module(monkeypatch):
    """Return the robot module, imported with a double of `lerobot.robots`."""
    robots = ModuleType("lerobot.robots")
    robots.Robot = type("Robot", (), {"__init__": lambda self, config: None})
    robots.RobotConfig = type("RobotConfig", (), {"register_subclass": staticmethod(lambda name: lambda kind: kind)})
    monkeypatch.setitem(sys.modules, "lerobot", ModuleType("lerobot"))
    monkeypatch.setitem(sys.modules, "lerobot.robots", robots)
    spec = importlib.util.spec_from_file_location("guiderail_lerobot_robot", FILE)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    return module


def start(module, script, tmp_path):
    """Return a robot whose process is running; its interpreter is a shell script."""
    interpreter = tmp_path / "python"
    interpreter.write_text(f"#!/bin/sh\n{script}\n")
    interpreter.chmod(0o755)
    config = SimpleNamespace(python=str(interpreter), environment="NarrowPassage", options={}, seed=0)
    robot = module.GuiderailRobot(config)
    robot._start()
    return robot


def test_process_is_killed_when_it_does_not_end_in_time(module, monkeypatch, tmp_path):
    monkeypatch.setattr(module, "STOP_TIME", 0.1)
    robot = start(module, "exec sleep 20", tmp_path)
    process = robot._process
    robot.disconnect()
    assert process.returncode == -signal.SIGKILL
    assert not robot.is_connected


def test_process_is_not_killed_when_it_ends_with_its_input(module, tmp_path):
    robot = start(module, "cat > /dev/null", tmp_path)
    process = robot._process
    robot.disconnect()
    assert process.returncode == 0


def test_pipes_of_an_ended_process_are_closed_at_the_next_start(module, tmp_path):
    robot = start(module, "exit 3", tmp_path)
    ended = robot._process
    ended.wait()
    robot._start()
    assert ended.stdin.closed
    assert ended.stdout.closed
    robot._stop()
