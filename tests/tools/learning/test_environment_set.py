"""Training and evaluation over a set of environments, of which each episode has another one."""

import collections

import gymnasium
import numpy as np
import pytest

import guiderail
from guiderail.models.common.errors import InputError
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.learning.environment_set import EnvironmentSet, find_members, load_variants
from guiderail.tools.learning.run_folder import RunFolder, configure
from guiderail.tools.learning.train import train
from guiderail.tools.learning.trainer import Observers, run_training
from oracles.same_runs import differences

SETTINGS = {"net_arch": "8", "gradient_steps": 1, "batch_size": 8, "learning_starts": 10}
ENVIRONMENT = {"guidance": "kgrl", "action_dims": "0,1", "action_repeat": 40}
VARIANTS = {"near": {}, "walled": {"wall": -0.5}, "slow": {"action_repeat": 5}}


def configuration(variants=VARIANTS, episodes=5, **settings):
    members, _ = find_members(["Bead"], {}, variants)
    first = members[0]
    return configure(
        first.task, first.environment, settings=SETTINGS | settings, episodes=episodes, seed=3, members=members
    )


class Stopped(Exception):
    pass


def stop_in_episode_2(row):
    if row["episode"] == 2:
        raise Stopped


@pytest.mark.parametrize("settings", [{}, {"num_envs": 2}])
def test_run_over_a_set_resumes_bit_for_bit(settings, tmp_path):
    config = configuration(**settings)
    whole, stopped = RunFolder(tmp_path / "whole"), RunFolder(tmp_path / "stopped")
    run_training(whole, config)
    with pytest.raises(Stopped):
        run_training(stopped, config, observers=Observers(stop_in_episode_2))
    run_training(stopped, stopped.config(), resume=True)
    assert differences(whole.path, stopped.path) == []


def test_environments_occur_equally_often_in_an_order_of_the_seed():
    envs = {name: gymnasium.Env() for name in "abc"}
    for env in envs.values():
        env.observation_space = env.action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    orders = []
    for seed in (0, 1):
        env = EnvironmentSet(envs, seed)
        orders.append([env.select(index) for index in range(30)])
        assert [env.select(index) for index in reversed(range(30))] == orders[-1][::-1]  # does not depend on the past
        blocks = [orders[-1][start : start + 3] for start in range(0, 30, 3)]
        assert all(sorted(block) == ["a", "b", "c"] for block in blocks)
        assert len(set(map(tuple, blocks))) > 1
    assert orders[0] != orders[1]


def test_table_and_evaluation_name_the_environment_of_an_episode(tmp_path):
    run = guiderail.train(
        "Bead", "skgrl", out=tmp_path / "run", variants=VARIANTS, episodes=6, seed=1, settings=SETTINGS, pictures=False
    )
    assert collections.Counter(run.episodes["environment"]) == dict.fromkeys(VARIANTS, 2)
    assert run.config.members[1].environment["wall"] == -0.5
    assert run.config.action_repeat == 2  # mean of 1, 1 and 5, rounded
    evaluation = guiderail.evaluate(run, episodes=2, baselines=["uniform_random"], processes=1)
    assert evaluation["episodes"] == 6
    assert set(evaluation["environments"]) == set(VARIANTS)
    for name, rows in evaluation.rows.items():
        assert list(rows["environment"]) == [variant for variant in VARIANTS for _ in range(2)], name
    # An episode is that of the environment alone.
    env = make_environment("Bead", run.config.members[1].environment)
    env.reset(seed=1)
    alone = rollout(env, run.policy, index=0, seed=1_000_000, held_out=True)
    assert evaluation.rows["policy"]["return"][2] == alone["return"]
    env.close()


def test_lists_of_environments_are_checked_before_an_evaluation():
    evaluation = guiderail.evaluate(
        lambda observation: np.zeros(2), ["NarrowPassage"], episodes=2, baselines=[],
        environment={"guidance": "kgrl", "action_dims": "0,1"}, processes=1,
    )  # fmt: skip
    assert "environments" not in evaluation  # a list of one is that environment
    with pytest.raises(InputError, match="NarrowPassage is given twice"):
        guiderail.evaluate(lambda observation: np.zeros(2), ["NarrowPassage", "NarrowPassage"], episodes=2)
    with pytest.raises(InputError, match="at least one environment"):
        guiderail.evaluate(lambda observation: np.zeros(2), [], episodes=2)


def test_environments_given_as_objects_are_a_set(tmp_path):
    class Corner(gymnasium.Env):
        observation_space = action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

        def __init__(self, goal):
            self.goal = np.array(goal)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.x = self.np_random.uniform(-1, 1, 2).astype(np.float32)
            return self.x, {}

        def step(self, action):
            self.x = np.clip(self.x + 0.5 * action, -1, 1).astype(np.float32)
            distance = float(np.linalg.norm(self.x - self.goal))
            return self.x, -distance, distance < 0.1, False, {"is_success": distance < 0.1}

    envs = [gymnasium.wrappers.TimeLimit(Corner(goal), 5) for goal in ([1.0, 1.0], [-1.0, 1.0])]
    run = guiderail.train(envs, out=tmp_path / "run", episodes=4, settings=SETTINGS, pictures=False)
    assert len(set(run.episodes["environment"])) == 2
    assert guiderail.evaluate(run, episodes=2, baselines=[])["episodes"] == 4


def test_sets_of_unequal_environments_are_refused(tmp_path):
    def start(variants, **options):
        given = {"variants": variants, "episodes": 2, "settings": SETTINGS, "pictures": False}
        train("NarrowPassage", out=tmp_path / "run", **given, **(ENVIRONMENT | options))

    for variants, message in (
        ({"one": {}, "other": {"action_dims": "0"}}, r"other has the actions .*\(1,\).* and one .*\(2,\)"),
        ({"one": {}, "other": {"reward": "shaped"}}, "other has the reward terms .* the same reward"),
        ({"one": {}, "other": {"guidance": "skgrl"}}, "need the same guidance, not .*kgrl"),
        ({"one": {}, "other": {"gap_wdith": 1}}, "no option 'gap_wdith'"),
        ({"1": {}}, "name begins with a letter"),
        ({"one": 3}, "one must be options"),
        ({}, "must be options of the environment by the variant's name"),
    ):
        with pytest.raises(InputError, match=message):
            start(variants)
        assert not (tmp_path / "run").exists()


def test_resume_refuses_another_set(tmp_path):
    options = {"settings": SETTINGS, "pictures": False}
    out = tmp_path / "run"
    train("Bead", out=out, variants=VARIANTS, episodes=1, **options)
    train("Bead", out=out, variants=VARIANTS, episodes=2, resume=True, **options)
    with pytest.raises(InputError, match="has another set of environments"):
        train("Bead", out=out, variants={**VARIANTS, "more": {}}, episodes=3, resume=True, **options)
    run = train(out=out, episodes=3, resume=True, pictures=False)
    assert sorted(run.episodes["environment"]) == sorted(VARIANTS)


def test_variants_are_read_from_a_file(tmp_path):
    (tmp_path / "part").mkdir()
    (tmp_path / "part" / "task.yaml").touch()
    file = tmp_path / "variants.yaml"
    file.write_text("near: {}\nother: {task: part, offset_range: [0.001, 0.002]}\n")
    variants = load_variants(file)
    assert variants == {"near": {}, "other": {"task": str(tmp_path / "part"), "offset_range": (0.001, 0.002)}}
    assert load_variants(None) == {}


def test_privileged_values_are_observed_in_every_environment():
    class Hidden(gymnasium.Env):
        observation_space = action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        privileged_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float32)
        observes_privileged = False

        def __init__(self, value):
            self.privileged = np.full(3, value)

    envs = {"a": Hidden(1.0), "b": Hidden(2.0)}
    both = EnvironmentSet(envs, 0)
    assert both.privileged_space.shape == (3,)
    both.observes_privileged = True
    assert all(env.observes_privileged for env in envs.values())
    for index in range(2):
        name = both.select(index)
        assert both.privileged[0] == {"a": 1.0, "b": 2.0}[name]
    del envs["b"].privileged
    envs["b"].privileged_space = None
    assert EnvironmentSet(envs, 0).privileged_space is None
