"""A run's environment with other arguments, wherever one can ask for them."""

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.certify import _find_subject
from guiderail.tools.environments import changed_environment, check_environment, make_environment
from guiderail.tools.evaluation import evaluate
from guiderail.tools.evaluation.policies import check_compatible
from guiderail.tools.evaluation.robustness import robustness
from guiderail.tools.evaluation.subject import EpisodeSpec
from guiderail.tools.experiments.declaration import Study
from guiderail.tools.experiments.job import Job, run_job
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.learning.train import configure
from guiderail.tools.visualization.report_data import command

HARD = {"difficulty": "hard"}


def policy(seen, moved):
    """A network of zeros."""
    layers = [(np.zeros((moved, seen), np.float32), np.zeros(moved, np.float32))]
    return Policy(layers, {"observation_shape": [seen], "action_low": [-1.0] * moved, "action_high": [1.0] * moved})


@pytest.mark.parametrize("task", ["BncConnector", "GridClamp", "NarrowPassage", "Pouring"])
def test_changed_difficulty_keeps_chosen_options(task):
    chosen = {"action_repeat": 3, "reward": "sparse"}
    standard, hard = (check_environment(task, chosen | more) for more in ({}, HARD))
    assert standard != hard | {"difficulty": "standard"}
    assert changed_environment(task, standard, HARD) == hard
    assert changed_environment(task, hard, {"difficulty": "standard"}) == standard
    assert changed_environment(task, hard, {**HARD, "action_repeat": 4}) == hard | {"action_repeat": 4}
    assert changed_environment(task, standard, {"action_repeat": 4}) == standard | {"action_repeat": 4}


class _AskedFor(Exception):
    """An environment that is not needed."""


def by_study(out):
    said = {"name": "one", "task": "GridClamp", "methods": {"zero": {"policy": "zero"}}, "seeds": [1]}
    run_job(Job(Study.model_validate(said | {"eval_set": [{"env": HARD, "episodes": 2}]}), "zero", 1, out))


@pytest.mark.parametrize(
    "ask",
    [
        lambda run: evaluate.evaluate(run, environment=HARD),
        lambda run: robustness([run], environment=HARD, axes="friction"),
        by_study,
    ],
    ids=["evaluate", "robustness", "study"],
)
def test_policy_is_evaluated_at_another_difficulty(ask, tmp_path, monkeypatch):
    def refuse(task, environment):
        raise _AskedFor(dict(environment))

    RunFolder(tmp_path).create(configure("GridClamp", {}, episodes=1))
    RunFolder(tmp_path).write_episodes([{"episode": 0, "return": 0.0, "success": 0, "termination": "", "steps": 1}])
    policy(3, 2).save(tmp_path)
    monkeypatch.setattr(evaluate, "make_environment", refuse)
    with pytest.raises(_AskedFor) as result:
        ask(tmp_path)
    assert result.value.args[0]["force_limit"] == check_environment("GridClamp", HARD)["force_limit"]


def test_a_policy_is_shown_and_certified_at_another_difficulty(tmp_path):
    RunFolder(tmp_path).create(configure("NarrowPassage", {}, episodes=1))
    policy(3, 2).save(tmp_path)
    hard = check_environment("NarrowPassage", HARD)
    assert EpisodeSpec.of_policy(tmp_path, HARD).environment == hard
    assert _find_subject(str(tmp_path), HARD)[1] == hard


def test_policy_is_refused_with_both_shapes_when_they_differ():
    env = make_environment("Bead", {})
    check_compatible(policy(3, 2), env)
    for other, shapes in ((policy(4, 2), r"\(4,\) and returns actions \(2,\)"), (policy(3, 1), r"\(3,\) .* \(1,\)")):
        with pytest.raises(
            InputError, match=rf"takes observations {shapes}, .* observations \(3,\) and actions \(2,\)"
        ):
            check_compatible(other, env)


def test_policy_is_refused_with_the_options_that_differ():
    env = make_environment("NarrowPassage", {"guidance": "kgrl"})
    learned_in = check_environment("NarrowPassage", {"guidance": "kgrl", **HARD})
    with pytest.raises(
        InputError, match=r"it learned with difficulty='hard' instead of 'standard', gap_width=0.03 inst"
    ):
        check_compatible(policy(4, 2), env, learned_in)


@pytest.mark.parametrize("chosen", [{"difficulty": "hard"}, {"station": "arm", "action_repeat": 7}])
def test_command_of_a_run_names_options_beyond_defaults(chosen):
    words = command(configure("BncConnector", {"guidance": "kgrl", **chosen}), "out").split()
    arguments = [word for word in words if "=" in word]
    assert arguments == [f"{key}={value}" for key, value in chosen.items()]
