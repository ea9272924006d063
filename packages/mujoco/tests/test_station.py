"""Contact physics of connector and clamp in MuJoCo, with the criteria of the tests in Drake."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from pushed_station import push_robot
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator

from guiderail import InputError, make_env
from guiderail.diagrams.envs.recording import drive_along
from guiderail.diagrams.stations.gantry import CARRIAGE_MASS
from guiderail.diagrams.stations.station import CONTACT_STIFFNESS, Impedance
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.diagrams.tasks.grid_clamp import GridClampWorkcell
from guiderail.models.common.transforms import MM
from guiderail.models.control.wrench import approach_impedance
from guiderail.models.objects.bnc_connector.demonstrations import CLEAR, poses
from oracles.connector import insert_and_lock

pytest.importorskip("mujoco")
import mujoco

from guiderail_mujoco.bullet import BulletStation
from guiderail_mujoco.physx import PhysxStation
from guiderail_mujoco.station import MujocoContact, MujocoStation, constraint_torques, mujoco_parts
from guiderail_mujoco.surfaces import surfaces_of

CONNECTOR, CLAMP = BncWorkcell(), GridClampWorkcell()
STIFFNESS = Impedance().stiffness[2]  # [N/m]
# Height of the plug's mouth on top of the lugs, relative to the locked pose [m].
LUG_TOP = CONNECTOR.dimensions.lug_height + CONNECTOR.dimensions.lug_radius - CONNECTOR.dimensions.locked_height
LOCKED = round(insert_and_lock()[0][-1] / 0.02)  # control steps until the plug is locked


def drive(workcell, times, motion, prepare=None):
    return drive_along(MujocoStation(workcell), times, np.asarray(motion, dtype=float), prepare)


def descent(z_mm, x_mm=0.0, y_mm=0.0):
    """Return poses (N, 6) at heights (N,) and horizontal positions [mm]."""
    motion = np.zeros((len(z_mm), 6))
    motion[:, 0], motion[:, 1], motion[:, 2] = np.array(x_mm) * MM, np.array(y_mm) * MM, np.array(z_mm) * MM
    return motion


def workpiece_in_fixture(driven, workpiece, fixture):
    """Return the pose of a workpiece in its fixture; both are names of bodies."""
    station = driven.station
    bodies = station.GetOutputPort("body_poses").Eval(station.GetMyContextFromRoot(driven.context))
    X_WW, X_WF = (bodies[int(station.plant.GetBodyByName(name).index())] for name in (workpiece, fixture))
    return X_WF.InvertAndCompose(X_WW)


@pytest.fixture(scope="module")
def locked_and_pulled():
    """Lock the plug on a moved jack, then command a pull of 45 N, above the limit of 40 N.

    Returns:
        Driven station, recording, and offset of the jack [m].
    """
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
    assert recording["impedance_force"][:LOCKED].max() < 15.0
    assert not recording["saturation"][1:LOCKED].any()  # from the first command on


def test_wrench_equals_the_force_of_the_impedance(locked_and_pulled):
    turning = slice(150, 215)
    _, recording, _ = locked_and_pulled
    measured = np.linalg.norm(recording["wrench"][turning, :3], axis=1)
    # Sliding over facets causes vibrations, so averages over five control steps (0.1 s) are compared.
    window = np.ones(5) / 5
    expected = np.convolve(recording["impedance_force"][turning, 0], window, "valid")
    np.testing.assert_allclose(np.convolve(measured, window, "valid"), expected, atol=0.6)


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
    offset = np.array([3.0 * MM, 3.0 * MM, -3.0 * MM, 0.05, 0.05, 0.05])
    motion = np.tile([0.0, 0.0, 2.0 * MM, np.pi / 2, 0.0, 0.0], (4, 1))
    motion[1:, 2] = -2.0 * MM  # seated, so that the contact resists torques about all axes
    motion[2:, axis] += offset[axis]
    _, recording = drive(CONNECTOR, [0.0, 0.5, 0.7, 1.0], motion)
    f, t = np.split(recording["wrench"][-1], 2)
    load = np.array([*f, t[2], -t[0], t[1]])  # a quarter turn about z rotates the other axes to −x and y
    deflection = recording["pose"][-1] - recording["desired_pose"][-1]
    assert abs(load[axis]) > 0.3 * abs(stiffness * offset)[axis]
    assert deflection[axis] == pytest.approx(load[axis] / stiffness[axis], rel=0.02)


@pytest.fixture(scope="module")
def inserted():
    return drive(CLAMP, [0.0, 1.6, 1.9], descent([4.0, -6.0, -6.0]))


def test_snap_force_peaks_at_the_lip(inserted):
    driven, recording = inserted
    X_FG = workpiece_in_fixture(driven, "clamp", "table")
    assert np.abs((CLAMP.X_FT.inverse() @ X_FG).translation()).max() < 0.1 * MM
    assert recording["impedance_force"].max() <= 10.0
    z, force = recording["pose"][:, 2] / MM, recording["wrench"][:, 2]
    resistance = force[z > 0.85].max()
    assert 2.0 < resistance < 8.0
    assert z[np.flatnonzero(z < 0.85)[2]] < 0.1  # past the lip, the clamp snaps in within 30 ms
    assert recording["wrench"][:, 2].max() > resistance  # at the shoulder


def test_snap_holds_at_a_light_pull_but_not_at_a_strong_pull():
    _, recording = drive(CLAMP, [0.0, 0.4, 0.6, 0.9, 1.2, 1.5], descent([2.0, -4.0, 1.0, 1.0, 8.0, 16.0]))
    z, force = recording["pose"][:, 2], recording["wrench"][:, 2]
    assert z[44] < 0.6 * MM
    assert z[-1] > 10.0 * MM
    assert -12.0 < force.min() < -2.0


def test_sticking_contact_does_not_creep():
    """Next to its holes, the clamp presses with 27 N and is pushed sideways by 2 N; it would slip at 5.4 N."""
    sideways = 2.0 + 2.0 / STIFFNESS / MM
    motion = descent([13.0, -6.0, -6.0, -6.0], [2.0, 2.0, sideways, sideways], 1.5)
    _, recording = drive(CLAMP, [0.0, 0.5, 0.6, 1.6], motion)
    assert recording["wrench"][-1, 2] == pytest.approx(27.0, abs=0.2)
    assert recording["wrench"][-1, 0] == pytest.approx(-2.0, abs=0.2)
    assert abs(recording["pose"][-1, 0] - recording["pose"][-40, 0]) < 0.01 * MM


def run_episode(env, seed):
    """Run up to four random actions; return observations and rewards as one vector."""
    observation, _ = env.reset(seed=seed)
    outputs, rng = [observation], np.random.default_rng(seed)
    for _ in range(4):
        observation, reward, terminated, truncated, _ = env.step(rng.uniform(-1.0, 1.0, env.action_space.shape))
        outputs.append(np.append(observation, reward))
        if terminated or truncated:
            break
    return np.concatenate(outputs)


@pytest.mark.parametrize("task", ["BncConnector", "GridClamp"])
def test_episode_is_bit_identical_for_the_same_seed(task):
    """An episode and a displacement of the tool in between leave no state."""
    env = make_env(task, station="mujoco", action_repeat=25, fixture_offset="per_episode")
    first = run_episode(env, 3)
    assert not np.array_equal(run_episode(env, 4), first)
    push_robot(env, np.array([1.0 * MM, 0.0, 0.0, 0.0, 0.0, 0.0]))
    np.testing.assert_array_equal(run_episode(env, 3), first)


@pytest.mark.parametrize(
    ("task", "options", "modulus_factor", "max_steps"),
    [
        ("BncConnector", {"fixture_offset": "none", "guidance": "kmp"}, 10.0, 400),
        ("GridClamp", {}, 30.0, 100),
    ],
    ids=lambda value: None if isinstance(value, dict) else str(value),
)
def test_stiff_contact_is_stable(task, options, modulus_factor, max_steps):
    """With stiffer springs under gasket and bead, contact would be unstable at the nominal time step."""
    env = make_env(task, station="mujoco", disturbances={"modulus_factor": (modulus_factor, modulus_factor)}, **options)
    env.reset(seed=2)
    rng, has_ended = np.random.default_rng(2), False
    while not has_ended and len(env.trace) < max_steps:
        _, _, terminated, truncated, info = env.step(rng.uniform(-1.0, 1.0, env.action_space.shape))
        has_ended = terminated or truncated
    displacements = np.abs(np.diff(env.trace.measured, axis=0))
    assert info["termination"] != "collision"
    assert "simulation_failure" not in info
    assert np.rad2deg(displacements[:, 3:]).max() < 3.0
    assert displacements[:, :3].max() < 3.0 * MM
    assert max(env.trace.force) < 20.0


def test_divergence_ends_the_episode_and_leaves_no_state(tmp_path, monkeypatch):
    """MuJoCo by itself would reset to zero, where the connector is locked, and write a log file."""
    monkeypatch.chdir(tmp_path)

    def build_env():
        return make_env("BncConnector", station="mujoco", fixture_offset="per_episode", action_repeat=25)

    env = build_env()
    run_episode(env, 4)
    env.reset(seed=3)
    last_finite, *_ = env.step(np.zeros(2))
    for displacement in (1e11, 1e300):
        env.reset(seed=3)
        env.step(np.zeros(2))
        push_robot(env, np.array([0.0, 0.0, displacement, 0.0, 0.0, 0.0]))
        observation, _, terminated, truncated, info = env.step(np.zeros(2))
        assert (terminated, truncated) == (False, True)
        assert "the simulation failed in MuJoCo" in info["simulation_failure"]
        assert not info["is_success"]
        np.testing.assert_array_equal(observation, last_finite)
    assert not list(tmp_path.iterdir())
    np.testing.assert_array_equal(run_episode(env, 5), run_episode(build_env(), 5))


@pytest.mark.parametrize("warning", ["CONTACTFULL", "CNSTRFULL"])
def test_episode_ends_when_the_engine_lacks_contact_memory(warning, monkeypatch):
    """MuJoCo by itself would drop the excess contacts, and the plug would penetrate the socket."""
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


def test_engine_bodies_have_the_offsets_of_the_reset():
    env = make_env("BncConnector", station="mujoco", fixture_offset="per_run")
    _, info = env.reset(seed=2)
    station = env.diagram.diagram.GetSubsystemByName("station")
    env.step(np.zeros(2))
    model = station.gantry.engine.model
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


@pytest.mark.parametrize(("applied", "expected"), [(1.0, 0.0), (7.0, -7.0)])  # forces [N]; joint friction of 2 N
def test_constraint_torques_exclude_joint_friction(applied, expected):
    model = mujoco.MjModel.from_xml_string(SLIDER)
    data = mujoco.MjData(model)
    data.qpos[:] = 0.1 if expected else 0.0  # in contact with the box, or at rest by friction
    data.qfrc_applied[:] = applied
    for _ in range(2000):
        mujoco.mj_step(model, data)
    assert data.qfrc_constraint[0] == pytest.approx(-applied, abs=0.05)
    assert constraint_torques(model, data)[0] == pytest.approx(expected, abs=0.05)


class WorkcellWithoutSurfaces:
    """Workcell that does not list its contact surfaces."""


def test_station_raises_when_surfaces_are_missing():
    with pytest.raises(InputError, match="which WorkcellWithoutSurfaces does not provide"):
        MujocoStation(WorkcellWithoutSurfaces())


@pytest.mark.parametrize(
    ("station", "engine"), [(MujocoStation, "mujoco"), (BulletStation, "pybullet"), (PhysxStation, "sapien")]
)
def test_station_raises_when_its_engine_is_missing(station, engine, monkeypatch):
    monkeypatch.setitem(sys.modules, engine, None)
    with pytest.raises(InputError, match=rf'pip install "guiderail\[{engine}\]"'):
        station(CONNECTOR)


def test_engine_step_is_rounded_to_a_fraction_of_the_time_step():
    for given, expected in ((0.0004, 0.01 / 25), (0.003, 0.01 / 3), (None, 0.001)):
        engine = MujocoStation(CONNECTOR, time_step=0.01, engine_step=given).gantry.engine
        assert engine.time_step == engine.model.opt.timestep == pytest.approx(expected)


@pytest.mark.parametrize("control_period", [0.01, 0.02, 0.1])
def test_tool_is_not_faster_than_the_bound_admits(control_period):
    """With a time step of 10 ms, it would be 1.4 times as fast (`LONGEST_STEP`)."""
    force = 20.0
    impedance = Impedance().with_max_force(force)
    station = MujocoStation(CONNECTOR, impedance, control_period=control_period)
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    pose = np.array([0.0, 0.0, 0.03, 0.0, 0.0, 0.0])
    station.get_desired_pose_input_port().FixValue(context, pose + [0.0, 0.0, 0.02, 0.0, 0.0, 0.0])
    station.set_pose(context, pose)
    speeds = []
    for i in range(1, 200):
        simulator.AdvanceTo(i * station.time_step)
        state = station.gantry.get_state_output_port().Eval(station.gantry.GetMyContextFromRoot(context))
        speeds.append(np.linalg.norm(state[6:9]))
    assert 0.9 < max(speeds) * approach_impedance(CONTACT_STIFFNESS, CARRIAGE_MASS) / force < 1.0


def test_parts_with_more_pairs_than_mask_bits_are_refused():
    surface = surfaces_of(CONNECTOR)[0][0]
    fixture = [replace(surface, name=f"surface_{i}", pair=f"pair_{i}") for i in range(31)]
    mujoco_parts(fixture[:30], [], MujocoContact())
    with pytest.raises(InputError, match="at most 30 pairs of surfaces, and the workcell has 31"):
        mujoco_parts(fixture, [], MujocoContact())


def test_disturbed_period_is_a_multiple_of_the_engine_step():
    with pytest.raises(InputError, match=r"whole multiple of the plant's time step of 0\.02 s"):
        make_env("GridClamp", station="mujoco", disturbances={"clock_factor": 1.5}, time_step=0.02)


@pytest.mark.parametrize("workcell", [BncWorkcell, GridClampWorkcell])
def test_all_shapes_are_polyhedra(workcell):
    """MuJoCo's contacts of a cylinder's edge with polyhedra began up to 1.5 mm deep (`surfaces.CYLINDER_SIDES`)."""
    model = MujocoStation(workcell()).gantry.engine.model
    polyhedra = {int(mujoco.mjtGeom.mjGEOM_MESH), int(mujoco.mjtGeom.mjGEOM_BOX)}
    assert set(model.geom_type.tolist()) <= polyhedra


def test_set_pose_raises_when_the_pose_is_not_finite():
    station = MujocoStation(CONNECTOR)
    context, zero = station.CreateDefaultContext(), np.zeros(6)
    invalid = [np.r_[np.nan, zero[1:]], np.r_[zero[1:], -np.inf], zero[1:], [*zero, 0.0], ["a"] * len(zero), None]
    for pose in invalid:
        with pytest.raises(InputError, match="pose must be 6 finite numbers, not"):
            station.set_pose(context, pose)


@pytest.mark.parametrize("time_step", [0.0, -0.01, np.nan])
def test_station_raises_when_the_time_step_is_not_positive(time_step):
    with pytest.raises(InputError, match="whole multiple"):
        MujocoStation(CONNECTOR, time_step=time_step)
