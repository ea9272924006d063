"""Guidance by the weights of a ProMP: the displacement by hand, and one action for a whole episode."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.envs.make import make_env
from guiderail.models.common.errors import InputError
from guiderail_data.promp import basis
from guiderail_data.promp_guidance import NUM_BASIS, WeightedBasis

PERIOD = 0.1


@pytest.mark.parametrize(("time", "phase"), [(0.0, 0.0), (0.5, 0.5), (1.0, 1.0), (3.0, 1.0)])
def test_displacement_is_the_weighted_sum_of_the_basis_functions(time, phase):
    system = WeightedBasis(2, 11, PERIOD, num_basis=3)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.get_weights_input_port().FixValue(context, [1.0, 0.0, -1.0, 0.5, 0.5, 0.5])
    simulator.AdvanceTo(time)
    simulator.AdvancePendingEvents()
    bumps = np.exp(-0.5 * (2.0 * (phase - np.array([0.0, 0.5, 1.0]))) ** 2)
    first = (bumps[0] - bumps[2]) / bumps.sum()
    np.testing.assert_allclose(system.get_displacement_output_port().Eval(context), [first, 0.5], atol=1e-12)


@pytest.mark.parametrize("numbers", [(1, 2), (11, 1), (11, 12)])
def test_numbers_of_steps_and_basis_functions_are_checked(numbers):
    with pytest.raises(InputError, match=r"must be a whole number (of at least|from) 2"):
        WeightedBasis(2, numbers[0], PERIOD, num_basis=numbers[1])


def test_one_action_displaces_the_whole_motion():
    env = make_env("NarrowPassage", guidance="promp", action_repeat=1000)
    commands = []
    for weight in (0.0, 0.1):
        env.reset(seed=0)
        weights = np.zeros((2, NUM_BASIS))
        weights[1] = weight * np.arange(NUM_BASIS) / (NUM_BASIS - 1)
        terminated, truncated = env.step(weights.ravel())[2:4]
        assert terminated or truncated
        commands.append(np.array(env.trace.commanded))
    steps = min(map(len, commands))
    apart = (commands[1][:steps] - commands[0][:steps])[:, 1]
    assert apart[1] == pytest.approx(0.0, abs=1e-3)
    expected = basis(np.linspace(0, 1, 400), NUM_BASIS) @ weights[1]
    ratio = apart[50:steps] / expected[49 : steps - 1]
    np.testing.assert_allclose(ratio, ratio[0], rtol=0.02)
