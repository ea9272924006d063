"""Environment of a run with changed options, in every tool that accepts changes."""

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.environments import changed_environment, check_environment, make_environment
from guiderail.tools.evaluation import evaluate
from guiderail.tools.evaluation.policies import check_compatible
from guiderail.tools.evaluation.subject import EpisodeSpec
from guiderail.tools.learning.run_folder import RunFolder, configure
from guiderail_studies.certify import _find_subject
from guiderail_studies.declaration import Study
from guiderail_studies.job import Job, run_job
from guiderail_studies.report_data import command
from guiderail_studies.robustness import robustness

HARD = {"difficulty": "hard"}


def zero_policy(num_observations, num_actions):
    """Return a policy with weights of zero."""
    layers = [(np.zeros((num_actions, num_observations), np.float32), np.zeros(num_actions, np.float32))]
    limits = {"action_low": [-1.0] * num_actions, "action_high": [1.0] * num_actions}
    return Policy(layers, {"observation_shape": [num_observations], **limits})


@pytest.mark.parametrize("task", ["BncConnector", "GridClamp", "NarrowPassage", "Pouring"])
def test_changed_difficulty_keeps_chosen_options(task):
    chosen = {"action_repeat": 3, "reward": "sparse"}
    standard, hard = (check_environment(task, chosen | difficulty) for difficulty in ({}, HARD))
    assert standard != hard | {"difficulty": "standard"}
    assert changed_environment(task, standard, HARD) == hard
    assert changed_environment(task, hard, {"difficulty": "standard"}) == standard
    assert changed_environment(task, hard, {**HARD, "action_repeat": 4}) == hard | {"action_repeat": 4}
    assert changed_environment(task, standard, {"action_repeat": 4}) == standard | {"action_repeat": 4}


class _Requested(Exception):
    """Exception with the options of a requested environment, which is not created."""


def evaluate_by_study(out):
    declaration = {"name": "clamp", "task": "GridClamp", "methods": {"zero": {"policy": "zero"}}, "seeds": [1]}
    run_job(Job(Study.model_validate(declaration | {"eval_set": [{"env": HARD, "episodes": 2}]}), "zero", 1, out))


@pytest.mark.parametrize(
    "evaluate_run",
    [
        lambda run: evaluate.evaluate(run, environment=HARD),
        lambda run: robustness([run], environment=HARD, axes="friction"),
        evaluate_by_study,
    ],
    ids=["evaluate", "robustness", "study"],
)
def test_policy_is_evaluated_at_another_difficulty(evaluate_run, tmp_path, monkeypatch):
    def raise_options(task, environment):
        raise _Requested(dict(environment))

    RunFolder(tmp_path).create(configure("GridClamp", {}, episodes=1))
    RunFolder(tmp_path).write_episodes([{"episode": 0, "return": 0.0, "success": 0, "termination": "", "steps": 1}])
    zero_policy(3, 2).save(tmp_path)
    monkeypatch.setattr(evaluate, "make_environment", raise_options)
    with pytest.raises(_Requested) as result:
        evaluate_run(tmp_path)
    assert result.value.args[0]["force_limit"] == check_environment("GridClamp", HARD)["force_limit"]


def test_policy_is_shown_and_certified_at_another_difficulty(tmp_path):
    RunFolder(tmp_path).create(configure("NarrowPassage", {}, episodes=1))
    zero_policy(3, 2).save(tmp_path)
    hard = check_environment("NarrowPassage", HARD)
    assert EpisodeSpec.of_policy(tmp_path, HARD).environment == hard
    assert _find_subject(str(tmp_path), HARD)[1] == hard


def test_refusal_of_a_policy_names_shapes_that_differ():
    env = make_environment("Bead", {})
    check_compatible(zero_policy(3, 2), env)
    for policy, shapes in (
        (zero_policy(4, 2), r"\(4,\) and returns actions \(2,\)"),
        (zero_policy(3, 1), r"\(3,\) .* \(1,\)"),
    ):
        message = rf"takes observations {shapes}, .* observations \(3,\) and actions \(2,\)"
        with pytest.raises(InputError, match=message):
            check_compatible(policy, env)


def test_refusal_of_a_policy_names_options_that_differ():
    env = make_environment("NarrowPassage", {"guidance": "kgrl"})
    trained = check_environment("NarrowPassage", {"guidance": "kgrl", **HARD})
    message = "it learned with difficulty='hard' instead of 'standard', gap_width=0.03 inst"
    with pytest.raises(InputError, match=message):
        check_compatible(zero_policy(4, 2), env, trained)


@pytest.mark.parametrize("chosen", [{"difficulty": "hard"}, {"station": "arm", "action_repeat": 7}])
def test_command_of_a_run_names_options_without_defaults(chosen):
    arguments = command(configure("BncConnector", {"guidance": "kgrl", **chosen}), "out").split()
    assert [argument for argument in arguments if "=" in argument] == [
        f"{key}={value}" for key, value in chosen.items()
    ]
