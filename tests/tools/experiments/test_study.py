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
from guiderail.tools.evaluation.metrics import STATISTICS, statistics_of, wilson
from guiderail.tools.experiments.declaration import EvalSet, Ratio, Study, load_study, source_file
from guiderail.tools.experiments.engines.engine import make_engine
from guiderail.tools.experiments.job import Job, check_job
from guiderail.tools.experiments.study import (
    AT_ONCE,
    NEVER,
    _pooled_success,
    breaking_point,
    differences_by_method,
    draw_sweeps,
    each,
    ratio,
    run_study,
    study_command,
)
from guiderail.tools.imports import import_modules
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.tables import read_table
from research.studies import study_names, study_path
from research.thesis import describe_differences

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


def study(**changed):
    return Study.model_validate(BEAD | changed)


def run(one, out):
    return run_study(one, out, make_engine(processes=1))


def without_clock(rows):
    return rows.drop(columns=["folder", "training_wall_time"]).to_dict("records")


def modification_times(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


def test_study_has_a_row_per_method_seed_number_and_eval_set(tmp_path):
    methods = {"learner": {}, "nothing": {"policy": "zero"}, "anything": {"policy": "uniform_random", "seeds": [9]}}
    eval_set = [{"episodes": 2}, {"name": "far away", "episodes": 3, "env": {"wall": -0.5}}]
    rows = run(study(methods=methods, eval_set=eval_set), tmp_path)
    expected = [
        *(("learner", seed, number, name) for seed in (5, 6) for number in (2, 4) for name in ("held out", "far away")),
        *(("nothing", seed, 0, name) for seed in (5, 6) for name in ("held out", "far away")),
        *(("anything", 9, 0, name) for name in ("held out", "far away")),
    ]
    assert list(rows[["method", "seed", "after_episodes", "eval_set"]].itertuples(index=False, name=None)) == expected
    assert rows[rows["eval_set"] == "far away"]["success_rate"].eq(0).all()
    assert rows[rows["eval_set"] == "far away"]["episodes"].eq(3).all()
    assert rows[rows["method"] == "learner"]["training_episodes"].eq(rows["after_episodes"][:8]).all()
    assert rows[rows["method"] == "nothing"]["training_success_rate"].isna().all()


def test_interrupted_study_resumes_to_the_same_rows(tmp_path):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    expected = run(study(), whole)
    before = modification_times(whole)
    assert without_clock(run(study(), whole)) == without_clock(expected)
    assert modification_times(whole) == before
    run(study(after_episodes=[2], seeds=[5]), parts)
    assert without_clock(run(study(), parts)) == without_clock(expected)


def test_failed_job_is_listed_and_stops_no_other(tmp_path, capsys):
    file, out = tmp_path / "beads.yaml", tmp_path / "out"
    expected = run(study(), tmp_path / "undisturbed")
    run(study(after_episodes=[2]), out)
    checkpoint = out / "learner-5" / "checkpoint" / "state.safetensors"
    whole = checkpoint.read_bytes()
    checkpoint.write_bytes(whole[:-1000])
    file.write_text(yaml.safe_dump(BEAD))
    command = ["study", str(file), "--out", str(out), "--processes", "1", "--json"]
    with pytest.raises(SystemExit) as end:
        main(command)
    output = capsys.readouterr()
    assert end.value.code == 1
    sentence = f"learner, seed 5, failed: the checkpoint {checkpoint} is damaged"
    assert output.err.splitlines()[-1].startswith(f"guiderail: {sentence}")
    assert json.loads(output.out)["failed"][0].startswith(sentence)
    assert read_table(out / "beads.csv")["seed"].tolist() == [6, 6]
    assert "damaged" in (out / "logs" / "beads-learner-5.txt").read_text()
    (file_of_episodes,) = (out / "learner-6").glob("held_out-4-*.csv")
    table = file_of_episodes.read_bytes()
    file_of_episodes.write_text("a,b\n1\n")
    with pytest.raises(RunsFailedError) as failed:
        run(study(), out)
    assert [sentence.partition(",")[2][:7] for sentence in failed.value.sentences] == [" seed 5", " seed 6"]
    file_of_episodes.write_bytes(table)
    checkpoint.write_bytes(whole)
    assert without_clock(run(study(), out)) == without_clock(expected)


def test_finished_job_is_listed_when_its_statistic_raises(tmp_path, monkeypatch):
    returns = []

    def compute(rows):
        if rows["return"].iloc[0] in returns:
            raise ZeroDivisionError("no path")
        return 1.0

    fragile = replace(STATISTICS["success_rate"], name="fragile", compute=compute)
    monkeypatch.setitem(STATISTICS, "fragile", fragile)
    one = study(statistics=["fragile"], after_episodes=[2])
    expected = without_clock(run(one, tmp_path))
    returns.append(read_table(tmp_path / "learner-5" / "episodes.csv")["return"].iloc[0])
    with pytest.raises(RunsFailedError) as failed:
        run(one, tmp_path)
    (sentence,) = failed.value.sentences
    log = tmp_path / "logs" / "beads-learner-5.txt"
    assert sentence == f"learner, seed 5, failed: ZeroDivisionError: no path (the traceback is in {log})"
    assert "in compute" in log.read_text()
    assert without_clock(failed.value.rows) == [row for row in expected if row["seed"] == 6]


def continued(episodes=4, source="coarse-{seed}"):
    """Return a study whose method `fine`, declared first, starts from the run of `coarse`."""
    fine = {"learner": {"settings": {"init_from": source}, "episodes": 2}}
    methods = {"fine": fine, "coarse": {"learner": {"episodes": episodes}}}
    return study(methods=methods, seeds=[5], after_episodes=[], eval_set=[{"episodes": 2}])


def test_job_starts_when_the_run_it_starts_from_is_finished(tmp_path):
    run(continued().subset(["coarse"]), tmp_path / "parts")
    expected = run(continued().subset(["fine"]), tmp_path / "parts")
    rows = run(continued(), tmp_path / "whole")
    assert rows["method"].tolist() == ["fine", "coarse"]
    assert without_clock(rows[:1]) == without_clock(expected)
    assert RunFolder(tmp_path / "whole" / "fine-5").config().source.startswith("coarse-5, 4 episodes, policy ")


def test_study_with_a_source_can_be_moved_and_resumed(tmp_path):
    run(continued(), tmp_path / "old")
    (tmp_path / "old").rename(tmp_path / "new")
    longer = continued().model_dump(exclude={"eval_set"})
    longer["methods"]["fine"]["learner"]["episodes"] = 3
    assert run(Study.model_validate(longer), tmp_path / "new")["training_episodes"].tolist() == [3, 4]
    shutil.rmtree(tmp_path / "new" / "coarse-5")  # only a run that is to be trained needs it
    assert run(Study.model_validate(longer).subset(["fine"]), tmp_path / "new")["training_episodes"].tolist() == [3]


@pytest.mark.parametrize(
    ("trained", "wanted", "methods", "words"),
    [
        (4, continued(6), None, r"differs from the run that it was trained from \(coarse-5, 4 episodes, policy"),
        (None, continued(), ["fine"], "coarse-5, which has 0 of its 4 episodes: train that run first"),
        (None, continued(source="corase-{seed}"), None, "corase-5, which is missing or not finished"),
        (None, continued(source="fine-{seed}"), None, "fine, seed 5, would start from its own run"),
    ],
)
def test_study_refuses_a_source_before_anything_runs(trained, wanted, methods, words, tmp_path):
    if trained:
        run(continued(trained), tmp_path)
    before = modification_times(tmp_path)
    with pytest.raises(InputError, match=words):
        run(wanted.subset(methods), tmp_path)
    assert modification_times(tmp_path) == before


def test_study_refuses_a_source_that_is_only_partly_trained(tmp_path):
    run(continued(2).subset(["coarse"]), tmp_path)
    with pytest.raises(InputError, match="coarse-5, which has 2 of its 4 episodes"):
        run(continued(4).subset(["fine"]), tmp_path)
    run(continued(4).subset(["coarse"]), tmp_path)
    with pytest.raises(InputError, match="coarse-5, which has 4 episodes instead of 2"):
        run(continued(2), tmp_path)


def test_job_fails_when_the_run_it_starts_from_failed(tmp_path):
    run(continued(2).subset(["coarse"]), tmp_path)
    (tmp_path / "coarse-5" / "checkpoint" / "state.safetensors").write_bytes(b"")
    with pytest.raises(RunsFailedError) as failed:
        run(continued(4), tmp_path)
    assert failed.value.sentences[0] == "fine, seed 5, failed: it starts from the run of coarse, seed 5, which failed"


def test_study_imports_what_registers_its_task(tmp_path):
    file = tmp_path / "pearl.py"
    file.write_text(
        "import bead, gymnasium\n"
        "if 'guiderail/Pearl-v0' not in gymnasium.registry:\n"
        "    gymnasium.register('guiderail/Pearl-v0', entry_point=bead.Bead)\n"
    )
    with pytest.raises(InputError, match=r"there is no .*file or task folder"):
        run(study(task="Pearl", imports=[str(tmp_path / "perl.py")], after_episodes=[2]), tmp_path / "out")
    rows = run(study(task="Pearl", imports=[str(file)], seeds=[5], after_episodes=[2]), tmp_path / "out")
    assert rows["seed"].tolist() == [5]
    assert RunFolder(tmp_path / "out" / "learner-5").config().imports == (str(file),)


def test_study_refuses_two_runs_in_one_folder(tmp_path):
    with pytest.raises(InputError, match="the runs of learner, seed 5, and of learner, seed 6"):
        run(study(folder="{method}"), tmp_path)


def test_earlier_policy_can_be_evaluated_later(tmp_path):
    run(study(eval_set=[]), tmp_path)
    late, expected = run(study(), tmp_path), run(study(), tmp_path / "other")
    assert without_clock(late) == without_clock(expected)
    for folder in (tmp_path / "learner-5" / "after_episodes").iterdir():
        for file in folder.iterdir():
            file.unlink()
        folder.rmdir()
    with pytest.raises(InputError, match="is lost"):
        run(study(eval_set=[{"episodes": 4}]), tmp_path)


def without_last_row(file):
    file.write_text("".join(file.read_text().splitlines(keepends=True)[:-1]))


def test_evaluated_episodes_that_were_lost_are_evaluated_again(tmp_path):
    one = study(after_episodes=[2], seeds=[5])
    expected = run(one, tmp_path)
    (table,) = (tmp_path / "learner-5").glob("held_out-2-*.csv")
    whole = table.read_bytes()
    without_last_row(table)
    assert without_clock(run(one, tmp_path)) == without_clock(expected)
    assert table.read_bytes() == whole


def test_training_episodes_that_were_lost_are_restored(tmp_path):
    one, folder = study(seeds=[5]), RunFolder(tmp_path / "learner-5")
    expected, config = run(one, tmp_path), folder.config()
    table = folder.path / "episodes.csv"
    whole = table.read_bytes()
    for _ in range(3):
        without_last_row(table)
    assert without_clock(run(one, tmp_path)) == without_clock(expected)
    assert (table.read_bytes(), folder.config()) == (whole, config)
    without_last_row(table)
    folder.checkpoint.unlink()
    with pytest.raises(RunsFailedError) as failed:
        run(one, tmp_path)
    assert f"{table} has 3 of 4 episodes: restore it" in failed.value.sentences[0]


def test_evaluated_episodes_of_other_settings_are_not_used(tmp_path):
    methods = {"nothing": {"policy": "zero"}}
    near, far = (
        run(study(methods=methods, eval_set=[{"episodes": 3, "env": {"wall": wall}}]), tmp_path) for wall in (1.0, -0.5)
    )
    assert near["mean_return"].gt(far["mean_return"]).all()
    other = run(study(methods={"nothing": {"policy": "constant"}}), tmp_path)
    assert not other["mean_return"].isin(near["mean_return"]).any()


def test_studies_in_one_folder_are_kept_apart(tmp_path):
    """The digest has the seed if the folder's name has not, and the task; a file name without a digest is refused."""
    (tmp_path / "pearl.py").write_text(
        "import bead, gymnasium\n"
        "if 'guiderail/Twin-v0' not in gymnasium.registry:\n"
        "    gymnasium.register('guiderail/Twin-v0', entry_point=bead.Bead)\n"
    )
    uniform_random = {"methods": {"anything": {"policy": "uniform_random"}}, "folder": "{method}", "seeds": [5]}
    out = tmp_path / "out"
    for changed in ({}, {"seeds": [6]}, {"task": "Twin", "imports": [str(tmp_path / "pearl.py")]}):
        run(study(**(uniform_random | changed)), out)
    assert len(list((out / "anything").glob("held_out-0-*.csv"))) == 3
    named = {"eval_set": [{"episodes": 3, "file": "held_out.csv"}]}
    run(study(**uniform_random, **named), out)
    before = modification_times(out)
    run(study(**uniform_random, **named), out)
    assert modification_times(out) == before
    for changed in ({"env": {"wall": -0.5}}, {"seeds": [6]}, {"eval_set": [{"episodes": 4, "file": "held_out.csv"}]}):
        with pytest.raises(InputError, match="episodes of another study"):
            run(study(**(uniform_random | named | changed)), out)
    assert modification_times(out) == before


def test_differences_are_grouped_by_method():
    study = load_study(study_path("connector_hard")).subset(["kgrl", "skgrl", "uniform_random", "scripted"])
    groups = differences_by_method(study, describe_differences)
    assert "reward aligned (thesis: sparse)" in groups["all methods"]
    assert any(sentence.startswith("difficulty 'hard', added here") for sentence in groups["all methods"])
    assert any("checkpoint selection" in sentence for sentence in groups["kgrl"])
    assert any("ρ" in sentence for sentence in groups["skgrl"])
    for method, one in study.methods.items():
        own = [one for methods, sentences in groups.items() if method in methods.split(", ") for one in sentences]
        config = Job(study, method, study.seeds[0], Path()).config(60)
        learns = one.policy == "learned"
        expected = describe_differences(config, learns=learns)
        assert sorted([*groups["all methods"], *own]) == sorted(expected)
        assert any("checkpoint selection" in sentence for sentence in expected) == learns


def test_breaking_point_is_interpolated():
    assert breaking_point([1.0, 2.0, 3.0], [1.0, 1.0, 0.8]) == pytest.approx(2.5)
    assert breaking_point([30.0, 20.0, 10.0], [1.0, 0.9, 0.0]) == pytest.approx(20.0)
    assert breaking_point([1.0, 2.0], [0.89, 1.0]) == AT_ONCE
    assert breaking_point([1.0, 2.0], [1.0, 0.9]) == NEVER


def test_study_refuses_a_folder_with_another_run(tmp_path):
    run(study(seeds=[5], after_episodes=[2]), tmp_path)
    before = modification_times(tmp_path)
    with pytest.raises(InputError, match="another learner"):
        run(study(learner={"settings": SETTINGS | {"batch_size": 8}}), tmp_path)
    (tmp_path / "learner-6").mkdir()
    (tmp_path / "learner-6" / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="already exists"):
        run(study(seeds=[6]), tmp_path)
    assert before.items() <= modification_times(tmp_path).items()


def test_best_constant_is_the_best_of_its_grid(tmp_path):
    rows = run(study(methods={"best": {"policy": "best_constant", "grid": [-1, 0, 1]}}, seeds=[1]), tmp_path)
    tried = read_table(next((tmp_path / "best-1").glob("best_constant-*.csv")))
    assert len(tried) == 9
    assert tried[["action_0", "action_1"]].iloc[0].tolist() == [1.0, 1.0]  # up and to the right, where the goal is
    assert tried["success_rate"].is_monotonic_decreasing
    env = make_environment("Bead", {})
    expected = evaluate_policy(env, constant_policy(env, np.array([1.0, 1.0])), episodes=3)
    assert rows["mean_return"].tolist() == [expected["return"].mean()]


def test_sampled_options_change_every_few_episodes(tmp_path):
    eval_set = [{"episodes": 5, "every": 2, "sampled": {"wall": [0.2, 0.3]}}]
    run(study(methods={"nothing": {"policy": "zero"}}, seeds=[0], eval_set=eval_set), tmp_path)
    (file,) = (tmp_path / "nothing-0").glob("*.csv")
    rows = read_table(file)
    assert rows["episode"].tolist() == [0, 1, 2, 3, 4]
    assert rows["wall"].between(0.2, 0.3).all()
    assert [group["episode"].tolist() for _, group in rows.groupby("wall", sort=False)] == [[0, 1], [2, 3], [4]]


def test_process_engine_gives_the_rows_of_this_process(tmp_path):
    declared = Study.model_validate(
        {
            "name": "passage",
            "task": "NarrowPassage",
            "methods": {"anything": {"policy": "uniform_random"}},
            "seeds": [0],
            "eval_set": [{"episodes": 1}],
        }
    )
    one, two = (run_study(declared, tmp_path / str(n), make_engine(processes=n)).drop(columns="folder") for n in (1, 2))
    pd.testing.assert_frame_equal(one, two)


def test_study_command_summarizes_each_seed(tmp_path, capsys):
    one = study(ratios=[{"of": "mean_return", "method": "learner", "against": "learner"}], after_episodes=[2])
    result = study_command(one, tmp_path, make_engine(processes=1), file=Path("first.yaml"))
    assert json.loads(source_file(tmp_path, one.name).read_text())["file"] == "first.yaml"
    described = study_command(one, tmp_path, describe_differences=lambda config, *, learns=True: [config.task])
    assert described["differences"] == {"all methods": ["Bead"]}
    rows = read_table(tmp_path / "beads.csv")
    assert len(rows) == 2
    rates = ", ".join(f"{rate:.0%}" for rate in rows["success_rate"])
    assert result["learner after 2 episodes, held out, success of each seed"] == rates
    assert result["mean return of learner as a fraction of learner's, each seed"] == "1.00, 1.00"
    assert "differences" not in result
    err = capsys.readouterr().err
    assert "1/2 learner, seed 5: held out" in err
    assert "2/2 learner, seed 6: held out" in err


def test_ratio_is_per_seed_and_of_sums():
    rows = pd.DataFrame(
        {"method": ["a", "a", "b", "b"], "seed": [0, 1, 0, 1], "force": [1.0, 2.0, 4.0, 2.0], "after": [3, None, 1, 2]}
    )
    expected = Ratio(of="force", method="a", against="b")
    assert list(ratio(rows, expected).values()) == ["0.25, 1.00", "0.50"]
    assert ratio(rows[:2], expected) == ratio(rows[:3], expected) == {}
    assert ratio(rows.assign(seed=[0, 1, 1, 2]), expected) == {}
    assert each(rows[:2].astype(object), "after") == "3.0, never"


def test_ratio_lists_each_seed_once_with_several_evaluation_sets():
    rows = pd.DataFrame(
        [
            {
                "method": method,
                "seed": seed,
                "after_episodes": 4,
                "eval_set": name,
                "force": force,
                "training_force": 1.0,
            }
            for method, scale in (("a", 1.0), ("b", 2.0))
            for seed in (5, 6)
            for name, force in (("near", scale), ("far", scale**2))
        ]
    )
    label = "force of a as a fraction of b's after 4 episodes"
    expected = {f"{label}, {name}, each seed": f"{r}, {r}" for name, r in (("near", "0.50"), ("far", "0.25"))}
    actual = ratio(rows, Ratio(of="force", method="a", against="b"))
    assert {name: text for name, text in actual.items() if name.endswith("each seed")} == expected
    training = ratio(rows, Ratio(of="training_force", method="a", against="b"))
    assert training[f"training {label}, each seed"] == "1.00, 1.00"
    assert len(training) == 2


def test_statistics_of_an_imported_task_are_known(tmp_path):
    (tmp_path / "shiny.py").write_text(
        "from guiderail.diagrams.tasks.narrow_passage.task import NarrowPassage\n"
        "from guiderail.diagrams.tasks.registry import register_task\n"
        "from guiderail.tools.evaluation.metrics import Metric\n\n\n"
        "@register_task('shiny/Passage')\n"
        "class Shiny(NarrowPassage):\n"
        "    statistics = (Metric('shine', '', 'shine', len),)\n"
    )
    changed = {"task": "shiny/Passage", "imports": [str(tmp_path / "shiny.py")], "statistics": ["shine"]}
    one = study(**changed, methods={"nothing": {"policy": "zero"}}, learner={}, eval_set=[])
    assert "training_shine" in run(one, tmp_path / "out")


WRONG = [
    ({"methods": {}}, "methods"),
    ({"seeds": []}, "seeds"),
    ({"seeds": ["x"]}, "seeds"),
    ({"seeds": [True]}, "seeds, 0: input should be a valid integer, not True"),
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
    (
        {"after_episodes": [2, 5], "methods": {"one": {"learner": {"episodes": 4}}}},
        "no method trains for 5 episodes",
    ),
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
    ({"eval_set": [{"file": "./episodes.csv"}]}, "has a file of the run, episodes.csv"),
    ({"eval_set": [{"file": "held_out.csv"}]}, "write {name}, {after_episodes} and {digest} into the file's name"),
    (
        {
            "after_episodes": [2],
            "eval_set": [{"name": name, "episodes": k, "file": "a.csv"} for k, name in [(1, "a"), (2, "b")]],
        },
        "the evaluation set 'b' has the file a.csv of other evaluated episodes",
    ),
    ({"eval_set": [{"first_seed": 2**31}]}, "less than 2147483648"),
    ({"sweeps": [{"quantity": "wall", "at": {"nan": {}}}]}, "finite number"),
    ({"sweeps": [{"quantity": "wall", "at": {"1": {}, "1.0": {}}}]}, "'1' and '1.0' are one value of the sweep"),
    ({"statistics": ["sucess_rate"]}, "did you mean success_rate"),
    ({"eval_set": [{"episodes": 2}, {"episodes": 3}]}, "called 'held out'"),
    ({"ratios": [{"of": "mean_force", "method": "learnt", "against": "learner"}]}, "did you mean learner"),
    ({"ratios": [{"of": "mean_fource", "method": "learner", "against": "learner"}]}, "did you mean mean_force"),
]


@pytest.mark.parametrize(("changed", "words"), WRONG, ids=[words for _, words in WRONG])
def test_invalid_study_is_one_sentence_and_writes_nothing(changed, words, tmp_path):
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(BEAD | changed))
    with pytest.raises(InputError) as refused:
        run(load_study(tmp_path / "study.yaml"), tmp_path / "out")
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "out").exists()


def test_null_preset_of_a_method_leaves_the_study_s_out(tmp_path):
    methods = {"sac": {}, "bc": {"learner": {"algorithm": "bc", "preset": None}}}
    declaration = {"name": "clamp", "task": "GridClamp", "methods": methods, "seeds": [0], "after_episodes": [5]}
    study = Study.model_validate(declaration | {"learner": {"algorithm": "sac", "preset": "sac_gridclamp"}})
    assert [Job(study, name, 0, tmp_path).config(5).learner.algorithm for name in methods] == ["sac", "bc"]


def test_job_is_evaluated_after_the_numbers_that_it_reaches():
    methods = {"short": {"learner": {"episodes": 2}}, "long": {}, "nothing": {"policy": "zero"}}
    one = study(methods=methods)
    assert [Job(one, name, 5, None).after_episodes for name in methods] == [[2], [2, 4], [0]]
    assert study(methods={"nothing": {"policy": "zero"}}, learner={"episodes": 1}).after_episodes == (2, 4)


@pytest.mark.parametrize("text", ["[1, 2]", "a: [", "", "\x00", "just words"])
def test_load_study_refuses_invalid_files(text, tmp_path):
    (tmp_path / "study.yaml").write_text(text)
    with pytest.raises(InputError) as refused:
        load_study(tmp_path / "study.yaml")
    assert "\n" not in str(refused.value)


def test_load_study_refuses_a_missing_file(tmp_path):
    with pytest.raises(InputError, match="did you mean connector"):
        study_path("conector")
    with pytest.raises(InputError, match="there is no file"):
        load_study(tmp_path / "none.yaml")
    chosen = load_study(study_path("connector")).subset(["kgrl"], [1, 2])
    assert (list(chosen.methods), chosen.seeds) == (["kgrl"], (1, 2))
    with pytest.raises(InputError, match="did you mean kgrl"):
        chosen.subset(["kgrll"])


@pytest.mark.parametrize(
    ("seeds", "words"),
    [
        ([-1], "seeds, 0: .*not -1"),
        ([1, 2, 1], "seed 1 is given twice"),
        ([], "seeds"),
        ([1.5], "1.5"),
        ([2**31], "2147"),
    ],
)
def test_subset_refuses_the_seeds_that_a_file_cannot_have(seeds, words):
    with pytest.raises(InputError, match=words) as refused:
        load_study(study_path("connector")).subset(None, seeds)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name", study_names())
def test_study_of_research_is_valid(name, tmp_path):
    declared = load_study(study_path(name))
    assert declared.name == name
    import_modules(declared.imports)
    for method in declared.methods:
        check_job(Job(declared, method, declared.seeds[0], tmp_path))
    for expected in declared.ratios:
        assert expected.of.removeprefix("training_") in statistics_of(declared.task)
        assert {expected.method, expected.against} <= declared.methods.keys()


def test_scripted_pour_succeeds_with_constraints_only(tmp_path):
    declared = load_study(study_path("pouring_mugs")).subset(["scripted_pour", "person_unconstrained"])
    declared = declared.model_copy(update={"eval_set": (EvalSet(episodes=1),)})
    bound, free = run(declared, tmp_path).to_dict("records")
    assert (bound["success_rate"], free["success_rate"]) == (1.0, 0.0)
    assert bound["ended_in_spill"] + bound["ended_in_collision"] == 0
    assert free["ended_in_spill"] + free["ended_in_collision"] == 1
    assert bound["max_commanded_violation"] <= 1e-9


def test_policy_is_trained_on_the_gantry_for_any_station(tmp_path):
    declared = load_study(study_path("connector_on_arm"))
    config = Job(declared, "skgrl", 30, tmp_path).config(80)
    assert config.environment["station"] == "gantry"
    assert declared.eval_set[0].env == {"station": "arm"}


def test_run_of_a_study_is_a_run_folder(tmp_path):
    run(study(seeds=[5]), tmp_path)
    folder = RunFolder(tmp_path / "learner-5")
    assert folder.config().episodes == 4
    assert np.array_equal(folder.episodes()["episode"], range(4))


def test_sweep_is_evaluated_at_each_value_and_drawn(tmp_path):
    """The wall is at the start of the bead, or so far away that nothing succeeds."""
    walls = {"quantity": "wall [m]", "at": {0.0: {}, -0.5: {"wall": -0.5}}, "episodes": 2}
    methods = {"nothing": {"policy": "zero", "seeds": [9]}, "anything": {"policy": "uniform_random"}}
    one = study(methods=methods, sweeps=[walls], eval_set=[])
    result = study_command(one, tmp_path, make_engine(processes=1))
    rows = read_table(tmp_path / "beads.csv")
    assert rows["eval_set"].tolist() == ["wall [m] 0", "wall [m] -0.5"] * 3
    assert rows[rows["eval_set"] == "wall [m] -0.5"]["success_rate"].eq(0).all()
    assert result["picture"] == str(tmp_path / "beads.png")
    assert result["nothing, below 90% at wall [m]"] == "from the easiest on"
    assert (tmp_path / "beads.png").stat().st_size > 10_000
    assert run_study(one, tmp_path, make_engine(processes=1))["eval_set"].tolist() == rows["eval_set"].tolist()


def test_longer_training_is_evaluated_by_itself(tmp_path):
    eval_set = [{"episodes": 2, "file": "held_out-{episodes}-{digest}.csv"}]
    run(study(after_episodes=[2], seeds=[5], eval_set=eval_set), tmp_path)
    run(study(after_episodes=[4], seeds=[5], eval_set=eval_set), tmp_path)
    assert len(list((tmp_path / "learner-5").glob("held_out-2-*.csv"))) == 2
    same = [{"episodes": 2, "file": "held_out.csv"}]
    run(study(after_episodes=[4], seeds=[5], eval_set=same), tmp_path)
    with pytest.raises(InputError, match="after other training"):
        run(study(after_episodes=[6], seeds=[5], eval_set=same), tmp_path)


def test_subset_of_a_study_has_a_table_of_its_own(tmp_path):
    methods = {"learner": {}, "nothing": {"policy": "zero"}}
    (tmp_path / "beads.yaml").write_text(yaml.safe_dump(BEAD | {"methods": methods, "after_episodes": [2]}))
    for words, rows in (([], 4), (["--methods", "nothing"], 2), (["--seeds", "5"], 2)):
        with pytest.raises(SystemExit) as end:
            main(["study", str(tmp_path / "beads.yaml"), "--out", str(tmp_path / "out"), "--processes", "1", *words])
        assert end.value.code == 0
        name = "-".join(["beads", *words[1:]])
        assert len(read_table(tmp_path / "out" / f"{name}.csv")) == rows
    assert len(read_table(tmp_path / "out" / "beads.csv")) == 4


def sweep_rows(*rates):
    result = [
        {"method": "one", "eval_set": "x", "seed": k, "after_episodes": 60, "episodes": 50} for k in range(len(rates))
    ]
    return pd.DataFrame(result, dtype=object).assign(success_rate=rates)


def test_band_spans_the_intervals_of_all_seeds():
    assert _pooled_success(sweep_rows(0.8), "one", "x") == pytest.approx((0.8, *wilson(40, 50)))
    assert _pooled_success(sweep_rows(1.0, 0.0), "one", "x") == pytest.approx(
        (0.5, wilson(0, 50)[0], wilson(50, 50)[1])
    )
    assert _pooled_success(sweep_rows(1.0, 1.0), "one", "x") == pytest.approx((1.0, *wilson(50, 50)))
    assert _pooled_success(sweep_rows(1.0), "another", "x") is None


def test_sweep_of_one_value_is_drawn(tmp_path):
    one = Study.model_validate(
        {"name": "one", "task": "Bead", "methods": {"one": {"policy": "zero"}}, "seeds": [0], "eval_set": [],
         "sweeps": [{"quantity": "x", "at": {1.0: {}}}]}
    )  # fmt: skip
    result = sweep_rows(0.5).assign(eval_set="x 1")
    assert draw_sweeps(one, result, tmp_path / "one.png").is_file()
