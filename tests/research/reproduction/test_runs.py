"""Runs of the reproduction: order, cost, and resumption."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.tables import read_table
from guiderail_studies.job import Job
from research.reproduction import runs as module
from research.reproduction.command import main
from research.reproduction.runs import FIGURES, find_runs, jobs_of, remaining_hours
from research.reproduction.tables import store
from research.studies import study_names

CLAMP = FIGURES["3.10"][0]


def test_every_figure_names_a_study():
    assert {runs.study for group in FIGURES.values() for runs in group} <= set(study_names())


def test_find_runs_merges_figures_of_one_study():
    (runs,) = find_runs(["4.5", "5.6"])
    assert set(runs.methods) == {"kgrl", "residual", "safe_residual", "skgrl", "kgrl_constant", "skgrl_constant"}


def test_find_runs_refuses_an_unknown_figure():
    with pytest.raises(InputError, match="no runs belong to figure"):
        find_runs(["9.9"])


def test_jobs_are_ordered_seed_by_seed(tmp_path):
    jobs = jobs_of(CLAMP, tmp_path)
    assert [job.seed for job in jobs] == sorted(job.seed for job in jobs)
    assert {job.method for job in jobs[:4]} == {"sct", "sct_no_force", "straight", "uniform_random"}


def test_cost_is_that_of_all_episodes_when_nothing_is_done(tmp_path):
    learning = [job for job in jobs_of(CLAMP, tmp_path) if job.learns]
    assert remaining_hours(CLAMP, tmp_path) == pytest.approx(len(learning) * 100 * CLAMP.seconds[""] / 3600)


def test_cost_falls_by_the_episodes_that_are_done(tmp_path, monkeypatch):
    before = remaining_hours(CLAMP, tmp_path)
    monkeypatch.setattr(module, "num_done", lambda job: 40)
    assert remaining_hours(CLAMP, tmp_path) == pytest.approx(0.6 * before)


def test_command_prints_the_cost_and_trains_nothing(tmp_path, capsys):
    main(["--figure", "3.10", "--cost", "--out", str(tmp_path)])
    assert "core-hours" in capsys.readouterr().out
    assert not list(tmp_path.iterdir())


def test_command_refuses_runs_that_are_not_resumed(tmp_path, monkeypatch):
    monkeypatch.setattr("research.reproduction.command.num_done", lambda job: 1)
    with pytest.raises(InputError, match="give --resume"):
        main(["--figure", "3.10", "--out", str(tmp_path)])


def fake_job(folder, method, seed, episodes, value):
    """Return a job with a number of finished training episodes, all with the same return."""
    rows = pd.DataFrame({"episode": range(episodes), "return": value})
    folder.mkdir(exist_ok=True)
    (folder / "episodes.csv").touch()
    run = SimpleNamespace(path=folder, episodes=lambda: rows)
    return SimpleNamespace(method=method, seed=seed, learns=True, after_episodes=[], folder=run)


def test_stored_runs_stay_unless_the_folder_has_as_many_episodes(tmp_path, monkeypatch):
    """The runs of figure 4.5 don't remove those of figure 5.6 from their table, nor does an unfinished run."""
    for jobs in (
        [("kgrl", 0, 3, 1.0), ("kgrl", 1, 3, 1.0), ("skgrl", 0, 3, 1.0)],
        [("kgrl", 0, 2, 2.0), ("kgrl", 1, 3, 2.0), ("residual", 0, 1, 2.0)],
    ):
        fakes = [fake_job(tmp_path / "runs", *job) for job in jobs]
        monkeypatch.setattr("research.reproduction.tables.jobs_of", lambda runs, out, fakes=fakes: fakes)
        (file,) = store(CLAMP, tmp_path, tmp_path)
    means = read_table(file).groupby(["method", "seed"])["return"].mean().to_dict()
    assert means == {("kgrl", 0): 1.0, ("kgrl", 1): 2.0, ("skgrl", 0): 1.0, ("residual", 0): 2.0}


def test_training_ends_after_consecutive_successes(tmp_path, monkeypatch):
    """An interrupted run that is trained again has the settings that it began with."""
    seen = []
    monkeypatch.setattr(
        "guiderail.tools.learning.trainer.run_training",
        lambda folder, config, resume: seen.append((folder.path, config.learner.stop_after_successes, resume)),
    )
    job = jobs_of(FIGURES["3.5"][0], tmp_path)[0]
    module._train_until_converged(job)
    job.folder.path.mkdir(parents=True)
    (job.folder.path / "config.yaml").touch()
    module._train_until_converged(job)
    assert seen == [(Path(job.folder.path), 10, False), (Path(job.folder.path), 10, True)]


def test_run_has_ended_when_its_policy_is_written(tmp_path, monkeypatch):
    job: Job = jobs_of(replace(FIGURES["3.5"][0]), tmp_path)[0]
    monkeypatch.setattr(module, "num_done", lambda job: 57)
    assert not module.has_ended(job, stops=True)
    job.folder.path.mkdir(parents=True)
    (job.folder.path / "policy.json").touch()
    assert module.has_ended(job, stops=True)
