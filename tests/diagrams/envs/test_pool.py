"""Environments release their resources, and a reused diagram has no state of the earlier one."""

import gc
import pickle
import re
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import psutil
import pytest

from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.guidance.guidance import FunctionGuidance
from guiderail.diagrams.guidance.registry import GUIDANCE, register_guidance
from guiderail.diagrams.tasks.grid_clamp.task import GridClamp
from guiderail.diagrams.tasks.registry import TASKS, environment_id, register_task
from guiderail.models.common.errors import InputError
from guiderail.models.objects import grid_clamp
from guiderail.models.primitives import Demonstrations
from guiderail.models.primitives.kernels import KERNELS, SquaredExponential, register_kernel
from guiderail.models.robots.robot import ROBOTS, find_robot
from guiderail.models.templates import load_template

GRID_CLAMP = Path(grid_clamp.__file__).parent / "grid_clamp.yaml"
CASES = [
    ("NarrowPassage", {"guidance": "safe_residual"}),
    ("BncConnector", {"guidance": "kgrl", "adaptive_history": False}),
    ("GridClamp", {"guidance": "sct"}),
    ("Pouring", {"mug_offset": 0.02}),
]


def episode(env, seed):
    """Return the results of a dozen random actions, to the last bit."""
    observation, info = env.reset(seed=seed)
    seen, rng = [observation.tobytes(), repr(env.sampled)], np.random.default_rng(seed)
    for _ in range(12):
        observation, reward, terminated, truncated, info = env.step(rng.uniform(-1, 1, env.action_space.shape))
        seen += [observation.tobytes(), reward, repr(info)]
        if terminated or truncated:
            break
    return [*seen, env.trace.commanded.tobytes(), env.trace.measured.tobytes(), env.trace.signals["wrench"].tobytes()]


@pytest.mark.parametrize(("task", "options"), CASES)
def test_episode_is_equal_in_a_reused_diagram(task, options):
    first = make_env(task, **options, action_repeat=2)
    diagram = first.task.diagram
    expected = episode(first, 3)
    episode(first, 4)
    first.close()
    second = make_env(task, **options, action_repeat=2)
    assert second.task.diagram is diagram
    # The first reset hides what is constant in a run: nothing of the run before is left.
    assert episode(second, 3) == expected
    third = make_env(task, **options, action_repeat=2)
    assert third.task.diagram is not diagram
    assert episode(third, 3) == expected
    second.close()
    third.close()


@pytest.fixture
def registries():
    """Remove the registrations of each test."""
    before = [(registry, set(registry.names())) for registry in (TASKS, GUIDANCE, KERNELS)]
    yield
    for registry, names in before:
        for name in set(registry.names()) - names:
            del registry._entries[name]
            gymnasium.registry.pop(environment_id(name), None)


def last_command(task, action=1.0, steps=3, **options):
    """Return the last command of a few steps in a new environment, which is closed afterwards."""
    env = make_env(task, **options)
    env.reset(seed=0)
    for _ in range(steps):
        env.step(np.full(env.action_space.shape, action))
    env.close()
    return env.trace.commanded[-1]


def test_own_template_is_new_when_the_file_changed(tmp_path, registries):
    file = tmp_path / "clamp.yaml"

    @register_task("lab/Edited")
    class Edited(GridClamp):
        def template(self):
            return replace(super().template(), template=load_template(file))

    sideways, shipped = [], GRID_CLAMP.read_text()
    for width in ("0.008", "0.002"):
        file.write_text(shipped.replace("width_m: 0.008", f"width_m: {width}"))
        sideways.append(last_command("lab/Edited", action_repeat=20)[0])
    assert sideways == pytest.approx([0.004, 0.001], abs=1e-6)


def test_own_guidance_is_new_when_its_file_changed(tmp_path, registries):
    file = tmp_path / "target.txt"

    @register_guidance("from_file")
    def build(prior):
        target = np.full(prior.pose_size, float(file.read_text()))
        return FunctionGuidance(prior, lambda action, pose, wrench: target, action_size=1)

    for target in (0.1, 0.2):
        file.write_text(str(target))
        assert last_command("NarrowPassage", guidance="from_file").tolist() == [target, target]


def test_own_kernel_is_new_when_it_is_registered_again(registries):
    commands = []
    for number in (1.0, 3.0):

        @register_kernel("changed")
        class Changed(SquaredExponential):
            factor = number

            def __call__(self, a, b):
                return super().__call__(self.factor * a, self.factor * b)

        commands.append(last_command("NarrowPassage", kernel="changed"))
    assert not np.array_equal(*commands)


def test_demonstrations_are_new_when_the_file_changed(tmp_path):
    file, commands = tmp_path / "mine.npz", []
    times, height = 0.02 * np.arange(100), np.linspace(0.02, 0.0, 100)
    for x in (0.0, 1e-3):
        outputs = [np.outer(np.ones(100), [x + d, d, 0.0, d, d, d]) for d in (-1e-4, 0.0, 1e-4)]
        Demonstrations(times, [one + np.outer(height, [0, 0, 1, 0, 0, 0]) for one in outputs]).save(file)
        commands.append(last_command("BncConnector", 0.0, 1, guidance="kgrl", demonstrations=str(file))[0])
    assert commands == pytest.approx([0.0, 1e-3], abs=2e-4)


def test_own_robot_is_new_when_its_model_changed(tmp_path, monkeypatch):
    arm, masses = find_robot("iiwa14"), []
    monkeypatch.setitem(ROBOTS._entries, "mine", replace(arm, name="mine", model=tmp_path / "mine.urdf"))
    monkeypatch.setitem(ROBOTS._origins, "mine", ("", ""))
    for mass in (1.5, 2.5):
        link = f'<mass value="{mass}"/>'
        (tmp_path / "mine.urdf").write_text(re.sub('<mass value="[^"]*"/>', link, arm.model.read_text(), count=1))
        env = make_env("BncConnector", station="arm", robot="mine", guidance="safe_residual")
        plant = env.task.diagram.GetSubsystemByName("station").GetSubsystemByName("plant")
        masses.append(plant.GetBodyByName("iiwa_link_0").default_mass())
        env.close()
    assert masses == [1.5, 2.5]


@pytest.mark.parametrize("robot", ["iiwa14", "panda"])
def test_diagram_of_a_packaged_robot_is_reused(robot):
    env = make_env("BncConnector", station="arm", robot=robot, guidance="safe_residual")
    env.close()
    again = make_env("BncConnector", station="arm", robot=robot, guidance="safe_residual")
    assert again.task.diagram is env.task.diagram
    again.close()


def test_two_environments_never_share_a_diagram():
    env = make_env("NarrowPassage")
    other, different = make_env("NarrowPassage"), make_env("NarrowPassage", action_scale=2.0)
    assert len({id(one.task.diagram) for one in (env, other, different)}) == 3
    env.close()
    env.close()  # gives back once
    second, more = make_env("NarrowPassage"), make_env("NarrowPassage")
    assert second.task.diagram is not more.task.diagram
    assert {id(second.task.diagram), id(more.task.diagram)}.isdisjoint({id(other.task.diagram)})
    for one in (other, different, second, more):
        one.close()


def test_diagram_is_given_back_when_its_view_cannot_open(monkeypatch):
    env = make_env("NarrowPassage")
    diagram = env.task.diagram
    env.close()
    with monkeypatch.context() as patch:
        patch.setattr("guiderail.diagrams.envs.env.View", lambda query: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            make_env("NarrowPassage", render_mode="human")
    second = make_env("NarrowPassage")
    assert second.task.diagram is diagram
    second.close()


def test_a_closed_environment_stays_closed():
    env = make_env("NarrowPassage")
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()
    assert len(env.trace) > 0, "what it recorded stays"
    with pytest.raises(InputError, match="is closed"):
        env.reset()


@pytest.mark.parametrize(("render_mode", "close"), [(None, False), ("human", False), ("human", True)])
def test_memory_does_not_grow_with_environments(close, render_mode):
    process, after = psutil.Process(), []
    make_env("NarrowPassage", guidance="safe_residual").close()  # what the process starts once, and keeps
    before = count_resources(process)
    for index in range(6):
        env = make_env("NarrowPassage", guidance="safe_residual", render_mode=render_mode)
        env.simulator.set_target_realtime_rate(0.0)
        env.reset(seed=index)
        env.step(env.action_space.sample())
        if render_mode == "human":
            assert env.task.meshcat.HasPath("/drake/visualizer/robot")
            assert count_resources(process)[:2] > before[:2]
        if close:
            env.close()
        del env
        gc.collect()
        after.append((*count_resources(process), process.memory_info().rss / 1e6))
    assert {one[:3] for one in after} == {before}, "threads, descriptors and ports that are listened at"
    assert after[-1][3] - after[1][3] < 5.0, "a diagram of its own each would be 9 MB"


def count_resources(process):
    """Return the number of threads, descriptors and ports of a process."""
    listening = [one for one in process.net_connections() if one.status == psutil.CONN_LISTEN]
    return process.num_threads(), process.num_fds(), len(listening)


def test_view_follows_the_scene_without_side_effects():
    def motion(render_mode):
        env = make_env("NarrowPassage", guidance="safe_residual", render_mode=render_mode)
        env.simulator.set_target_realtime_rate(0.0)
        env.reset(seed=0)
        meshcat, shown = env.task.meshcat, []
        for moves in (True, True, False):
            if moves:
                env.step(np.ones(2))
            if meshcat is not None:
                env.render()
                shown.append(meshcat.StaticHtml())
        poses = env.trace.measured.copy()
        env.close()
        assert env.task.meshcat is None
        return poses, shown

    poses, shown = motion("human")
    assert shown[0] != shown[1] == shown[2]
    np.testing.assert_array_equal(poses, motion(None)[0])


def test_pickling_is_refused_with_the_remedy():
    env = make_env("NarrowPassage")
    with pytest.raises(InputError, match=r"cannot be pickled: call gymnasium.make in the worker") as error:
        pickle.dumps(env)
    assert "\n" not in str(error.value)
    env.close()
