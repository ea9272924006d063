"""Scenario files: robot, bus and surroundings of a connection."""

from pathlib import Path

import pytest
from pydrake.lcm import DrakeLcm

from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail.tools.cli.main import main
from guiderail_hardware.drivers.lcm_simulated import SimulatedIiwa
from guiderail_hardware.robot.connection import RobotConnection
from guiderail_hardware.robot.scenario import load_scenario

SHIPPED = Path(__file__).parents[4] / "examples" / "connector.scenario.yaml"
DRIVER_WITH = "model_drivers: {iiwa14: !IiwaDriver {control_mode: torque_only, lcm_bus: bus, %s}}\n"
DRIVER = "model_drivers: {iiwa14: !IiwaDriver {control_mode: torque_only, lcm_bus: bus}}\n"
BUS = "lcm_buses: {bus: {lcm_url: 'udpm://239.255.76.67:7668?ttl=0'}}\n"


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a scenario file and returns its path."""

    def write(text):
        path = tmp_path / "scenario.yaml"
        path.write_text(text)
        return path

    return write


def test_scenario_selects_simulated_or_real_robot(write):
    simulated, real = (
        RobotConnection.from_scenario(write(f"station: {word}\n{BUS}{DRIVER}")) for word in ("simulation", "hardware")
    )
    assert (simulated.sim, real.sim) == (True, False)
    assert (simulated.robot, real.robot) == ("iiwa14", "iiwa14")
    assert real.environment_options("hardware")["robot_url"] == "udpm://239.255.76.67:7668?ttl=0"
    # A real robot's driver must not receive the messages of a simulated driver.
    assert simulated.environment_options("hardware")["robot_url"] != real.environment_options("hardware")["robot_url"]
    with pytest.raises(InputError, match="a bus of its own"):
        RobotConnection(sim=True, robot_url="udpm://239.255.76.67:7667")
    assert RobotConnection.from_scenario(None, robot="panda").robot == "panda"
    panda = write("station: hardware\nmodel_drivers: {panda: !PandaDriver {}}\n")
    assert RobotConnection.from_scenario(panda).robot == "panda"


def test_shipped_scenario_has_a_simulated_driver():
    assert RobotConnection.from_scenario(SHIPPED).sim


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("station: both\n", "hardware or simulation"),
        (SHIPPED.read_text() + "station: hardware\n", 'line 1[0-9]: duplicate key "station"'),
        ("model_drivers: {iiwa14: !PandaDriver {}}\n", "the driver of iiwa14 has the tag !IiwaDriver, not"),
        ("{}\n", "exactly one robot"),
        ("model_drivers: {iiwa14: !IiwaDriver {control_mode: position_only}}\n", "must accept them"),
        (DRIVER, "does not define"),
        ("directives: 3\n", "is no scenario"),
        ("{{", "is not text: put it in quotes"),
        ("[" * 5000, "inside each other"),
        ("station: [\n", "is not YAML"),
        ("station: !python/object:os.system x\n", "the tag"),
        (BUS.replace("ttl=0", "ttl=32") + DRIVER, "leave the local network"),
        (BUS.replace("udpm://239.255.76.67:7668?ttl=0", "tcpq://192.0.2.1:7700") + DRIVER, "leave the local network"),
        (BUS.replace("udpm://239.255.76.67:7668?ttl=0", "udpm://[abc") + DRIVER, "is no address"),
        ("", "no scenario: it must be a mapping with model_drivers"),
        ("model_drivers: null\n", "model_drivers must be a mapping, not 'null'"),
        ("lcm_buses: [1]\n", "lcm_buses must be a mapping, not a sequence"),
        ("model_drivers: {iiwa14: null}\n", "iiwa14 of model_drivers must be a mapping, not 'null'"),
        ("lcm_buses: {default: null}\n", "default of lcm_buses must be a mapping, not 'null'"),
        ("directives: [{}, [1]]\n", "1 of directives must be a mapping, not a sequence"),
        ("nonsense: 1\n", "nonsense"),
        (BUS.replace("'}}", "', channel_suffix: _LEFT}}") + DRIVER, "channel_suffix is '_LEFT'"),
        (BUS + DRIVER_WITH % "lcm_status_period: 0.001", "lcm_status_period is 0.001"),
        (BUS + DRIVER_WITH % "desired_kp_gains: [1, 2]", "desired_kp_gains"),
    ],
)
def test_load_scenario_raises_one_sentence_when_invalid(write, text, message):
    with pytest.raises(InputError, match=message) as caught:
        load_scenario(write(text))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [({"robot": "panda"}, "--robot panda"), ({"robot_url": "udpm://239.255.76.67:7777?ttl=0"}, "--robot-url udpm")],
)
def test_connection_raises_when_options_contradict_the_file(write, options, message):
    file = write(f"station: hardware\n{BUS}{DRIVER}")
    with pytest.raises(InputError, match=message):
        RobotConnection.from_scenario(file, **options)
    same = RobotConnection.from_scenario(file, robot="iiwa14", robot_url="udpm://239.255.76.67:7668?ttl=0")
    assert same == RobotConnection.from_scenario(file)


def test_deploy_refuses_a_robot_that_contradicts_the_scenario(write, capsys):
    file = write("station: hardware\nmodel_drivers: {panda: !PandaDriver {}}\n")
    for options, message in (([], "not a run"), (["--robot", "iiwa14"], "--robot iiwa14")):
        with pytest.raises(SystemExit) as end:
            main(["deploy", str(file.parent), "--scenario", str(file), *options])
        assert end.value.code == 2
        assert message in capsys.readouterr().err


def test_directives_add_models_to_the_simulated_robot(write, tmp_path):
    box = tmp_path / "box.sdf"
    box.write_text(
        "<sdf version='1.9'><model name='box'><link name='box'><collision name='c'><geometry><box><size>1 1 1</size>"
        "</box></geometry></collision></link></model></sdf>"
    )
    directives = f"""
directives:
- add_model: {{name: box, file: 'file://{box}'}}
- add_weld: {{parent: world, child: 'box::box'}}
"""
    scenario = load_scenario(write(BUS + DRIVER + directives))
    robot = SimulatedIiwa(BncWorkcell(), DrakeLcm("memq://"), directives=scenario.directives)
    assert robot.plant.HasModelInstanceNamed("box")
    missing = load_scenario(
        write(BUS + DRIVER + "directives: [{add_model: {name: box, file: 'file:///nowhere.sdf'}}]\n")
    )
    remote = load_scenario(
        write(BUS + DRIVER + "directives: [{add_model: {name: box, file: 'package://drake_models/box.sdf'}}]\n")
    )
    with pytest.raises(InputError, match="unknown package"):
        SimulatedIiwa(BncWorkcell(), DrakeLcm("memq://"), directives=remote.directives)
    with pytest.raises(InputError, match="can't be processed"):
        SimulatedIiwa(BncWorkcell(), DrakeLcm("memq://"), directives=missing.directives)
