"""Pipelined learner: training in a second process."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from spaces_only_env import SpacesOnlyEnv

from guiderail.models.common.errors import InputError
from guiderail.tools.evaluation.episode import Transition
from guiderail.tools.evaluation.step_log import read_step_log
from guiderail.tools.learning.learner import LEARNERS
from guiderail.tools.learning.learner_config import resolve_preset
from guiderail.tools.learning.processes import PipelinedLearner, _write


def make_learner(algorithm="sac", **options):
    """Return a pipelined learner and its acting learner; `algorithm` trains in the second process."""
    env = SpacesOnlyEnv()
    small = {
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
