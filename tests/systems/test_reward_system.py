import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.systems.episode_terms import RewardSystem, RewardTerm


@pytest.fixture
def system():
    return RewardSystem(
        [
            RewardTerm("effort", {"pose": 2, "last_pose": 2}, lambda pose, last_pose: -np.sum((pose - last_pose) ** 2)),
            RewardTerm("height", {"pose": 2}, lambda pose: pose[1]),
        ]
    )


@pytest.fixture
def context(system):
    context = system.CreateDefaultContext()
    system.get_signal_input_port("pose").FixValue(context, [3.0, 5.0])
    system.get_signal_input_port("last_pose").FixValue(context, [1.0, 4.0])
    return context


def test_reward_is_the_sum_of_its_terms(system, context):
    assert system.get_term_output_port("effort").Eval(context) == [-5.0]
    assert system.get_term_output_port("height").Eval(context) == [5.0]
    assert system.get_reward_output_port().Eval(context) == [0.0]


def test_reward_changes_with_its_inputs(system, context):
    system.get_reward_output_port().Eval(context)
    system.get_signal_input_port("pose").FixValue(context, [1.0, 4.0])
    assert system.get_reward_output_port().Eval(context) == [4.0]


def test_each_term_is_evaluated_once_for_all_ports():
    calls = []
    system = RewardSystem([RewardTerm("x", {"u": 1}, lambda u: calls.append(1) or u[0])])
    context = system.CreateDefaultContext()
    system.get_signal_input_port("u").FixValue(context, [2.0])
    for _ in range(3):
        system.get_reward_output_port().Eval(context)
        system.get_term_output_port("x").Eval(context)
    context.SetTime(1.0)
    system.get_reward_output_port().Eval(context)
    assert len(calls) == 1


def test_term_that_modifies_its_argument_does_not_affect_others():
    modifying = RewardTerm("modifying", {"u": 1}, lambda u: u.fill(9.0) or 0.0)
    system = RewardSystem([modifying, RewardTerm("u", {"u": 1}, lambda u: u[0])])
    context = system.CreateDefaultContext()
    system.get_signal_input_port("u").FixValue(context, [2.0])
    assert system.get_reward_output_port().Eval(context) == [2.0]


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.nan, "reward term 'a' of own is not finite, but nan"),
        (-np.inf, "reward term 'a' of own is not finite, but -inf"),
        ([1.0, 2.0], r"reward term 'a' of own must be one number, and it is \[1.0, 2.0\]"),
        ("1", "reward term 'a' of own must be one number, and it is '1'"),
        (None, "reward term 'a' of own must be one number, and it is None"),
    ],
)
def test_evaluation_refuses_a_term_that_is_no_finite_number(value, message):
    system = RewardSystem([RewardTerm("a", {}, lambda: value)], "own")
    with pytest.raises(InputError, match=message):
        system.get_reward_output_port().Eval(system.CreateDefaultContext())


def test_term_may_be_an_array_with_a_single_number():
    system = RewardSystem([RewardTerm("a", {}, lambda: [[2]])])
    assert system.get_reward_output_port().Eval(system.CreateDefaultContext()) == [2.0]


@pytest.mark.parametrize(("name", "words"), [("", "reward term 'a' is called"), ("own", "reward term 'a' of own is")])
def test_constructor_refuses_a_function_with_other_parameters(name, words):
    with pytest.raises(InputError, match=words):
        RewardSystem([RewardTerm("a", {"pose": 2}, lambda position: 0.0)], name)
