"""Disturbances of a simulated station: defaults, effects and invalid values."""

from dataclasses import replace

import numpy as np
import pytest

from guiderail import InputError, make_env
from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.stations.disturbances import Disturbances, DisturbedStation, disturbed
from guiderail.diagrams.stations.station import CONTROL_PERIOD, PLANT_PERIOD, Impedance
from guiderail.models.common.transforms import MM

DOWN = np.array([0.0, 0.0, -1.0])
CLAMP = {"fixture_offset": "none", "action_repeat": 25}  # without a random fixture offset


def descend(num_actions=3, seed=1, **options):
    """Push the clamp onto the table next to its holes; return environment, observations and the reset's info."""
    env = make_env("GridClamp", **CLAMP, **options)
    observation, info = env.reset(seed=seed, options={"offset": (1.5 * MM, 1.5 * MM)})
    observations = [observation]
    for _ in range(num_actions):
        observation, _, terminated, truncated, _ = env.step(DOWN)
        observations.append(observation)
        if terminated or truncated:
            break
    return env, np.array(observations), info


@pytest.fixture(scope="module")
def undisturbed():
    return descend()


def test_station_is_undisturbed_by_default(undisturbed):
    env, _, info = undisturbed
    assert not isinstance(env.diagram.diagram.GetSubsystemByName("station"), DisturbedStation)
    assert "friction_factor" not in info
    assert not EnvConfig.resolve("GridClamp", {}).parts["disturbances"].is_active
    assert not Disturbances.model_validate({}).is_active


def test_disturbances_depend_on_the_seed(undisturbed):
    errors = {"wrench_scale": (0.5, 2.0), "wrench_bias": (1.0, 0.02), "wrench_noise": (0.2, 0.01), "pose_bias": 1e-3}
    _, first, info = descend(sensing=errors)
    _, second, _ = descend(sensing=errors)
    np.testing.assert_array_equal(second, first)
    _, other_seed, other_info = descend(seed=2, sensing=errors)
    assert not np.array_equal(other_seed, first)
    assert 0.5 <= info["wrench_scale"] <= 2.0
    assert np.abs(info["wrench_bias"][:3]).max() <= 1.0
    assert info["wrench_scale"] != other_info["wrench_scale"]
    assert not np.array_equal(first, undisturbed[1])


def test_contact_factors_are_applied_at_every_reset():
    env, _, info = descend(1, disturbances={"friction_factor": (0.5, 0.5), "modulus_factor": (0.1, 0.1)})
    assert info["friction_factor"] == pytest.approx(0.5)

    def surfaces():
        """Return the proximity properties of the surfaces of clamp and table by name."""
        station = env.diagram.diagram.GetSubsystemByName("station")
        query = station.scene_graph.get_query_output_port().Eval(
            station.scene_graph.GetMyContextFromRoot(env.simulator.get_context())
        )
        inspector, result = query.inspector(), {}
        for body in ("clamp", "table"):
            for geometry in station.plant.GetCollisionGeometriesForBody(station.plant.GetBodyByName(body)):
                result[inspector.GetName(geometry).split("::")[-1]] = inspector.GetProximityProperties(geometry)
        return result

    pad = surfaces()["pad"]
    assert pad.GetProperty("material", "coulomb_friction").static_friction() == pytest.approx(0.1)
    assert pad.GetProperty("hydroelastic", "hydroelastic_modulus") == pytest.approx(1e5)
    env.reset(seed=3)
    assert surfaces()["pad"].GetProperty("hydroelastic", "hydroelastic_modulus") == pytest.approx(1e5)


def test_smaller_stiffness_leads_to_a_smaller_force(undisturbed):
    soft, _, _ = descend(disturbances={"stiffness_factor": 0.5})
    assert max(soft.trace.force) < 0.7 * max(undisturbed[0].trace.force)


def test_clock_factor_scales_the_control_period():
    env, _, _ = descend(1, disturbances={"clock_factor": 1.5})
    assert env.diagram.control_period == pytest.approx(3 * PLANT_PERIOD)
    assert env.diagram.control_period != CONTROL_PERIOD


def test_disturbed_period_is_a_multiple_of_the_plant_step():
    # The plant's time step is a quarter of the control period.
    fine = {"impedance_control": "cartesian", "bounded_force": False}
    env = make_env("GridClamp", disturbances={"clock_factor": 1.25}, **fine)
    assert env.diagram.control_period == pytest.approx(1.25 * CONTROL_PERIOD)
    for factor, options in ((1.3, fine), (1.5, {"time_step": CONTROL_PERIOD})):
        with pytest.raises(InputError, match="whole multiple of the plant's"):
            make_env("GridClamp", disturbances={"clock_factor": factor}, **options)


def test_stiffness_factor_scales_the_station_impedance():
    scaled, default = [], Impedance(stiffness=(800.0,) * 3 + (20.0,) * 3, damping_ratio=0.7)

    def build(impedance=default):
        scaled.append(impedance)
        raise InterruptedError

    with pytest.raises(InterruptedError):
        disturbed(build, Disturbances(stiffness_factor=0.5), True, "bench")
    assert scaled == [replace(default, stiffness=(400.0,) * 3 + (10.0,) * 3)]


def test_late_commands_delay_the_tool(undisturbed):
    late, _, _ = descend(1, disturbances={"late_commands": 20})  # 20 of the 25 control steps of the action
    assert late.trace.measured[-1, 2] > undisturbed[0].trace.measured[24, 2] + 1.0 * MM


def test_lost_commands_are_independent_of_the_noise():
    env = make_env(
        "GridClamp", sensing={"wrench_noise": (0.2, 0.01)}, disturbances={"lost_commands": 0.3}, action_repeat=1
    )
    station = env.diagram.diagram.GetSubsystemByName("station")
    commands, wrench = (station.GetSubsystemByName(name) for name in ("commands", "wrench"))
    env.reset(seed=1)
    root = env.simulator.get_context()
    losses, losses_of_noise_seed = [], []
    for _ in range(60):
        env.step(np.zeros(env.action_space.shape))
        count, is_lost = (commands.GetMyContextFromRoot(root).get_discrete_state(i).value()[0] for i in (0, 1))
        seed = wrench.GetMyContextFromRoot(root).get_numeric_parameter(2).value()[0]
        stream = np.random.default_rng([int(seed), int(count)])
        losses.append(is_lost)
        losses_of_noise_seed.append(stream.uniform() < 0.3)
    assert 0.1 < np.mean(losses) < 0.5
    assert np.mean(np.equal(losses, losses_of_noise_seed)) < 0.8  # 0.3² + 0.7² = 0.58 if independent


def test_payload_is_added_to_the_tool_mass_of_an_arm():
    env = make_env("GridClamp", station="arm", disturbances={"payload": 0.3})
    env.reset(seed=0)
    arm = env.diagram.diagram.GetSubsystemByName("station").GetSubsystemByName("station")
    tool = arm.arm.tool[0]
    mass = tool.get_mass(arm.plant.GetMyContextFromRoot(env.simulator.get_context()))
    assert mass == pytest.approx(tool.default_mass() + 0.3)
    assert tool.get_mass(arm.plant.CreateDefaultContext()) == pytest.approx(tool.default_mass())


def test_joint_friction_keeps_an_arm_away_from_its_command():
    def error(friction):
        """Return the distance along x and y from the command, after 0.5 s of the demonstration in free motion [m]."""
        env = make_env(
            "BncConnector", guidance="kgrl", station="arm", difficulty="hard", disturbances={"joint_friction": friction}
        )
        env.reset(seed=1)
        for _ in range(10):
            env.step(np.zeros(env.action_space.shape))
        station = env.diagram.diagram.GetSubsystemByName("station")
        context = station.GetMyContextFromRoot(env.simulator.get_context())
        command = station.get_desired_pose_input_port().Eval(context)
        return np.linalg.norm((station.get_pose_output_port().Eval(context) - command)[:2])

    assert error(0.0) < 2e-4
    assert error(0.7) > 5e-4
    with pytest.raises(InputError, match="only an arm's joints have friction"):
        make_env("GridClamp", station="gantry", disturbances={"joint_friction": 0.1})


def test_environment_raises_when_hardware_is_disturbed():
    from guiderail.diagrams.envs.make import make_skill

    with pytest.raises(InputError, match="real robot"):
        make_skill(
            "GridClamp", lambda o: o, station="hardware", robot_url="memq://", disturbances={"lost_commands": 0.1}
        )
