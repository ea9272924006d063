"""Task folder of a plug and a plate: accepted and refused numbers of its file, bounds, models and hold tests."""

import shutil
from contextlib import nullcontext

import gymnasium
import numpy as np
import pytest
import yaml
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.framework import DiagramBuilder

from guiderail.diagrams.envs.config import EnvConfig, stations_of
from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.envs.options import validate_options
from guiderail.diagrams.tasks.insertion import HOLD_DISTANCE
from guiderail.diagrams.tasks.registry import TASKS, environment_id, register_task_folder
from guiderail.models.common.errors import InputError
from guiderail.models.objects.sdf import lathe
from guiderail.models.primitives import Demonstrations
from guiderail.tools.environments import task_named
from guiderail.tools.imports import import_modules
from guiderail_parts.task import load_task_folder, write_workcell
from guiderail_parts.task_file import Bounds, MotionNumbers, read_task_file, task_folder_digest

PART = {"mass": 0.1, "center": [0.0, 0.0, 0.0], "gyration": 0.01}
BY_PHASE = {
    "lower": [[-0.002, -0.002, None, None, None, None], [-0.001, -0.001, None, None, None, None]],
    "upper": [[0.002, 0.002, None, None, None, None], [0.001, 0.001, None, None, None, None]],
    "phases": [0.0, 0.5],
}


@pytest.fixture(autouse=True)
def remove_registrations():
    """Remove the registrations of the test at its end."""
    before = set(TASKS.names())
    yield
    for name in set(TASKS.names()) - before:
        del TASKS._entries[name]
        gymnasium.registry.pop(environment_id(name), None)


def part(name, **changes):
    """Return the entry of a part in the task file, with changed values."""
    return PART | {"visual": f"{name}.obj", "pieces": [{"file": f"{name}.obj", "modulus": 1e9}]} | changes


def write(folder, **changes):
    """Write a task folder, whose task file has changed values; return the folder."""
    folder.mkdir(exist_ok=True)
    for name, low, high, radius in (("plug", 0.0, 0.02, 0.005), ("socket", -0.02, -0.005, 0.015)):
        profile = [(0.0, high), (radius, high), (radius, low), (0.0, low)]
        (folder / f"{name}.obj").write_text(lathe(profile, 6).to_obj())
    t = np.linspace(0.0, 1.0, 51)
    motions = [np.column_stack([a * t, -a * t, 20.0 * (1.0 - t), *3 * [0.01 * a * t]]) * 1e-3 for a in (-0.2, 0, 0.2)]
    Demonstrations(t, motions).save(folder / "demonstrations.npz")
    content = {
        "format": "guiderail task 1",
        "name": f"parts/{folder.name}",
        "plug": part("plug"),
        "socket": part("socket", pieces=[{"file": "socket.obj"}]),
        "motion": {"travel": 0.02, "first_contact": 0.01},
        "demonstrations": {"components": 3},
    }
    (folder / "task.yaml").write_text(yaml.safe_dump(content | changes))
    return folder


def test_commands_satisfy_the_bounds_of_each_phase(tmp_path):
    folder = write(tmp_path / "by_phase", bounds=BY_PHASE)
    env = make_env(str(folder), action_repeat=10, horizon=4)
    env.reset(seed=0)
    done = False
    while not done:
        *_, terminated, truncated, _ = env.step(np.ones(2))
        done = terminated or truncated
    assert np.abs(env.trace.commanded[26:, :2]).max() <= 0.001 + 1e-9
    assert np.abs(env.trace.commanded[:25, :2]).max() > 0.0
    env.close()
    with pytest.raises(InputError, match="needs walls to keep out of"):
        EnvConfig.resolve(str(folder), {"guidance": "safe_residual"})


def with_last_lower_bound(row):
    """Return the bounds by phase with another lower bound in the last phase."""
    return BY_PHASE | {"lower": [BY_PHASE["lower"][0], row]}


@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        (BY_PHASE | {"phases": [0.5, 0.0]}, "begin at 0"),
        (BY_PHASE | {"phases": [0.0, 0.0]}, "increase"),
        (BY_PHASE | {"phases": [0.0, 1.0]}, "below 1"),
        (BY_PHASE | {"phases": None}, "without phases, lower and upper are one list each"),
        (BY_PHASE | {"phases": [0.0]}, "one list for each phase"),
        (with_last_lower_bound([None, -0.001, *[None] * 4]), "in every phase or in none"),
        (with_last_lower_bound([float("nan"), -0.001, *[None] * 4]), "six finite numbers"),
        (with_last_lower_bound([float("inf"), -0.001, *[None] * 4]), "six finite numbers"),
        (with_last_lower_bound([10**400, -0.001, *[None] * 4]), "six finite numbers"),
        (with_last_lower_bound([True, -0.001, *[None] * 4]), "six finite numbers"),
        (with_last_lower_bound(3), "six finite numbers"),
        (BY_PHASE | {"lower": 3}, "tuple"),
        ({"lower": [0.002, *[None] * 5], "upper": [0.001, *[None] * 5]}, "no lower bound may exceed its upper bound"),
    ],
)
def test_bounds_are_refused_when_invalid(bounds, message):
    with pytest.raises(InputError, match=message):
        validate_options(Bounds, bounds, "here")


@pytest.mark.parametrize(
    ("options", "remedy"),
    [
        ({"bound": 0.003}, "between phases: leave it out"),
        ({"difficulty": "hard"}, "give bound=None .* with this difficulty"),
        ({"difficulty": "automate"}, "give bound=None .* with this difficulty"),
    ],
)
def test_bound_with_phases_is_refused_with_its_remedy(options, remedy, tmp_path):
    folder = str(write(tmp_path / "by_phase", bounds=BY_PHASE))
    with pytest.raises(InputError, match=remedy):
        EnvConfig.resolve(folder, options).declared.constraints()
    EnvConfig.resolve(folder, options | {"bound": None}).declared.constraints()


def test_bounds_change_between_phases():
    bounds = Bounds.model_validate(BY_PHASE)
    constraints = bounds.constraints(11)
    corner = np.array([0.0015, 0.0, 9.0, 9.0, 9.0, 9.0])
    assert [constraints.violation(corner, step) <= 0.0 for step in (0, 4, 5, 10)] == [True, True, False, False]


def test_folder_is_the_same_task_until_a_file_changes(tmp_path):
    folder = write(tmp_path / "changed")
    tasks = [load_task_folder(folder)]
    for name in ("task.yaml", "demonstrations.npz", "plug.obj", "socket.obj"):
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content)
        assert load_task_folder(folder) is tasks[-1]
        if name == "demonstrations.npz":
            Demonstrations(np.linspace(0.0, 1.0, 51), 2 * [np.zeros((51, 6))]).save(folder / name)
        else:
            (folder / name).write_bytes(content.replace(b"0.02", b"0.03"))
        tasks.append(load_task_folder(folder))
    assert len(set(tasks)) == 5


def test_demonstrations_are_read_again_when_the_file_changed(tmp_path):
    folder, heights = write(tmp_path / "replaced"), []
    name = register_task_folder(folder)
    for scale in (1.0, 0.5):
        loaded = Demonstrations.load(folder / "demonstrations.npz")
        Demonstrations(loaded.times, [scale * output for output in loaded.outputs]).save(folder / "demonstrations.npz")
        env = make_env(name, guidance="kmp", action_repeat=25)
        env.reset(seed=0)
        env.step(np.zeros(env.action_space.shape))
        heights.append(env.trace.commanded[-1, 2])
        env.close()
    assert heights == pytest.approx([0.0104, 0.0052], abs=2e-4)


def test_second_folder_of_a_name_is_refused_when_different(tmp_path):
    first, copy, changed = (write(tmp_path / name, name="parts/peg") for name in ("first", "copy", "changed"))
    assert [register_task_folder(folder) for folder in (first, copy, first)] == 3 * ["parts/peg"]
    write(changed, name="parts/peg", force_limit=20.0)
    with pytest.raises(InputError, match=f"in {changed} and {first} are both called parts/peg: change 'name:' in"):
        register_task_folder(changed)


def test_measured_clearance_changes_the_digest(tmp_path):
    digests = []
    for clearance, speed in ((0.5, 3.0), (0.5, 4.0), (0.2, 4.0)):
        write(tmp_path / "task", measured={"clearance_mm": clearance, "real_time_factor": speed})
        digests.append(task_folder_digest(tmp_path / "task"))
    assert digests[0] == digests[1] != digests[2], "only the clearance determines the hold tests"


@pytest.mark.parametrize("kind", ["per_run", "none"])
def test_square_of_offsets_requires_sampling_per_episode(tmp_path, kind):
    folder = str(write(tmp_path / "square"))
    assert EnvConfig.resolve(folder, {"difficulty": "automate"}).declared.offsets.is_square
    with pytest.raises(InputError, match="choose fixture_offset=per_episode"):
        EnvConfig.resolve(folder, {"difficulty": "automate", "fixture_offset": kind})


def test_sdf_file_is_written_again_when_damaged(tmp_path):
    folder = write(tmp_path / "damaged")
    workcell = write_workcell(folder, read_task_file(folder))
    content = workcell.sdf("plug").read_bytes()
    workcell.sdf("plug").write_bytes(b"\xff" + content)
    write_workcell(folder, read_task_file(folder))
    assert workcell.sdf("plug").read_bytes() == content


def test_task_has_no_mujoco_station_without_convex_pieces(tmp_path):
    folder = write(tmp_path / "stations")
    assert [name for name in stations_of(load_task_folder(folder)) if name != "hardware"] == ["arm", "gantry"]
    pytest.importorskip("guiderail_mujoco")  # without it, the message names the distribution to install
    with pytest.raises(InputError, match="has no station 'mujoco': choose one of arm, gantry"):
        EnvConfig.resolve(str(folder), {"station": "mujoco"})


def test_task_has_a_mujoco_station_with_convex_pieces(tmp_path):
    pytest.importorskip("guiderail_mujoco.station", reason="needs guiderail-mujoco")
    both = {name: part(name, convex=[f"{name}.obj"]) for name in ("plug", "socket")}
    for number, (parts, has_mujoco) in enumerate(((both, True), ({"plug": both["plug"]}, False))):
        folder = write(tmp_path / f"convex_{number}", **parts)
        assert ("mujoco" in stations_of(load_task_folder(folder))) is has_mujoco
        workcell = EnvConfig.resolve(str(folder), {}).declared.workcell()
        (plug,) = workcell.workpiece_surfaces()
        assert np.ptp(plug.shape.vertices, axis=0)[2] == pytest.approx(0.02)
        with nullcontext() if has_mujoco else pytest.raises(InputError, match=r"the socket .* has no convex pieces"):
            workcell.fixture_surfaces()
    folder = write(tmp_path / "crowded", **both, scenario=["table.dmd.yaml"])
    (folder / "table.dmd.yaml").write_text("directives: []")
    assert "mujoco" not in stations_of(load_task_folder(folder))


def test_scenario_adds_its_models_to_the_plant(tmp_path):
    folder = write(tmp_path / "on_a_table", scenario=["table.dmd.yaml"])
    (folder / "table.sdf").write_text("<sdf version='1.9'><model name='table'><link name='top'/></model></sdf>")
    (folder / "package.xml").write_text("<package><name>surroundings</name></package>")
    model = "{name: table, file: 'package://surroundings/table.sdf'}"
    (folder / "table.dmd.yaml").write_text(f"directives:\n- add_model: {model}\n")
    workcell = EnvConfig.resolve(str(folder), {}).declared.workcell()
    plant, _ = AddMultibodyPlantSceneGraph(DiagramBuilder(), time_step=0.01)
    workcell.add_fixture(plant)
    assert plant.HasModelInstanceNamed("table")


@pytest.mark.parametrize(("travel", "is_accepted"), [(0.01, False), (0.0504, False), (0.0505, True)])
def test_plug_starts_above_the_rim(travel, is_accepted):
    with nullcontext() if is_accepted else pytest.raises(InputError, match="first_contact must be at least"):
        motion = validate_options(MotionNumbers, {"travel": travel, "first_contact": 0.05}, "here")
        for times, _ in (motion.plan_search(), motion.plan_straight_insertion()):
            assert np.diff(times).min() >= 0.0


def test_missing_task_folder_is_named(tmp_path):
    with pytest.raises(InputError, match=f"there is no task folder {tmp_path}/gone: restore it"):
        read_task_file(tmp_path / "gone")
    with pytest.raises(InputError, match=f"there is no file or task folder {tmp_path}/gone to import: restore it"):
        import_modules([str(tmp_path / "gone")])


@pytest.mark.parametrize(
    ("name", "is_accepted"),
    [
        ("plug.obj", True),
        ("meshes/plug (1).obj", True),
        ("../plug.obj", False),
        ("meshes/../../plug.obj", False),
        ("/etc/hostname", False),
        (".hidden", False),
        ('x"/><plugin/>.obj', False),
        ("a&b.obj", False),
        ("a\nb.obj", False),
    ],
)
def test_file_of_a_task_is_refused_outside_its_folder(name, is_accepted, tmp_path):
    folder = write(tmp_path / "task")
    (folder / "meshes").mkdir()
    shutil.copy(folder / "plug.obj", tmp_path)
    if is_accepted and name != "plug.obj":
        shutil.copy(folder / "plug.obj", folder / name)
    tree = yaml.safe_load((folder / "task.yaml").read_text())
    tree["plug"]["visual"] = name
    (folder / "task.yaml").write_text(yaml.safe_dump(tree))
    with nullcontext() if is_accepted else pytest.raises(InputError, match="not a plain path inside"):
        read_task_file(folder)


def test_models_are_written_once_or_failure_is_refused(tmp_path):
    folder = write(tmp_path / "written")
    task = EnvConfig.resolve(str(folder), {}).declared
    assert task.workcell() is task.workcell()
    assert "from task.yaml; change the dimensions there" in (folder / "plug.sdf").read_text()
    assert sorted(path.name for path in folder.glob("*.sdf*")) == ["plug.sdf", "socket.sdf"]
    (folder / "plug.sdf").unlink()
    (folder / "plug.sdf").mkdir()
    with pytest.raises(InputError, match=r"plug\.sdf cannot be written"):
        EnvConfig.resolve(str(folder), {}).declared.workcell()


def test_center_of_mass_is_that_of_the_task_file(tmp_path):
    center = [0.001, -0.002, 0.003]
    folder = write(tmp_path / "centered", plug=part("plug", center=center))
    plant = MultibodyPlant(0.0)
    plug = EnvConfig.resolve(str(folder), {}).declared.workcell().add_workpiece(plant, plant.world_frame())
    np.testing.assert_allclose(plug.default_com(), center)


def test_start_pose_is_within_the_bounds(tmp_path):
    bounds = {"lower": [*[None] * 3, *[-0.01] * 3], "upper": [0.0001, None, 0.0195, *[0.01] * 3]}
    task = EnvConfig.resolve(str(write(tmp_path / "low", bounds=bounds)), {"start_offset_max": 0.002}).declared
    for seed in range(5):
        start = task.start_pose(np.random.default_rng(seed))
        assert task.constraints().violation(start) <= 1e-9
        assert start[2] == pytest.approx(0.0195)


@pytest.mark.parametrize(
    ("learner", "cause"),
    [
        ({"algorithm": "tqx"}, "there is no algorithm 'tqx': did you mean tqc"),
        ({"algorithm": "tqc", "settings": {"symetry": "near"}}, "no setting 'symetry'"),
        ({"settings": {"batch_size": 32}}, None),
        ({}, None),
    ],
)
def test_learner_of_a_task_folder_is_validated_at_loading(learner, cause, tmp_path):
    folder = str(write(tmp_path / "peg", recommended={"learner": learner}))
    message = f"learner in {folder}/task.yaml is invalid: .*{cause}"
    with nullcontext() if cause is None else pytest.raises(InputError, match=message):
        assert task_named(folder)[0] == "parts/peg"


FREE = [None] * 6  # no bound on any output


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"bounds": {"lower": FREE, "upper": [*FREE[:2], -0.1, *FREE[3:]]}}, "exclude the pose of the seated plug"),
        ({"bounds": {"lower": [*FREE[:2], 0.5, *FREE[3:]], "upper": FREE}}, "exclude the pose of the seated plug"),
        ({"bounds": {"lower": [*FREE[:2], 0.019, *FREE[3:]], "upper": FREE}}, "exclude the pose of the seated plug"),
        ({"bounds": {"lower": [0.001, *FREE[1:]], "upper": FREE}}, "exclude the pose of the seated plug"),
        ({"bounds": {"lower": [*FREE[:5], 0.3], "upper": FREE}}, "exclude the pose of the seated plug"),
        ({"bounds": {"lower": FREE, "upper": [*FREE[:2], 0.015, *FREE[3:]]}}, "exclude the demonstrations' start, z"),
        ({"bounds": {"lower": [-2, -2, *FREE[2:]], "upper": [2, 2, *FREE[2:]]}}, "bounds are in meters and radians"),
        ({"tolerance": {"height": 0.5}}, r"height must be less than motion\.first_contact, 0\.01 m"),
        ({"tolerance": {"height": 0.01}}, r"height must be less than motion\.first_contact, 0\.01 m"),
        ({"tolerance": {"steps": 52}}, r"tolerance\.steps in .* is 52, longer than an episode"),
        ({"tolerance": {"lateral": 1.0}}, r"tolerance\.lateral must be at most 0\.01, not 1\.0"),
        (
            {"motion": {"travel": 0.02, "first_contact": 0.0005}},
            r"motion\.first_contact must be more than 0\.0005, not 0\.0005",
        ),
        ({"motion": {"travel": 0.02, "first_contact": 0.01, "push": -1.0}}, r"push must be at least 0, not -1\.0"),
        ({"plug": part("plug", pieces=[{"file": "plug.obj", "friction": 3}])}, r"plug\.pieces\[0\]\.friction must be"),
        ({"motion": {"travel": 0.02}}, r"motion\.first_contact is missing: give it"),
        (
            {"motion": {"travel": 0.02, "first_contact": 0.01, "pusch": 0}},
            r"motion has no option 'pusch': did you mean push",
        ),
        ({"recommended": {"learner": {"algoritm": "tqc"}}}, "there is no key 'algoritm': did you mean algorithm"),
        ({"recommended": {"learner": {"algorithm": 3}}}, r"recommended\.learner cannot .*: algorithm must be a name"),
        (
            {"bounds": {"lower": [0.002, *FREE[1:]], "upper": [0.001, *FREE[1:]]}},
            r"edited/task\.yaml is invalid: bounds cannot be .*: no lower bound may",
        ),
        ({"motion": {"first_contact": 0.01}}, r"motion\.travel is missing"),
        ({"plug": part("plug", pieces=[{"file": "plug.obj", "modulus": -1.0}])}, r"plug\.pieces\[0\]\.modulus must be"),
        ({"plug": part("plug", center="middle")}, r"plug\.center must be 3 numbers, such as .*, not 'middle'"),
        ({"place": [0.5]}, r"place must be 3 numbers, such as 0.55,0,0.15, not \[0.5\]"),
        ({"measured": {"clearance_mm": "abc"}}, "clearance_mm must be a number from 0 to 500, or null"),
        ({"measured": {"clearance_mm": -5}}, "clearance_mm must be a number from 0 to 500, or null"),
        ({"measured": {"clearance_mm": 10**400}}, "clearance_mm must be a number from 0 to 500, or null"),
    ],
)
def test_task_file_is_refused_when_a_value_is_invalid(changes, message, tmp_path):
    with pytest.raises(InputError, match=message):
        EnvConfig.resolve(str(write(tmp_path / "edited", **changes)), {})


def test_bounds_at_the_command_of_a_push_are_accepted(tmp_path):
    # At the end, the demonstrated command is 4 mm below the seated pose.
    upper = [[*row[:2], height, *row[3:]] for row, height in zip(BY_PHASE["upper"], (0.03, -0.003), strict=True)]
    folder = write(tmp_path / "accepted", bounds=BY_PHASE | {"upper": upper}, tolerance={"steps": 51})
    assert EnvConfig.resolve(str(folder), {}).declared.file.tolerance.steps == 51


def test_scene_has_the_box_of_each_phase(tmp_path):
    lower, upper = [[-0.001, -0.003], [0.0, -0.003]], [[0.002, 0.001], [0.0005, 0.001]]
    bounds = {"lower": [[*row, *FREE[2:]] for row in lower], "upper": [[*row, *FREE[2:]] for row in upper]}
    task = EnvConfig.resolve(str(write(tmp_path / "phases", bounds=bounds | {"phases": [0.0, 0.5]})), {}).declared
    edges = np.array(task.scene().constraint) - task.file.place
    for number, box in enumerate(np.split(edges, 2)):
        np.testing.assert_allclose(box.min(axis=(0, 1)), [*lower[number], 0.0], atol=1e-12)
        np.testing.assert_allclose(box.max(axis=(0, 1)), [*upper[number], 0.02], atol=1e-12)
    task = EnvConfig.resolve(
        str(write(tmp_path / "open", bounds={"lower": [0.0, *5 * [None]], "upper": 6 * [0.1]})), {}
    ).declared
    assert task.scene().constraint == ()
    task = EnvConfig.resolve(str(write(tmp_path / "replaced")), {"bound": 0.0035}).declared
    assert np.ptp(np.array(task.scene().constraint)[..., 0]) == pytest.approx(0.007)


def test_success_on_hardware_is_estimated_from_height_and_turn(tmp_path):
    task = EnvConfig.resolve(str(write(tmp_path / "hardware")), {"reward": "shaped"}).declared
    D, y0 = task.observable_success()
    np.testing.assert_array_equal(D @ [1.0, 2.0, 3.0, 4.0, 5.0, 6.0] + y0, [0.0, 0.0, 3.0, 0.0, 0.0, 4.0])
    assert "aligned" in task.simulated_rewards


@pytest.mark.parametrize(
    ("x", "clearance", "pushes"),
    [
        (0.0, 0.1, [(2.0, 0.0), (-2.0, 0.0), (0.0, 2.0), (0.0, -2.0)]),
        (1.0, 0.1, [(-3.0, 0.0), (0.0, 2.0), (0.0, -2.0)]),  # +x is 1 mm from the bound
        (1.0, 0.3, [(-3.0, 0.0)]),
        (0.0, 50.0, []),
        (0.0, None, [(2.0, 0.0), (-2.0, 0.0), (0.0, 2.0), (0.0, -2.0)]),
    ],
)
def test_pushes_of_a_hold_test_are_within_the_bounds(x, clearance, pushes, tmp_path):
    folder = write(
        tmp_path / "pushed",
        bounds={"lower": [-0.002, -0.002, *4 * [None]], "upper": [0.002, 0.002, *4 * [None]]},
        measured={"clearance_mm": clearance},
    )
    task = EnvConfig.resolve(str(folder), {}).declared
    pose = np.array([1e-3 * x, 0.0, 0.0, 0.0, 0.0, 0.0])
    tests = task.hold_tests(pose)
    assert [tuple(1e3 * displacement for displacement in test.displacement[:2]) for test in tests] == [
        pytest.approx(push, abs=1e-6) for push in pushes
    ]
    for test in tests:
        assert test.displacement[2] == 0.0
        assert np.linalg.norm(test.displacement) > test.max_motion  # a plug next to the socket moves farther
        assert (
            task.constraints().violation(pose + [*test.displacement, 0.0, 0.0, 0.0], task.reference().num_steps) <= 1e-9
        )


def test_turned_plug_is_pulled_by_the_hold_test(tmp_path):
    task = EnvConfig.resolve(
        str(write(tmp_path / "turned", motion={"travel": 0.02, "first_contact": 0.01, "turn": 30.0})), {}
    ).declared
    assert [test.displacement for test in task.hold_tests(np.zeros(6))] == [(0.0, 0.0, HOLD_DISTANCE)]
