"""Parallel actors, which simulate episodes in forks of the learning process."""

import os
import signal
from dataclasses import replace

import pandas as pd
import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.learning.episodes import ActorEpisodes
from guiderail.tools.learning.run_folder import LOCK, RunFolder
from guiderail.tools.learning.trainer import Observers, run_training
from oracles.same_runs import differences


@pytest.fixture
def parallel_config(bead_config):
    """Return a function from a number of actors to the configuration of a run of 8 episodes, half of them greedy."""

    def config(num_envs, **settings):
        options = {"greedy_episode_fraction": 0.5, "selection_window": 2, "num_envs": num_envs, **settings}
        return replace(bead_config, learner=replace(bead_config.learner, **options))

    return config


def rows(folder):
    return pd.DataFrame(folder.episodes()).drop(columns="wall_time")


class Stopped(Exception):
    pass


def stop_in_episode_4(row):
    if row["episode"] == 4:
        raise Stopped


def test_run_with_actors_resumes_bit_for_bit(parallel_config, tmp_path):
    """Episodes that are in simulation when the run stops are simulated again after the resume."""
    config = parallel_config(3)
    whole, stopped = RunFolder(tmp_path / "whole"), RunFolder(tmp_path / "stopped")
    run_training(whole, config)
    with pytest.raises(Stopped):
        run_training(stopped, config, observers=Observers(stop_in_episode_4))
    run_training(stopped, config, resume=True)
    assert differences(whole.path, stopped.path) == []


def test_lock_is_released_after_the_actors_end(parallel_config, tmp_path, monkeypatch):
    folder, close, locked = RunFolder(tmp_path / "run"), ActorEpisodes.end, []

    def close_and_record(self):
        close(self)
        locked.append((folder.path / LOCK).exists())

    monkeypatch.setattr(ActorEpisodes, "end", close_and_record)
    with pytest.raises(Stopped):
        run_training(folder, parallel_config(2), observers=Observers(stop_in_episode_4))
    assert locked == [True]
    assert not (folder.path / LOCK).exists()


def test_actors_act_with_weights_of_a_fixed_age(parallel_config, tmp_path):
    folders = {number: RunFolder(tmp_path / str(number)) for number in (1, 2)}
    for number, folder in folders.items():
        # Learning starts within the first episode, and constant episodes are independent of the weights.
        run_training(folder, parallel_config(number, learning_starts=1, constant_episodes=0))
    single, double = (rows(folder) for folder in folders.values())
    pd.testing.assert_frame_equal(single[:2], double[:2])  # both acted with the initial weights
    assert not single[2:3].equals(double[2:3])  # only a single actor has learned from episode 0


def test_demonstrator_acts_in_actors(parallel_config, tmp_path):
    config = parallel_config(2, demonstration_episodes=2)
    result = run_training(
        RunFolder(tmp_path / "run"), config, demonstrator=lambda env: lambda observation: env.action_space.low
    )
    assert [row["is_demonstration"] for row in result] == [1, 1, 0, 0, 0, 0, 0, 0]


def test_run_ends_with_one_sentence_when_an_actor_is_killed(parallel_config, tmp_path, monkeypatch):
    monkeypatch.setattr(ActorEpisodes, "_simulate", lambda self, assignment: os.kill(os.getpid(), signal.SIGKILL))
    with pytest.raises(InputError, match="an actor was killed: resume"):
        run_training(RunFolder(tmp_path / "run"), parallel_config(2))


def test_error_of_an_actor_is_raised_in_the_main_process(parallel_config, tmp_path, monkeypatch):
    def refuse(self, assignment):
        raise InputError("the episode is refused")

    monkeypatch.setattr(ActorEpisodes, "_simulate", refuse)
    with pytest.raises(InputError, match="the episode is refused"):
        run_training(RunFolder(tmp_path / "run"), parallel_config(2))
    assert not (tmp_path / "run").exists()


def test_diverged_run_with_actors_is_reported(parallel_config, tmp_path):
    with pytest.raises(InputError, match="learning diverged"):
        run_training(RunFolder(tmp_path / "run"), parallel_config(2, learning_rate=1e30, constant_episodes=0))


def test_actors_are_refused_with_conflicting_settings(parallel_config, tmp_path):
    folder = RunFolder(tmp_path / "run")
    with pytest.raises(InputError, match="num_envs does not work with --human"):
        run_training(folder, replace(parallel_config(2), human_in_the_loop=True))
    with pytest.raises(InputError, match="callbacks need the episodes"):
        run_training(folder, parallel_config(2), observers=Observers(sb3_callbacks=[]))
    assert not folder.path.exists()


def test_actors_continue_the_episode_count_of_init_from(parallel_config, bead_run, monkeypatch, tmp_path):
    simulate = ActorEpisodes._simulate

    def raise_episode_number(self, assignment):
        simulate(self, assignment)
        raise InputError(f"the actor is in episode {self._learner.episodes}")

    monkeypatch.setattr(ActorEpisodes, "_simulate", raise_episode_number)
    episodes = len(RunFolder(bead_run).episodes())
    with pytest.raises(InputError, match=f"in episode {episodes + 1}$"):
        run_training(RunFolder(tmp_path / "second"), parallel_config(1, init_from=str(bead_run)))
