"""Reports of runs and studies: tables, intervals, commands, figures and refused inputs."""

import html
import itertools
import math
import re
import shlex
import shutil
from dataclasses import replace
from functools import partial
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.baselines import BaselinePolicy, uniform_random
from guiderail.tools.evaluation.episode import HELD_OUT_SEED
from guiderail.tools.evaluation.evaluate import evaluate
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.evaluation.step_log import StepLog, read_step_log
from guiderail.tools.learning.run_folder import RunFolder, configure
from guiderail.tools.learning.trainer import run_training
from guiderail.tools.tables import read_table, write_table
from guiderail.tools.visualization.figures import new_figure, plot_run
from guiderail_studies.report import SAFETY_COLUMNS, _safety, draw_runs, to_svg, write_report
from guiderail_studies.report_data import _stored_episodes, command, gather

SETTINGS = {"net_arch": "16", "batch_size": 16, "learning_starts": 10, "gradient_steps": 2}


@pytest.fixture(scope="module")
def study_folder(tmp_path_factory):
    """Return a folder with the runs of two methods with two seeds, and the table of a study."""
    folder = tmp_path_factory.mktemp("beads")
    for guidance in ("skgrl", "kmp"):
        for seed in (1, 2):
            config = configure("Bead", {"guidance": guidance}, settings=SETTINGS, episodes=3, seed=seed)
            run_training(RunFolder(folder / f"{guidance}-{seed}"), config)
    rows = [("learner", "learned", seed, 3, 10, rate) for seed, rate in ((1, 0.9), (2, 0.7))]
    rows.append(("no action", "zero", 1, 0, 10, 0.1))
    table = pd.DataFrame(rows, columns=["method", "policy", "seed", "after_episodes", "episodes", "success_rate"])
    write_table(folder / "beads", table.assign(eval_set="held out"))
    return folder


def text_of(page):
    """Return the text of an HTML page without figures and styles."""
    return " ".join(re.sub(r"<[^>]+>", " ", re.sub(r"<(svg|style).*?</\1>", " ", page, flags=re.S)).split())


def test_report_executes_no_code_that_a_run_names(study_folder, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(study_folder / "skgrl-1", run)
    (tmp_path / "mine.py").write_text("raise SystemExit('the code of the run was executed')")
    text = (run / "config.yaml").read_text().replace("imports: []", f"imports: [{tmp_path / 'mine.py'}]")
    (run / "config.yaml").write_text(re.sub("algorithm: .*", "algorithm: my_learner\n  my_setting: 0.123", text))
    page = write_report([run], tmp_path / "report.html").read_text()
    assert "my_learner" in page
    with pytest.raises(InputError, match="which would execute code"):
        write_report([run], tmp_path / "again.html", episodes=1)


def test_report_of_a_study_is_one_self_contained_page(study_folder, tmp_path):
    page = write_report([study_folder], tmp_path / "report.html").read_text()
    assert page.count("<svg") >= 4
    assert write_report([study_folder], tmp_path / "again.html").read_text() == page
    assert re.findall(r"(?:src|href)=\"(?!#)[^\"]*\"", page) == []
    assert "<script" not in page
    text = text_of(page)
    assert "sKGRL" in text
    assert "16/20 80.0%" in text, "successes of all seeds"
    assert "9/10 (59.6% to 98.2%), 7/10 (39.7% to 89.2%)" in text, "successes and interval of each seed"
    assert "58.4%" not in text, "no interval of all seeds, because the episodes of a seed are not independent"
    assert "no action: zero" in text
    assert "guiderail study beads.yaml --out studies" in text
    assert RunFolder(study_folder / "kmp-1").config().versions["drake"] in text


def test_methods_are_named_after_differing_settings(study_folder):
    data = gather([study_folder / "skgrl-1", study_folder / "kmp-1"])
    assert [run.method for run in data.runs] == ["sKGRL", "demonstration alone"]
    assert not data.is_study
    assert len(data.held_out) == 0
    second = gather([study_folder / "skgrl-1", study_folder / "skgrl-2"])
    assert {run.method for run in second.runs} == {"sKGRL"}
    assert [len(runs) for runs in second.methods("Bead").values()] == [2]


def test_report_evaluates_a_run_and_baselines_once(study_folder):
    run = study_folder / "skgrl-1"
    held_out = gather([run], episodes=2).held_out
    assert set(held_out["policy"]) == {"learned", "demonstration", "uniform_random", "constant"}
    assert held_out["episodes"].eq(2).all()
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    gather([run], episodes=2)
    assert before == {path: path.stat().st_mtime_ns for path in run.rglob("*")}


def test_report_ignores_evaluations_of_other_conditions(study_folder, tmp_path):
    run = shutil.copytree(study_folder / "skgrl-2", tmp_path / "run")
    baselines = {"uniform_random": partial(BaselinePolicy, uniform_random)}
    evaluate(run, episodes=4, environment={"wall": -0.5}, baselines=baselines)
    evaluate(run, episodes=4, seed=7, baselines=baselines)
    assert len(gather([run]).held_out) == 0
    evaluate(run, episodes=2, baselines=baselines)
    held_out = gather([run]).held_out
    assert held_out[["policy", "episodes"]].to_numpy().tolist() == [
        ["demonstration", 2],
        ["uniform_random", 2],
        ["learned", 2],
    ]


def test_rows_of_a_partial_study_are_counted_once(study_folder, tmp_path):
    folder = tmp_path / "tables"
    folder.mkdir()
    shutil.copy(study_folder / "beads.csv", folder)
    rows = read_table(study_folder / "beads.csv")
    row = rows.iloc[[0]]
    write_table(folder / "beads-learner-1-5", pd.concat([row, row.assign(seed=5, success_rate=0.2)]))
    page = write_report([folder], tmp_path / "page.html").read_text()
    text = text_of(page)
    assert "beads: learner 3 held out 16/20" in text
    assert "beads-learner-1-5: learner 3 held out 2/10" in text
    assert "guiderail study beads.yaml --methods learner --seeds 5 --out studies" in text
    assert "Baseline policies." not in text
    (folder / "beads.csv").unlink()
    text = text_of(write_report([folder], tmp_path / "page.html").read_text())
    assert "guiderail study beads.yaml --methods learner --seeds 1,5 --out studies" in text


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("episodes", "ten", "episodes in .*beads.csv is not an array of numbers"),
        ("episodes", "", "beads.csv is damaged: episodes are whole numbers from 1 on .*, not nan and 0.9"),
        ("episodes", 0, "not 0 and 0.9; restore it, or run the study again"),
        ("episodes", 2.5, "not 2.5 and 0.9"),
        ("episodes", "inf", "not inf and 0.9"),
        ("success_rate", "high", "success_rate in .*beads.csv is not an array of numbers"),
        ("success_rate", 1.5, "success_rate is from 0 to 1, not 10 and 1.5"),
        ("success_rate", -0.1, "not 10 and -0.1"),
    ],
)
def test_study_table_is_refused_when_damaged(name, value, message, study_folder, tmp_path):
    rows = read_table(study_folder / "beads.csv").astype({name: object})
    rows.loc[0, name] = value
    write_table(tmp_path / "beads", rows)
    with pytest.raises(InputError, match=message):
        write_report([tmp_path], tmp_path / "page.html")


@pytest.mark.parametrize("text", [b"a,b\n1\n", b"", b"\xff\n", b'a,"b\n', b"a,a\n1,2\n"])
def test_report_ignores_other_files_in_a_study_folder(text, study_folder, tmp_path):
    shutil.copy(study_folder / "beads.csv", tmp_path)
    (tmp_path / "other.csv").write_bytes(text)
    assert "16/20" in write_report([tmp_path], tmp_path / "page.html").read_text()
    table = (study_folder / "beads.csv").read_text()
    (tmp_path / "beads.csv").write_text(table + "1,2\n")
    with pytest.raises(InputError, match=r"beads\.csv is not a table of episodes: restore it"):
        gather([tmp_path])


def test_report_is_refused_without_folders():
    with pytest.raises(InputError, match="at least one run or study"):
        gather([])


@pytest.mark.parametrize(
    ("content", "arguments"),
    [
        ('{"file": "my studies/first.yaml", "imports": true}', "'my studies/first.yaml' --trust-imports"),
        ('{"file": "first.yaml", "imports": false}', "first.yaml"),
        ("[1]", "beads.yaml"),
    ],
)
def test_command_of_a_study_names_its_file(content, arguments, study_folder, tmp_path):
    shutil.copy(study_folder / "beads.csv", tmp_path)
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "beads.json").write_text(content)
    text = html.unescape(text_of(write_report([tmp_path], tmp_path / "page.html").read_text()))
    assert f"guiderail study {arguments} --out studies" in text


def test_studies_with_similar_names_are_separate(study_folder, tmp_path):
    folder = tmp_path / "tables"
    folder.mkdir()
    rows = read_table(study_folder / "beads.csv")
    for name in ("beads", "beads-hard", "beads-3"):
        write_table(folder / name, rows)
    text = text_of(write_report([folder], tmp_path / "page.html").read_text())
    for name in ("beads", "beads-hard", "beads-3"):
        assert f"{name}: learner 3 held out 16/20" in text
        assert f"guiderail study {name}.yaml --out studies" in text


def test_partial_study_is_omitted_when_its_rows_are_known(study_folder, tmp_path):
    folder = tmp_path / "tables"
    folder.mkdir()
    shutil.copy(study_folder / "beads.csv", folder)
    rows = read_table(study_folder / "beads.csv")
    write_table(folder / "beads-2", rows.iloc[1:])  # of `--seeds 2`; the method "no action" declares the seed 1
    text = text_of(write_report([folder], tmp_path / "page.html").read_text())
    assert "beads-2" not in text


def test_runs_with_equal_folder_names_are_numbered(study_folder, tmp_path):
    for name in ("a", "b"):
        shutil.copytree(study_folder / "skgrl-1", tmp_path / name / "same")
    text = text_of(write_report([tmp_path / "a/same", tmp_path / "b/same"], tmp_path / "page.html").read_text())
    assert "--out runs/same-1" in text
    assert "--out runs/same-2" in text


def test_report_checks_its_path_before_the_evaluation(study_folder, tmp_path):
    (tmp_path / "file").touch()
    before = sorted(study_folder.rglob("*"))
    with pytest.raises(InputError, match="cannot be written"):
        write_report([study_folder / "skgrl-1"], tmp_path / "file" / "page.html", episodes=5)
    assert sorted(study_folder.rglob("*")) == before


def test_report_leaves_out_the_figure_of_a_missing_column(study_folder, tmp_path):
    run = shutil.copytree(study_folder / "skgrl-1", tmp_path / "run")
    table = pd.read_csv(run / "episodes.csv")
    table.drop(columns="mean_squared_force").to_csv(run / "episodes.csv", index=False)
    assert "success rate over" in write_report([run], tmp_path / "page.html").read_text()
    table.drop(columns="max_commanded_violation").to_csv(run / "episodes.csv", index=False)
    with pytest.raises(InputError, match="no max_commanded_violation; train again"):
        write_report([run], tmp_path / "page.html")
    with pytest.raises(InputError, match="no max_commanded_violation; train again"):
        plot_run(run)
    table.assign(fault="NONE").to_csv(run / "episodes.csv", index=False)  # text, as in a run on hardware
    assert plot_run(run).is_file()


def test_description_of_a_figure_is_escaped_in_xml():
    figure, _ = new_figure(1, 1, (1.0, 1.0))
    element = ElementTree.fromstring(to_svg(figure, 'success of "my" <task> & more'))
    assert element.attrib["aria-label"] == 'success of "my" <task> & more'


def test_safety_is_counted_in_control_steps_with_a_step_log(tmp_path):
    config = configure("NarrowPassage", {"guidance": "residual"}, episodes=1)
    folder, env = RunFolder(tmp_path / "run"), make_environment("NarrowPassage", config.environment)
    folder.create(config)
    folder.write_episodes([rollout(env, lambda _: np.array([1.0, 0.0]), StepLog(env, folder.steps), seed=0)])
    env.close()
    (run,) = gather([tmp_path / "run"]).runs
    step_log, row = read_step_log(tmp_path / "run" / "steps"), run.episodes.iloc[0]
    assert run.safety["source"] == "step_log"
    assert run.safety["steps"] == len(step_log) == row["steps"]
    assert run.safety["collision_steps"] > 0
    assert run.safety["measured_violations"] == (step_log["measured_violation"] > 1e-9).sum()
    assert run.safety["max_commanded_violation"] == row["max_commanded_violation"]
    assert run.safety["collision_steps"] == row["collision_steps"]
    (tmp_path / "run" / "steps" / "episode-000000.parquet").unlink()
    with pytest.raises(InputError, match="has no step log"):
        _ = run.safety


def test_command_of_a_run_reproduces_its_configuration(bead_config):
    config = replace(bead_config, step_log=False)
    arguments = shlex.split(command(config, "runs/bead"))
    assert arguments[:3] == ["guiderail", "train", "Bead"]
    assert arguments[-3:] == ["--no-step-log", "--out", "runs/bead"]
    settings = dict(value.split("=") for name, value in itertools.pairwise(arguments) if name == "--set")
    option = dict(zip(arguments[3:-3:2], arguments[4:-3:2], strict=True))
    second = configure(
        "Bead", {"guidance": option["--guidance"]}, algorithm=option["--algorithm"], preset=option["--preset"],
        episodes=int(option["--episodes"]), seed=int(option["--seed"]), settings=settings, step_log=False,
    )  # fmt: skip
    assert second == config
    with_human = replace(config, human_in_the_loop=True)
    assert "--human-in-the-loop" in shlex.split(command(with_human, "runs/bead"))


@pytest.mark.parametrize("name", ["report.pdf", "report"])
def test_report_refuses_an_ending_before_reading(name, tmp_path):
    with pytest.raises(InputError, match=r"a page is .html"):
        write_report([tmp_path / "missing"], tmp_path / name)


def test_report_refuses_a_folder_without_runs(tmp_path):
    with pytest.raises(InputError, match="holds no run"):
        write_report([tmp_path], tmp_path / "report.html")


def test_report_evaluates_a_run_next_to_a_study(study_folder, tmp_path):
    run = tmp_path / "alone"
    run_training(RunFolder(run), configure("Bead", {}, settings=SETTINGS, episodes=2, seed=9))
    held_out = gather([run, study_folder], episodes=2).held_out
    assert set(held_out["seed"]) == {1, 2, 9}
    assert held_out[(held_out["seed"] == 9) & (held_out["policy"] == "learned")]["episodes"].tolist() == [2]


@pytest.mark.parametrize("values", [[0.1, math.nan], [math.nan, 0.1]])
def test_violation_is_shown_as_not_finite_when_nan(values):
    runs = [
        dict.fromkeys(SAFETY_COLUMNS, 0.0) | {"episodes": 1, "steps": 1, "max_commanded_violation": value}
        for value in values
    ]
    (row,) = _safety({"kgrl": runs}).rows
    assert "not finite" in [cell.text for cell in row.cells]


def test_seeds_with_separate_initial_runs_are_one_method(study_folder, tmp_path):
    for seed, source in ((1, "coarse-1"), (2, "coarse-2"), (1, "other"), (2, "other")):
        run = shutil.copytree(study_folder / f"skgrl-{seed}", tmp_path / f"{source.partition('-')[0]}-fine-{seed}")
        config = RunFolder(run).config()
        RunFolder(run).write_config(replace(config, learner=replace(config.learner, init_from=str(tmp_path / source))))
    methods = [run.method for run in gather([tmp_path]).runs]
    assert methods == ["init from coarse-{seed}"] * 2 + ["init from other"] * 2


def test_report_refuses_a_table_with_missing_rows(study_folder, tmp_path):
    table = shutil.copytree(study_folder / "skgrl-1", tmp_path / "run") / "episodes.csv"
    table.write_text("".join(table.read_text().splitlines(keepends=True)[:-1]))
    with pytest.raises(InputError, match=f"{table} has 2 of the 3 episodes of its checkpoint: resume the run"):
        gather([tmp_path])


def test_draw_runs_draws_the_mean_and_a_band_of_runs():
    _, axes = new_figure(1, 2, (4.0, 3.0))
    runs = [np.array([0.0, 2.0, 4.0]), np.array([2.0, 2.0])]
    draw_runs(axes[0, 0], runs, color="C0", label="two", window=1)
    draw_runs(axes[0, 1], runs[:1], color="C0", label="one", window=1)
    np.testing.assert_array_equal(axes[0, 0].lines[0].get_ydata(), [1.0, 2.0])
    assert [len(axis.collections) for axis in axes.flat] == [1, 0]


def test_stored_episodes_belong_to_the_policy_of_the_run(bead_run):
    folder = RunFolder(bead_run)
    evaluate(bead_run, episodes=2, baselines=["constant"])
    evaluate(bead_run, episodes=2, environment={"wall": -0.5})
    pd.DataFrame({"success": [1]}).to_csv(bead_run / "baselines" / "other.csv", index=False)
    stored = dict(_stored_episodes(folder, folder.config(), HELD_OUT_SEED))
    assert {name: len(rows) for name, rows in stored.items()} == {"policy": 2, "demonstration": 2, "constant": 2}
    policy = Policy.load(bead_run)
    policy._layers[0][0][0, 0] += 0.1
    policy.save(bead_run)
    assert "policy" not in dict(_stored_episodes(folder, folder.config(), HELD_OUT_SEED))
