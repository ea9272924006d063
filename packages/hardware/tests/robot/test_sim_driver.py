"""Simulated driver and safety monitor: refused arguments, and offsets of the parts."""

from functools import partial
from importlib.util import find_spec

import numpy as np
import pytest
from pydrake.lcm import DrakeLcm

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.options import validate_options
from guiderail.models.common.errors import InputError
from guiderail_hardware.drivers.lcm import IiwaDriver
from guiderail_hardware.drivers.lcm_simulated import SimulatedIiwa
from guiderail_hardware.robot.sim_driver import (
    PartRandomizer,
    publish_part_offsets,
    run_safety_monitor,
    run_sim_driver,
    subscribe_part_offsets,
)

SEED = 30


@pytest.mark.parametrize("value", [-0.1, float("nan"), float("inf")])
def test_driver_raises_when_the_joint_friction_is_invalid(value):
    with pytest.raises(InputError, match="joint_friction must be at least 0"):
        run_sim_driver("", 1.0, 1.0, driver="fci", joint_friction=value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seconds": 0.0}, "^--seconds must be a positive number, not 0$"),
        ({"command_timeout": -1.0}, "^--command-timeout must be a positive number, not -1$"),
        ({"joint_friction": 0.1}, "leave joint_friction=0.1 out"),
        (
            {"scenario": "model_drivers: {panda: !PandaDriver {}}"},
            "has the robot 'panda': name a scenario of .* iiwa14",
        ),
    ],
)
def test_driver_raises_when_an_argument_is_invalid_for_an_iiwa(arguments, message, tmp_path):
    if "scenario" in arguments:
        (tmp_path / "a.yaml").write_text(arguments["scenario"])
        arguments = {"scenario": tmp_path / "a.yaml"}
    with pytest.raises(InputError, match=message):
        run_sim_driver(**{"url": "memq://", "seconds": 0.01, "command_timeout": 0.1} | arguments)


@pytest.mark.skipif(find_spec("franky_sim") is not None, reason="the simulator is installed")
def test_driver_names_the_package_of_the_franka_simulator():
    with pytest.raises(InputError, match=r"the simulated Franka needs .*: pip install"):
        run_sim_driver("", 1.0, 1.0, driver="fci")


def test_monitor_names_the_supported_robots_when_unknown():
    with pytest.raises(InputError, match=r"watches no robot 'nope': choose one of iiwa14, panda$"):
        run_safety_monitor("", "nope", "BncConnector")


def test_part_offsets_equal_the_simulation_for_the_same_seed():
    task = EnvConfig.resolve("BncConnector", {"fixture_offset": "per_run"}).declared
    lcm = DrakeLcm("memq://")
    robot = SimulatedIiwa(task.workcell(), lcm)
    context = robot.CreateDefaultContext()
    subscribe_part_offsets(lcm, task, robot, context)
    randomize = PartRandomizer(task, partial(publish_part_offsets, IiwaDriver(lcm)), SEED)
    rng = np.random.default_rng(7)
    simulated = EnvConfig.resolve("BncConnector", {"fixture_offset": "per_run"}).declared
    run = {}
    simulated.offsets.draw(np.random.default_rng(SEED), validate_options(simulated.Reset, {}, "a reset"), run)
    simulation_rng, jack_positions = np.random.default_rng(7), []
    plant = robot.plant
    plant_context = plant.GetMyContextFromRoot(context)
    for options in ({}, {"held_out": True}):
        offsets = randomize(rng, options)
        lcm.HandleSubscriptions(0)
        expected = simulated.offsets.draw(simulation_rng, validate_options(simulated.Reset, options, "a reset"), run)
        np.testing.assert_array_equal(offsets["jack_offset"], expected[0])
        np.testing.assert_array_equal(offsets["grasp_offset"], expected[1])
        jack_positions.append(plant.GetBodyByName("jack").EvalPoseInWorld(plant_context).translation())
        nominal = plant.GetBodyByName("jack").EvalPoseInWorld(plant.CreateDefaultContext()).translation()
        np.testing.assert_allclose((jack_positions[-1] - nominal)[:2], expected[0], atol=1e-12)
    np.testing.assert_array_equal(*jack_positions)  # the fixture offset is constant in a run
