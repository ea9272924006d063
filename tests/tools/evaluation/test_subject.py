import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.evaluation.subject import find_subject


@pytest.fixture
def policy(tmp_path):
    """Return the folder of a policy that was trained with kgrl and the mean contact point."""
    description = {"observation_shape": [17], "action_low": [-1.0, -1.0], "action_high": [1.0, 1.0]}
    description["environment"] = {"guidance": "kgrl", "observation": "mean_contact_point"}
    Policy([(np.zeros((2, 17)), np.zeros(2))], description).save(tmp_path / "policy")
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
