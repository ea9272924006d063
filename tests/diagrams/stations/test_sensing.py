"""Named settings of the sensors: their errors, their replacement by single options, and the tare in free motion."""

import numpy as np
import pytest

from guiderail import InputError, make_env
from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_station
from guiderail.diagrams.stations.disturbances import Disturbances, DisturbedStation
from guiderail.diagrams.stations.options import SENSING, TARE_AVERAGED, TARE_SKIPPED
from guiderail.models.common.transforms import MM

HARD = {"difficulty": "hard", "guidance": "kgrl", "action_repeat": 1}
TARE_STEPS = TARE_SKIPPED + TARE_AVERAGED


def free_motion(env, steps=45, seed=3):
    """Return measured and exact wrenches (steps, 6) [N, Nm] without contact, and the reset's info."""
    _, info = env.reset(seed=seed)
    station = env.diagram.diagram.GetSubsystemByName("station")
    exact = []
    for _ in range(steps):
        env.step(np.zeros(env.action_space.shape))
        exact.append(
            station.GetOutputPort("exact_wrench").Eval(station.GetMyContextFromRoot(env.simulator.get_context()))
        )
    return env.trace.signals["wrench"].copy(), np.array(exact), info


@pytest.mark.parametrize(
    ("station", "sensing"), [("gantry", "robot"), ("gantry", "wrist"), ("arm", "robot"), ("mujoco", "wrist")]
)
def test_setting_is_tared_and_seeded_on_every_station(station, sensing):
    env = make_env("BncConnector", station=station, sensing=sensing, **HARD)
    measured, exact, info = free_motion(env)
    repeated, _, repeated_info = free_motion(env, steps=20)
    np.testing.assert_array_equal(repeated, measured[:20])
    other_seed, _, other_info = free_motion(env, steps=20, seed=4)
    assert not np.array_equal(other_seed, measured[:20])
    delay = info["wrench_delay"]
    assert SENSING[sensing].wrench_delay[0] <= delay <= SENSING[sensing].wrench_delay[1]
    assert np.array_equal(repeated_info["calibration_error"], info["calibration_error"])
    assert not np.array_equal(other_info["calibration_error"], info["calibration_error"])
    assert np.abs(info["calibration_error"][:3]).max() <= 0.15 * MM
    np.testing.assert_array_equal(measured[: TARE_STEPS + delay - 1], 0.0)
    # The bias is several newtons before the tare, and tenths of a newton after the tare.
    errors = (measured - exact)[TARE_STEPS + delay :]
    assert 1e-4 < np.abs(errors[:, :3]).max() < 0.6
    assert 1e-5 < np.abs(errors[:, 3:]).max() < 0.15


def test_arm_estimates_the_wrench_from_joint_torques():
    env = make_env(
        "BncConnector", station="arm", sensing={"profile": "robot", "tare": False, "wrench_delay": 0}, **HARD
    )
    measured, exact, info = free_motion(env)
    assert info["torque_offset"].shape == (7,)
    bias = np.abs((measured - exact)[10:].mean(axis=0))
    assert 0.3 < bias[:3].max() < 10.0  # newtons, as published for arms with joint torque sensors
    wrist = make_env("BncConnector", station="arm", sensing="wrist", **HARD)
    assert "torque_offset" not in free_motion(wrist, steps=2)[2]


def test_payload_is_measured_and_tared():
    """A payload of 0.5 kg that the model lacks weighs 4.9 N before the tare, and nothing after the tare."""
    sensing = {"profile": "robot", "wrench_bias": (0.0, 0.0), "wrench_scale": (1.0, 1.0)}
    options = {**HARD, "station": "arm", "disturbances": {"payload": 0.5}}
    untared, _, _ = free_motion(make_env("BncConnector", sensing={**sensing, "tare": False}, **options))
    assert untared[12:28, 2].mean() == pytest.approx(-0.5 * 9.81, abs=0.5)
    tared, _, _ = free_motion(make_env("BncConnector", sensing=sensing, **options))
    assert abs(tared[12:28, 2].mean()) < 0.3


def test_calibration_error_displaces_tool_from_measurement():
    env = make_env("BncConnector", sensing={"calibration_error": (1.0 * MM, 0.0)}, **HARD)
    _, info = env.reset(seed=1)
    for _ in range(30):
        env.step(np.zeros(2))
    station = env.diagram.diagram.GetSubsystemByName("station")
    inner = station.GetSubsystemByName("station")
    true_pose = inner.get_pose_output_port().Eval(inner.GetMyContextFromRoot(env.simulator.get_context()))
    np.testing.assert_allclose(env.trace.measured[-1] - true_pose, info["calibration_error"], atol=1e-9)
    # The robot tracks the measured pose, so the true pose of the tool has the error.
    assert np.abs(env.trace.measured[-1] - env.trace.commanded[-1])[:2].max() < 0.1 * MM
    assert np.abs(info["calibration_error"][:2]).max() > 0.15 * MM


def test_measured_pose_has_the_resolution_of_encoders():
    env = make_env("BncConnector", sensing="robot", **HARD)
    free_motion(env, steps=5)
    steps = env.trace.measured / np.repeat(SENSING["robot"].pose_resolution, 3)
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)


@pytest.mark.parametrize("task", ["BncConnector", "GridClamp"])
@pytest.mark.parametrize("difficulty", ["standard", "hard"])
def test_tare_ends_before_the_first_contact(task, difficulty):
    """For the smallest, zero and largest action; a tare during contact would subtract the contact force."""
    env = make_env(task, difficulty=difficulty, action_repeat=1)
    for seed, action in enumerate((-1.0, 0.0, 1.0)):
        env.reset(seed=seed)
        for _ in range(TARE_STEPS + 1):
            env.step(np.full(env.action_space.shape, action))
        assert np.abs(env.trace.signals["wrench"]).max() < 1e-6


def test_single_option_replaces_a_value_of_the_setting():
    def errors(**options):
        return Disturbances(**options).errors

    assert errors(sensing="robot").wrench_delay == (1, 5)
    assert errors(sensing="robot", wrench_delay=2).wrench_delay == (2, 2)
    assert not errors(sensing="robot", tare=False).tare
    assert errors(sensing="robot", wrench_bias=(3.0, 0.1)).wrench_bias == (3.0, 0.1)
    joint_torque = errors(sensing="robot", wrench_bias=(0.0, 0.0), wrench_noise=(0.0, 0.0)).joint_torque
    assert (joint_torque.offset, joint_torque.mass, joint_torque.noise) == (0.0, 0.0, 0.0)
    assert joint_torque.friction > 0.0
    assert errors(wrench_scale=(0.5, 2.0)).wrench_scale == (0.5, 2.0)


def test_setting_of_a_stored_configuration_can_be_changed():
    """A run's folder stores all options; another setting must not inherit the errors of the stored setting."""
    stored = EnvConfig.resolve("BncConnector", {"sensing": "robot"}).options
    changed = EnvConfig.resolve("BncConnector", {**stored, "sensing": "exact"})
    assert not changed.parts["disturbances"].is_active
    assert EnvConfig.resolve("BncConnector", stored).options == stored


@pytest.mark.parametrize(("sensing", "is_tared"), [("robot", True), ("exact", False)])
def test_hardware_station_is_tared_and_adds_no_errors(sensing, is_tared):
    options = {"station": "hardware", "robot_url": "memq://", "sensing": sensing}
    task = EnvConfig.resolve("BncConnector", options)
    station = make_station(task)
    for copy in (station, station.clone(task.declared.workcell())):
        assert any(system.get_name() == "tare" for system in copy.GetSystems()) == is_tared
    noisy = EnvConfig.resolve("BncConnector", {**options, "sensing.wrench_noise": (0.1, 0.01)})
    with pytest.raises(InputError, match="disturbances of its own"):
        make_station(noisy)


def test_exact_setting_adds_no_disturbances():
    env = make_env("BncConnector", sensing="exact", **HARD)
    assert not isinstance(env.diagram.diagram.GetSubsystemByName("station"), DisturbedStation)
