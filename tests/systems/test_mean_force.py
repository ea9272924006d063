import numpy as np
from pydrake.systems.analysis import Simulator

from guiderail.systems.wrench_signals import MeanForce


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
