"""Benchmark of parallel actors."""

from dataclasses import replace

import pytest

from research.benchmarks import actors
from research.benchmarks.actors import seconds_per_episode


@pytest.mark.parametrize(
    ("cores", "num_envs", "expected"),
    [(1, 0, 3.0), (1, 2, 3.0), (2, 1, 2.0), (2, 2, 1.5), (16, 1, 2.0), (16, 4, 1.0), (100, 50, 1.0)],
)
def test_model_is_limited_by_work_learner_or_actors(cores, num_envs, expected):
    assert seconds_per_episode(2.0, 1.0, cores, num_envs) == expected


def test_benchmark_measures_each_number_of_actors(bead_config, monkeypatch):
    def configured(task, environment, *, episodes, settings):
        learner = replace(bead_config.learner, num_envs=settings["num_envs"])
        return replace(bead_config, learner=learner, episodes=episodes)

    monkeypatch.setattr(actors, "configure", configured)
    result = actors.measure("Bead", {})
    assert result["simulation"] > 0
    assert result["learning"] > 0
    assert [row["measured"] is None for row in result["rows"]] == [False, False, False, True, True]
