"""Learning log of a run, in the formats of Stable-Baselines3's logger."""

import sys
from dataclasses import replace
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from guiderail.models.common import errors
from guiderail.models.common.errors import InputError
from guiderail.tools.learning.learner import LearningLog
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.learning.train import train
from guiderail.tools.learning.trainer import Observers, run_training
from oracles.same_runs import differences

LOSSES = ["train/critic_loss", "train/actor_loss", "train/ent_coef"]


@pytest.mark.parametrize("algorithm", ["sac", "tqc"])
@pytest.mark.parametrize("dropout", [0.0, 0.01], ids=["fast", "sb3"])
def test_log_has_returns_and_losses(dropout, algorithm, bead_config, tmp_path):
    learner = replace(bead_config.learner, algorithm=algorithm, dropout=dropout, constant_episodes=0)
    run_training(
        RunFolder(tmp_path),
        config := replace(bead_config, learner=learner, episodes=4),
        observers=Observers(log=["csv"]),
    )
    logged, episodes = pd.read_csv(tmp_path / "logs" / "progress.csv"), RunFolder(tmp_path).episodes()
    np.testing.assert_allclose(logged["rollout/return"], episodes["return"])
    assert np.isfinite(logged[LOSSES].iloc[-1]).all()
    assert config.episodes == len(logged)


def test_log_does_not_change_the_run(bead_config, tmp_path):
    for name, log in (("silent", ()), ("logged", ["json"])):
        run_training(RunFolder(tmp_path / name), bead_config, observers=Observers(log=log))
    assert (tmp_path / "logged" / "logs" / "progress.json").is_file()
    assert not (tmp_path / "silent" / "logs").exists()
    assert differences(tmp_path / "silent", tmp_path / "logged") == []


def test_resumed_run_keeps_the_log_of_its_first_part(bead_config, tmp_path):
    run_training(RunFolder(tmp_path), replace(bead_config, episodes=2), observers=Observers(log=["csv"]))
    run_training(RunFolder(tmp_path), replace(bead_config, episodes=4), resume=True, observers=Observers(log=["csv"]))
    files = sorted(path.name for path in (tmp_path / "logs").iterdir())
    assert files == ["progress-from-2.csv", "progress.csv"]


def test_log_format_is_refused_when_unknown_or_not_installed(monkeypatch, bead_config, tmp_path):
    with pytest.raises(InputError, match="did you mean tensorboard"):
        run_training(RunFolder(tmp_path), bead_config, observers=Observers(log=["tensorbord"]))
    monkeypatch.setattr(errors, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"guiderail\[tensorboard\]"):
        run_training(RunFolder(tmp_path), bead_config, observers=Observers(log=["tensorboard"]))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(find_spec("tensorboard") is None, reason="an extra: pip install 'guiderail[tensorboard]'")
def test_tensorboard_log_is_written(bead_config, tmp_path):
    run_training(RunFolder(tmp_path), replace(bead_config, episodes=1), observers=Observers(log=["tensorboard"]))
    assert list((tmp_path / "logs").glob("events.out.tfevents.*"))


def test_wandb_logs_the_values_of_each_episode(tmp_path, monkeypatch):
    """A replacement of the package wandb records the logged values."""
    sent, runs = [], []

    class Run:
        def log(self, values, step):
            sent.append((step, values))

        def finish(self):
            runs.append("finished")

    def init(**options):
        runs.append(options)
        return Run()

    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(init=init, __spec__=ModuleSpec("wandb", None)))
    log = LearningLog(tmp_path / "run" / "logs", "wandb")
    rows = [{"episode": 0, "steps": 7, "return": 1.5}, {"episode": 1, "steps": 5, "return": 2.5}]
    log.record(rows[:1], lambda: {"train/critic_loss": 0.1})
    log.record(rows, dict)
    log.close()
    first = {"rollout/return": 1.5, "rollout/steps": 7, "train/critic_loss": 0.1}
    assert sent == [(7, first), (12, {"rollout/return": 2.5, "rollout/steps": 5})]
    assert runs[0]["name"] == "run"
    assert runs[0]["resume"] == "allow"
    assert runs[-1] == "finished"


def test_log_has_an_entry_for_training_after_the_last_episode(tmp_path):
    log, rows = LearningLog(tmp_path, "csv"), [{"episode": 0, "steps": 10, "return": 1.5}]
    log.record(rows, dict)
    log.record(rows, lambda: {"train/loss": 0.5}, is_finished=True)
    log.record(rows, dict, is_finished=True)
    log.close()
    logged = pd.read_csv(tmp_path / "progress.csv")
    assert len(logged) == 2
    assert logged["train/loss"].tolist()[1] == 0.5


def test_train_resumes_a_run_without_its_task(tmp_path):
    train("NarrowPassage", "kgrl", out=tmp_path / "run", episodes=1, algorithm="sac", pictures=False)
    assert len(train(resume=True, out=tmp_path / "run", episodes=2, pictures=False).episodes) == 2
    with pytest.raises(InputError, match=r"training needs the name of a task or its folder, .* not None"):
        train(out=tmp_path / "other")
