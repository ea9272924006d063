"""Report of the reproduction against its stored tables."""

import numpy as np
import pandas as pd
import pytest

from guiderail.tools.tables import read_table
from research.figures.thesis import THESIS
from research.reproduction.knowledge import count_knowledge
from research.reproduction.report import (
    BEGIN,
    DETAILS,
    END,
    HOLDS,
    PAGE,
    ROOT,
    avoided_at,
    converged_at,
    entries,
    format_details,
    format_verdicts,
)
from research.reproduction.tables import TABLES, load


@pytest.fixture(scope="module")
def report():
    return entries()


def verdict_of(report, number):
    (entry,) = [entry for entry in report if number in entry.numbers]
    return entry.verdict


def test_report_has_every_figure_once(report):
    assert sorted(number for entry in report for number in entry.numbers) == sorted(THESIS)


def test_report_names_stored_files_only(report):
    missing = [name for entry in report for name in entry.tables if not (ROOT / "research" / name).is_file()]
    assert not missing


def test_page_has_the_report_of_the_stored_tables(report):
    text = PAGE.read_text("utf-8")
    assert text.partition(BEGIN)[2].partition(END)[0].strip() == format_verdicts(report).strip()
    assert DETAILS.read_text("utf-8") == format_details(report)


def test_open_figures_count_the_runs_that_have_ended(report):
    for number in ("3.5", "3.6"):
        assert verdict_of(report, number).startswith("open")


def test_image_policies_avoid_the_obstacle_after_30_episodes(report):
    rows = load("narrow_passage_images_evaluated")
    last = rows[(rows["method"] == "kgrl") & (rows["after_episodes"] == 30)]
    assert last["seed"].nunique() == 10
    assert (last["reward_obstacle_cost"] == 0).all()
    assert (last["return"] > 199.9).all()
    assert verdict_of(report, "4.7") == HOLDS


def test_kgrl_always_passes_the_narrow_passage(report):
    rows = load("thesis_narrow_passage")
    kgrl = rows[rows["method"] == "kgrl"]
    assert len(kgrl) == 600
    assert kgrl["success"].all()
    assert kgrl["collisions"].sum() == 0
    assert verdict_of(report, "4.5") == f"{HOLDS}, with actions of five control steps"


def test_cost_of_force_lowers_the_force_on_the_clamp():
    rows = load("thesis_grid_clamp")
    early = rows[rows["episode"] < 70].groupby("method")["mean_squared_force"].mean()
    assert early["sct"] < 0.7 * early["sct_no_force"]


def test_balls_fall_into_the_mug_near_the_pour_line():
    rows = read_table(TABLES / "pour_line.csv")
    radius = np.hypot(rows["x_mm"], rows["y_mm"] + 35)
    assert (rows["ending"][radius <= 25] == "success").all()
    assert (rows["ending"] != "success").sum() > 20


def test_shielded_template_never_spills_in_training():
    assert not (load("pouring_hard_shield")["termination"] == "spill").any()


@pytest.mark.parametrize(
    ("success", "expected"), [([1] * 10, 0), ([0, 0] + [1] * 12, 2), ([1] * 9 + [0] + [1] * 9, None), ([], None)]
)
def test_convergence_begins_with_ten_successes(success, expected):
    assert converged_at(pd.Series(success, dtype=float)) == expected


@pytest.mark.parametrize(
    ("costs", "expected"), [([-80.0] * 3 + [0.0] * 6, 3), ([-80.0] * 9, None), ([0.0] * 5, 0), ([0.0] * 4, None)]
)
def test_obstacle_is_avoided_when_five_episodes_cost_little(costs, expected):
    assert avoided_at(pd.Series(costs)) == expected


def test_knowledge_of_the_template_is_counted():
    counts = count_knowledge()
    assert counts["template"]["states"] == 3
    assert counts["template"]["active constraints"] > counts["reward"]["terms"]
