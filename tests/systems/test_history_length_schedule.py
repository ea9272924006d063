import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail.systems.history_length_schedule import HistoryLengthSchedule

PERIOD = 0.125


def lengths_under(forces, **arguments):
    """The history length after each control step with these forces."""
    system = HistoryLengthSchedule([1, 2, 5, 10], PERIOD, **arguments)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    wrench = system.get_wrench_input_port().FixValue(context, np.zeros(6))
    simulator.Initialize()
    lengths = []
    for n, force in enumerate(forces, start=1):
        wrench.GetMutableData().set_value([0.0, 0.0, force, 9.0, 9.0, 9.0])
        simulator.AdvanceTo((n + 0.5) * PERIOD)
        lengths.append(int(system.get_history_length_output_port().Eval(context)[0]))
    return lengths


def test_gets_shorter_in_contact_and_longer_after_dwelling_in_free_space_one_length_at_a_time():
    lengths = lengths_under([0, 0, 3, 3, 3, 3] + [0] * 9, dwell_steps=3)
    assert lengths == [10, 10, 5, 2, 1, 1, 1, 1, 2, 2, 2, 5, 5, 5, 10]


def test_noise_about_a_threshold_changes_nothing():
    noisy = 1.5 + 0.4 * np.array([1, -1] * 20)
    assert set(lengths_under(noisy)) == {10}
    assert lengths_under([3.0, 3.0, 3.0, *noisy], dwell_steps=1)[3:] == [1] * 40


def test_a_contact_in_between_restarts_the_dwelling():
    assert lengths_under([3, 3, 3, 0, 0, 3, 0, 0], dwell_steps=3)[2:] == [1] * 6


def test_torques_are_no_contact():
    assert lengths_under([0.0] * 5) == [10] * 5


def test_a_force_at_the_threshold_is_no_contact_yet():
    assert lengths_under([2.0] * 3) == [10] * 3


def test_a_force_that_is_no_number_is_contact():
    assert lengths_under([np.nan] * 3) == [2, 1, 1]
    assert lengths_under([3.0] * 3 + [np.nan] * 4, dwell_steps=2) == [2, 1, 1, 1, 1, 1, 1]


def test_an_initialization_begins_with_the_longest_in_free_space():
    system = HistoryLengthSchedule([1, 5], PERIOD, dwell_steps=2)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    wrench = system.get_wrench_input_port().FixValue(context, [5.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    length = system.get_history_length_output_port()
    simulator.AdvanceTo(2 * PERIOD)
    assert length.Eval(context)[0] == 1
    context.SetTime(0.0)
    wrench.GetMutableData().set_value([1.5, 0.0, 0.0, 0.0, 0.0, 0.0])  # which ends no contact, and begins none
    simulator.Initialize()
    assert length.Eval(context)[0] == 5
    simulator.AdvanceTo(2 * PERIOD)
    assert length.Eval(context)[0] == 5


@pytest.mark.parametrize(
    "arguments",
    [
        {"contact_threshold": 1.0, "release_threshold": 2.0},
        {"release_threshold": -0.1},
        {"dwell_steps": 0},
        {"wrench_size": 0},
        {"lengths": []},
        {"lengths": [0, 3]},
    ],
)
def test_what_makes_no_sense_is_refused(arguments):
    with pytest.raises(InputError):
        HistoryLengthSchedule(arguments.pop("lengths", [1, 2]), PERIOD, **arguments)


def test_one_component_and_a_contact_that_ends_at_no_force_are_allowed():
    HistoryLengthSchedule([1], PERIOD, contact_threshold=0.0, release_threshold=0.0, dwell_steps=1, wrench_size=1)
