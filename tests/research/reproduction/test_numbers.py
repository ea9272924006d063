"""Numbers in the page and the details of the reproduction, recomputed from the stored tables.

The formulas are those of the thesis's measures, written independently of the report.
"""

import re
from functools import cache

import numpy as np
import pandas as pd
import pytest

from research.reproduction.report import DETAILS, PAGE, RESULTS
from research.reproduction.tables import TABLES

PASSAGE = {"kgrl": "KGRL", "residual": "residual RL", "safe_residual": "safe residual RL"}
CLAMP = {"sct": "with the cost of force", "sct_no_force": "without it"}
JERKS = ("commanded_linear", "commanded_angular", "measured_linear")


@cache
def table(name):
    """Return a stored table: of the reproduction, a row for each episode, or else of the results."""
    is_of_runs = name == "connector_10hz" or not (TABLES / f"{name}.csv").is_file()
    folder = RESULTS if is_of_runs else TABLES
    return pd.read_csv(folder / f"{name}.csv")


def rows_of(name, method):
    rows = table(name)
    return rows[rows["method"] == method]


def runs_of(name, method, column):
    """Return a column as an array (runs, episodes)."""
    return np.array([run[column].to_numpy(float) for _, run in rows_of(name, method).groupby("seed")])


def band(name, method, column, first, last, digits=1):
    """Return mean and standard deviation over runs of the mean over episodes `first` to `last`, counted from one."""
    means = runs_of(name, method, column)[:, first - 1 : last].mean(axis=1)
    return f"{means.mean():.{digits}f} ± {means.std():.{digits}f}"


def first_streak(success):
    """Return the number of episodes before ten successes in a row."""
    starts = [i for i in range(len(success) - 9) if np.all(success[i : i + 10])]
    return starts[0] if starts else None


def section(heading):
    """Return the text of a section of the details."""
    text = DETAILS.read_text("utf-8")
    return re.split(r"\n## ", text.split(f"## {heading}\n")[1])[0]


def page():
    """Return the text of the page with single spaces."""
    return " ".join(PAGE.read_text("utf-8").split())


@pytest.mark.parametrize("method", CLAMP)
def test_numbers_of_the_clamp(method):
    name, text = "thesis_grid_clamp", section("Figure 3.10")
    streaks = ", ".join(str(first_streak(run)) for run in runs_of(name, method, "success"))
    assert f"{CLAMP[method]}: ten successes in a row begin after {streaks} episodes" in text
    for column, first, last, unit in (
        ("mean_squared_force", 1, 70, " N²"),
        ("mean_squared_force", 71, 100, " N²"),
        ("steps", 91, 100, ""),
    ):
        assert band(name, method, column, first, last) + unit in text
    assert f"episodes 71 to 100 {band(name, method, 'success', 71, 100, 3)}" in text
    returns = [band(name, method, "return", *part) for part in ((1, 10), (61, 70), (91, 100))]
    least = runs_of(name, method, "return")[:, 90:].mean(axis=1).min()
    assert f"{', '.join(returns)} (least of a run {least:.1f})" in section("Figure 3.11")


def test_verdict_of_the_clamp_names_force_steps_and_random_actions():
    name = "thesis_grid_clamp"
    force = [runs_of(name, method, "mean_squared_force")[:, :70].mean() for method in CLAMP]
    steps = [runs_of(name, method, "steps")[:, 90:].mean() for method in CLAMP]
    random = rows_of("grid_clamp_baselines", "uniform_random")["success_rate"].item()
    assert (
        f"learned within 70 episodes with {100 - 100 * force[0] / force[1]:.0f} % less force, but "
        f"{100 * steps[0] / steps[1] - 100:.0f} % longer episodes; random actions succeed in {100 * random:.0f} %"
    ) in page()


@pytest.mark.parametrize("method", PASSAGE)
def test_numbers_of_the_narrow_passage(method):
    name, rows = "thesis_narrow_passage", rows_of("thesis_narrow_passage", method)
    first = int((rows.loc[rows["episode"] == 0, "success"] == 1).sum())
    assert (
        f"{PASSAGE[method]}: success {band(name, method, 'success', 1, 60, 2)} of 60 episodes, {first} of 10 first "
        f"episodes; return of the last ten episodes {band(name, method, 'return', 51, 60)}"
    ) in section("Figure 4.5")
    in_zone = (rows["max_measured_violation"] > 0).sum()
    counts = f"{rows['collisions'].sum()} collisions, {in_zone} episodes in the zone, of {len(rows)} episodes"
    assert f"{PASSAGE[method]}: {counts}" in section("Figure 4.6")


@pytest.mark.parametrize("method", ["kgrl", "skgrl", "kgrl_constant", "skgrl_constant"])
def test_numbers_of_the_comparison_with_skgrl(method):
    name, text = "thesis_narrow_passage", section("Figure 5.6")
    parts = (
        f"return of the last ten episodes {band(name, method, 'return', 51, 60)}",
        f"action cost of the first ten {band(name, method, 'reward_action_cost', 1, 10, 2)}, of the last ten "
        f"{band(name, method, 'reward_action_cost', 51, 60, 2)}",
    )
    assert "; ".join(parts) in text


def test_verdict_of_the_comparison_counts_runs():
    name = "thesis_narrow_passage"
    last = {method: runs_of(name, method, "return")[:, 50:].mean(axis=1) for method in ("kgrl", "skgrl")}
    better = int((last["skgrl"] > last["kgrl"].mean()).sum())
    stuck = int((last["skgrl"] < 190).sum())  # the obstacle costs more than 30 in such a run
    assert f"higher return in {better} of 10 runs, {stuck} never avoid the obstacle" in page()
    assert last["skgrl"].mean() < last["kgrl"].mean()
    constant = [runs_of(name, f"{method}_constant", "return")[:, 50:].mean(axis=1) for method in ("kgrl", "skgrl")]
    assert constant[0].max() < constant[1].min()
    costs = [runs_of(name, f"{method}_constant", "reward_obstacle_cost")[:, :20].mean() for method in ("kgrl", "skgrl")]
    assert costs[0] == pytest.approx(costs[1], rel=0.1)  # no later avoidance after constant actions


def test_numbers_of_the_images():
    text, name = section("Figure 4.7"), "narrow_passage_images"
    for column in ("return", "reward_obstacle_cost"):
        for first, last in ((1, 5), (26, 30)):
            assert band(name, "kgrl", column, first, last) in text
    greedy = rows_of(f"{name}_evaluated", "kgrl").groupby(["after_episodes", "seed"])["return"].mean()
    means = greedy.groupby("after_episodes").mean()
    assert f"mean returns of {', '.join(f'{value:.0f}' for value in means)}" in text


def test_numbers_of_pouring():
    rows = rows_of("pouring_sac", "rl_sct_shaped")
    actions = rows["training_total_steps"].sum() / rows["training_episodes"].sum() / 10
    constant = rows_of("pouring_baselines", "best_constant")["success_rate"].item()
    text = section("Figure 3.7")
    assert f"one constant action pours in {100 * constant:.0f} % of the episodes" in text
    assert f"{actions:.0f} actions instead of the thesis's 149" in text
    streaks = ", ".join(f"{value:.0f}" for value in rows["training_episodes_to_convergence"])
    assert f"begin after {streaks} episodes" in text
    text, name = section("Pouring at difficulty hard"), "pouring_hard_shield"
    streaks = ", ".join(str(first_streak(run)) for run in runs_of(name, "rl_sct", "success"))
    assert f"episodes until ten successes in a row: {streaks};" in text
    held_out = rows_of(f"{name}_evaluated", "rl_sct").groupby("seed")["success"].sum()
    assert ", ".join(f"{number} of 100" for number in held_out) in text


def test_numbers_of_the_connector():
    kgrl, skgrl = (rows_of("connector_10hz", method) for method in ("kgrl", "skgrl"))
    for rows, first in ((kgrl, "its first 35 ({:.0f} %)"), (skgrl, "{:.0f} % of the first 35 episodes succeed")):
        successes = 45 * rows["training_success_rate"] - 10 * rows["training_success_rate_last_10"]
        assert first.format(100 * successes.sum() / 35 / len(rows)) in page()
    last = [100 * rows["training_success_rate_last_10"].mean() for rows in (kgrl, skgrl)]
    assert f"{last[1]:.0f} % of the last ten" in page()
    assert f"KGRL's last ten training episodes ({last[0]:.0f} %)" in page()
    assert f"{last[0]:.0f} % (KGRL) and {last[1]:.0f} % (sKGRL) of the last ten of 45 episodes succeed" in page()
    assert (skgrl["training_success_rate_last_10"] >= 0.9).sum() == 9
    streaks = ["never" if pd.isna(v) else f"{v:.0f}" for v in skgrl["training_episodes_to_convergence"]]
    assert f"begin after {', '.join(streaks)} episodes" in section("Figure 5.9")
    assert (100 * skgrl.set_index("seed").loc[[600, 606, 608], "success_rate"]).round().tolist() == [75, 20, 60]
    assert f"in {100 * kgrl['success_rate'].mean():.1f} % of the held-out episodes (seed 608 in 3 of 20)" in page()
    assert kgrl.set_index("seed").loc[608, "success_rate"] == 3 / 20
    random = {m: rows_of("connector_10hz", m) for m in ("uniform_random", "uniform_random_skgrl")}
    rates = [f"{100 * rows['success_rate'].mean():.0f} %" for rows in random.values()]
    assert (
        f"the jack in {rates[0]} of the episodes (five of these seeds; through sKGRL's guidance in {rates[1]}" in page()
    )
    assert [len(rows) for rows in random.values()] == [5, 3]
    assert kgrl["training_mean_force"].mean() / skgrl["training_mean_force"].mean() == pytest.approx(2.0, abs=0.1)
    weaker = (kgrl["mean_squared_force"] < kgrl["training_mean_squared_force"]).sum()
    shorter = (kgrl["mean_steps"] * 45 < kgrl["training_total_steps"]).sum()
    assert f"less force in {weaker} and shorter episodes in {shorter} of 10 runs" in page()
    slow = rows_of("connector_thesis", "skgrl")
    assert (slow["training_success_rate"] == 0).all()
    assert f"in none of {slow['training_episodes'].sum():.0f} episodes" in page()
    is_solved = [rows["training_success_rate_last_10"] == 1 for rows in (kgrl, skgrl)]
    returns = [
        rows["training_mean_return_last_10"][own].mean() for rows, own in zip((kgrl, skgrl), is_solved, strict=True)
    ]
    assert returns[0] < returns[1]  # sKGRL's return is the higher one after convergence as well


def test_demonstration_alone_never_locks_the_connector():
    slow = rows_of("connector_thesis", "demonstration")
    at_10_hz = rows_of("connector_10hz_evaluated", "demonstration")
    assert f"none of {slow['episodes'].sum()} episodes at 50 Hz and {len(at_10_hz)} at 10 Hz" in page()
    assert slow["success_rate"].sum() + at_10_hz["success"].sum() == 0


def test_scripted_policy_locks_the_connector_with_some_histories():
    rows = table("connector_history")
    solved = (rows["success_rate"] * rows["episodes"]).groupby(rows["method"]).sum().round().astype(int).to_dict()
    assert (rows["episodes"].groupby(rows["method"]).sum() == 6).all()
    assert f"{solved.pop('thesis_50_hz')} of 6 episodes at 50 Hz and in {solved.pop('thesis')} of 6 at 10 Hz" in page()
    assert set(solved) == {"one_pose_50_hz", "larger_variance", "one_pose", "commanded"}
    assert set(solved.values()) == {6}


def test_numbers_of_the_jerk():
    kgrl, skgrl = (rows_of("connector_10hz", method).set_index("seed") for method in ("kgrl", "skgrl"))
    columns = [f"training_jerk_{jerk}_first_10" for jerk in JERKS]
    ranges = [((ratio := kgrl[column] / skgrl[column]).min(), ratio.max()) for column in columns]
    (low, high), (low_angular, high_angular), (low_measured, high_measured) = ranges
    assert f"| command | {low:.1f} to {high:.1f} | {low_angular:.0f} to {high_angular:.0f} |" in page()
    assert f"measured pose | {low_measured:.1f} to {high_measured:.1f} | – |" in page()
    means = [kgrl[column].mean() / skgrl[column].mean() for column in columns]
    assert f"{means[1]:.0f} times smaller in rotation, {means[0]:.0f} times in translation" in page()
    present = pd.read_csv(TABLES / "connector_10hz.csv")
    means = present[present["episode"] < 10].groupby(["method", "seed"]).mean(numeric_only=True)
    ratios = means.loc["kgrl"] / means.loc["skgrl"]
    assert len(ratios) == 3
    for which, label in (("commanded", "command"), ("measured", "measured pose")):
        linear, angular = (ratios[f"jerk_{which}_{part}"] for part in ("linear", "angular"))
        numbers = f"{linear.min():.1f} to {linear.max():.1f} | {angular.min():.0f} to {angular.max():.0f}"
        assert f"{label} | {numbers} |" in page()
    free = table("smoothness").query("place == 'free' and method == 'sKGRL P=10 ρ=1e-08'").iloc[0]
    linear, angular = free["times_below_kgrl_linear"], free["times_below_kgrl_angular"]
    assert f"in free space | command | {linear:.1f} | {angular:.0f} |" in page()


@pytest.mark.parametrize(("figure", "study"), [("3.5", "thesis_pouring_sac"), ("3.6", "thesis_pouring_tqc")])
def test_shaped_template_converges_in_ten_runs(figure, study):
    runs = [run for _, run in table(study).query("method == 'rl_sct_shaped'").groupby("seed")]
    assert len(runs) == 10
    assert all(run["success"].iloc[-10:].all() and not (run["termination"] == "collision").any() for run in runs)
    verdict = next(line for line in PAGE.read_text("utf-8").splitlines() if line.startswith(f"| Figure {figure} |"))
    assert f"after {max(len(run) for run in runs) - 10} or fewer episodes with RL-SCT-Shaped (thesis: 250)" in verdict


def test_hours_are_those_of_the_stored_runs():
    rows = [rows_of("pouring_sac", "rl_sct_shaped")["training_wall_time"]]
    rows += [rows_of("connector_10hz", method)["training_wall_time"] for method in ("kgrl", "skgrl")]
    names = ("thesis_pouring_sac", "thesis_pouring_tqc", "pouring_hard_shield", "thesis_grid_clamp")
    names += ("thesis_narrow_passage",)
    rows += [table(name)["wall_time"] for name in names]
    rows += [rows_of("narrow_passage_images", "kgrl")["wall_time"]]
    assert f"took {sum(own.sum() for own in rows) / 3600:.1f} hours" in page()


def test_page_names_every_figure_and_table_of_the_thesis():
    counts = {2: 2, 3: 11, 4: 8, 5: 10}
    figures = {f"{chapter}.{i}" for chapter, count in counts.items() for i in range(1, count + 1)}
    text = page().split("## Jerk")[0]
    assert figures <= set(re.findall(r"\b[2-5]\.\d+\b", text))
    assert "table 3.1" in text
    assert "tables 3.2, 3.3 and 4.1" in text
