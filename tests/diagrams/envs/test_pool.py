"""Reuse of diagrams by later environments, and release of the resources of environments."""

import gc
import pickle
import re
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import psutil
import pytest
from pydrake.systems.framework import DiagramBuilder

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
    ("NarrowPassage", {"guidance": "safe_residual", "start_deviation": 0.01}),
    ("NarrowPassage", {"guidance": "kgrl", "difficulty": "hard"}),
    ("BncConnector", {"guidance": "kgrl", "adaptive_history": False}),
    ("BncConnector", {"fixture_offset": "per_episode"}),
    ("GridClamp", {"guidance": "sct"}),
    ("Pouring", {"mug_offset": 0.02}),
    ("Pouring", {"difficulty": "hard"}),
]


def run_episode(env, seed):
    """Run up to twelve random actions; return the sampled values, results of all steps, and the trace."""
    observation, info = env.reset(seed=seed)
    results, rng = [observation.tobytes(), repr(env.sampled)], np.random.default_rng(seed)
    for _ in range(12):
        observation, reward, terminated, truncated, info = env.step(rng.uniform(-1, 1, env.action_space.shape))
        results += [observation.tobytes(), reward, repr(info)]
        if terminated or truncated:
            break
    return [
        *results,
        env.trace.commanded.tobytes(),
        env.trace.measured.tobytes(),
        env.trace.signals["wrench"].tobytes(),
    ]


@pytest.mark.parametrize(("task", "options"), CASES)
def test_episode_is_equal_in_a_reused_diagram(task, options):
    first = make_env(task, **options, action_repeat=2)
    diagram = first.task.diagram
    expected = run_episode(first, 3)
    assert run_episode(first, 4)[:2] != expected[:2], "both seeds have the same samples"
    first.close()
    second = make_env(task, **options, action_repeat=2)
    assert second.task.diagram is diagram
    # The first reset samples the values that are constant in a run, so a value of the first run would differ.
    assert run_episode(second, 3) == expected
    third = make_env(task, **options, action_repeat=2)
    assert third.task.diagram is not diagram
    assert run_episode(third, 3) == expected
    second.close()
    third.close()


@pytest.fixture
def registries():
    """Remove the registrations of the test at its end."""
    before = [(registry, set(registry.names())) for registry in (TASKS, GUIDANCE, KERNELS)]
    yield
    for registry, names in before:
        for name in set(registry.names()) - names:
            del registry._entries[name]
            gymnasium.registry.pop(environment_id(name), None)


def last_command(task, action=1.0, steps=3, **options):
    """Return the last commanded pose after `steps` steps in a new environment, and close the environment."""
    env = make_env(task, **options)
    env.reset(seed=0)
    for _ in range(steps):
        env.step(np.full(env.action_space.shape, action))
    env.close()
    return env.trace.commanded[-1]


def test_template_is_read_again_when_its_file_changed(tmp_path, registries):
    file = tmp_path / "clamp.yaml"

    @register_task("lab/Edited")
    class Edited(GridClamp):
        def template(self):
            return replace(super().template(), template=load_template(file))

    x_commands, shipped = [], GRID_CLAMP.read_text()
    for width in ("0.008", "0.002"):
        file.write_text(shipped.replace("width_m: 0.008", f"width_m: {width}"))
        x_commands.append(last_command("lab/Edited", action_repeat=20)[0])
    assert x_commands == pytest.approx([0.004, 0.001], abs=1e-6)


def test_guidance_is_built_again_when_its_file_changed(tmp_path, registries):
    file = tmp_path / "target.txt"

    @register_guidance("from_file")
    def build(prior):
        target = np.full(prior.pose_size, float(file.read_text()))
        return FunctionGuidance(prior, lambda action, pose, wrench: target, action_size=1)

    for target in (0.1, 0.2):
        file.write_text(str(target))
        assert last_command("NarrowPassage", guidance="from_file").tolist() == [target, target]


def test_new_kernel_is_used_when_registered_again(registries):
    commands = []
    for number in (1.0, 3.0):

        @register_kernel("changed")
        class Changed(SquaredExponential):
            factor = number

            def __call__(self, a, b):
                return super().__call__(self.factor * a, self.factor * b)

        commands.append(last_command("NarrowPassage", kernel="changed"))
    assert not np.array_equal(*commands)


def test_demonstrations_are_read_again_when_the_file_changed(tmp_path):
    file, commands = tmp_path / "own.npz", []
    times, height = 0.02 * np.arange(100), np.linspace(0.02, 0.0, 100)
    for x in (0.0, 1e-3):
        outputs = [np.outer(np.ones(100), [x + d, d, 0.0, d, d, d]) for d in (-1e-4, 0.0, 1e-4)]
        Demonstrations(times, [output + np.outer(height, [0, 0, 1, 0, 0, 0]) for output in outputs]).save(file)
        commands.append(last_command("BncConnector", 0.0, 1, guidance="kgrl", demonstrations=str(file))[0])
    assert commands == pytest.approx([0.0, 1e-3], abs=2e-4)


def test_robot_is_loaded_again_when_its_model_changed(tmp_path, monkeypatch):
    arm, masses = find_robot("iiwa14"), []
    monkeypatch.setitem(ROBOTS._entries, "own", replace(arm, name="own", model=tmp_path / "own.urdf"))
    monkeypatch.setitem(ROBOTS._origins, "own", ("", ""))
    for mass in (1.5, 2.5):
        link = f'<mass value="{mass}"/>'
        (tmp_path / "own.urdf").write_text(re.sub('<mass value="[^"]*"/>', link, arm.model.read_text(), count=1))
        env = make_env("BncConnector", station="arm", robot="own", guidance="safe_residual")
        plant = env.task.diagram.GetSubsystemByName("station").GetSubsystemByName("plant")
        masses.append(plant.GetBodyByName("iiwa_link_0").default_mass())
        env.close()
    assert masses == [1.5, 2.5]


@pytest.mark.parametrize("robot", ["iiwa14", "panda"])
def test_diagram_of_a_packaged_robot_is_reused(robot):
    env = make_env("BncConnector", station="arm", robot=robot, guidance="safe_residual")
    env.close()
    second = make_env("BncConnector", station="arm", robot=robot, guidance="safe_residual")
    assert second.task.diagram is env.task.diagram
    second.close()


def test_two_open_environments_never_share_a_diagram():
    envs = [make_env("NarrowPassage"), make_env("NarrowPassage"), make_env("NarrowPassage", action_scale=2.0)]
    assert len({id(env.task.diagram) for env in envs}) == 3
    envs[0].close()
    envs[0].close()  # the second call does not release the diagram again
    envs += [make_env("NarrowPassage"), make_env("NarrowPassage")]
    assert len({id(env.task.diagram) for env in envs[1:]}) == 4
    for env in envs:
        env.close()


def test_diagram_is_not_reused_when_part_of_another_diagram():
    env = make_env("NarrowPassage", gap_width=0.041)
    builder = DiagramBuilder()
    builder.AddSystem(env.task.diagram)
    outer = builder.Build()
    env.close()
    make_env("NarrowPassage", gap_width=0.041).reset(seed=0)
    assert outer.num_input_ports() == 0


def test_diagram_is_released_when_the_view_fails_to_open(monkeypatch):
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


def test_closed_environment_keeps_its_trace_and_refuses_reset():
    env = make_env("NarrowPassage")
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()
    assert len(env.trace) > 0
    with pytest.raises(InputError, match="is closed"):
        env.reset()


@pytest.mark.parametrize(("render_mode", "close"), [(None, False), ("human", False), ("human", True)])
def test_resources_are_released_by_close_and_deletion(close, render_mode):
    process, after = psutil.Process(), []
    make_env("NarrowPassage", guidance="safe_residual").close()  # starts threads that do not end
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
    assert {counts[:3] for counts in after} == {before}, "threads, descriptors or listening ports remain"
    assert after[-1][3] - after[1][3] < 5.0, "memory growth [MB]; a diagram has 9 MB"


def count_resources(process):
    """Return the numbers of threads, descriptors and listening ports of a process."""
    listening = [port for port in process.net_connections() if port.status == psutil.CONN_LISTEN]
    return process.num_threads(), process.num_fds(), len(listening)


def test_view_follows_the_scene_without_side_effects():
    def motion(render_mode):
        env = make_env("NarrowPassage", guidance="safe_residual", render_mode=render_mode)
        env.simulator.set_target_realtime_rate(0.0)
        env.reset(seed=0)
        meshcat, pages = env.task.meshcat, []
        for moves in (True, True, False):
            if moves:
                env.step(np.ones(2))
            if meshcat is not None:
                env.render()
                pages.append(meshcat.StaticHtml())
        poses = env.trace.measured.copy()
        env.close()
        assert env.task.meshcat is None
        return poses, pages

    poses, pages = motion("human")
    assert pages[0] != pages[1] == pages[2]
    np.testing.assert_array_equal(poses, motion(None)[0])


def test_pickling_is_refused_with_the_remedy():
    env = make_env("NarrowPassage")
    with pytest.raises(InputError, match=r"cannot be pickled: call gymnasium.make in the worker") as error:
        pickle.dumps(env)
    assert "\n" not in str(error.value)
    env.close()
