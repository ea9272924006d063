import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from guiderail.models.common.errors import InputError, RunsFailedError
from guiderail.tools.cli.main import main
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.baselines import constant_policy
from guiderail.tools.evaluation.evaluate import evaluate_policy
from guiderail.tools.evaluation.metrics import STATISTICS, wilson
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.tables import read_table
from guiderail_studies.declaration import EvalSet, Ratio, Study, load_study, source_file
from guiderail_studies.engines.engine import make_engine
from guiderail_studies.job import Job
from guiderail_studies.study import (
    AT_ONCE,
    NEVER,
    _pooled_success,
    breaking_point,
    draw_sweeps,
    each,
    method_rows,
    ratio,
    run_study,
    study_command,
)
from research.studies import study_path

SETTINGS = {"net_arch": "16", "batch_size": 16, "learning_starts": 10, "gradient_steps": 4}
BEAD = {
    "name": "beads",
    "task": "Bead",
    "learner": {"settings": SETTINGS},
    "methods": {"learner": {}},
    "seeds": [5, 6],
    "after_episodes": [2, 4],
    "eval_set": [{"episodes": 3}],
}


def make_study(**changed):
    """Return the study of the bead with changed entries."""
    return Study.model_validate(BEAD | changed)


def run(study, out):
    """Run a study in this process; return its table."""
    return run_study(study, out, make_engine(processes=1))


def without_clock(rows):
    return rows.drop(columns=["folder", "training_wall_time"]).to_dict("records")


def modification_times(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


def test_study_has_a_row_per_method_seed_number_and_eval_set(tmp_path):
    methods = {"learner": {}, "zero": {"policy": "zero"}, "random": {"policy": "uniform_random", "seeds": [9]}}
    eval_set = [{"episodes": 2}, {"name": "far away", "episodes": 3, "env": {"wall": -0.5}}]
    rows = run(make_study(methods=methods, eval_set=eval_set), tmp_path)
    expected = [
        *(("learner", seed, number, name) for seed in (5, 6) for number in (2, 4) for name in ("held out", "far away")),
        *(("zero", seed, 0, name) for seed in (5, 6) for name in ("held out", "far away")),
        *(("random", 9, 0, name) for name in ("held out", "far away")),
    ]
    assert list(rows[["method", "seed", "after_episodes", "eval_set"]].itertuples(index=False, name=None)) == expected
    assert rows[rows["eval_set"] == "far away"]["success_rate"].eq(0).all()
    assert rows[rows["eval_set"] == "far away"]["episodes"].eq(3).all()
    assert rows[rows["method"] == "learner"]["training_episodes"].eq(rows["after_episodes"][:8]).all()
    assert rows[rows["method"] == "zero"]["training_success_rate"].isna().all()


def test_interrupted_study_resumes_to_the_same_rows(tmp_path):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    expected = run(make_study(), whole)
    before = modification_times(whole)
    assert without_clock(run(make_study(), whole)) == without_clock(expected)
    assert modification_times(whole) == before
    run(make_study(after_episodes=[2], seeds=[5]), parts)
    assert without_clock(run(make_study(), parts)) == without_clock(expected)


def test_failed_job_is_listed_and_other_jobs_finish(tmp_path, capsys):
    file, out = tmp_path / "beads.yaml", tmp_path / "out"
    expected = run(make_study(), tmp_path / "undisturbed")
    run(make_study(after_episodes=[2]), out)
    checkpoint = out / "learner-5" / "checkpoint" / "state.safetensors"
    content = checkpoint.read_bytes()
    checkpoint.write_bytes(content[:-1000])
    file.write_text(yaml.safe_dump(BEAD))
    command = ["study", str(file), "--out", str(out), "--processes", "1", "--json"]
    with pytest.raises(SystemExit) as end:
        main(command)
    output = capsys.readouterr()
    assert end.value.code == 1
    message = f"learner, seed 5, failed: the checkpoint {checkpoint} is damaged"
    assert output.err.splitlines()[-1].startswith(f"guiderail: {message}")
    assert json.loads(output.out)["failed"][0].startswith(message)
    assert read_table(out / "beads.csv")["seed"].tolist() == [6, 6]
    assert "damaged" in (out / "logs" / "beads-learner-5.txt").read_text()
    (episodes,) = (out / "learner-6").glob("held_out-4-*.csv")
    table = episodes.read_bytes()
    episodes.write_text("a,b\n1\n")
    with pytest.raises(RunsFailedError) as failed:
        run(make_study(), out)
    assert [sentence.partition(",")[2][:7] for sentence in failed.value.sentences] == [" seed 5", " seed 6"]
    episodes.write_bytes(table)
    checkpoint.write_bytes(content)
    assert without_clock(run(make_study(), out)) == without_clock(expected)


def test_finished_job_is_listed_when_its_statistic_raises(tmp_path, monkeypatch):
    returns = []

    def compute(rows):
        if rows["return"].iloc[0] in returns:
            raise ZeroDivisionError("no path")
        return 1.0

    failing = replace(STATISTICS["success_rate"], name="failing", compute=compute)
    monkeypatch.setitem(STATISTICS, "failing", failing)
    study = make_study(statistics=["failing"], after_episodes=[2])
    expected = without_clock(run(study, tmp_path))
    returns.append(read_table(tmp_path / "learner-5" / "episodes.csv")["return"].iloc[0])
    with pytest.raises(RunsFailedError) as failed:
        run(study, tmp_path)
    (sentence,) = failed.value.sentences
    log = tmp_path / "logs" / "beads-learner-5.txt"
    assert sentence == f"learner, seed 5, failed: ZeroDivisionError: no path (the traceback is in {log})"
    assert "in compute" in log.read_text()
    assert without_clock(failed.value.rows) == [row for row in expected if row["seed"] == 6]


def make_continued_study(episodes=4, source="coarse-{seed}"):
    """Return a study whose method `fine`, declared first, starts from the run of `coarse`."""
    fine = {"learner": {"settings": {"init_from": source}, "episodes": 2}}
    methods = {"fine": fine, "coarse": {"learner": {"episodes": episodes}}}
    return make_study(methods=methods, seeds=[5], after_episodes=[], eval_set=[{"episodes": 2}])


def test_job_starts_when_its_source_is_finished(tmp_path):
    run(make_continued_study().subset(["coarse"]), tmp_path / "parts")
    expected = run(make_continued_study().subset(["fine"]), tmp_path / "parts")
    rows = run(make_continued_study(), tmp_path / "whole")
    assert rows["method"].tolist() == ["fine", "coarse"]
    assert without_clock(rows[:1]) == without_clock(expected)
    assert RunFolder(tmp_path / "whole" / "fine-5").config().source.startswith("coarse-5, 4 episodes, policy ")


def test_study_with_a_source_can_be_moved_and_resumed(tmp_path):
    run(make_continued_study(), tmp_path / "old")
    (tmp_path / "old").rename(tmp_path / "new")
    longer = make_continued_study().model_dump(exclude={"eval_set"})
    longer["methods"]["fine"]["learner"]["episodes"] = 3
    assert run(Study.model_validate(longer), tmp_path / "new")["training_episodes"].tolist() == [3, 4]
    shutil.rmtree(tmp_path / "new" / "coarse-5")  # a finished run does not need its source
    assert run(Study.model_validate(longer).subset(["fine"]), tmp_path / "new")["training_episodes"].tolist() == [3]


@pytest.mark.parametrize(
    ("trained_episodes", "study", "methods", "message"),
    [
        (
            4,
            make_continued_study(6),
            None,
            r"differs from the run that it was trained from \(coarse-5, 4 episodes, policy",
        ),
        (None, make_continued_study(), ["fine"], "coarse-5, which has 0 of its 4 episodes: train that run first"),
        (None, make_continued_study(source="corase-{seed}"), None, "corase-5, which is missing or not finished"),
        (None, make_continued_study(source="fine-{seed}"), None, "fine, seed 5, would start from its own run"),
    ],
)
def test_study_refuses_an_invalid_source_before_training(trained_episodes, study, methods, message, tmp_path):
    if trained_episodes:
        run(make_continued_study(trained_episodes), tmp_path)
    before = modification_times(tmp_path)
    with pytest.raises(InputError, match=message):
        run(study.subset(methods), tmp_path)
    assert modification_times(tmp_path) == before


def test_study_refuses_a_source_that_is_only_partly_trained(tmp_path):
    run(make_continued_study(2).subset(["coarse"]), tmp_path)
    with pytest.raises(InputError, match="coarse-5, which has 2 of its 4 episodes"):
        run(make_continued_study(4).subset(["fine"]), tmp_path)
    run(make_continued_study(4).subset(["coarse"]), tmp_path)
    with pytest.raises(InputError, match="coarse-5, which has 4 episodes instead of 2"):
        run(make_continued_study(2), tmp_path)


def test_job_fails_when_its_source_failed(tmp_path):
    run(make_continued_study(2).subset(["coarse"]), tmp_path)
    (tmp_path / "coarse-5" / "checkpoint" / "state.safetensors").write_bytes(b"")
    with pytest.raises(RunsFailedError) as failed:
        run(make_continued_study(4), tmp_path)
    assert failed.value.sentences[0] == "fine, seed 5, failed: it starts from the run of coarse, seed 5, which failed"


def test_study_imports_the_module_of_its_task(tmp_path):
    file = tmp_path / "pearl.py"
    file.write_text(
        "import bead, gymnasium\n"
        "if 'guiderail/Pearl-v0' not in gymnasium.registry:\n"
        "    gymnasium.register('guiderail/Pearl-v0', entry_point=bead.Bead)\n"
    )
    with pytest.raises(InputError, match=r"there is no .*file or task folder"):
        run(make_study(task="Pearl", imports=[str(tmp_path / "perl.py")], after_episodes=[2]), tmp_path / "out")
    rows = run(make_study(task="Pearl", imports=[str(file)], seeds=[5], after_episodes=[2]), tmp_path / "out")
    assert rows["seed"].tolist() == [5]
    assert RunFolder(tmp_path / "out" / "learner-5").config().imports == (str(file),)


def test_study_refuses_two_runs_in_one_folder(tmp_path):
    with pytest.raises(InputError, match="the runs of learner, seed 5, and of learner, seed 6"):
        run(make_study(folder="{method}"), tmp_path)


def test_earlier_policy_can_be_evaluated_later(tmp_path):
    run(make_study(eval_set=[]), tmp_path)
    evaluated, expected = run(make_study(), tmp_path), run(make_study(), tmp_path / "other")
    assert without_clock(evaluated) == without_clock(expected)
    for folder in (tmp_path / "learner-5" / "after_episodes").iterdir():
        for file in folder.iterdir():
            file.unlink()
        folder.rmdir()
    with pytest.raises(InputError, match="is lost"):
        run(make_study(eval_set=[{"episodes": 4}]), tmp_path)


def remove_last_row(file):
    file.write_text("".join(file.read_text().splitlines(keepends=True)[:-1]))


def test_evaluated_episodes_that_were_lost_are_evaluated_again(tmp_path):
    study = make_study(after_episodes=[2], seeds=[5])
    expected = run(study, tmp_path)
    (table,) = (tmp_path / "learner-5").glob("held_out-2-*.csv")
    content = table.read_bytes()
    remove_last_row(table)
    assert without_clock(run(study, tmp_path)) == without_clock(expected)
    assert table.read_bytes() == content


def test_training_episodes_that_were_lost_are_restored(tmp_path):
    study, folder = make_study(seeds=[5]), RunFolder(tmp_path / "learner-5")
    expected, config = run(study, tmp_path), folder.config()
    table = folder.path / "episodes.csv"
    content = table.read_bytes()
    for _ in range(3):
        remove_last_row(table)
    assert without_clock(run(study, tmp_path)) == without_clock(expected)
    assert (table.read_bytes(), folder.config()) == (content, config)
    remove_last_row(table)
    folder.checkpoint.unlink()
    with pytest.raises(RunsFailedError) as failed:
        run(study, tmp_path)
    assert f"{table} has 3 of 4 episodes: restore it" in failed.value.sentences[0]


def test_evaluated_episodes_of_other_settings_are_not_used(tmp_path):
    methods = {"baseline": {"policy": "zero"}}
    near, far = (
        run(make_study(methods=methods, eval_set=[{"episodes": 3, "env": {"wall": wall}}]), tmp_path)
        for wall in (1.0, -0.5)
    )
    assert near["mean_return"].gt(far["mean_return"]).all()
    constant = run(make_study(methods={"baseline": {"policy": "constant"}}), tmp_path)
    assert not constant["mean_return"].isin(near["mean_return"]).any()


def test_studies_in_one_folder_have_separate_files(tmp_path):
    """The digest includes the task, and the seed if the folder's name omits it; a file of another study is refused."""
    (tmp_path / "pearl.py").write_text(
        "import bead, gymnasium\n"
        "if 'guiderail/Twin-v0' not in gymnasium.registry:\n"
        "    gymnasium.register('guiderail/Twin-v0', entry_point=bead.Bead)\n"
    )
    declaration = {"methods": {"random": {"policy": "uniform_random"}}, "folder": "{method}", "seeds": [5]}
    out = tmp_path / "out"
    for changed in ({}, {"seeds": [6]}, {"task": "Twin", "imports": [str(tmp_path / "pearl.py")]}):
        run(make_study(**(declaration | changed)), out)
    assert len(list((out / "random").glob("held_out-0-*.csv"))) == 3
    named = {"eval_set": [{"episodes": 3, "file": "held_out.csv"}]}
    run(make_study(**declaration, **named), out)
    before = modification_times(out)
    run(make_study(**declaration, **named), out)
    assert modification_times(out) == before
    for changed in ({"env": {"wall": -0.5}}, {"seeds": [6]}, {"eval_set": [{"episodes": 4, "file": "held_out.csv"}]}):
        with pytest.raises(InputError, match="episodes of another study"):
            run(make_study(**(declaration | named | changed)), out)
    assert modification_times(out) == before


def test_breaking_point_is_interpolated():
    assert breaking_point([1.0, 2.0, 3.0], [1.0, 1.0, 0.8]) == pytest.approx(2.5)
    assert breaking_point([30.0, 20.0, 10.0], [1.0, 0.9, 0.0]) == pytest.approx(20.0)
    assert breaking_point([1.0, 2.0], [0.89, 1.0]) == AT_ONCE
    assert breaking_point([1.0, 2.0], [1.0, 0.9]) == NEVER


def test_study_refuses_a_folder_with_another_run(tmp_path):
    run(make_study(seeds=[5], after_episodes=[2]), tmp_path)
    before = modification_times(tmp_path)
    with pytest.raises(InputError, match="another learner"):
        run(make_study(learner={"settings": SETTINGS | {"batch_size": 8}}), tmp_path)
    (tmp_path / "learner-6").mkdir()
    (tmp_path / "learner-6" / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="already exists"):
        run(make_study(seeds=[6]), tmp_path)
    assert before.items() <= modification_times(tmp_path).items()


def test_best_constant_is_the_best_of_its_grid(tmp_path):
    rows = run(make_study(methods={"best": {"policy": "best_constant", "grid": [-1, 0, 1]}}, seeds=[1]), tmp_path)
    table = read_table(next((tmp_path / "best-1").glob("best_constant-*.csv")))
    assert len(table) == 9
    assert table[["action_0", "action_1"]].iloc[0].tolist() == [
        1.0,
        1.0,
    ]  # the goal is in the positive direction of both entries
    assert table["success_rate"].is_monotonic_decreasing
    env = make_environment("Bead", {})
    expected = evaluate_policy(env, constant_policy(env, np.array([1.0, 1.0])), episodes=3)
    assert rows["mean_return"].tolist() == [expected["return"].mean()]


def test_sampled_options_change_every_few_episodes(tmp_path):
    eval_set = [{"episodes": 5, "every": 2, "sampled": {"wall": [0.2, 0.3]}}]
    run(make_study(methods={"zero": {"policy": "zero"}}, seeds=[0], eval_set=eval_set), tmp_path)
    (file,) = (tmp_path / "zero-0").glob("*.csv")
    rows = read_table(file)
    assert rows["episode"].tolist() == [0, 1, 2, 3, 4]
    assert rows["wall"].between(0.2, 0.3).all()
    assert [group["episode"].tolist() for _, group in rows.groupby("wall", sort=False)] == [[0, 1], [2, 3], [4]]


def test_process_engine_returns_the_rows_of_a_single_process(tmp_path):
    methods = {"random": {"policy": "uniform_random"}}
    declaration = {"name": "passage", "task": "NarrowPassage", "methods": methods, "seeds": [0]}
    study = Study.model_validate(declaration | {"eval_set": [{"episodes": 1}]})
    tables = (run_study(study, tmp_path / str(number), make_engine(processes=number)) for number in (1, 2))
    pd.testing.assert_frame_equal(*(table.drop(columns="folder") for table in tables))


def test_method_row_has_mean_and_range_over_seeds():
    rows = pd.DataFrame(
        {
            "method": ["a", "a", "b"],
            "after_episodes": [60, 60, 0],
            "eval_set": "held out",
            "episodes": 100,
            "success_rate": [0.5, 1.0, 0.25],
            "mean_return": [1.0, 3.0, 2.0],
            "peak_force": [10.0, 12.0, np.nan],
            "violating_episodes": [1, 2, 0],
            "training_episodes_to_convergence": [20, None, None],
        }
    )
    learned, baseline = method_rows(rows)
    assert learned["success [%]"] == "75 (50–100)"
    assert (learned["largest force [N]"], learned["episodes with a violation"]) == ("12", "3")
    assert learned["episodes to convergence"] == "20, 1 never"
    assert (baseline["success [%]"], baseline["seeds"]) == ("25", 1)
    assert (baseline["largest force [N]"], baseline["episodes to convergence"]) == ("–", "–")
    assert baseline["success in training [%]"] == "–"  # the rows have no such column


def test_study_command_summarizes_each_seed(tmp_path, capsys):
    study = make_study(ratios=[{"of": "mean_return", "method": "learner", "against": "learner"}], after_episodes=[2])
    result = study_command(study, tmp_path, make_engine(processes=1), file=Path("first.yaml"))
    assert json.loads(source_file(tmp_path, study.name).read_text())["file"] == "first.yaml"
    rows = read_table(tmp_path / "beads.csv")
    assert len(rows) == 2
    rates = ", ".join(f"{rate:.0%}" for rate in rows["success_rate"])
    assert result["learner after 2 episodes, held out, success of each seed"] == rates
    assert result["mean return of learner as a fraction of learner's, each seed"] == "1.00, 1.00"
    header, _, row = (tmp_path / "beads.md").read_text().splitlines()  # one method, with two seeds
    assert header.count("|") == 13
    assert row.startswith("| learner | 2 | 2 | held out | 3 |")
    err = capsys.readouterr().err
    assert "1/2 learner, seed 5: held out" in err
    assert "2/2 learner, seed 6: held out" in err


def test_ratio_is_computed_per_seed_and_of_sums():
    rows = pd.DataFrame(
        {"method": ["a", "a", "b", "b"], "seed": [0, 1, 0, 1], "force": [1.0, 2.0, 4.0, 2.0], "after": [3, None, 1, 2]}
    )
    declared = Ratio(of="force", method="a", against="b")
    assert list(ratio(rows, declared).values()) == ["0.25, 1.00", "0.50"]
    assert ratio(rows[:2], declared) == ratio(rows[:3], declared) == {}
    assert ratio(rows.assign(seed=[0, 1, 1, 2]), declared) == {}
    assert each(rows[:2].astype(object), "after") == "3.0, never"


def test_ratio_lists_each_seed_once_with_several_evaluation_sets():
    rows = pd.DataFrame(
        [
            {"method": method, "seed": seed, "eval_set": name, "force": force}
            for method, scale in (("a", 1.0), ("b", 2.0))
            for seed in (5, 6)
            for name, force in (("near", scale), ("far", scale**2))
        ]
    ).assign(after_episodes=4, training_force=1.0)
    label = "force of a as a fraction of b's after 4 episodes"
    expected = {
        f"{label}, {name}, each seed": f"{value}, {value}" for name, value in (("near", "0.50"), ("far", "0.25"))
    }
    actual = ratio(rows, Ratio(of="force", method="a", against="b"))
    assert {name: text for name, text in actual.items() if name.endswith("each seed")} == expected
    training = ratio(rows, Ratio(of="training_force", method="a", against="b"))
    assert training[f"training {label}, each seed"] == "1.00, 1.00"
    assert len(training) == 2


def test_statistics_of_an_imported_task_are_computed(tmp_path):
    (tmp_path / "passage_of_lab.py").write_text(
        "from guiderail.diagrams.tasks.narrow_passage import NarrowPassage\n"
        "from guiderail.diagrams.tasks.registry import register_task\n"
        "from guiderail.tools.evaluation.metrics import Metric\n\n\n"
        "@register_task('lab/Passage')\n"
        "class LabPassage(NarrowPassage):\n"
        "    statistics = (Metric('count', '', 'number of episodes', len),)\n"
    )
    changed = {"task": "lab/Passage", "imports": [str(tmp_path / "passage_of_lab.py")], "statistics": ["count"]}
    study = make_study(**changed, methods={"zero": {"policy": "zero"}}, learner={}, eval_set=[])
    assert "training_count" in run(study, tmp_path / "out")


INVALID = [
    ({"methods": {}}, "methods"),
    ({"seeds": []}, "seeds"),
    ({"seeds": ["x"]}, "seeds"),
    ({"seeds": [True]}, "seeds.0: input should be a valid integer, not True"),
    ({"seeds": [-1]}, "greater than or equal to 0"),
    ({"seeds": [0, 0]}, "the seed 0 is given twice"),
    ({"methods": {"learner": {"seeds": [3, 3]}}}, "the seed 3 is given twice"),
    ({"learner": {"settings": {"init_from": ""}}}, "would be outside the study's folder"),
    ({"learner": {"settings": {"init_from": None}}}, "init_from names the folder of a run, not None"),
    ({"methods": {"one": {"learner": {"settings": {"init_from": "{method}"}}}}}, "the placeholders are {seed}"),
    ({"methods": {"learner": {"seeds": [True]}}}, "input should be a valid integer, not True"),
    ({"learner": {"settings": {"stop_after_successes": 3}}}, "runs of a study have equal lengths"),
    ({"after_episodes": [0]}, "greater than or equal to 1"),
    ({"after_episodes": [True]}, "input should be a valid integer, not True"),
    ({"after_episodes": [5], "learner": {"episodes": 1}}, "no method trains for 5 episodes"),
    ({"after_episodes": [2, 5], "methods": {"one": {"learner": {"episodes": 4}}}}, "no method trains for 5 episodes"),
    ({"task": "NarrowPassage", "eval_set": [{"options": {"held_otu": True}}]}, "did you mean held_out"),
    ({"task": "NarrowPassage", "eval_set": [{"options": {"held_out": "far"}}]}, "held_out cannot be 'far'"),
    ({"after_episodes": [], "learner": {}}, "learner needs a number of training episodes"),
    ({"task": "Beat"}, "did you mean Bead"),
    ({"tsak": "Bead"}, "did you mean task"),
    ({"methods": {"learner": {"enf": {}}}}, "did you mean env"),
    ({"methods": {"../up": {}}}, "should match pattern"),
    ({"methods": {"one": {"policy": "magic"}}}, "no policy 'magic'"),
    ({"methods": {"one": {"env": {"guidanse": "kmp"}}}}, "did you mean guidance"),
    ({"learner": {"preset": "tqc_contct"}}, "did you mean tqc_contact"),
    ({"learner": {"algorithm": "sacc"}}, "did you mean sac"),
    ({"learner": {"settings": {"batchsize": 3}}}, "batch_size"),
    ({"eval_set": [{"episodes": 0}]}, "eval_set"),
    ({"eval_set": [{"env": {"stattion": "arm"}}]}, "no option 'stattion'"),
    ({"eval_set": [{"sampled": {"wal": [0, 1]}}]}, "did you mean wall"),
    ({"eval_set": [{"sampled": {"wall": [0.3, 0.2]}}]}, "the smaller first"),
    ({"eval_set": [{"sampled": {"wall": [0.2, float("nan")]}}]}, "finite"),
    ({"folder": "{guidance}-{seed}"}, "the placeholders are {method}, {seed}, {episodes}, {algorithm}"),
    ({"folder": "{method}-{seed"}, "has a brace without its counterpart"),
    ({"folder": "{method}-{seed:999999999}"}, "an unknown or formatted placeholder"),
    ({"folder": "{seed.__class__}"}, "an unknown or formatted placeholder"),
    ({"folder": "../{method}"}, "would be outside the study's folder"),
    ({"folder": "/{method}"}, "would be outside the study's folder"),
    ({"folder": "."}, "would be outside the study's folder"),
    ({"methods": {"..": {}}}, "should match pattern"),
    ({"eval_set": [{"file": "../{digest}.csv"}]}, "would be outside the study's folder"),
    (
        {"eval_set": [{"file": "{after_episodes}-{seed}.csv"}]},
        "the placeholders are {name}, {after_episodes}, {episodes}, {digest}",
    ),
    ({"eval_set": [{"file": "./episodes.csv"}]}, "names episodes.csv, which is reserved for the run"),
    ({"eval_set": [{"file": "held_out.csv"}]}, "write {name}, {after_episodes} and {digest} into the file's name"),
    (
        {
            "after_episodes": [2],
            "eval_set": [{"name": name, "episodes": k, "file": "a.csv"} for k, name in [(1, "a"), (2, "b")]],
        },
        "the evaluation set 'b' has the same file, a.csv, as other evaluated episodes",
    ),
    ({"eval_set": [{"first_seed": 2**31}]}, "less than 2147483648"),
    ({"sweeps": [{"quantity": "wall", "at": {"nan": {}}}]}, "finite number"),
    ({"sweeps": [{"quantity": "wall", "at": {"1": {}, "1.0": {}}}]}, "'1' and '1.0' are one value of the sweep"),
    ({"statistics": ["sucess_rate"]}, "did you mean success_rate"),
    ({"eval_set": [{"episodes": 2}, {"episodes": 3}]}, "called 'held out'"),
    ({"ratios": [{"of": "mean_force", "method": "learnt", "against": "learner"}]}, "did you mean learner"),
    ({"ratios": [{"of": "mean_fource", "method": "learner", "against": "learner"}]}, "did you mean mean_force"),
]


@pytest.mark.parametrize(("changed", "message"), INVALID, ids=[message for _, message in INVALID])
def test_invalid_study_is_refused_and_writes_nothing(changed, message, tmp_path):
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(BEAD | changed))
    with pytest.raises(InputError) as error:
        run(load_study(tmp_path / "study.yaml"), tmp_path / "out")
    assert message in str(error.value)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "out").exists()


def test_null_preset_of_a_method_removes_the_preset(tmp_path):
    methods = {"sac": {}, "ppo": {"learner": {"algorithm": "ppo", "preset": None}}}
    declaration = {"name": "clamp", "task": "GridClamp", "methods": methods, "seeds": [0], "after_episodes": [5]}
    study = Study.model_validate(declaration | {"learner": {"algorithm": "sac", "preset": "sac_gridclamp"}})
    assert [Job(study, name, 0, tmp_path).config(5).learner.algorithm for name in methods] == ["sac", "ppo"]


def test_after_episodes_are_limited_to_the_training_length():
    methods = {"short": {"learner": {"episodes": 2}}, "long": {}, "zero": {"policy": "zero"}}
    study = make_study(methods=methods)
    assert [Job(study, name, 5, None).after_episodes for name in methods] == [[2], [2, 4], [0]]
    assert make_study(methods={"zero": {"policy": "zero"}}, learner={"episodes": 1}).after_episodes == (2, 4)


@pytest.mark.parametrize("text", ["[1, 2]", "a: [", "", "\x00", "just words"])
def test_load_study_refuses_invalid_files(text, tmp_path):
    (tmp_path / "study.yaml").write_text(text)
    with pytest.raises(InputError) as error:
        load_study(tmp_path / "study.yaml")
    assert "\n" not in str(error.value)


def test_load_study_refuses_a_missing_file(tmp_path):
    with pytest.raises(InputError, match="did you mean connector"):
        study_path("conector")
    with pytest.raises(InputError, match="there is no file"):
        load_study(tmp_path / "none.yaml")
    subset = load_study(study_path("connector")).subset(["kgrl"], [1, 2])
    assert (list(subset.methods), subset.seeds) == (["kgrl"], (1, 2))
    with pytest.raises(InputError, match="did you mean kgrl"):
        subset.subset(["kgrll"])


@pytest.mark.parametrize(
    ("seeds", "message"),
    [
        ([-1], r"seeds\.0: .*not -1"),
        ([1, 2, 1], "seed 1 is given twice"),
        ([], "seeds"),
        ([1.5], "1.5"),
        ([2**31], "2147"),
    ],
)
def test_subset_refuses_invalid_seeds(seeds, message):
    with pytest.raises(InputError, match=message) as error:
        load_study(study_path("connector")).subset(None, seeds)
    assert "\n" not in str(error.value)


def test_scripted_pour_succeeds_with_constraints_only(tmp_path):
    study = load_study(study_path("pouring_mugs")).subset(["scripted_pour", "person_unconstrained"])
    study = study.model_copy(update={"eval_set": (EvalSet(episodes=1),)})
    constrained, unconstrained = run(study, tmp_path).to_dict("records")
    assert (constrained["success_rate"], unconstrained["success_rate"]) == (1.0, 0.0)
    assert constrained["ended_in_spill"] + constrained["ended_in_collision"] == 0
    assert unconstrained["ended_in_spill"] + unconstrained["ended_in_collision"] == 1
    assert constrained["max_commanded_violation"] <= 1e-9


def test_policy_is_trained_on_the_gantry_for_any_station(tmp_path):
    study = load_study(study_path("connector_on_arm"))
    config = Job(study, "skgrl", 30, tmp_path).config(80)
    assert config.environment["station"] == "gantry"
    assert study.eval_set[0].env == {"station": "arm"}


def test_run_of_a_study_is_a_run_folder(tmp_path):
    run(make_study(seeds=[5]), tmp_path)
    folder = RunFolder(tmp_path / "learner-5")
    assert folder.config().episodes == 4
    assert np.array_equal(folder.episodes()["episode"], range(4))


def test_sweep_is_evaluated_at_each_value_and_drawn(tmp_path):
    """A wall at −0.5 stops the bead before the goal, so that no episode succeeds."""
    walls = {"quantity": "wall [m]", "at": {0.0: {}, -0.5: {"wall": -0.5}}, "episodes": 2}
    methods = {"zero": {"policy": "zero", "seeds": [9]}, "random": {"policy": "uniform_random"}}
    study = make_study(methods=methods, sweeps=[walls], eval_set=[])
    result = study_command(study, tmp_path, make_engine(processes=1))
    rows = read_table(tmp_path / "beads.csv")
    assert rows["eval_set"].tolist() == ["wall [m] 0", "wall [m] -0.5"] * 3
    assert rows[rows["eval_set"] == "wall [m] -0.5"]["success_rate"].eq(0).all()
    assert result["picture"] == str(tmp_path / "beads.png")
    assert result["zero, below 90% at wall [m]"] == "from the easiest on"
    assert (tmp_path / "beads.png").stat().st_size > 10_000
    assert run_study(study, tmp_path, make_engine(processes=1))["eval_set"].tolist() == rows["eval_set"].tolist()


def test_longer_training_is_evaluated_again(tmp_path):
    eval_set = [{"episodes": 2, "file": "held_out-{episodes}-{digest}.csv"}]
    run(make_study(after_episodes=[2], seeds=[5], eval_set=eval_set), tmp_path)
    run(make_study(after_episodes=[4], seeds=[5], eval_set=eval_set), tmp_path)
    assert len(list((tmp_path / "learner-5").glob("held_out-2-*.csv"))) == 2
    named = [{"episodes": 2, "file": "held_out.csv"}]
    run(make_study(after_episodes=[4], seeds=[5], eval_set=named), tmp_path)
    with pytest.raises(InputError, match="after other training"):
        run(make_study(after_episodes=[6], seeds=[5], eval_set=named), tmp_path)


def test_subset_of_a_study_has_a_table_of_its_own(tmp_path):
    methods = {"learner": {}, "zero": {"policy": "zero"}}
    (tmp_path / "beads.yaml").write_text(yaml.safe_dump(BEAD | {"methods": methods, "after_episodes": [2]}))
    for options, rows in (([], 4), (["--methods", "zero"], 2), (["--seeds", "5"], 2)):
        with pytest.raises(SystemExit) as end:
            main(["study", str(tmp_path / "beads.yaml"), "--out", str(tmp_path / "out"), "--processes", "1", *options])
        assert end.value.code == 0
        name = "-".join(["beads", *options[1:]])
        assert len(read_table(tmp_path / "out" / f"{name}.csv")) == rows
    assert len(read_table(tmp_path / "out" / "beads.csv")) == 4


def sweep_rows(*rates):
    """Return the rows of a method at one value of a sweep, one seed for each success rate."""
    row = {"method": "zero", "eval_set": "x", "after_episodes": 60, "episodes": 50}
    return pd.DataFrame([row] * len(rates), dtype=object).assign(seed=range(len(rates)), success_rate=rates)


def test_band_spans_the_intervals_of_all_seeds():
    assert _pooled_success(sweep_rows(0.8), "zero", "x") == pytest.approx((0.8, *wilson(40, 50)))
    assert _pooled_success(sweep_rows(1.0, 0.0), "zero", "x") == pytest.approx(
        (0.5, wilson(0, 50)[0], wilson(50, 50)[1])
    )
    assert _pooled_success(sweep_rows(1.0, 1.0), "zero", "x") == pytest.approx((1.0, *wilson(50, 50)))
    assert _pooled_success(sweep_rows(1.0), "another", "x") is None


def test_sweep_of_one_value_is_drawn(tmp_path):
    sweep = {"quantity": "x", "at": {1.0: {}}}
    study = make_study(methods={"zero": {"policy": "zero"}}, learner={}, eval_set=[], sweeps=[sweep])
    assert draw_sweeps(study, sweep_rows(0.5).assign(eval_set="x 1"), tmp_path / "sweep.png").is_file()
