"""Training over a set of two engines, with a privileged critic."""

import gymnasium
import pytest

pytest.importorskip("mujoco")

import guiderail
from guiderail.tools.learning.environment_set import EnvironmentSet


def test_one_policy_learns_in_both_engines_with_a_privileged_critic(tmp_path):
    run = guiderail.train(
        "BncConnector", "kgrl", out=tmp_path / "run", variants={"drake": {}, "mujoco": {"station": "mujoco"}},
        settings={"net_arch": "8", "gradient_steps": 1, "learning_starts": 10, "batch_size": 8, "symmetry": "near",
                  "privileged_critic": True},
        difficulty="hard", action_repeat=5, episodes=2, pictures=False,
        bounded_force=False, force_limit=5.0,  # an episode ends at the first contact
    )  # fmt: skip
    assert sorted(set(run.episodes["environment"])) == ["drake", "mujoco"]
    assert [member.environment["station"] for member in run.config.members] == ["gantry", "mujoco"]
    guiderail.train(out=tmp_path / "run", episodes=3, resume=True, pictures=False)
    assert len(run.episodes) == 3


def test_privileged_observation_is_that_of_the_current_engine():
    options = {"guidance": "kgrl", "difficulty": "hard", "disable_env_checker": True}
    members = {
        station: gymnasium.make("guiderail/BncConnector-v0", station=station, **options)
        for station in ("gantry", "mujoco")
    }
    env = EnvironmentSet(members, 0)
    env.observes_privileged = True
    env.reset(seed=3)
    for index in range(2):
        name = env.select(index)
        env.reset()
        offset = env.privileged[:2]
        assert members[name].unwrapped.privileged is env.privileged
        assert offset == pytest.approx(members[name].unwrapped.sampled["jack_offset"][:2] / 2e-3, abs=1e-6)
    env.close()
