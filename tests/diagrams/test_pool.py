"""What an environment leaves behind: nothing, and no trace of itself in the next one."""

import base64
import gc
import pickle
import re

import numpy as np
import psutil
import pytest

from guiderail.diagrams.make import make_env
from guiderail.models.errors import InputError

CASES = [
    ("NarrowPassage", {"guidance": "safe_residual"}),
    ("BncConnector", {"guidance": "kgrl", "adaptive_history": False}),
    ("GridClamp", {"guidance": "sct"}),
    ("Pouring", {"mug_offset": 0.02}),
]


def episode(env, seed):
    """What a dozen random actions lead to, to the last bit."""
    observation, info = env.reset(seed=seed)
    seen, rng = [observation.tobytes(), repr(env.drawn)], np.random.default_rng(seed)
    for _ in range(12):
        observation, reward, terminated, truncated, info = env.step(rng.uniform(-1, 1, env.action_space.shape))
        seen += [observation.tobytes(), reward, repr({k: v for k, v in info.items() if k != "ledger"})]
        if terminated or truncated:
            break
    return [*seen, env.trace.commanded.tobytes(), env.trace.measured.tobytes(), env.trace.signals["wrench"].tobytes()]


@pytest.mark.parametrize(("task", "options"), CASES)
def test_an_episode_is_the_same_in_a_diagram_that_was_used_before(task, options):
    first = make_env(task, **options, hold=2)
    diagram = first.task.diagram
    expected = episode(first, 3)
    episode(first, 4)
    first.close()
    second = make_env(task, **options, hold=2)
    assert second.task.diagram is diagram
    # The first reset hides what is constant in a run: nothing of the run before is left.
    assert episode(second, 3) == expected
    third = make_env(task, **options, hold=2)
    assert third.task.diagram is not diagram
    assert episode(third, 3) == expected
    second.close()
    third.close()


def test_two_environments_never_share_a_diagram():
    env = make_env("NarrowPassage")
    other, different = make_env("NarrowPassage"), make_env("NarrowPassage", kappa=2.0)
    assert len({id(one.task.diagram) for one in (env, other, different)}) == 3
    env.close()
    env.close()  # gives back once
    again, more = make_env("NarrowPassage"), make_env("NarrowPassage")
    assert again.task.diagram is not more.task.diagram
    assert {id(again.task.diagram), id(more.task.diagram)}.isdisjoint({id(other.task.diagram)})
    for one in (other, different, again, more):
        one.close()


def test_a_closed_environment_stays_closed():
    env = make_env("NarrowPassage")
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()
    assert len(env.trace) > 0, "what it recorded stays"
    with pytest.raises(InputError, match="is closed"):
        env.reset()


@pytest.mark.parametrize(("render_mode", "close"), [(None, False), ("human", True)])
def test_nothing_grows(close, render_mode):
    process, after = psutil.Process(), []
    for index in range(6):
        env = make_env("NarrowPassage", guidance="safe_residual", render_mode=render_mode)
        env.simulator.set_target_realtime_rate(0.0)
        env.reset(seed=index)
        env.step(env.action_space.sample())
        if close:
            env.close()
        del env
        gc.collect()
        after.append((process.num_threads(), process.num_fds(), process.memory_info().rss / 1e6))
    threads, descriptors, memory = np.array(after[1:]).T
    assert len({*threads}) == len({*descriptors}) == 1
    assert memory[-1] - memory[0] < 5.0, "a diagram of its own each would be 9 MB"


def test_a_view_that_is_used_again_shows_nothing_of_what_was_drawn_before():
    """Pages are the same but for the names that Meshcat makes up."""

    def page():
        env = make_env("NarrowPassage", guidance="safe_residual", render_mode="human")
        env.simulator.set_target_realtime_rate(0.0)
        env.reset(seed=0)
        return env, env.task.meshcat

    env, meshcat = page()
    meshcat.SetLine("/guiderail/executed/0", np.eye(3))
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.StartRecording()
    env.step(env.action_space.sample())
    env.close()
    env, again = page()
    assert again is meshcat
    assert not meshcat.HasPath("/guiderail")
    assert meshcat.HasPath("/drake/visualizer/robot")
    properties = re.findall(r"[A-Za-z0-9+/=]{40,200}", meshcat.StaticHtml())
    commands = [base64.b64decode(one + "=" * (-len(one) % 4)) for one in properties if len(one) % 4 == 0]
    hidden = [one for one in commands if b"/Grid" in one and one.endswith(b"\xc2")]
    assert hidden == []
    env.close()


def test_pickling_says_what_to_do_instead():
    env = make_env("NarrowPassage")
    with pytest.raises(InputError, match=r"cannot be pickled: call gymnasium.make in the worker") as error:
        pickle.dumps(env)
    assert "\n" not in str(error.value)
    env.close()
