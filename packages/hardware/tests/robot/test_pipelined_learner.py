"""Learner that acts while a second process trains."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
import torch
from gymnasium import spaces
from spaces_only_env import SpacesOnlyEnv

from guiderail.models.common.errors import InputError
from guiderail.tools.evaluation.episode import Transition
from guiderail.tools.evaluation.step_log import read_step_log
from guiderail.tools.learning.checkpoint import load_off_policy, save_checkpoint
from guiderail.tools.learning.learner import LEARNERS
from guiderail.tools.learning.learner_config import resolve_preset
from guiderail.tools.learning.run_folder import RunFolder
from guiderail_hardware.robot.pipelined_learner import PipelinedLearner, _write

OBSERVED, HIDDEN = 3, 2  # sizes of an observation and of a privileged observation


def make_learner(algorithm="sac", *, privileged=False, **options):
    """Return a pipelined learner and its acting learner; `algorithm` trains in the second process."""
    env = SpacesOnlyEnv()
    env.privileged_space = spaces.Box(-np.inf, np.inf, (HIDDEN,), np.float32)
    small = {
        "privileged_critic": privileged,
        "net_arch": (8, 8),
        "learning_starts": 4,
        "batch_size": 4,
        "exploration.constant_episodes": 0,
        "train_freq": 1,
    }
    preset = resolve_preset("tqc_contact", "sac", small)
    keywords = {"action_repeat": 1, "seed": 0, "max_transitions": 100, "symmetry": None}
    acting = LEARNERS.get("sac")(preset, env, **keywords)
    arguments = ((replace(preset, algorithm=algorithm), env), keywords)
    return PipelinedLearner(acting, arguments, waits=True, **options), acting


def test_step_log_is_absent_when_writing_fails(tmp_path, monkeypatch):
    rows, file = pa.table({"episode": np.zeros(9, np.int32)}), tmp_path / "steps" / "episode-000000.parquet"

    def fail(*arguments):
        raise OSError("the process was killed")

    with monkeypatch.context() as patch:
        patch.setattr("os.replace", fail)
        with pytest.raises(InputError):
            _write(None, file, rows)
    assert list(tmp_path.rglob("*.parquet")) == []
    _write(None, file, rows)
    assert len(read_step_log(file.parent)) == 9


def test_step_log_that_cannot_be_written_is_reported(forkserver, tmp_path):
    (tmp_path / "file").write_text("")
    learner, _ = make_learner()
    learner.write(tmp_path / "file" / "episode-000000.parquet", pa.table({"episode": [0]}))
    with pytest.raises(InputError, match="cannot be written"):
        learner.finish()


def test_failure_of_a_learner_in_the_second_process_is_named(forkserver, tmp_path):
    module = tmp_path / "lab_learner.py"
    module.write_text(
        "from guiderail.tools.learning.learner import register_learner\n"
        "from guiderail.tools.learning.off_policy import SacLearner\n"
        '@register_learner("lab")\n'
        "class Lab(SacLearner):\n"
        "    def state(self):\n"
        "        raise OSError('no space')\n"
    )
    learner, _ = make_learner("lab", imports=(str(module),))
    with pytest.raises(InputError, match=r"Lab in the training process failed: lab_learner\.py, line 6: OSError: no"):
        learner.state()
    learner.close()


def test_pipelined_learner_acts_with_weights_two_episodes_old(forkserver):
    learner, acting = make_learner(excluded=("stopped",))
    before = acting.actor().state_dict()["mu.weight"].clone()
    rng, last = np.random.default_rng(0), {"success": False}
    for termination, known in (("time_limit", 0), ("stopped", 0), ("success", 0), ("time_limit", 1), ("success", 2)):
        learner.on_episode_start()
        for _ in range(6):
            observation, action = rng.uniform(-1, 1, 3).astype(np.float32), learner.act(np.zeros(3, np.float32))
            learner.on_step(Transition(observation, action, 0.0, observation, False, False, {}))
        assert (learner.known, learner.late) == (known, 0)
        learner.on_episode_end({"termination": termination, **last})
        learner.submit_episode()
    learner.finish()
    assert (learner.known, acting.transitions, acting.episodes) == (4, 24, 4)
    assert not np.allclose(before, acting.actor().state_dict()["mu.weight"])


def run_episode(learner, seed=0):
    rng = np.random.default_rng(seed)
    learner.on_episode_start()
    for _ in range(8):
        observation, hidden = (rng.uniform(-1, 1, size).astype(np.float32) for size in (OBSERVED, HIDDEN))
        action = learner.act(observation)
        learner.on_step(Transition(observation, action, 1.0, observation, False, False, {}, hidden, hidden))
    learner.on_episode_end({"termination": "success", "success": True})


def test_learner_restores_a_pending_episode(forkserver):
    """The pending episode of a checkpoint contains the hidden values."""
    whole, resumed = (make_learner(privileged=True)[0] for _ in range(2))
    run_episode(whole)
    arrays, values = whole.state()
    assert arrays["pending/privileged"].shape == (8, HIDDEN)
    random_state = torch.get_rng_state(), np.random.get_state()  # noqa: NPY002
    whole.submit_episode()
    whole.finish()
    torch.set_rng_state(random_state[0])
    np.random.set_state(random_state[1])  # noqa: NPY002
    resumed.restore(arrays, values)
    resumed.finish()
    observation = np.linspace(-1, 1, OBSERVED, dtype=np.float32)
    policies = [learner.policy({"observation_shape": [OBSERVED]}) for learner in (whole, resumed)]
    np.testing.assert_array_equal(policies[0](observation), policies[1](observation))


def test_simulated_run_starts_from_a_run_of_a_robot(forkserver, tmp_path):
    learner, _ = make_learner()
    for seed in range(2):
        run_episode(learner, seed)
        learner.submit_episode()
    arrays, values = learner.state()
    save_checkpoint(RunFolder(tmp_path).checkpoint, arrays, {"learner": values})
    learner.finish()
    stored, learned = load_off_policy(str(tmp_path))
    assert (learned["transitions"], learned["episodes"]) == (16, 2)
    for name in ("policy/actor.mu.weight", "buffer/rewards"):
        np.testing.assert_array_equal(np.ravel(stored[name]), np.ravel(arrays[f"learning/{name}"]))
