"""Contact in the rigid engines: drag, lever arm, locking, springs, and episodes that repeat bit for bit."""

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import Simulator

from guiderail import InputError, make_env
from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.recording import drive_along
from guiderail.diagrams.stations.station import CONTROL_PERIOD, Impedance
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.diagrams.tasks.contact_probe import MAX_DRAG_ERROR, SPEEDS, drag
from guiderail.diagrams.tasks.grid_clamp import GridClampWorkcell
from guiderail.models.common.transforms import MM
from guiderail.models.control.wrench import center_of_pressure
from guiderail_mujoco.bullet import BulletStation
from guiderail_mujoco.physx import PhysxStation
from guiderail_mujoco.rigid import MAX_STEP, STEP
from oracles.connector import insert_and_lock

HARD = EnvConfig.resolve("BncConnector", {"difficulty": "hard"}).declared
CONNECTOR, RIM, CLAMP = HARD.workcell(), HARD.rim_contact(), GridClampWorkcell()
STATIONS = {"pybullet": BulletStation, "sapien": PhysxStation}
STIFFNESS = Impedance().stiffness[2]  # [N/m]
PRESSED = 2.7 * MM  # depth of the command below the rim; 4 N


@pytest.fixture(params=STATIONS)
def name(request):
    """Name of a station whose engine is installed."""
    if find_spec(request.param) is None:
        pytest.skip(f"{request.param} is not installed")
    return request.param


@pytest.mark.parametrize(("speed", "step"), [(SPEEDS[0], MAX_STEP), (SPEEDS[1], STEP), (SPEEDS[1], MAX_STEP)])
def test_drag_on_the_rim_is_the_friction(name, speed, step):
    measured = drag(CONNECTOR, RIM, speed, name, engine_step=step)
    assert measured == pytest.approx(RIM.friction, rel=MAX_DRAG_ERROR)


def press(name, friction=1.0, lateral=0.0, prepare=None, step=STEP):
    """Press the plug on the rim for 0.5 s, and return its displacement along x [m] and the wrench (6,).

    Args:
        name: Name of the station.
        friction: Factor of the friction.
        lateral: Displacement of the command along x [m].
        prepare: Function of station and context that moves fixture or workpiece.
        step: Time step of the engine [s].
    """
    station = STATIONS[name](CONNECTOR, engine_step=step)
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    start = np.array([RIM.radius, 0.0, RIM.height, RIM.turn, 0.0, 0.0])
    if prepare is not None:
        prepare(station, context)
    station.set_pose(context, start)
    station.set_contact(context, friction, 1.0)
    station.get_desired_pose_input_port().FixValue(context, start + [lateral, 0.0, -PRESSED, 0.0, 0.0, 0.0])
    simulator.Initialize()
    simulator.AdvanceTo(0.5)
    wrench = station.get_wrench_output_port().Eval(context)
    return station.get_pose_output_port().Eval(context)[0] - start[0], wrench


@pytest.mark.parametrize("step", [STEP, MAX_STEP])
def test_lever_arm_is_that_of_rigid_circles(name, step):
    """The plug stands on the two points in which the edges of barrel and mouth cross."""
    _, wrench = press(name, step=step)
    assert wrench[2] == pytest.approx(PRESSED * STIFFNESS, rel=1e-2)
    size, offset = CONNECTOR.dimensions, RIM.radius
    mouth = size.bore_radius + size.mouth_chamfer
    rigid = offset - (offset**2 + size.barrel_radius**2 - mouth**2) / (2.0 * offset)
    assert np.linalg.norm(center_of_pressure(wrench, 0.5)) == pytest.approx(rigid, rel=0.05)


def test_friction_factor_decides_between_sticking_and_sliding(name):
    """A lateral force of 0.6 N is below the friction of 0.8 N, and above half of it."""
    lateral = 0.4 * MM
    assert abs(press(name, 1.0, lateral)[0]) < 0.02 * MM
    slid, wrench = press(name, 0.5, lateral)
    assert slid == pytest.approx(lateral - 0.5 * RIM.friction * PRESSED, rel=0.2)
    assert -wrench[0] == pytest.approx(0.5 * RIM.friction * wrench[2], rel=0.05)


def test_plug_locks_on_a_moved_jack_and_holds_a_pull(name):
    offset = np.array([3.0 * MM, -2.0 * MM, 1.0 * MM])
    workcell = BncWorkcell()
    times, motion = insert_and_lock()
    pull = np.array([0.0, 0.0, 45.0 / STIFFNESS, 0.0, 0.0, 0.0])
    moved = np.concatenate([motion, [pull]]) + np.array([*offset, 0.0, 0.0, 0.0])
    _, recording = drive_along(
        STATIONS[name](workcell, engine_step=MAX_STEP), np.append(times, times[-1] + 1.0), moved,
        lambda plant, context: workcell.set_fixture_offset(plant, context, RigidTransform(offset)),
    )  # fmt: skip
    locked = recording["pose"][round(times[-1] / 0.02) - 1]
    assert np.abs(locked[:3] - offset).max() < 0.3 * MM
    assert np.abs(np.rad2deg(locked[3:])).max() < 1.0
    assert recording["wrench"][-1, 2] == pytest.approx(-40.0, abs=0.5)
    assert recording["pose"][-1, 2] - offset[2] < 0.5 * MM


def test_springs_of_the_clamp_resist_the_lip_and_hold_a_light_pull(name):
    """The forces are those of MuJoCo's test; a bead that turned in its joint would slide without them."""
    motion = np.zeros((5, 6))
    motion[:, 2] = np.array([2.0, -4.0, 1.0, 1.0, 8.0]) * MM
    _, recording = drive_along(STATIONS[name](CLAMP, engine_step=MAX_STEP), [0.0, 0.6, 0.8, 1.1, 1.6], motion)
    z, force = recording["pose"][:, 2], recording["wrench"][:, 2]
    assert 2.0 < force[z > 0.85 * MM].max() < 8.0
    assert z[round(1.1 / CONTROL_PERIOD) - 1] < 0.6 * MM
    assert -8.0 < force.min() < -4.0


def test_free_motion_with_a_grasp_offset_has_no_wrench(name):
    tolerance = {"pybullet": 1e-6, "sapien": 2e-5}[name]  # PhysX computes in single precision
    station = STATIONS[name](CONNECTOR)
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    offset = RigidTransform(RollPitchYaw(0.02, -0.03, 0.05), [1.0 * MM, -0.5 * MM, 2.0 * MM])
    CONNECTOR.set_grasp_offset(station.plant, station.plant.GetMyMutableContextFromRoot(context), offset)
    start = np.array([0.0, 0.0, 0.05, 3.0, 0.0, 0.0])
    desired = start + [0.01, -0.005, 0.01, 0.3, 0.1, -0.1]  # beyond a half turn about z
    station.set_pose(context, start)
    station.get_desired_pose_input_port().FixValue(context, desired)
    simulator.Initialize()
    for end in (0.02, 0.06, 0.6):
        simulator.AdvanceTo(end)
        np.testing.assert_allclose(station.get_wrench_output_port().Eval(context), 0.0, atol=tolerance)
    np.testing.assert_allclose(station.get_pose_output_port().Eval(context), desired, atol=1e-5)


OPTIONS = {"guidance": "kgrl", "difficulty": "hard", "action_repeat": 25, "engine_step": MAX_STEP}


def episode(env, seed):
    """Return the outputs of an episode with random actions, as bytes."""
    observation, _ = env.reset(seed=seed)
    outputs, rng = [observation.tobytes()], np.random.default_rng(seed)
    for _ in range(4):
        observation, reward, terminated, truncated, info = env.step(rng.uniform(-1.0, 1.0, env.action_space.shape))
        outputs += [observation.tobytes(), np.float64(reward).tobytes(), np.float64(info["contact_force"]).tobytes()]
        if terminated or truncated:
            break
    assert info["contact_force"] > 0.0
    return b"".join(outputs)


def test_episode_is_equal_bit_for_bit_in_one_process_and_in_another(name, forks):
    env = make_env("BncConnector", station=name, **OPTIONS)
    first = episode(env, 3)
    env.reset(seed=4)
    env.step(np.ones(env.action_space.shape))
    assert episode(env, 3) == first
    made = f"make_env('BncConnector', station={name!r}, **OPTIONS)"
    code = f"from {Path(__file__).stem} import *; print(episode({made}, 3).hex())"
    other = forks.run("-c", code, folder=Path(__file__).parent)
    assert other.stdout.split() == [first.hex()], other.stderr


def test_rest_of_an_episode_in_contact_is_equal_bit_for_bit_when_restored(name):
    env = make_env("BncConnector", station=name, **OPTIONS)
    env.reset(seed=3)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (5, *env.action_space.shape))

    def run(actions):
        return [(row[0].tobytes(), row[1], repr(row[4])) for row in map(env.step, actions)]

    run(actions[:3])
    state = env.save()
    expected = run(actions[3:])
    env.reset()
    env.restore(state)
    assert run(actions[3:]) == expected


def test_step_is_refused_where_the_contact_is_not_accurate(name):
    with pytest.raises(InputError, match=r"set engine_step to at most 0\.002 s"):
        STATIONS[name](CONNECTOR, engine_step=0.004)
    stiff = replace(Impedance(), stiffness=tuple(30.0 * value for value in Impedance().stiffness))
    with pytest.raises(InputError, match=r"set engine_step to at most 0\.0012 s"):
        STATIONS[name](CONNECTOR, stiff, engine_step=MAX_STEP)
