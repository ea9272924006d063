import numpy as np
from pydrake.systems.analysis import Simulator

from guiderail.systems.movement_primitive import HistoryLengthSchedule

PERIOD = 0.125


def lengths_under(forces, **arguments):
    """Return the history length after each control step with these forces along z [N]."""
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


def test_length_decreases_in_contact_and_increases_after_dwell():
    lengths = lengths_under([0, 0, 3, 3, 3, 3] + [0] * 9, dwell_steps=3)
    assert lengths == [10, 10, 5, 2, 1, 1, 1, 1, 2, 2, 2, 5, 5, 5, 10]


def test_length_is_constant_when_noise_is_between_the_thresholds():
    forces = 1.5 + 0.4 * np.array([1, -1] * 20)
    assert set(lengths_under(forces)) == {10}
    assert lengths_under([3.0, 3.0, 3.0, *forces], dwell_steps=1)[3:] == [1] * 40


def test_contact_restarts_the_dwell_steps():
    assert lengths_under([3, 3, 3, 0, 0, 3, 0, 0], dwell_steps=3)[2:] == [1] * 6


def test_torque_without_force_is_no_contact():
    assert lengths_under([0.0] * 5) == [10] * 5


def test_contact_begins_above_2_N_and_ends_at_1_N_by_default():
    assert lengths_under([2.0] * 3) == [10] * 3
    assert lengths_under([2.001] * 3) == [2, 1, 1]
    assert lengths_under([3.0, 1.0, 1.5]) == [2, 2, 2]
    assert lengths_under([3.0, 1.0005, 1.0005]) == [2, 1, 1]


def test_length_increases_after_10_free_steps_by_default():
    assert lengths_under([3.0] * 3 + [0.0] * 20)[2:] == [1] * 10 + [2] * 10 + [5]


def test_nan_force_is_contact():
    assert lengths_under([np.nan] * 3) == [2, 1, 1]
    assert lengths_under([3.0] * 3 + [np.nan] * 4, dwell_steps=2) == [2, 1, 1, 1, 1, 1, 1]


def test_initialization_restores_the_longest_length():
    system = HistoryLengthSchedule([1, 5], PERIOD, dwell_steps=2)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    wrench = system.get_wrench_input_port().FixValue(context, [5.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    length = system.get_history_length_output_port()
    simulator.AdvanceTo(2 * PERIOD)
    assert length.Eval(context)[0] == 1
    context.SetTime(0.0)
    wrench.GetMutableData().set_value([1.5, 0.0, 0.0, 0.0, 0.0, 0.0])  # 1.5 N neither starts nor ends a contact
    simulator.Initialize()
    assert length.Eval(context)[0] == 5
    simulator.AdvanceTo(2 * PERIOD)
    assert length.Eval(context)[0] == 5
