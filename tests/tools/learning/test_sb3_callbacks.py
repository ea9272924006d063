"""Callbacks of Stable-Baselines3 in a training run."""

from dataclasses import replace

import pytest
from stable_baselines3 import TD3
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback

from guiderail.models.common.errors import InputError
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.learning.trainer import Observers, run_training


class Recorder(BaseCallback):
    """Callback that records its calls, and stops the training after `last` transitions."""

    def __init__(self, last=10**9):
        super().__init__()
        self.calls, self.transitions, self.last = [], [], last

    def _on_training_start(self):
        self.calls.append("training start")

    def _on_rollout_start(self):
        self.calls.append("start")

    def _on_step(self):
        self.transitions.append((self.num_timesteps, self.locals["rewards"][0], self.locals["infos"][0]["is_success"]))
        return self.num_timesteps < self.last

    def _on_rollout_end(self):
        self.calls.append("end")

    def _on_training_end(self):
        self.calls.append("training end")


def test_callbacks_receive_every_transition_and_the_model(bead_config, tmp_path):
    recorder, checkpoints = Recorder(), CheckpointCallback(5, str(tmp_path / "models"))
    config = replace(bead_config, episodes=3, learner=replace(bead_config.learner, algorithm="sac"))
    rows = run_training(RunFolder(tmp_path / "run"), config, observers=Observers(sb3_callbacks=[recorder, checkpoints]))
    assert recorder.calls == ["training start", *["start", "end"] * 3, "training end"]
    assert [count for count, _, _ in recorder.transitions] == list(range(1, len(recorder.transitions) + 1))
    assert sum(reward for _, reward, _ in recorder.transitions) == pytest.approx(sum(row["return"] for row in rows))
    assert recorder.model.policy is not None
    assert len(list((tmp_path / "models").glob("*.zip"))) == len(recorder.transitions) // 5
    plain = run_training(RunFolder(tmp_path / "plain"), config)
    assert [row["return"] for row in plain] == [row["return"] for row in rows]


def test_count_of_transitions_continues_when_resumed(bead_config, tmp_path):
    config, folder = replace(bead_config, episodes=1), RunFolder(tmp_path / "run")
    first, second = Recorder(), Recorder()
    run_training(folder, config, observers=Observers(sb3_callbacks=first))
    run_training(folder, replace(config, episodes=2), resume=True, observers=Observers(sb3_callbacks=second))
    counts = [count for count, _, _ in [*first.transitions, *second.transitions]]
    assert counts == list(range(1, len(counts) + 1))


def test_callback_that_returns_false_ends_the_training(bead_config, tmp_path):
    recorder = Recorder(last=1)
    rows = run_training(RunFolder(tmp_path / "run"), bead_config, observers=Observers(sb3_callbacks=recorder))
    assert len(rows) == 1
    assert (tmp_path / "run" / "policy.safetensors").is_file()
    resumed = run_training(RunFolder(tmp_path / "run"), bead_config, resume=True)
    assert len(resumed) == bead_config.episodes


def test_callbacks_of_another_kind_are_refused(bead_config, tmp_path):
    for callbacks in (lambda: True, [TD3]):
        with pytest.raises(InputError, match="is no callback"):
            run_training(RunFolder(tmp_path / "run"), bead_config, observers=Observers(sb3_callbacks=callbacks))
    assert not (tmp_path / "run").exists()
