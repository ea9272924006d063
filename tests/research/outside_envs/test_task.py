"""Tasks around environments of other packages, with a point environment, and the table of results."""

import csv
import json
import os
from dataclasses import replace
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from research.outside_envs import learn
from research.outside_envs.learn import print_table, read_rows
from research.outside_envs.task import ACTION_REPEAT, LearnerSettings, OutsideTask, Part, Recording, num_steps

PARTS = {
    "approach": Part(12, "start", -1.0),
    "insert": Part(12, "goal", 1.0, dwell=3, lower=np.array([-0.02, -np.inf])),
    "retract": Part(12, "goal", 1.0, source="insert", is_reversed=True),
}


class Point(gymnasium.Env):
    """Point in a plane whose actions are a displacement and a grip."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32)

    hidden = np.array([0.7])

    def __init__(self, seed=0):
        self.steps, self.length = 0, num_steps(PARTS)

    def reset(self, *, seed=None, options=None):
        self.p, self.start, self.goal, self.steps, self.grips = np.zeros(2), np.zeros(2), np.array([0.5, 0.1]), 0, []
        return self.p.astype(np.float32), {}

    def step(self, action):
        self.p, self.steps = self.p + 0.1 * np.clip(action[:2], -1, 1), self.steps + 1
        self.grips.append(action[2])
        info = {"is_success": False, "peak_force": 0.0, "side": 1.0}
        return self.p.astype(np.float32), -1.0, False, self.steps >= self.length, info


def record(count, seed):
    """Return recordings of straight motions to the goal, with noise along the second axis."""
    rng = np.random.default_rng(seed)
    origins = {"start": np.zeros(2), "goal": np.array([0.5, 0.1])}
    paths = [np.linspace([0, 0], [0.5, 0.1], 21) + [0, 1] * rng.normal(0, 0.02, 2) for _ in range(count)]
    return [Recording(path, [10], origins) for path in paths]


TASK = OutsideTask(
    PARTS, ("x [m]", "y [m]"), 0.05, Point, record,
    pose=lambda env, _: env.unwrapped.p,
    to_action=lambda env, _, command, grip: np.append(np.clip((command - env.unwrapped.p) / 0.1, -1, 1), grip),
    scripted=lambda env: np.zeros(3),
)  # fmt: skip


@pytest.fixture(scope="module")
def segments():
    return TASK.make_segments(5, 0)


def test_segments_have_frames_limits_and_reversed_motions(segments):
    approach, insert, retract = segments
    assert [segment.name for segment in segments] == list(PARTS)
    assert np.allclose(approach.recorded.outputs[0][0][0], 0.0)
    assert np.allclose(insert.recorded.outputs[0][-1][0], 0.0), "in the goal's frame"
    for forward, backward in zip(insert.recorded.outputs, retract.recorded.outputs, strict=True):
        assert np.array_equal(forward[::-1], backward)
    assert insert.constraints.violation(np.array([-0.021, 0.0])) == pytest.approx(0.001)
    assert insert.constraints.violation(np.array([-0.019, 0.0])) < 0.0
    assert retract.constraints.violation(np.array([-0.021, 0.0])) < 0.0


def test_part_of_a_recording_is_reversed():
    parts = {**PARTS, "retract": Part(12, "goal", 1.0, source="insert", until_fraction=0.5, is_reversed=True)}
    _, insert, retract = replace(TASK, parts=parts).make_segments(5, 0)
    for forward, backward in zip(insert.recorded.outputs, retract.recorded.outputs, strict=True):
        half = round(0.5 * len(forward))
        assert np.array_equal(forward[:half][::-1], backward)
    assert num_steps(parts) == num_steps(PARTS)


def test_fitted_guide_is_reused_for_other_seeds(segments):
    guide = TASK.make("kgrl", 0, segments).guide
    assert TASK.make(guide, 1, segments).guide is guide


def test_action_lasts_until_the_next_decision(segments):
    task = replace(TASK, decisions=("retract",), observed=(1, 2), action_dims=(1,))
    env = task.make("kgrl", 0, segments)
    assert env.action_space.shape == (1,)
    observation, _ = env.reset(seed=0)
    assert observation.shape == env.observation_space.shape == (2,)
    _, first, *_, info = env.step(np.array([0.5]))
    assert info["segment"] == "retract"
    assert 27 <= info["control_steps"] <= 27 + ACTION_REPEAT
    assert info["constraint_violation"] <= 1e-9
    _, second, _, truncated, info = env.step(np.array([-0.5]))
    assert truncated
    assert first + second == -info["control_steps"] == -num_steps(PARTS)


def test_guided_commands_satisfy_constraints_and_have_grips(segments):
    env, rng = TASK.make("kgrl", 0, segments), np.random.default_rng(0)
    env.reset(seed=0)
    done, worst = False, -np.inf
    while not done:
        *_, truncated, info = env.step(rng.choice([-1.0, 1.0], 2))
        worst, done = max(worst, info["constraint_violation"]), truncated
    assert worst <= 1e-9
    assert env.unwrapped.grips == [-1.0] * 12 + [1.0] * 27  # 12 steps of the first part, 12 + 3 + 12 of the others


def test_unguided_violation_is_the_distance_to_the_segments(segments):
    env = TASK.make("none", 0, segments)
    observation, _ = env.reset(seed=0)
    assert observation.shape == (3,)
    assert observation[-1] == -1.0
    *_, info = env.step(np.zeros(3))
    assert info["constraint_violation"] <= 0.0
    *_, info = env.step(np.array([0.0, 1.0, 0.0]))
    assert info["constraint_violation"] > 0.3
    assert env.unwrapped.steps == 10


@pytest.mark.parametrize("step", [1, 2])
def test_unguided_violation_is_nan_when_a_pose_is_nan(step, segments):
    env = TASK.make("none", 0, segments)
    env.reset(seed=0)
    pose = env._pose
    env._pose = lambda inner, observation: pose(inner, observation) * (np.nan if inner.unwrapped.steps == step else 1.0)
    *_, info = env.step(np.zeros(3))
    assert np.isnan(info["constraint_violation"])


@pytest.mark.parametrize("violations", [(np.nan, -0.1), (-0.1, np.nan)])
def test_nan_violation_counts_as_violated_episode(violations):
    info = {"is_success": True, "fallback": 0, "side": 1.0}
    row = {}
    for violation in violations:
        row = learn.add_step(row, {**info, "constraint_violation": violation})
    summary = learn.summarize([row, learn.add_step({}, {**info, "constraint_violation": -0.1})])
    assert summary["violated_episodes"] == 1
    assert np.isnan(summary["max_violation"])


def test_table_has_a_nan_violation(tmp_path):
    row = {
        "episodes": 1, "successes": 1, "by_side": [[1, 1], [0, 0]], "violated_episodes": 1, "max_violation": np.nan,
        "fallbacks": 0, "median_force": 1.0, "max_force": 20.0,
    }  # fmt: skip
    result = {"task": "peg", "method": "kgrl", "seed": 1, "held_out": {"learned": row}, "cpu_s": 1.0}
    (tmp_path / "a.json").write_text(json.dumps(result))
    assert np.isnan(read_rows(tmp_path)[0]["max_commanded_violation"])


def test_table_has_intervals_and_maxima_of_all_episodes(tmp_path, capsys):
    row = {
        "episodes": 10, "successes": 9, "by_side": [[5, 5], [4, 5]], "violated_episodes": 0, "max_violation": -0.1,
        "fallbacks": 0, "median_force": 1.0, "max_force": 20.0,
    }  # fmt: skip
    training = {**row, "violated_episodes": 3, "max_violation": 0.002, "max_force": 30.0}
    result = {"task": "peg", "method": "kgrl", "seed": 1, "curve": [0, 1], "held_out": {"learned": row}, "cpu_s": 1.0}
    (tmp_path / "a.json").write_text(json.dumps({**result, "training": training}))
    (tmp_path / "b.json").write_text(
        json.dumps({**result, "method": "baselines", "held_out": {"zero": row}, "curve": []})
    )
    learned, zero = read_rows(tmp_path)
    assert (learned["success_rate"], learned["success_right"], learned["violated_episodes"]) == (0.9, 0.8, 3)
    assert (learned["max_commanded_violation"], learned["peak_force"]) == (0.002, 30.0)
    assert 0.55 < learned["success_low"] < 0.6 < 0.98 < learned["success_high"] < 1.0
    assert (zero["method"], zero["max_commanded_violation"]) == ("baselines: zero", 0.0)
    print_table(tmp_path)
    assert "| peg | kgrl | 1 | 2 | 90% of 10 (60% to 98%) | 100%, 80% | 3, 2.0 | 30 |" in capsys.readouterr().out
    assert len(list(csv.DictReader((tmp_path / "outside_envs.csv").open()))) == 2


def test_critics_but_not_the_actor_observe_hidden_values(segments):
    env = TASK.make("kgrl", 0, segments)
    model, rows = learn.train(env, 16, 0, LearnerSettings())
    assert len(rows) == 16
    assert model.num_timesteps > LearnerSettings.learning_starts
    observation, _ = env.reset(seed=0)
    extended = [np.append(observation, value).astype(np.float32) for value in (0.0, 0.7)]
    first, second = (model.predict(values, deterministic=True)[0] for values in extended)
    assert np.array_equal(first, second)
    assert np.array_equal(learn.policy_of(model)(observation, {}), first)
    stored = model.replay_buffer.observations[: model.replay_buffer.pos, 0]
    assert stored.shape[1] == len(observation) + 1
    assert (stored[:, -1] == np.float32(0.7)).all()
    inputs = model.critic.q_networks[0][0].in_features
    assert inputs == len(observation) + 1 + 2  # observation, hidden value and action


def test_demonstrated_transitions_have_the_hidden_values(segments, monkeypatch):
    step = Point.step
    monkeypatch.setattr(Point, "step", lambda self, action: (*step(self, action)[:4], {"is_success": True}))
    rows = learn.demonstrate_transitions(TASK, TASK.make("none", 0, segments), 1)
    assert all(before[0, -1] == after[0, -1] == np.float32(0.7) for before, after, *_ in rows)


def test_interrupted_write_leaves_no_result(tmp_path, monkeypatch):
    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("sys.argv", ["learn", "peg", "--method", "baselines", "--out", str(tmp_path)])
    monkeypatch.setattr(learn, "import_module", lambda name: SimpleNamespace(TASK=TASK))
    monkeypatch.setattr(learn, "evaluate_baselines", lambda *_: {"zero": {}})
    monkeypatch.setattr("torch.set_num_threads", lambda number: None)
    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(InputError, match="cannot be written"):
        learn.main()
    assert not list(tmp_path.iterdir())
