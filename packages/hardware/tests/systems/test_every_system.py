"""Rules of `oracles.systems` for the systems of robots."""

import re
from pathlib import Path
from types import SimpleNamespace

import pytest
from pydrake.math import RigidTransform

from guiderail.diagrams.stations.arm import ArmControllerPlant, controller_model
from guiderail.diagrams.stations.station import Impedance
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail_hardware import systems
from guiderail_hardware.models.joint_status import StatusLimits
from guiderail_hardware.station import make_robot_impedance
from oracles.franka import FRANKA_LIMITS
from oracles.systems import RULES, check_source, system_names

FOLDER = Path(systems.__file__).parent
FILES = sorted(path for path in FOLDER.glob("*.py") if path.stem != "__init__")
NAMES = [name for path in FILES for name in system_names(path)]
PERIOD = 0.125


@pytest.fixture(scope="module")
def system_by_name():
    """Return one instance of each system by name, with all optional ports."""
    plant, _ = controller_model(BncWorkcell())
    model = ArmControllerPlant(BncWorkcell(), "panda")
    safety = systems.SafetyLimits((1.0,) * 7, (1.0,) * 7, (1.0,) * 7, decay_time=1.0)
    gamepad = SimpleNamespace(index=None, axes=[])
    browser = SimpleNamespace(
        AddSlider=lambda *arguments: None, GetGamepad=lambda: gamepad, GetSliderValue=lambda name: 0.5
    )
    instances = [
        systems.HeartbeatMonitor(period=PERIOD, timeout=0.5),
        systems.PoseMotionLimiter(FRANKA_LIMITS, period=PERIOD),
        systems.PosePublisher(lambda pose, time: None, lambda: None, RigidTransform(), period=PERIOD),
        systems.PoseRateLimiter(period=PERIOD),
        systems.MeshcatDevice(browser, [(0, 1.0)], [("KeyA", "KeyD")], PERIOD),
        systems.SpringReference(model, make_robot_impedance(model, Impedance())),
        systems.StatusWatchdog(plant, StatusLimits((1.0,) * 7), (1.0,) * 7, period=PERIOD),
        systems.TorqueSafetyLimiter(plant, safety, period=PERIOD),
        systems.TorquePublisher(lambda torque, time: None, 7, period=PERIOD, hold=lambda: None),
    ]
    return {type(instance).__name__: instance for instance in instances}


def test_these_tests_cover_every_system(system_by_name):
    assert sorted(system_by_name) == sorted(NAMES)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_file_has_one_exported_and_tested_system(path):
    (name,) = system_names(path)
    assert re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower() == path.stem
    assert getattr(systems, name).__name__ == name
    assert (Path(__file__).parent / f"test_{path.stem}.py").is_file()
    check_source(path)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
@pytest.mark.parametrize("name", NAMES)
def test_system_satisfies_the_rules(rule, name, system_by_name):
    rule(system_by_name[name])
