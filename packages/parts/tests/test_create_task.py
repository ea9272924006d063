"""Command `create-task`: task folders of two meshes, their checks, difficulties, search and fitted bounds."""

import json
import shutil
from contextlib import contextmanager, nullcontext
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import yaml

from guiderail.diagrams.envs.config import EnvConfig, stations_of
from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.envs.options import validate_options
from guiderail.diagrams.tasks.insertion import CENTER_OF_PRESSURE_SCALE, InsertionReset
from guiderail.diagrams.tasks.registry import TASKS, environment_id
from guiderail.models.common import files as common_files
from guiderail.models.common.errors import InputError
from guiderail.models.primitives import Demonstrations, mixture
from guiderail.tools.cli.main import main
from guiderail.tools.environments import task_named
from guiderail.tools.evaluation.baselines import find_scripted_policy
from guiderail.tools.learning.run_folder import RunFolder, configure
from guiderail.tools.learning.train import train
from guiderail_parts import contact, contact_map, difficulty, trial
from guiderail_parts import create_task as create_task_module
from guiderail_parts.contact import rank
from guiderail_parts.contact_map import ContactMap
from guiderail_parts.create_task import ask_unit, create_task, read_parts
from guiderail_parts.geometry import demonstrator
from guiderail_parts.task import (
    BLOCKED,
    CENTER_OF_PRESSURE,
    COMMAND,
    FOLLOWING,
    TIME,
    ScriptedSearch,
    Z,
    load_task_folder,
)
from guiderail_parts.task_file import Bounds, MotionNumbers, PartTaskFile, read_task_file

pytest.importorskip("trimesh")
pytest.importorskip("manifold3d")

from oracles.parts import PARTS, screw

RUN = {}
SMALL_LEARNER = "--set", "net_arch=8", "--set", "gradient_steps=1"


@pytest.fixture(autouse=True)
def new_run():
    """Clear the hidden values of a run before each test."""
    RUN.clear()


def call(*arguments, code=0):
    """Run the command line, and assert its exit code."""
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    assert end.value.code == code


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return the task folder of a square peg, the drawn part that is simulated fastest."""
    parent = tmp_path_factory.mktemp("parts")
    plug, socket = PARTS["square_peg"]().write(parent)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(contact, "MIN_SPEED", 0.0)  # no other contact is tried on a slow machine
        patch.setattr(contact_map, "TOUCHES", 20)
        patch.setattr(mixture, "_MAX_COMPONENTS", 4)
        call("create-task", plug, socket, "--unit", "mm", "--out", parent / "peg", "--hard-episodes", 1, "--json")
    yield parent / "peg"
    # The task must not be registered in other tests.
    for name in [name for name in TASKS.names() if name.startswith("parts/")]:
        del TASKS._entries[name]
        gymnasium.registry.pop(environment_id(name), None)


def test_measured_properties_agree_with_the_drawing(folder):
    measured = yaml.safe_load((folder / "task.yaml").read_text())["measured"]
    assert measured["clearance_mm"] == pytest.approx(0.1, abs=1e-3)
    assert measured["inserted"] is True
    assert measured["blocked_1.5_mm_off"] == [True, True]
    assert max(measured["penetration_mm"], measured["penetration_pushed_on_the_rim_mm"]) <= 0.05
    assert measured["demonstrations_seated"] == "10 of 10"
    assert measured["drag"] == pytest.approx(0.2, rel=0.15)
    assert read_task_file(folder).demonstrations.components > 1
    page = (folder / "preview.html").read_text()
    assert "plug" in page
    assert len(page) > 100_000


def test_scenarios_with_conflicting_names_are_refused(tmp_path):
    plug, socket = PARTS["square_peg"]().write(tmp_path)
    for name in (
        "a/table.dmd.yaml",
        "b/table.dmd.yaml",
        "a/table.yaml",
        "a/plug.obj",
        "a/b,c.dmd.yaml",
        "a/b#c.dmd.yaml",
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("directives: []\n")
    for names, message in (
        (("a/table.dmd.yaml", "b/table.dmd.yaml"), "two scenarios are called table.dmd.yaml"),
        (("a/table.yaml",), "is not a scenario: name a .dmd.yaml file"),
        (("a/plug.obj",), "is not a scenario"),
        (("a/b,c.dmd.yaml",), "has a comma in its name"),
        (("a/b#c.dmd.yaml",), "a scenario's name is letters, digits, .* and not 'b#c.dmd.yaml'"),
    ):
        with pytest.raises(InputError, match=message):
            create_task(plug, socket, tmp_path / "peg", unit="mm", scenario=[tmp_path / name for name in names])
    assert not (tmp_path / "peg").exists()


def test_create_task_refuses_a_folder_below_a_file(tmp_path):
    plug, socket = PARTS["square_peg"]().write(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot be written"):
        create_task(plug, socket, tmp_path / "file" / "peg", unit="mm")


def test_unit_is_asked_for_on_standard_error(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sys.stdin", SimpleNamespace(isatty=lambda: True, readline=lambda: "cm\n"))
    files = [tmp_path / "plug.stl", tmp_path / "socket.stl"]
    assert ask_unit(files, None) is None, "the unit is asked for missing files"
    for file in files:
        file.touch()
    assert ask_unit(files, None) == "cm"
    assert capsys.readouterr().out == ""


def test_rank_prefers_seating_then_allowed_depth_then_speed():
    def key(seats, deepest, speed):
        return rank(SimpleNamespace(aligned=SimpleNamespace(success=seats), deepest=deepest, speed=speed), 1e-4)

    # From the best to the worst, with an allowed penetration of 0.1 mm.
    keys = {
        "allowed and fast": key(True, 0.9e-4, 3.0),
        "allowed and slow": key(True, 0.2e-4, 2.5),
        "10 % too deep": key(True, 1.1e-4, 2.1),
        "130 % too deep and fast": key(True, 2.3e-4, 4.4),
        "5 % too deep and too slow": key(True, 1.05e-4, 1.4),
        "not seated": key(False, 0.1e-4, 9.0),
    }
    assert sorted(keys, key=keys.get, reverse=True) == list(keys)


def test_task_of_a_study_may_be_a_task_folder(folder, tmp_path, monkeypatch):
    declaration = pytest.importorskip("guiderail_studies.declaration", reason="needs guiderail-studies")
    file = tmp_path / "study.yaml"
    file.write_text("{name: short, task: ./peg, methods: {random: {policy: uniform_random}}, seeds: [0]}")
    monkeypatch.chdir(folder.parent)
    study = declaration.load_study(file)
    assert (study.task, study.imports) == ("parts/peg", (str(folder.resolve()),))


def test_page_shows_an_episode_of_a_created_task(folder, tmp_path):
    call("visualize", folder, "--policy", "zero", "--episodes", 1, "--html", tmp_path / "page.html")
    assert (tmp_path / "page.html").stat().st_size > 100_000


def test_created_task_has_its_own_learner_and_symmetry(folder):
    name, _ = task_named(str(folder))
    recommended = yaml.safe_load((folder / "task.yaml").read_text())["recommended"]
    config = configure(name, {}, **{"settings": {"batch_size": 32}})
    for key, value in recommended["environment"].items():
        assert config.environment[key] == (tuple(value) if isinstance(value, list) else value)
    assert (config.learner.symmetry, config.learner.batch_size) == ("near", 32)
    task = EnvConfig.resolve(name, {}).declared
    assert task.symmetries()[0].actions.shape == (
        7,
        6,
        6,
    )  # a square has eight symmetries, one of which is the identity
    changed = yaml.safe_load((folder / "task.yaml").read_text())
    for wrong in ({"sides": ["upside down"]}, {"time_step": 0.003}):
        with pytest.raises(InputError, match=next(iter(wrong))):
            validate_options(PartTaskFile, changed | wrong, "task.yaml")


def test_difficulties_of_a_created_task_bound_offset_command(folder):
    hard = yaml.safe_load((folder / "task.yaml").read_text())["hard"]
    (low, high), turn = hard["offset_range"], hard["fixture_turn"]
    assert 0.0 < turn < 2.0  # [°]; 0.1 mm of clearance at a radius of 7 mm is 0.8°
    for name, is_inside, bound in (
        ("hard", lambda x, y, z: low <= np.hypot(x, y) <= high and abs(z) <= np.deg2rad(turn), hard["bound"]),
        ("automate", lambda x, y, z: max(abs(x), abs(y)) <= 2e-3 and abs(z) <= np.deg2rad(5.0), 3.5e-3),
    ):
        task = EnvConfig.resolve(str(folder), {"difficulty": name}).declared
        rng = np.random.default_rng(0)
        offsets = np.array([task.offsets.draw(rng, InsertionReset(), RUN)[0] for _ in range(200)])
        assert all(is_inside(*offset) for offset in offsets)
        assert (np.ptp(offsets[:, :2], axis=0) > 0.9 * 2.0 * min(high, 2e-3)).all()
        np.testing.assert_allclose(task.constraints().nearest(np.full(6, 9e-3))[:3], [bound, bound, 9e-3])
    assert np.hypot(*offsets[:, :2].T).max() > 2e-3, "no sample in the corners of the square"


def test_hard_is_calibrated_with_a_single_episode(folder):
    tree = yaml.safe_load((folder / "task.yaml").read_text())
    result, hard = tree["measured"]["hard"], tree["hard"]
    assert (
        result["force_limit"] == hard["force_limit"] == min(35.0, max(10.0, np.ceil(2.5 * tree["measured"]["force"])))
    )
    assert hard["guidance"] == "kgrl"
    for policy in ("uniform_random", "scripted"):
        successes, episodes = map(int, result[policy].split(" of "))
        assert 0 <= successes <= episodes <= 1


def test_parts_of_convex_pieces_are_simulated_in_mujoco(folder):
    pytest.importorskip("guiderail_mujoco.station", reason="needs guiderail-mujoco")
    file = read_task_file(folder)
    assert "mujoco" in stations_of(load_task_folder(folder))
    assert len(file.plug.convex) >= 1
    assert len(file.socket.convex) >= 5  # four walls and the bottom
    assert trial.insert_in_mujoco(folder, file) == (True, False)
    assert trial.insert_in_mujoco(folder, file, 2e-3) == (False, True)
    assert trial.insert_in_mujoco(folder, with_floor_only(folder, file), 2e-3) == (False, False)
    env = make_env(str(folder), station="mujoco", guidance="kgrl")
    env.reset(seed=0, options={"offset": (0.0, 0.0)})
    done = False
    while not done:
        *_, terminated, done, info = env.step(np.zeros(2))
        done = done or terminated
    env.close()
    assert info["is_success"]


def with_floor_only(folder, file):
    """Return the task file with the lowest convex piece of the socket and without its walls."""

    def highest(name):
        lines = (folder / name).read_text().splitlines()
        return max(float(line.split()[3]) for line in lines if line.startswith("v "))

    floor = min(file.socket.convex, key=highest)
    pieces = (file.socket.pieces[0].model_copy(update={"file": floor}),)
    return file.model_copy(update={"socket": file.socket.model_copy(update={"convex": (floor,), "pieces": pieces})})


@pytest.mark.parametrize("offset", [0.0, 1.5e-3])
def test_offset_plug_is_blocked_only_by_the_walls(folder, offset):
    pytest.importorskip("guiderail_mujoco", reason="a task has convex pieces only with guiderail-mujoco")
    file = read_task_file(folder)
    with_walls = trial.insert(folder, file, offset=(offset, 0.0))
    assert (with_walls.success, with_walls.is_blocked) == (offset == 0.0, offset > 0.0)
    without_walls = trial.insert(folder, with_floor_only(folder, file), offset=(offset, 0.0))
    assert (without_walls.success, without_walls.is_blocked) == (offset == 0.0, False)


@pytest.mark.parametrize("offset", [0.0, 1.5e-3])
def test_real_time_factor_counts_only_simulated_time(folder, monkeypatch, offset):
    """The factor is 1 if the CPU time is replaced by the simulated time."""
    contexts = []

    class RecordedStation(trial.DrivenStation):
        def __init__(self, *arguments, **keywords):
            super().__init__(*arguments, **keywords)
            contexts.append(self.context)

    monkeypatch.setattr(trial, "DrivenStation", RecordedStation)
    monkeypatch.setattr(trial, "time", SimpleNamespace(process_time=lambda: contexts[0].get_time()))
    file = read_task_file(folder)
    result = trial.insert(folder, file, offset=(offset, 0.0))
    is_complete = contexts[0].get_time() == pytest.approx(file.motion.plan_straight_insertion()[0][-1], abs=0.02)
    assert (result.success, is_complete) == (offset == 0.0, offset == 0.0)
    assert result.real_time_factor == pytest.approx(1.0)


def test_seated_plug_may_be_turned_by_up_to_20_degrees(folder):
    task = EnvConfig.resolve(str(folder), {}).declared
    turned = [task.file.tolerance.accepts(np.array([*[0.0] * 5, np.deg2rad(turn)])) for turn in (19.0, 21.0)]
    assert turned == [True, False]


def test_bound_is_refused_when_the_file_has_phases(folder, monkeypatch):
    task = EnvConfig.resolve(str(folder), {"bound": 3e-3}).declared
    lower, upper = ((x, x, *[None] * 4) for x in (-1e-3, 1e-3))
    phases = Bounds.model_validate({"lower": (lower,) * 2, "upper": (upper,) * 2, "phases": (0.0, 0.5)})
    monkeypatch.setattr(type(task), "file", task.file.model_copy(update={"bounds": phases}))
    with pytest.raises(InputError, match="bound replaces constant bounds"):
        task.constraints()


def test_scripted_search_integrates_the_center_of_pressure(folder):
    file = read_task_file(folder)
    assert file.search.lever_sign == -1  # the rim supports the outer edge of a peg
    search, observation = ScriptedSearch(file, lambda: 2.0), np.zeros(17)
    observation[CENTER_OF_PRESSURE] = 1.0, 0.0

    def act(time, height):
        observation[TIME], observation[Z] = time - 1.0, height / (0.5 * file.motion.travel) - 1.0
        return search(observation)

    on_rim, inserted = file.motion.first_contact, 0.5 * file.motion.first_contact
    step = 0.1 * file.search.speed
    for time, height, x in (
        (0.0, on_rim, 0.0),
        (0.1, on_rim, -step),
        (0.2, on_rim, -2 * step),
        (0.3, inserted, -2 * step),
    ):
        np.testing.assert_allclose(act(time, height), [x, 0.0], atol=1e-12)
    np.testing.assert_array_equal(act(1.9, on_rim), [-1.0, 0.0])  # limit of an action
    np.testing.assert_array_equal(act(0.0, on_rim), [0.0, 0.0])  # a new episode
    with pytest.raises(InputError, match="needs the center of pressure"):
        search(observation[:13])


def test_scripted_search_follows_the_plug_below_the_rim(folder):
    file = read_task_file(folder)
    times, poses = file.motion.plan_search()
    inserted, duration = 0.5 * file.motion.first_contact, times[-1]
    grid = np.arange(0.0, duration, 0.01)
    time = grid[
        np.argmax(np.interp(grid, times, poses[:, 2]) < inserted)
    ]  # [s] when the demonstrated command is below the rim
    search, observation = ScriptedSearch(file, lambda: duration), np.zeros(17)
    observation[CENTER_OF_PRESSURE] = 1.0, 0.0

    def act(time, height):
        observation[TIME], observation[Z] = 2.0 * time / duration - 1.0, height / (0.5 * file.motion.travel) - 1.0
        return search(observation)[0]

    act(0.0, file.motion.travel)
    act(time - 0.1, inserted)
    start = act(time - 0.05, inserted)
    observation[COMMAND] = 0.5, 0.0  # the position of the plug is 0
    assert act(time, inserted) - start == pytest.approx(-0.05 * FOLLOWING * 0.5)  # towards the plug
    start = act(time, inserted)
    assert act(time + 0.05, inserted + BLOCKED + 1e-3) - start == pytest.approx(-0.05 * file.search.speed)  # blocked


@contextmanager
def few_demonstrations(number=3, misaligned=1):
    """Record few demonstrations, try one contact at `misaligned` misalignments, cut no pieces for MuJoCo.

    Also touch only 4 times for the map, and fit a single component; the task of `folder` has all of them.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(contact, "MAX_TRIALS", 1)
        patch.setattr(contact, "MIN_SPEED", 0.0)  # no other contact is tried on a slow machine
        for module in (contact, create_task_module):
            patch.setattr(module, "MISALIGNMENTS", contact.MISALIGNMENTS[:misaligned])
        patch.setattr(trial, "add_convex_pieces", lambda folder, file, *_: file)
        patch.setattr(demonstrator, "_ANGLES", demonstrator._ANGLES[:number])
        patch.setattr(demonstrator, "NUM_DEMONSTRATIONS", number)
        patch.setattr(create_task_module, "NUM_DEMONSTRATIONS", number)
        patch.setattr(contact_map, "TOUCHES", 4)
        patch.setattr(mixture, "_MAX_COMPONENTS", 1)
        yield


@pytest.fixture(scope="module")
def turning(tmp_path_factory):
    """Return the task folder of the square peg with an unknown turn of the socket of up to 4.5°."""
    parent = tmp_path_factory.mktemp("turning")
    plug, socket = PARTS["square_peg"]().write(parent)
    with few_demonstrations(), pytest.MonkeyPatch.context() as patch:
        # The first setting is accepted without episodes.
        patch.setattr(difficulty, "score_setting", lambda *arguments: difficulty.Score(0, 1, 1, 1))
        create_task(plug, socket, parent / "turning_peg", unit="mm", search_turn=4.5, hard_episodes=1)
    return parent / "turning_peg"


def test_unknown_turn_is_demonstrated_and_reached_by_actions(turning):
    task = EnvConfig.resolve(str(turning), {"difficulty": "hard"}).declared
    rng = np.random.default_rng(0)
    turns = np.rad2deg([task.offsets.draw(rng, InsertionReset(), RUN)[0][2] for _ in range(200)])
    assert 4.3 < np.abs(turns).max() <= 4.5
    assert list(task.defaults["action_dims"]) == [0, 1, 3]
    limit = np.rad2deg(task.constraints().nearest(np.full(6, 1.0))[3])
    assert limit == pytest.approx(6.75)  # [°]; 1.5 times the unknown turn
    outputs = np.array(Demonstrations.load(turning / "demonstrations.npz").outputs)
    assert np.rad2deg(outputs[:, -1, 3].std()) > 2.5
    assert task.symmetries()[0] is None  # a reflection would reverse the turn


def test_scripted_search_turns_a_blocked_plug_back_and_forth(turning):
    file = read_task_file(turning)
    search, observation = ScriptedSearch(file, lambda: 20.0), np.zeros(17)
    observation[CENTER_OF_PRESSURE] = 1.0, 0.0
    observation[Z] = file.motion.first_contact / (0.5 * file.motion.travel) - 1.0
    turns = []
    for time in np.arange(0.0, 20.0, 0.1):
        observation[TIME] = 0.1 * time - 1.0
        turns.append(search(observation)[2])
    assert (min(turns), max(turns)) == (-1.0, 1.0)
    assert np.abs(np.diff(turns)).max() <= 0.1 * file.search.turn_speed + 1e-9
    observation[TIME] = -1.0
    np.testing.assert_array_equal(search(observation), np.zeros(3))  # a new episode


def test_screw_is_inserted_by_a_turn_with_its_pitch(tmp_path, capsys, monkeypatch):
    part = screw()
    arguments = [*part.write(tmp_path), "--unit", "mm", "--hard-episodes", "0", "--out", tmp_path / "screw"]
    monkeypatch.setattr(trial, "MAX_SESSIONS", 1)  # a single attempt at each demonstration, of which one seats the plug
    with few_demonstrations(2, misaligned=0):  # no rim blocks the shaft of a screw that is 1.5 mm off
        call("create-task", *arguments, *part.options)
    assert "1 of 2" in capsys.readouterr().out
    file = read_task_file(tmp_path / "screw")
    assert (file.motion.turn, file.motion.advance) == (pytest.approx(-180.0), pytest.approx(4e-3))
    assert file.measured["inserted"]
    assert file.measured["penetration_mm"] < 0.5 * file.measured["clearance_mm"]
    with pytest.raises(ValueError, match="the advance must be more than"):
        MotionNumbers.model_validate({"travel": 0.02, "first_contact": 0.004, "turn": -180.0, "advance": 0.004})


def test_search_turn_is_refused_when_out_of_range(tmp_path):
    for turn in (-1.0, 10.1, np.nan):
        with pytest.raises(InputError, match="--search-turn is from 0 to 10 degrees"):
            create_task(tmp_path / "a.stl", tmp_path / "b.stl", tmp_path / "peg", unit="mm", search_turn=turn)


@pytest.mark.parametrize("pose", [(0.0, 0.0, 1.0), (0.0,) * 7, (np.nan,) * 6, ()])
def test_plug_pose_is_refused_when_not_six_numbers(pose, tmp_path):
    with pytest.raises(InputError, match="--plug-pose is 6 finite numbers"):
        create_task(tmp_path / "a.stl", tmp_path / "b.stl", tmp_path / "peg", unit="mm", plug_pose=pose)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"turn": "a"}, "--turn must be a number, not 'a'"),
        ({"shrink": None}, "--shrink must be a number, not None"),
        ({"hard_episodes": 2.5}, "--hard-episodes must be a whole number from 0 to 100, not 2.5"),
        ({"plug": 5}, "the plug must be the path of a file or folder, not 5"),
        ({"scenario": ["missing.dmd.yaml"]}, "there is no scenario missing.dmd.yaml"),
        ({"center": (0.0, 0.0)}, r"--center is 3 numbers, not \(0.0, 0.0\)"),
        ({"center": "0,0,0"}, "--center is not an array of numbers"),
        ({}, "there is no mesh .*a.stl"),
    ],
)
def test_argument_is_refused_when_its_type_is_wrong(arguments, message, tmp_path):
    paths = {name: str(tmp_path / name) for name in ("plug", "socket", "out")} | {"plug": str(tmp_path / "a.stl")}
    with pytest.raises(InputError, match=message):
        create_task(**(paths | {"socket": str(tmp_path / "b.stl"), "unit": "mm"} | arguments))


@pytest.mark.parametrize(("seats", "expected"), [(True, (4, 4)), (False, (0, 2))])
def test_demonstrations_are_not_counted_after_the_time_limit(seats, expected, folder, tmp_path, monkeypatch):
    clock = iter(range(0, 1000, 9))  # CPU time [s]; the fifth check would begin after the limit of 45 s
    monkeypatch.setattr(trial, "time", SimpleNamespace(process_time=lambda: next(clock)))
    monkeypatch.setattr(trial, "_seats", lambda *arguments: seats)
    assert trial.demonstrate(tmp_path, read_task_file(folder)) == expected


@pytest.mark.parametrize(
    ("counts", "stored", "sentences"),
    [
        ((10, 10), "10 of 10", []),
        ((9, 10), "9 of 10", ["only 9 of 10 checked demonstrations"]),
        ((4, 4), "4 of 4, 6 unchecked", ["6 of 10 demonstrations are not checked"]),
        ((0, 3), None, []),
    ],
)
def test_unchecked_demonstrations_are_not_reported_as_failed(counts, stored, sentences, folder, tmp_path, monkeypatch):
    monkeypatch.setattr(trial, "demonstrate", lambda folder, file: counts)
    monkeypatch.setattr(trial, "num_components", lambda folder, file: 3)
    monkeypatch.setattr(trial, "write_preview", lambda *arguments: None)
    file, choice, logged = read_task_file(folder), SimpleNamespace(aligned=None), []
    shutil.copy(folder / file.plug.visual, tmp_path)
    refusal = pytest.raises(InputError, match="none of the 3 checked demonstrations seats the plug")
    with refusal if stored is None else nullcontext():
        measured = create_task_module._write_task(
            tmp_path, file, choice, {"real_time_factor": 1.0, "force": 6.0}, 0, 0.0, logged.append
        )
        assert measured["demonstrations_seated"] == stored
        written = yaml.safe_load((tmp_path / "task.yaml").read_text())
        assert written["recommended"]["environment"]["force_limit"] == 15.0  # 2.5 times the force
    assert all(text.startswith(start) for text, start in zip(logged[1:], sentences, strict=True))


@pytest.fixture
def task_file(folder):
    """Yield the task file, and restore its text after the test."""
    file = folder / "task.yaml"
    text = file.read_text()
    yield file
    file.write_text(text)


def test_options_of_a_created_task_are_listed(folder, capsys):
    call("list", folder)
    assert "offset_range" in capsys.readouterr().out


def test_fitted_bounds_are_written_to_the_task_file(folder, task_file, capsys):
    pytest.importorskip("guiderail_data", reason="needs guiderail-data")
    call("dataset", "fit-bounds", folder / "demonstrations.npz", "--phases", 3, "--outputs", "0,1", "--task", folder)
    assert str(task_file) in capsys.readouterr().out.splitlines()[-1]
    constraints = EnvConfig.resolve(str(folder), {}).declared.constraints()
    assert constraints.G.shape[0] > 1
    np.testing.assert_array_equal(constraints.G[0, [0, 2], :2], np.eye(2))
    env = make_env(str(folder), horizon=4)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()


def test_fitted_bounds_are_refused_when_excluding_the_target(folder, tmp_path, capsys):
    pytest.importorskip("guiderail_data", reason="needs guiderail-data")
    before = (folder / "task.yaml").read_text()
    demonstrations = Demonstrations.load(folder / "demonstrations.npz")
    shifted = [outputs + [0.005, *[0.0] * 5] for outputs in demonstrations.outputs]
    Demonstrations(demonstrations.times, shifted).save(tmp_path / "shifted.npz")
    call("dataset", "fit-bounds", tmp_path / "shifted.npz", "--outputs", "0,1", "--task", folder, code=2)
    assert "exclude the pose of the seated plug" in capsys.readouterr().err
    assert (folder / "task.yaml").read_text() == before


def test_task_is_unchanged_when_bounds_cannot_be_written(folder, monkeypatch, capsys):
    pytest.importorskip("guiderail_data", reason="needs guiderail-data")

    def fail(*paths):
        raise OSError(28, "No space left on device")

    before = (folder / "task.yaml").read_text()
    monkeypatch.setattr(common_files.os, "replace", fail)
    call("dataset", "fit-bounds", folder / "demonstrations.npz", "--task", folder, code=2)
    assert "cannot be written" in capsys.readouterr().err
    assert (folder / "task.yaml").read_text() == before


def test_task_is_unchanged_when_bounds_cannot_be_drawn(folder, tmp_path, monkeypatch, capsys):
    pytest.importorskip("guiderail_data", reason="needs guiderail-data")

    def fail(*_):
        raise InputError("no room")

    before = (folder / "task.yaml").read_text()
    monkeypatch.setattr("guiderail_data.validate._draw", fail)
    args = ("--draw", tmp_path / "bounds.png", "--out", tmp_path / "bounds.yaml", "--task", folder)
    call("dataset", "fit-bounds", folder / "demonstrations.npz", *args, code=2)
    assert (folder / "task.yaml").read_text() == before
    assert not (tmp_path / "bounds.yaml").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("force_limit: 35.0", "force_limit: -3"), "force_limit must be at least 1"),
        (lambda text: text.replace("file: plug_0.obj", "file: gone.obj"), "names gone.obj"),
        (lambda text: text.replace("place:", "plaze:"), "did you mean place?"),
        (lambda text: "format: other\n", "is no task"),
    ],
)
def test_task_file_is_refused_when_edited_incorrectly(change, message, folder, task_file, capsys):
    task_file.write_text(change(task_file.read_text()))
    call("list", folder, code=2)
    assert message in capsys.readouterr().err


def test_create_task_refuses_wrong_arguments(folder, tmp_path, capsys):
    plug, socket = PARTS["bayonet"]().write(tmp_path)
    for arguments, message in (
        ((), "does not say its unit"),
        (("--unit", "ell"), "there is no unit"),
        (("--unit", "mm"), "does not pass the socket"),
        (("--unit", "mm", "--axis", "z"), "--axis is one of"),
        (("--unit", "mm", "--plug-pose", "1,2"), "--plug-pose takes 6 numbers"),
        (("--unit", "mm", "--plug-pose", "1e9,0,0,0,0,0"), "mm apart: draw them assembled"),
        (("--unit", "mm", "--center", "1e9,0,0"), "is not near the plug"),
        (("--unit", "mm", "--turn", "181"), "--turn is at most 180"),
        (("--unit", "mm", "--turn", "nan"), "--turn is at most 180"),
        (("--unit", "mm", "--pitch", "2"), "give --turn, too"),
        (("--unit", "mm", "--pitch", "nan", "--turn", "40"), "--pitch is at most 100 mm either way, not nan"),
        (("--unit", "mm", "--pitch", "2", "--turn", "40"), "a right-handed screw (--pitch above 0) enters with --turn"),
        (("--unit", "mm", "--pitch", "-99", "--turn", "60"), "give a smaller --turn or --pitch"),
        (("--unit", "mm", "--force-limit", "0"), "--force-limit is from 1 to 60 N"),
        (("--unit", "mm", "--force-limit", "10001"), "--force-limit is from 1 to 60 N"),
        (("--unit", "mm", "--out", tmp_path / ("n" * 300)), "check it"),
        (("--unit", "mm", "--out", folder), "already exists"),
        (("--unit", "mm", "--shrink", "9"), "--shrink is from 0 to 0.5 mm, not 9"),
        (("--unit", "mm", "--friction", "5"), "friction must be at most 2, not 5"),
        (("--unit", "mm", "--scenario", tmp_path / "none.yaml"), "there is no scenario"),
    ):
        out = () if "--out" in arguments else ("--out", tmp_path / "task")
        call("create-task", plug, socket, *out, *arguments, code=2)
        assert message in capsys.readouterr().err
        assert sorted(path.name for path in tmp_path.iterdir()) == ["plug.stl", "socket.stl"]


def test_axis_and_plug_pose_transform_the_parts(tmp_path):
    """Parts drawn along x, with a distance between plug and socket, have the same bounds in the target frame."""
    plug, socket = PARTS["square_peg"]().write(tmp_path)
    upright = read_parts(plug, socket, "mm", (0,) * 6, "+z", None)
    import trimesh

    rotation = trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0])
    for path in (plug, socket):
        trimesh.load(path).apply_transform(rotation).export(path)
    trimesh.load(plug).apply_translation([-30.0, 0, 0]).export(plug)
    lying = read_parts(plug, socket, "mm", (30.0, 0, 0, 0, 0, 0), "+x", None)
    for transformed, expected in zip(lying, upright, strict=True):
        np.testing.assert_allclose(transformed.bounds, expected.bounds, atol=1e-8)
    with pytest.raises(InputError, match="--axis"):
        read_parts(plug, socket, "mm", (0,) * 6, "up", None)


@pytest.mark.parametrize(("distance", "is_accepted"), [(0.9, True), (1.1, False)])
def test_parts_are_refused_when_more_than_1_mm_apart(distance, is_accepted, tmp_path):
    plug, socket = PARTS["square_peg"]().write(tmp_path)
    first, second = read_parts(plug, socket, "mm", (0,) * 6, "+z", None)
    x = 1e3 * (second.bounds[1, 0] - first.bounds[0, 0]) + distance
    with nullcontext() if is_accepted else pytest.raises(InputError, match=r"the parts are 1\.1 mm apart"):
        read_parts(plug, socket, "mm", (x, 0, 0, 0, 0, 0), "+z", None)


@pytest.mark.parametrize(("distance", "is_accepted"), [(999.0, True), (1001.0, False)])
def test_center_is_refused_when_over_1_m_from_the_plug(distance, is_accepted, tmp_path):
    plug, socket = PARTS["square_peg"]().write(tmp_path)
    with nullcontext() if is_accepted else pytest.raises(InputError, match="is not near the plug"):
        read_parts(plug, socket, "mm", (0,) * 6, "+z", (distance, 0, 0))


def test_plug_without_a_stop_is_not_pushed_past_the_target(tmp_path):
    import trimesh

    plug = trimesh.creation.box((8.0, 8.0, 30.0))
    plate = trimesh.creation.box((30.0, 30.0, 10.0)).difference(trimesh.creation.box((8.4, 8.4, 20.0)))
    plug.apply_translation((0.0, 0.0, 15.0)).export(tmp_path / "plug.stl")
    plate.apply_translation((0.0, 0.0, 5.0)).export(tmp_path / "socket.stl")
    files, logged = (tmp_path / "plug.stl", tmp_path / "socket.stl", tmp_path / "task"), []
    with few_demonstrations():
        create_task(*files, unit="mm", hard_episodes=0, log=logged.append)
    assert any(line.startswith("nothing stops the plug at the seated pose") for line in logged)
    created = yaml.safe_load((tmp_path / "task" / "task.yaml").read_text())
    assert created["motion"]["push"] == 0.0
    assert created["measured"]["demonstrations_seated"] in ("2 of 3", "3 of 3")


def test_parts_are_a_set_of_environments(folder, tmp_path, capsys):
    other = tmp_path / "other"
    shutil.copytree(folder, other)
    text = (other / "task.yaml").read_text()
    (other / "task.yaml").write_text(text.replace("name: parts/peg", "name: parts/other", 1))
    options = *SMALL_LEARNER, "--set", "demonstration_episodes=1", "--no-pictures", "--out", tmp_path / "run"
    # An episode ends at the first contact.
    options = *options, "--env", "force_limit=1", "--env", "bounded_force=false"
    call("train", folder, other, "--episodes", 2, "--evaluate", 1, *options, "--json")
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["held_out_episodes"] == 2
    run = RunFolder(tmp_path / "run")
    assert sorted(run.episodes()["environment"]) == ["parts/other", "parts/peg"]
    assert len({member.task_content for member in run.config().members}) == 2
    capsys.readouterr()
    tasks = "--task", folder, "--task", other
    call("evaluate", tmp_path / "run", *tasks, "--episodes", 1, "--baselines", "scripted", "--json")
    result = json.loads(capsys.readouterr().out)
    assert {*result["environments"]} == {"parts/other", "parts/peg"}
    assert result["max_commanded_violation"] <= 1e-9
    assert {*result["environments"]["parts/peg"]} == {"policy", "demonstration", "scripted"}
    changed = (other / "task.yaml").read_text().replace("force_limit: 35.0", "force_limit: 30.0", 1)
    (other / "task.yaml").write_text(changed)
    with pytest.raises(InputError, match="the files of parts/other are not those that the run"):
        train(out=tmp_path / "run", episodes=3, resume=True)


def shared(folder, **options):
    options = {"difficulty": "hard", "guidance": "kgrl", "observation": "shared"} | options
    return make_env(str(folder), **options)


def test_shared_observation_is_relative_to_the_measured_contact(folder):
    file, env = read_task_file(folder), shared(folder)
    assert file.motion.first_contact == pytest.approx(15e-3, abs=0.1e-3)  # depth of the drawn hole
    observations, poses, commands = [], [], []
    observation, _ = env.reset(seed=0)
    for _ in range(40):
        observation, _, terminated, truncated, _ = env.step(np.zeros(2))
        observations.append(observation)
        poses.append(env.trace.measured[-1].copy())
        commands.append(env.trace.commanded[-1].copy())
        if terminated or truncated:
            break
    observations, poses, commands = map(np.array, (observations, poses, commands))
    height = np.clip((poses[:, 2] - file.motion.first_contact) / 5e-3, -3, 3)
    np.testing.assert_allclose(observations[:, 15], height, atol=1e-5)
    lag = np.clip((poses - commands)[:, 2] / 5e-3, -3, 3)
    assert np.corrcoef(observations[:, 18], lag)[0, 1] > 0.99
    per_action = env.action_repeat * env.diagram.control_period
    for delay, entries in ((0.2, slice(19, 22)), (0.6, slice(22, 25))):
        back = round(delay / per_action)
        moved = np.clip((poses[back:] - poses[:-back])[:, :3] / 1e-3, -3, 3)
        np.testing.assert_allclose(observations[back:, entries], moved, atol=1e-4)
    env.close()


def test_search_inserts_with_the_estimated_socket(folder):
    assert read_task_file(folder).search.contact_map == "contact_map.csv"
    env = shared(folder)
    search = find_scripted_policy(env.diagram.task.name, "scripted_search")
    observation, _ = env.reset(seed=1)
    assert observation[25] == pytest.approx(observation[27], abs=1e-5)  # equally uncertain along x and y
    uncertainty, done = observation[25], False
    while not done:
        observation, _, terminated, truncated, info = env.step(search(observation))
        done = terminated or truncated
    assert info["is_success"]
    assert np.abs(observation[11:13]).max() < 0.4  # the plug is about where the socket was estimated
    assert max(observation[25], observation[27]) < 0.1 * uncertainty
    env.close()


def test_general_policy_inserts_a_part_that_it_has_never_seen(folder, capsys):
    arguments = ("--task", folder, "--difficulty", "hard", "--episodes", 3, "--baselines", "none", "--json")
    call("evaluate", "pretrained:insertion", *arguments)
    result = json.loads(capsys.readouterr().out)
    assert result["success_rate"] >= 0.6
    assert result["max_commanded_violation"] <= 1e-9


def test_without_a_contact_map_the_socket_stays_uncertain(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "no_map")
    file = tmp_path / "no_map/task.yaml"
    text = file.read_text().replace("contact_map: contact_map.csv", "contact_map: null")
    file.write_text(text.replace("parts/peg", "parts/no_map"))
    env = shared(tmp_path / "no_map")
    first, _ = env.reset(seed=1)
    for _ in range(20):
        observation, *_ = env.step(np.zeros(2))
    np.testing.assert_allclose(observation[25:28], first[25:28])
    env.close()


def test_shared_observation_has_the_center_of_pressure_with_the_sign_of_the_part(folder):
    env, other = shared(folder), shared(folder, observation="center_of_pressure")
    assert read_task_file(folder).search.lever_sign == -1
    for each in (env, other):
        each.reset(seed=1)
    centers = []
    for _ in range(30):
        centers.append((env.step(np.zeros(2))[0][28:30], other.step(np.zeros(2))[0][13:15]))
    ours, known = np.moveaxis(centers, 1, 0)
    assert np.abs(known).max() > 0.5
    lever = np.sqrt((ContactMap.load(folder / "contact_map.csv").centers ** 2).mean())
    np.testing.assert_allclose(ours, np.clip(-known * CENTER_OF_PRESSURE_SCALE / lever, -3, 3), atol=1e-5)
    env.close()
    other.close()


def test_shared_observation_has_the_symmetries_of_the_part(folder):
    env, other = shared(folder), shared(folder, observation="center_of_pressure")
    symmetry, known = env.diagram.near_symmetry.observations, other.diagram.near_symmetry.observations
    np.testing.assert_array_equal(symmetry[:, :10, :10], known[:, :10, :10])  # time, pose and force
    for matrix, by_center in zip(symmetry, known, strict=True):
        across = by_center[13:15, 13:15]
        for start in (11, 13, 16, 19, 22, 28):  # estimate, command, distance from it, progress, center of pressure
            np.testing.assert_array_equal(matrix[start : start + 2, start : start + 2], across)
        assert (np.diag(matrix)[[10, 15, 18, 21, 24]] == 1).all()
        xx, xy, yy = matrix[25:28, 25:28] @ [3.0, 0.5, 1.0]
        np.testing.assert_allclose([[xx, xy], [xy, yy]], across @ [[3.0, 0.5], [0.5, 1.0]] @ across.T)
    env.close()
    other.close()
