"""Physics of connector and clamp in MuJoCo, with the criteria of those in Drake."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform

from guiderail import InputError, make_env
from guiderail.diagrams.envs.recording import drive_along
from guiderail.diagrams.stations.station import Impedance
from guiderail.diagrams.tasks.bnc_connector.task import BncWorkcell
from guiderail.diagrams.tasks.grid_clamp.task import GridClampWorkcell
from guiderail.models.common.transforms import MM
from guiderail.models.objects.bnc_connector.demonstrations import CLEAR, insert_and_lock, poses

pytest.importorskip("mujoco")
import mujoco

from guiderail.diagrams.stations.mujoco import MujocoContact, MujocoStation, constraint_torques, mujoco_parts

CONNECTOR, CLAMP = BncWorkcell(), GridClampWorkcell()
STIFFNESS = Impedance().stiffness[2]
LUG_TOP = CONNECTOR.dimensions.lug_height + CONNECTOR.dimensions.lug_radius - CONNECTOR.dimensions.locked_height
LOCKED = round(insert_and_lock()[0][-1] / 0.02)


def drive(workcell, times, motion, prepare=None):
    return drive_along(MujocoStation(workcell), times, np.asarray(motion, dtype=float), prepare)


def descent(z_mm, x_mm=0.0, y_mm=0.0):
    motion = np.zeros((len(z_mm), 6))
    motion[:, 0], motion[:, 1], motion[:, 2] = np.array(x_mm) * MM, np.array(y_mm) * MM, np.array(z_mm) * MM
    return motion


def workpiece_in_fixture(driven, workpiece, fixture):
    station = driven.station
    bodies = station.GetOutputPort("body_poses").Eval(station.GetMyContextFromRoot(driven.context))
    of = {name: bodies[int(station.plant.GetBodyByName(name).index())] for name in (workpiece, fixture)}
    return of[fixture].InvertAndCompose(of[workpiece])


@pytest.fixture(scope="module")
def locked_and_pulled():
    """Lock the plug on a moved jack, then command a pull beyond the effort limit."""
    offset = np.array([3.0 * MM, -2.0 * MM, 1.0 * MM])
    times, motion = insert_and_lock()
    pull = np.array([0.0, 0.0, 45.0 / STIFFNESS, 0.0, 0.0, 0.0])
    motion = np.concatenate([motion, [pull, pull]]) + np.array([*offset, 0.0, 0.0, 0.0])

    def move(plant, context):
        CONNECTOR.set_fixture_offset(plant, context, RigidTransform(offset))

    driven, recording = drive(CONNECTOR, np.concatenate([times, times[-1] + [1.0, 1.5]]), motion, move)
    return driven, recording, offset


def test_plug_locks_at_the_nominal_pose(locked_and_pulled):
    _, recording, offset = locked_and_pulled
    final = recording["pose"][LOCKED - 1]
    assert np.abs(final[:3] - offset).max() < 0.3 * MM
    assert np.abs(np.rad2deg(final[3:])).max() < 1.0
    assert recording["contact_force"][:LOCKED].max() < 15.0
    assert not recording["saturation"][1:LOCKED].any()  # from the first command on


def test_wrench_equals_the_force_of_the_impedance(locked_and_pulled):
    turning = slice(250, 315)
    _, recording, _ = locked_and_pulled
    felt = np.linalg.norm(recording["wrench"][turning, :3], axis=1)
    # Sliding over facets causes vibrations, so the averages over 0.1 s are compared.
    over = np.ones(5) / 5
    pushed = np.convolve(recording["contact_force"][turning, 0], over, "valid")
    np.testing.assert_allclose(np.convolve(felt, over, "valid"), pushed, atol=0.6)


def test_locked_plug_resists_a_pull(locked_and_pulled):
    driven, recording, offset = locked_and_pulled
    assert recording["saturation"][-1, 0] == 1.0
    assert recording["wrench"][-1, 2] == pytest.approx(-40.0, abs=0.5)
    assert recording["pose"][-1, 2] - offset[2] < 0.5 * MM
    assert CONNECTOR.is_locked(CONNECTOR.X_FT.inverse() @ workpiece_in_fixture(driven, "plug", "jack"))


def test_rotation_is_blocked_before_insertion():
    depth = LUG_TOP - 30.0 / STIFFNESS
    motion = poses(np.array([CLEAR, LUG_TOP + 1.0 * MM, depth, depth]), np.deg2rad(45.0))
    _, recording = drive(CONNECTOR, [0.0, 0.8, 1.6, 2.0], motion)
    assert recording["wrench"][-1, 2] == pytest.approx(30.0, abs=1.5)
    assert recording["pose"][-1, 2] == pytest.approx(LUG_TOP, abs=0.1 * MM)


@pytest.mark.parametrize("axis", [0, 2, 3, 4])
def test_static_displacement_equals_compliance_times_wrench(axis):
    """Static displacement is within 2 % of K⁻¹ f for the measured wrench f."""
    stiffness = np.array(Impedance().stiffness)
    beyond = np.array([3.0 * MM, 3.0 * MM, -3.0 * MM, 0.05, 0.05, 0.05])
    motion = np.tile([0.0, 0.0, 2.0 * MM, np.pi / 2, 0.0, 0.0], (4, 1))
    motion[1:, 2] = -2.0 * MM  # seated, so that the contact resists torques about all axes
    motion[2:, axis] += beyond[axis]
    _, recording = drive(CONNECTOR, [0.0, 0.5, 0.7, 1.0], motion)
    f, t = np.split(recording["wrench"][-1], 2)
    load = np.array([*f, t[2], -t[0], t[1]])  # after a quarter turn the second hinge is −x and the third y
    deflection = recording["pose"][-1] - recording["desired_pose"][-1]
    assert abs(load[axis]) > 0.3 * abs(stiffness * beyond)[axis]
    assert deflection[axis] == pytest.approx(load[axis] / stiffness[axis], rel=0.02)


@pytest.fixture(scope="module")
def inserted():
    return drive(CLAMP, [0.0, 1.6, 1.9], descent([4.0, -6.0, -6.0]))


def test_snap_resists_then_yields(inserted):
    driven, recording = inserted
    tip = workpiece_in_fixture(driven, "clamp", "table")
    assert np.abs((CLAMP.X_FT.inverse() @ tip).translation()).max() < 0.1 * MM
    assert recording["contact_force"].max() <= 10.0
    z, force = recording["pose"][:, 2] / MM, recording["wrench"][:, 2]
    resistance = force[z > 0.85].max()
    assert 2.0 < resistance < 8.0
    assert z[np.flatnonzero(z < 0.85)[1]] < 0.1  # it jumps in behind the crest
    assert recording["wrench"][:, 2].max() > resistance  # later, at the shoulder


def test_snap_resists_a_light_pull_and_yields_to_a_strong_one():
    _, recording = drive(CLAMP, [0.0, 0.4, 0.6, 0.9, 1.2, 1.5], descent([2.0, -4.0, 1.0, 1.0, 8.0, 16.0]))
    z, force = recording["pose"][:, 2], recording["wrench"][:, 2]
    assert z[44] < 0.6 * MM
    assert z[-1] > 10.0 * MM
    assert -12.0 < force.min() < -2.0


def test_clamp_next_to_its_holes_does_not_creep():
    """With 27 N down and 2 N sideways, below the 5.4 N at which it slips."""
    sideways = 2.0 + 2.0 / STIFFNESS / MM
    motion = descent([13.0, -6.0, -6.0, -6.0], [2.0, 2.0, sideways, sideways], 1.5)
    _, recording = drive(CLAMP, [0.0, 0.5, 0.6, 1.6], motion)
    assert recording["wrench"][-1, 2] == pytest.approx(27.0, abs=0.2)
    assert recording["wrench"][-1, 0] == pytest.approx(-2.0, abs=0.2)
    assert abs(recording["pose"][-1, 0] - recording["pose"][-40, 0]) < 0.01 * MM


def episode(env, seed):
    observation, _ = env.reset(seed=seed)
    seen, rng = [observation], np.random.default_rng(seed)
    for _ in range(4):
        observation, reward, terminated, truncated, _ = env.step(rng.uniform(-1.0, 1.0, env.action_space.shape))
        seen.append(np.append(observation, reward))
        if terminated or truncated:
            break
    return np.concatenate(seen)


@pytest.mark.parametrize(
    ("task", "options"),
    [("BncConnector", {"fixture_offset": "per_episode"}), ("GridClamp", {"fixture_offset": "per_episode"})],
)
def test_episode_is_bit_identical_for_the_same_seed(task, options):
    """With a disturbed episode in between, which leaves no state."""
    env = make_env(task, station="mujoco", action_repeat=25, **options)
    first = episode(env, 3)
    episode(env, 4)
    env.push(np.array([1.0 * MM, 0.0, 0.0, 0.0, 0.0, 0.0]))
    np.testing.assert_array_equal(episode(env, 3), first)
    assert not np.array_equal(episode(env, 4), first)


@pytest.mark.parametrize(
    ("task", "options", "modulus", "most"),
    [
        ("BncConnector", {"fixture_offset": "none", "guidance": "kmp"}, 10.0, 400),
        ("GridClamp", {}, 10.0, 100),
        ("GridClamp", {}, 30.0, 100),
    ],
    ids=lambda value: None if isinstance(value, dict) else str(value),
)
def test_stiff_contact_is_stable(task, options, modulus, most):
    """Gasket and bead are on stiffer springs, which would be unstable at the nominal time step."""
    env = make_env(task, station="mujoco", modulus_factor=(modulus, modulus), **options)
    env.reset(seed=2)
    rng, over = np.random.default_rng(2), False
    while not over and len(env.trace) < most:
        _, _, terminated, truncated, info = env.step(rng.uniform(-1.0, 1.0, env.action_space.shape))
        over = terminated or truncated
    moved = np.abs(np.diff(env.trace.measured, axis=0))
    assert info["termination"] != "collision"
    assert "simulation_failure" not in info
    assert np.rad2deg(moved[:, 3:]).max() < 3.0
    assert moved[:, :3].max() < 3.0 * MM
    assert max(env.trace.force) < 20.0


def test_divergence_ends_only_the_present_episode(tmp_path, monkeypatch):
    """MuJoCo itself would continue from zero, where the connector is locked, and write a file."""
    monkeypatch.chdir(tmp_path)

    def generate_assets():
        return make_env("BncConnector", station="mujoco", fixture_offset="per_episode", action_repeat=25)

    env = generate_assets()
    episode(env, 4)
    env.reset(seed=3)
    valid, *_ = env.step(np.zeros(2))
    for displacement in (1e11, 1e300):
        env.reset(seed=3)
        env.step(np.zeros(2))
        env.push(np.array([0.0, 0.0, displacement, 0.0, 0.0, 0.0]))
        observation, _, terminated, truncated, info = env.step(np.zeros(2))
        assert (terminated, truncated) == (False, True)
        assert "the simulation failed in MuJoCo" in info["simulation_failure"]
        assert not info["is_success"]
        np.testing.assert_array_equal(observation, valid)
    assert not list(tmp_path.iterdir())
    np.testing.assert_array_equal(episode(env, 5), episode(generate_assets(), 5))


@pytest.mark.parametrize("warning", ["CONTACTFULL", "CNSTRFULL"])
def test_episode_ends_when_the_engine_runs_out_of_contacts(warning, monkeypatch):
    """MuJoCo itself would drop the contacts that are too many, and a plug would penetrate a socket."""
    step = mujoco.mj_step

    def step_and_warn(model, data):
        step(model, data)
        data.warning[mujoco.mjtWarning.__members__[f"mjWARN_{warning}"].value].number += 1

    env = make_env("BncConnector", station="mujoco", action_repeat=25)
    env.reset(seed=3)
    monkeypatch.setattr(mujoco, "mj_step", step_and_warn)
    *_, terminated, truncated, info = env.step(np.zeros(2))
    assert (terminated, truncated) == (False, True)
    assert "the simulation failed in MuJoCo" in info["simulation_failure"]


def test_engine_has_the_offsets_of_the_task():
    env = make_env("BncConnector", station="mujoco", fixture_offset="per_episode", grasp_angle=1.0)
    _, info = env.reset(seed=2)
    station = env.task.diagram.GetSubsystemByName("station")
    env.step(np.zeros(2))
    model = station.gantry.model
    X_TT = RigidTransform([*info["jack_offset"], 0.0])
    expected = (X_TT @ CONNECTOR.X_FT.inverse()).translation()
    np.testing.assert_allclose(model.body("fixture").pos, expected, atol=1e-12)
    np.testing.assert_allclose(model.body("workpiece").pos[:2], info["grasp_offset"][:2], atol=1e-12)


SLIDER = """
<mujoco><option gravity="0 0 0"/><worldbody>
<geom type="box" size="0.1 0.1 0.1" pos="0.3 0 0"/>
<body>
<joint type="slide" axis="1 0 0" frictionloss="2"/><geom type="box" size="0.1 0.1 0.1" mass="1" friction="0"/>
</body>
</worldbody></mujoco>
"""


@pytest.mark.parametrize(("applied", "expected"), [(1.0, 0.0), (7.0, -7.0)])
def test_constraint_torques_leave_joint_friction_out(applied, expected):
    model = mujoco.MjModel.from_xml_string(SLIDER)
    data = mujoco.MjData(model)
    data.qpos[:], data.qfrc_applied[:] = 0.1 if expected else 0.0, applied  # in contact, or held by the friction
    for _ in range(2000):
        mujoco.mj_step(model, data)
    assert data.qfrc_constraint[0] == pytest.approx(-applied, abs=0.05)
    assert constraint_torques(model, data)[0] == pytest.approx(expected, abs=0.05)


class Unknown:
    """Workcell without contact surfaces."""


def test_station_raises_when_surfaces_are_missing():
    with pytest.raises(InputError, match="which Unknown does not provide"):
        MujocoStation(Unknown())


def test_station_raises_when_mujoco_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(InputError, match=r'pip install "guiderail\[mujoco\]"'):
        MujocoStation(CONNECTOR)


def test_part_surfaces_are_refused_when_a_mask_has_too_few_bits():
    surface = CONNECTOR.fixture_surfaces()[0]
    fixture = [replace(surface, name=f"surface_{i}", pair=f"pair_{i}") for i in range(31)]
    mujoco_parts(fixture[:30], [], MujocoContact())
    with pytest.raises(InputError, match="at most 30 pairs of surfaces, and the workcell has 31"):
        mujoco_parts(fixture, [], MujocoContact())


def test_disturbed_clock_is_a_multiple_of_the_station_s_step():
    with pytest.raises(InputError, match=r"whole multiple of the plant's time step of 0\.02 s"):
        make_env("GridClamp", station="mujoco", clock_factor=1.5, time_step=0.02)
