"""Training in environments of other packages: registered ids, and environments that are given as objects."""

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import FlattenObservation, TimeLimit
from point_env import PointEnv, guided
from spaces_only_env import SpacesOnlyEnv

import guiderail
from guiderail.models.common.errors import InputError
from guiderail.tools.cli.main import main


@pytest.mark.parametrize(
    ("make", "algorithm"),
    [
        (lambda: guided(PointEnv()), "tqc"),
        (lambda: guided(PointEnv()), "ppo"),
        (lambda: TimeLimit(PointEnv(), 10), "sac"),
        (lambda: "Pendulum-v1", "ppo"),
        (lambda: "Pendulum-v1", "sac"),
    ],
)
def test_environment_of_another_package_is_trained(make, algorithm, tmp_path):
    env = make()
    settings = {"net_arch": "8"} if algorithm == "ppo" else {"net_arch": "8", "gradient_steps": 1}
    run = guiderail.train(env, out=tmp_path / "run", episodes=2, algorithm=algorithm, settings=settings)
    assert len(run.episodes) == 2
    assert run.summary["curve"].startswith("none: ") or run.summary["curve"].endswith(".png")
    result = guiderail.evaluate(run, episodes=2, baselines=())
    assert result["episodes"] == 2
    if not isinstance(env, str):
        env.reset(seed=0)  # training did not close it
        assert guiderail.evaluate(run.policy, env, 2, baselines=())["mean_return"] == result["mean_return"]


def test_resumed_run_is_the_same(tmp_path):
    given = {"settings": {"net_arch": "8", "gradient_steps": 1}, "pictures": False}
    for episodes, resume in ((1, False), (2, True)):
        task = None if resume else "Pendulum-v1"
        run = guiderail.train(task, out=tmp_path / "a", episodes=episodes, resume=resume, **{} if resume else given)
    other = guiderail.train("Pendulum-v1", out=tmp_path / "b", episodes=2, **given)
    assert run.episodes["return"].tolist() == other.episodes["return"].tolist()


class Endless(PointEnv):
    """Environment that never ends by itself."""


BOX = spaces.Box(-1, 1, (2,))


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (Endless(), "has no limit of steps.*TimeLimit"),
        (FlattenObservation(Endless()), "has no limit of steps.*TimeLimit"),
        (TimeLimit(SpacesOnlyEnv(BOX, spaces.Discrete(2)), 5), "has the actions Discrete"),
        (TimeLimit(SpacesOnlyEnv(BOX, spaces.Box(-np.inf, np.inf, (2,))), 5), "with finite bounds"),
        (TimeLimit(SpacesOnlyEnv(BOX, spaces.Box(-1, 1, (2, 2))), 5), r"a Box of shape \(A,\)"),
        (TimeLimit(SpacesOnlyEnv(spaces.Dict({"p": BOX}), BOX), 5), "FlattenObservation"),
        ("CartPole-v1", "has the actions Discrete"),
    ],
)
def test_environment_that_cannot_be_trained_is_refused(env, message, tmp_path):
    with pytest.raises(InputError, match=message):
        guiderail.train(env, out=tmp_path / "run", episodes=2)
    assert not (tmp_path / "run").exists()


def test_command_trains_a_registered_environment(tmp_path, capsys):
    out = tmp_path / "run"
    small = ("--set", "net_arch=8", "--set", "gradient_steps=1")
    with pytest.raises(SystemExit) as end:
        main(["train", "Pendulum-v1", "--episodes", "1", "--out", str(out), "--algorithm", "sac", *small])
    assert end.value.code == 0, capsys.readouterr().err
    with pytest.raises(SystemExit) as end:
        main(["evaluate", str(out), "--episodes", "2"])
    assert end.value.code == 0, capsys.readouterr().err


@pytest.mark.parametrize("repeat", [1, 4])
@pytest.mark.parametrize("limit", [None, 7, 100])
def test_limit_of_a_guided_environment_counts_actions(repeat, limit):
    from guiderail.tools.environments import trained_task

    inner = PointEnv() if limit is None else TimeLimit(PointEnv(), limit)
    env = guided(inner, action_repeat=repeat)
    bound, count = trained_task(env, "env").num_steps, 0
    env.reset(seed=0)
    is_over = False
    while not is_over:
        _, _, terminated, truncated, _ = env.step(np.ones(3))
        count, is_over = count + 1, terminated or truncated
    assert count <= bound
