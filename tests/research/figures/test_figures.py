"""Figures and tables of the thesis."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from guiderail.diagrams.envs.scene import Camera, look_at
from guiderail.models.policy import FORMAT, Policy
from guiderail.models.primitives import LinearConstraints
from guiderail.tools.tables import read_table
from guiderail_studies.declaration import load_study
from guiderail_studies.job import EVALUATED, TRAINING, Job
from research.figures import FIGURES, find_figure, reproduce
from research.figures.chapter_3 import METHODS
from research.figures.chapter_4 import MOVED_ELSEWHERE, _violation
from research.figures.thesis import TABLE_3_2, TABLE_4_1, THESIS
from research.studies import study_path

TABLES = {"table 3.2": TABLE_3_2, "table 4.1": TABLE_4_1}


def test_violation_of_a_path_with_nan_is_nan():
    primitive = SimpleNamespace(constraints=LinearConstraints.box([-1.0, -1.0], [1.0, 1.0]))
    path = np.zeros((3, 2))
    assert _violation(primitive, path) == -1.0
    path[1] = np.nan
    assert np.isnan(_violation(primitive, path))


@pytest.mark.parametrize("figure", FIGURES)
def test_find_figure_returns_a_function(figure):
    assert callable(find_figure(figure))


def test_thesis_results_exist_for_all_figures():
    photographs = {"4.1", "5.1"}  # with a result, but nothing to draw
    assert set(THESIS) == set(FIGURES) | photographs


@pytest.mark.parametrize("figure", ["2.2", "3.4", "5.3", "table 3.2", "table 4.1"])
def test_reproduce_writes_a_picture_or_a_table(figure, tmp_path):
    result = reproduce(figure, out=tmp_path)
    assert result["the thesis"] == THESIS[figure]
    if "table" in figure:
        assert result["the presets of that name have the thesis's values"] == "yes, all"
        assert {"thesis, " + p for p in TABLES[figure]} <= set(read_table(Path(result["table"]).with_suffix(".csv")))
    else:
        assert Path(result["picture"]).stat().st_size > 10_000


def test_camera_projects_its_target_to_the_center():
    camera = Camera((640, 480), np.pi / 2, look_at(np.array([0.0, -2.0, 0.0]), np.zeros(3)))
    points = camera.project(np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 2.0]]))
    np.testing.assert_allclose(points, [[320.0, 240.0], [560.0, 240.0], [320.0, 0.0]], atol=1e-9)


def test_figure_4_2_satisfies_the_constraints(tmp_path):
    result = reproduce("4.2", out=tmp_path)
    rows = read_table(tmp_path / "figure_4_2.csv")
    assert rows["max_commanded_violation"].max() <= 1e-9
    single = rows[rows["panel"].str.startswith("A2")]  # motions with a single action
    assert (single["max_commanded_violation"] > -1e-9).any()
    # A single action changes the motion locally: the change half a second away is less than a sixth.
    assert (single[MOVED_ELSEWHERE] < single["moved_at_3.2_s"] / 6).all()
    assert (single[MOVED_ELSEWHERE] > 0.0).all()
    assert (rows.loc[~rows.index.isin(single.index), MOVED_ELSEWHERE] > 0.05).all()
    assert result["exploration_follows_the_demonstrated_spread"] > 0.8
    assert (tmp_path / "figure_4_2.png").stat().st_size > 10_000


def test_figure_5_4_recovers_from_pushes(tmp_path):
    reproduce("5.4", out=tmp_path)
    rows = read_table(tmp_path / "figure_5_4.csv")
    assert rows["success"].all()
    assert (rows["steps_measured_in_the_zone"] <= 1).all()
    assert rows["max_commanded_violation"].max() <= 1e-9
    recovering = rows[~rows["is_into_zone"].astype(bool)]  # the constraint shortens the return from the zone
    wide, narrow = (recovering[recovering["y"] == y]["steps_to_half"] for y in (0.20, 0.54))
    assert narrow.max() < wide.min()


def write_finished_run(out, study, method, seed, endings):
    """Write a finished run of a study; `endings` has the initial of the termination of each episode."""
    terminations = {"s": "success", "p": "spill", "c": "collision", "t": "time_limit"}
    learner = study.learner.model_copy(update={"episodes": len(endings)})
    methods = {method: study.methods[method].model_copy(update={"learner": type(learner)()})}
    job = Job(study.model_copy(update={"learner": learner, "methods": methods}), method, seed, out)
    numbers = dict.fromkeys(("return", "peak_force", "mean_force", "mean_squared_force", "wall_time"), 0.5)
    numbers["steps"] = 12
    numbers |= {f"jerk_{which}_{part}": 1.0 for which in ("commanded", "measured") for part in ("linear", "angular")}
    counts = {"max_commanded_violation": -1.0, "max_measured_violation": -1.0, "collisions": 0, "fallback_steps": 0}
    rows = [
        {"episode": i, "success": int(end == "s"), "termination": terminations[end], **numbers, **counts}
        for i, end in enumerate(endings)
    ]
    job.folder.create(job.config(len(endings)))
    job.folder.write_episodes(rows)
    layer = (np.zeros((1, 1), np.float32), np.zeros(1, np.float32))
    limits = {"observation_shape": [1], "action_low": [-1.0], "action_high": [1.0]}
    Policy([layer], {"format": FORMAT, **limits}).save(job.folder.path)


def test_pouring_figures_use_every_finished_seed(tmp_path):
    for algorithm in ("sac", "tqc"):
        study = load_study(study_path(f"pouring_{algorithm}"))
        for method in METHODS:
            ending = "s" if method.startswith("rl_sct") else "c"
            write_finished_run(tmp_path, study, method, study.seeds[0], "tp" + ending * 10)
        write_finished_run(tmp_path, study, "rl_sct_shaped", study.seeds[0] + 3, "s" * 12)
    for figure in ("3.5", "3.6", "table 3.3"):
        result = reproduce(figure, seeds=1, episodes=12, out=tmp_path)
        assert result["RL-SCT-Shaped, episodes to convergence"] == "2, 0"
        assert result["RL-Shaped, episodes to convergence"] == "never"
        assert result["RL-Shaped, episodes that ended in a collision"] == "10"
        assert (tmp_path / f"{'table_3_3' if 'table' in figure else 'figure_' + figure.replace('.', '_')}.png").exists()
    assert reproduce("3.8", seeds=1, episodes=12, out=tmp_path)["tqc, RL-SCT-Sparse, episodes to convergence"] == "2"
    table = (tmp_path / "table_3_3.md").read_text()
    assert all(word in table for word in ("translational", "tilt", "pour", "TiltTowards", "15 per meter"))


def test_grid_clamp_figure_has_the_force_of_each_seed(tmp_path):
    study = load_study(study_path("grid_clamp_figures"))
    for method in study.methods:
        write_finished_run(tmp_path, study, method, 0, "t" + "s" * 11)
    result = reproduce("3.11", seeds=1, episodes=12, out=tmp_path)
    assert result["with the cost of force, return of the last ten episodes, each seed"] == "0.5"
    assert not set(EVALUATED) & set(read_table(tmp_path / "figure_3_11.csv").columns)
    assert {f"training_{name}" for name in TRAINING} <= set(read_table(tmp_path / "figure_3_11.csv").columns)
