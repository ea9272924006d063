import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail.systems.mean_force import MeanForce


def test_force_is_the_mean_of_the_last_control_step():
    system = MeanForce(size=2, substeps=4, period=0.1)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    force_sum = system.get_force_sum_input_port().FixValue(context, [8.0, 0.0])
    simulator.Initialize()
    total = np.array([8.0, 0.0])
    for n, added in enumerate(([0.0, 0.0], [12.0, 16.0], [-4.0, 0.0])):
        simulator.AdvanceTo((n + 0.5) * 0.1)
        total = total + added
        force_sum.GetMutableData().set_value(total)
        simulator.AdvanceTo((n + 1) * 0.1)
        np.testing.assert_allclose(system.get_force_output_port().Eval(context), np.array(added) / 4)
        np.testing.assert_allclose(system.get_magnitude_output_port().Eval(context), np.hypot(*added) / 4)


@pytest.mark.parametrize("arguments", [(2, 4, 0.0)])
def test_constructor_refuses_arguments_out_of_range(arguments):
    with pytest.raises(InputError):
        MeanForce(*arguments)


def test_constructor_accepts_one_component_and_one_substep():
    system = MeanForce(1, 1, 0.1)
    context = system.CreateDefaultContext()
    system.get_force_sum_input_port().FixValue(context, [-3.0])
    assert system.get_force_output_port().Eval(context) == [-3.0]
    assert system.get_magnitude_output_port().Eval(context) == [3.0]
