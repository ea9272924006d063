import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.evaluation.evaluate import evaluate
from guiderail.tools.evaluation.subject import find_subject
from guiderail.tools.pretrained import find_run


@pytest.fixture
def policy(tmp_path):
    """Return the folder of a policy that was trained with kgrl and the mean contact point."""
    description = dict(Policy.load(find_run("pretrained:connector")).description)
    description["environment"] = {"guidance": "kgrl", "observation": "mean_contact_point"}
    (size,) = description["observation_shape"]
    Policy([(np.zeros((2, size)), np.zeros(2))], description).save(tmp_path / "policy")
    return tmp_path / "policy"


def test_policy_acts_in_another_task_with_the_options_that_it_was_trained_with(policy):
    environment = find_subject(policy, "BncConnector").config.environment
    assert (environment["guidance"], environment["observation"]) == ("kgrl", "mean_contact_point")


def test_given_options_replace_those_of_the_policy(policy):
    environment = find_subject(policy, "BncConnector", {"observation": "state"}).config.environment
    assert (environment["guidance"], environment["observation"]) == ("kgrl", "state")


def test_options_that_the_task_does_not_accept_are_left_out(policy):
    environment = find_subject(policy, "NarrowPassage").config.environment
    assert environment["observation"] == "state"


def test_policy_without_a_run_needs_a_task(policy):
    with pytest.raises(InputError, match="is a policy without a run: name the task"):
        find_subject(policy, None)


def test_result_without_a_run_states_guidance_and_observation(policy):
    short = {"bounded_force": False, "force_limit": 5.0}  # the episode ends at the first contact
    result = evaluate(policy, "BncConnector", 1, baselines=(), processes=1, environment=short)
    scope = result["evaluation_scope"]
    assert scope.endswith(", guidance=kgrl, difficulty=standard, observation=mean_contact_point, action_repeat=10")


def test_run_of_an_environment_that_was_given_as_an_object_names_the_way_in_python():
    with pytest.raises(InputError, match="was given to training as an object: evaluate the run in Python"):
        find_subject("zero", "given/PushWall-v0")
