from functools import partial

import numpy as np
import pandas as pd
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import POSE_NAMES
from guiderail.models.policy import Policy
from guiderail.models.primitives import Demonstrations
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.baselines import BaselinePolicy, uniform_random, zero_policy
from guiderail.tools.evaluation.episode import HELD_OUT_SEED
from guiderail.tools.evaluation.evaluate import _save_demonstrations, evaluate, evaluate_policy
from guiderail.tools.evaluation.evaluation import COMPARED, Evaluation, compare, load_or_compute, statistics
from guiderail.tools.evaluation.metrics import UNCONSTRAINED
from guiderail.tools.evaluation.subject import evaluation_scope, outcome, refuse_guidance_change
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.learning.train import Run


@pytest.mark.parametrize("make_policy", [zero_policy, partial(BaselinePolicy, uniform_random)])
def test_episode_depends_on_its_seed_alone(make_policy):
    env = make_environment("Bead", {})
    first = evaluate_policy(env, make_policy(env), episodes=4, seed=20)
    assert first["return"].nunique() == 4
    second = evaluate_policy(env, make_policy(env), episodes=2, seed=22)
    assert second["return"].tolist() == first["return"][2:].tolist()


@pytest.mark.parametrize(
    ("seed", "first_number"), [(HELD_OUT_SEED, 0), (HELD_OUT_SEED + 8, 8), (0, 2**32 - HELD_OUT_SEED)]
)
def test_random_numbers_of_an_episode_are_seeded_by_its_seed(seed, first_number):
    env, numbers = make_environment("Bead", {}), []
    policy = zero_policy(env)
    policy.start_episode = numbers.append
    evaluate_policy(env, policy, episodes=2, seed=seed)
    assert numbers == [first_number, first_number + 1]
    evaluate_policy(env, policy, episodes=2, seed=seed, first_number=0)
    assert numbers[2:] == [0, 1]


def test_load_or_compute_computes_once(tmp_path):
    calls = []

    def compute():
        calls.append(1)
        return pd.DataFrame({"success": [1, 0], "return": [0.1 + 0.2, -np.inf]})

    first, second = (load_or_compute(tmp_path / "rows.csv", compute) for _ in range(2))
    pd.testing.assert_frame_equal(first, second)
    assert len(calls) == 1


def test_demonstration_runs_on_the_episodes_of_the_policy(bead_run, capsys):
    result = evaluate(bead_run, episodes=3, baselines=("uniform_random",))
    printed = capsys.readouterr().err
    assert "series 1 of 3: policy 3/3" in printed
    assert "series 2 of 3: demonstration alone 3/3" in printed
    for name in COMPARED:
        assert result[f"demonstration_{name}"] is not None, name
    blocked = evaluate(Run(bead_run), episodes=3, environment={"wall": -0.5})
    assert blocked["success_rate"] == blocked["demonstration_success_rate"] == 0.0
    assert blocked["mean_return"] != result["mean_return"]


def test_empty_set_of_baselines_evaluates_the_policy_alone(bead_run, capsys):
    result = evaluate(bead_run, episodes=2, baselines=())
    assert "series 1 of 1: policy 2/2" in capsys.readouterr().err
    assert result["demonstration_success_rate"] is None


def test_stored_episodes_that_lost_rows_are_evaluated_again(bead_run):
    baselines = {"uniform_random": partial(BaselinePolicy, uniform_random)}
    first = evaluate(bead_run, episodes=3, baselines=baselines)
    files = [*(bead_run / "baselines").glob("*.csv")]
    whole = [file.read_bytes() for file in files]
    for file in files:
        file.write_text("".join(file.read_text().splitlines(keepends=True)[:-1]))
    assert evaluate(bead_run, episodes=3, baselines=baselines).statistics == first.statistics
    assert [file.read_bytes() for file in files] == whole


def test_baselines_are_evaluated_once(bead_run, capsys):
    policies = {
        "zero": zero_policy,
        "uniform_random": partial(BaselinePolicy, uniform_random),
        "incompatible": lambda env: lambda observation: np.zeros(7),
    }
    first = evaluate(bead_run, episodes=3, baselines=policies)
    assert first["baselines"] == ["demonstration", "zero", "uniform_random"]
    assert first["skipped_baselines"] == ["incompatible"]
    for name in COMPARED:
        assert first[f"zero_{name}"] == first[f"demonstration_{name}"]
    assert first["uniform_random_mean_return"] != first["zero_mean_return"]
    assert "series 4 of 5: uniform random actions 3/3" in capsys.readouterr().err
    second = evaluate(bead_run, episodes=3, baselines=policies)
    printed = capsys.readouterr().err
    for name in ("series 2 of 5: demonstration alone", "series 4 of 5: uniform random actions"):
        assert f"{name}: evaluated before, and used again" in printed
        assert f"{name} 3/3" not in printed
    assert second == first
    for name, rows in first.rows.items():
        pd.testing.assert_frame_equal(second.rows[name], rows, check_exact=True)
    four = evaluate(bead_run, episodes=4, baselines=policies)
    assert four["uniform_random_mean_return"] != first["uniform_random_mean_return"]


def test_rows_of_another_function_are_not_used_again(bead_run):
    seeded = [partial(BaselinePolicy, uniform_random, seed=seed) for seed in (1, 2)]
    functions = [*seeded, *(lambda env, value=value: lambda _: np.full(2, value) for value in (0.5, 1.0))]
    series = [["uniform_random"], *({"uniform_random": function} for function in functions)]
    returns = [evaluate(bead_run, episodes=1, baselines=each)["uniform_random_mean_return"] for each in series]
    assert len(set(returns)) == len(series)
    assert len(list(bead_run.glob("baselines/uniform_random-*.csv"))) == 1 + len(seeded)


@pytest.mark.parametrize("name", ["../zero", "", "\0", "z" * 201])
def test_evaluate_refuses_a_baseline_that_cannot_name_a_file(bead_run, name):
    with pytest.raises(InputError, match="the name of a policy is a printable text of 1 to 200 bytes without '/'"):
        evaluate(bead_run, episodes=1, baselines={name: zero_policy})


def fail(*arguments):
    raise KeyError("gain")


def fail_in_episode(observation):
    """Return an action for the constant observation of the compatibility check only."""
    return np.zeros(2) if observation.min() == observation.max() else fail()


@pytest.mark.parametrize(
    ("make_policy", "name", "num_stored"),
    [
        (fail, "'lab'", 0),
        (lambda env: fail, "'lab'", 0),
        (lambda env: fail_in_episode, "'lab'", 1),
        (partial(BaselinePolicy, fail), "fail", 1),
        (partial(BaselinePolicy, lambda rng, size: fail_in_episode), "'lab'", 1),
    ],
)
def test_failure_of_a_given_baseline_is_named(make_policy, name, num_stored, bead_run):
    message = rf"the baseline policy {name} failed: test_evaluate\.py, line \d+: KeyError: 'gain'"
    with pytest.raises(InputError, match=message):
        evaluate(bead_run, episodes=2, baselines={"zero": zero_policy, "lab": make_policy}, processes=1)
    assert len(list(bead_run.glob("baselines/zero-*.csv"))) == num_stored


def test_evaluate_accepts_a_policy_without_a_run(bead_run, tmp_path):
    (tmp_path / "exported").mkdir()
    Policy.load(bead_run).save(tmp_path / "exported")
    own = evaluate(bead_run, episodes=2)
    exported = evaluate(tmp_path / "exported", "Bead", environment=RunFolder(bead_run).config().environment, episodes=2)
    assert exported["mean_return"] == own["mean_return"]
    assert exported["trained_episodes"] is None
    zero, function = (evaluate(act, "Bead", episodes=2) for act in ("zero", lambda observation: np.zeros(2)))
    assert zero["mean_return"] == function["mean_return"]
    assert list((tmp_path / "exported").rglob("*.csv")) == []
    with pytest.raises(InputError, match="name the task"):
        evaluate(lambda observation: np.zeros(2), episodes=2)


def test_evaluate_saves_successful_episodes(tmp_path):
    file = tmp_path / "saved.npz"
    result = evaluate("zero", "NarrowPassage", environment={"guidance": "kmp"}, episodes=1, save=str(file))
    assert result["success_rate"] == 1.0
    assert result["saved"] == Demonstrations.load(file).num_demonstrations == 1
    for path, message in ((file, "already exists"), (tmp_path / "x.yaml", r"\.npz or \.csv")):
        with pytest.raises(InputError, match=message):
            evaluate("zero", "NarrowPassage", save=path)
    with pytest.raises(InputError, match="no signal 'wrench'"):
        evaluate("zero", "NarrowPassage", save=tmp_path / "other.npz", signal="wrench")


def test_results_do_not_depend_on_the_number_of_processes(tmp_path):
    def evaluate_in(processes):
        return evaluate(
            "uniform_random", "NarrowPassage", 2, baselines=["constant", "scripted"],
            environment={"control_period": 0.16}, processes=processes, save=tmp_path / f"{processes}.npz",
        )  # fmt: skip

    single, several = evaluate_in(1), evaluate_in(2)
    assert single == several
    assert single.rows.keys() == several.rows.keys() == {"policy", "demonstration", "constant"}
    assert single["skipped_baselines"] == ["scripted"]
    for name, rows in single.rows.items():
        pd.testing.assert_frame_equal(rows, several.rows[name], check_exact=True)
    assert single["saved"] == several["saved"] > 0
    saved = [Demonstrations.load(tmp_path / f"{processes}.npz") for processes in (1, 2)]
    for first, second in zip(saved[0].outputs, saved[1].outputs, strict=True):
        np.testing.assert_array_equal(first, second)


def test_actions_of_a_baseline_are_independent_of_processes():
    """Each episode has a random generator of its own, whatever episodes its process has run before."""
    env = make_environment("Bead", {})
    rows = {
        processes: evaluate_policy(env, BaselinePolicy(uniform_random, env), episodes=6, processes=processes)
        for processes in (1, 3)
    }
    assert rows[1]["return"].nunique() == 6
    pd.testing.assert_frame_equal(rows[1], rows[3], check_exact=True)


def outcomes(*successes):
    """Return a table of episodes with these successes."""
    return pd.DataFrame({"success": successes})


def test_comparison_is_an_exact_paired_test_per_baseline():
    """The policy wins 9 of 10 discordant episodes: p = (1 + 10) / 2**10."""
    policy, best, worst = outcomes(*[1] * 9, 0, 1), outcomes(*[0] * 9, 1, 1), outcomes(*[0] * 11)
    comparison = compare({"policy": policy, "best": best, "worst": worst})
    assert comparison.baseline == "best"
    assert comparison.successes == 2
    assert comparison.p == pytest.approx(11 / 2**10)
    assert compare({"policy": policy, "same": policy}).p == 1.0
    assert compare({"policy": policy}) is None


def test_evaluation_has_a_table_and_a_sentence(bead_run):
    result = evaluate(bead_run, episodes=4, baselines=["constant"])
    assert list(result.table.index) == ["policy", "demonstration alone", "constant action"]
    assert result.table.loc["policy", "mean_return"] == result["mean_return"]
    low, high = 100 * result["success_low"], 100 * result["success_high"]
    assert f"in {4 * result['success_rate']:.0f} of 4 held-out episodes (95 % interval {low:.0f} to {high:.0f} %)" in (
        result.sentence
    )
    assert "not shown to be better than the best baseline" in result.sentence
    assert result.sentence.endswith("; every command satisfied the constraints.")
    assert result.sentence in str(result)
    assert result.sentence in result._repr_html_()


def test_sentence_says_that_commands_were_not_checked_without_constraints():
    rows = {"policy": pd.DataFrame({"success": [1], "max_commanded_violation": [UNCONSTRAINED]})}
    result = Evaluation(statistics(rows["policy"]), rows)
    assert "the commands were not checked, because there is no constraint" in result.sentence


def test_table_omits_collisions_that_are_not_counted():
    rows = {"policy": pd.DataFrame({"success": [1], "collisions": [0], "collision_steps": [0]})}
    assert {"collisions", "collision_steps"} <= {*Evaluation({"collisions": 0}, rows).table}
    table = Evaluation({"collisions": None, "collision_steps": None}, rows).table
    assert list(table) == ["success_rate", "success_low", "success_high"]


@pytest.mark.parametrize(("force", "text"), [({"peak_force": 2.0}, ", peak force 2.0 N"), ({}, "")])
def test_outcome_names_the_force_when_known(force, text):
    assert outcome({"termination": "success", "steps": 3, **force}) == f"success after 3 control steps{text}"


def test_sentence_names_the_best_baseline():
    rows = {"policy": outcomes(*[1] * 12), "zero": outcomes(1, *[0] * 11)}
    statistics = {"success_low": 0.7, "success_high": 1.0, "max_commanded_violation": 2e-3}
    sentence = Evaluation(statistics, rows).sentence
    assert (
        "better than the best baseline, zero action with 1 of 12 (one-sided p = 0.00049); the largest constraint"
        in sentence
    )
    assert "was 0.002 m or rad." in sentence


@pytest.mark.parametrize("guidance", ["residual", "kgrl", "none"])
def test_another_guidance_is_refused(guidance):
    refuse_guidance_change({"guidance": "skgrl"}, {"guidance": "skgrl"})
    with pytest.raises(InputError, match=f"its actions have another meaning with {guidance}"):
        refuse_guidance_change({"guidance": "skgrl"}, {"guidance": guidance})


def test_scope_differs_for_a_fixed_and_a_resampled_offset(bead_run):
    fixed, resampled = (
        evaluation_scope("BncConnector", {"fixture_offset": "per_run"}, resample_offsets=value)
        for value in (False, True)
    )
    assert "the one offset that is hidden in this run" in fixed
    assert (
        resampled == evaluation_scope("GridClamp", {"fixture_offset": "per_episode"}, resample_offsets=False) != fixed
    )
    assert evaluate(bead_run, episodes=1)["evaluation_scope"] == "held-out starts"
    with pytest.raises(InputError, match="no hidden offset to resample: leave --resample-offsets out"):
        evaluate(bead_run, episodes=1, resample_offsets=True)


def test_resampled_offsets_exclude_the_offset_of_the_run(bead_run, monkeypatch):
    monkeypatch.setattr("guiderail.tools.evaluation.evaluate.evaluation_scope", lambda *arguments: "any")
    run_seed = RunFolder(bead_run).config().seed
    for seed, episodes in ((run_seed, 1), (run_seed - 2, 3)):
        with pytest.raises(InputError, match="has the offset of the run itself"):
            evaluate(bead_run, episodes=episodes, seed=seed, resample_offsets=True)


def test_hidden_offset_is_resampled_only_with_new_run():
    env = make_environment("BncConnector", {"fixture_offset": "per_run"})
    env.reset(seed=3)
    for options, number in (({}, 1), ({"new_run": True}, 3)):
        sampled = [env.reset(seed=seed, options={"held_out": True} | options)[1]["jack_offset"] for seed in (7, 8, 9)]
        assert len({tuple(offset) for offset in sampled}) == number


@pytest.mark.parametrize(("num_outputs", "names"), [(6, POSE_NAMES), (2, ("y1", "y2"))])
def test_saved_poses_have_their_names(tmp_path, num_outputs, names):
    motion = np.arange(3.0), np.arange(3.0 * num_outputs).reshape(3, num_outputs)
    assert _save_demonstrations([None, motion], tmp_path / "saved.csv") == 1
    assert Demonstrations.load(tmp_path / "saved.csv").names == names
