import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.models.control.wrench import ContactPointMean
from guiderail.systems.wrench_signals import MeanContactPoint

PERIOD = 0.02


def wrench_at(point, force=4.0):
    """Return the wrench (6,) of a force along z at `point` (2,) [m] relative to the tool center."""
    f = np.array([0.0, 0.0, force])
    return np.concatenate([f, np.cross([*point, 0.0], f)])


def simulate(samples, time_constant=1.0):
    """Return the output after the samples, (pose, wrench) at each control step, and the last pose."""
    system = MeanContactPoint(0.5, period=PERIOD, time_constant=time_constant)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    for step, (pose, wrench) in enumerate(samples):
        system.get_pose_input_port().FixValue(context, pose)
        system.get_wrench_input_port().FixValue(context, wrench)
        if step == 0:
            simulator.Initialize()
        simulator.AdvanceTo((step + 1) * PERIOD)
    return system.get_mean_contact_point_output_port().Eval(context)


def test_two_points_of_a_rim_show_its_center_wherever_the_tool_stands():
    center, radius = np.array([0.002, -0.001]), 0.005
    samples = []
    for step in range(20):
        pose = np.append(0.001 * np.array([np.cos(step), np.sin(step)]), np.zeros(4))
        side = np.array([0.0, radius if step % 2 else -radius])
        samples.append((pose, wrench_at(center + side - pose[:2])))
    np.testing.assert_allclose(simulate(samples), center - samples[-1][0][:2], atol=1e-12)


def test_output_is_zero_before_the_first_contact_and_follows_the_pose_after_it():
    free = (np.full(6, 0.001), wrench_at([0.003, 0.0], force=0.4))
    np.testing.assert_array_equal(simulate([free, free]), np.zeros(2))
    contact = (np.zeros(6), wrench_at([0.003, 0.0]))
    np.testing.assert_allclose(simulate([contact, free]), [0.002, -0.001], atol=1e-12)


def test_samples_before_the_time_constant_decay():
    old, new = (np.zeros(6), wrench_at([-0.003, 0.0])), (np.zeros(6), wrench_at([0.003, 0.0]))
    recent = simulate([old] * 10 + [new] * 10, time_constant=5 * PERIOD)
    assert 0.0025 > recent[0] > 0.001
    assert simulate([old] * 10 + [new] * 10)[0] == pytest.approx(0.0)


def test_sample_counts_from_the_smallest_force_on():
    mean = ContactPointMean(0.5, 10.0)
    for force in (np.nextafter(0.5, 0.0), 0.5):
        mean.add(np.zeros(6), wrench_at([0.001, 0.0], force=force))
    assert mean.count == 1.0


@pytest.mark.parametrize("place", range(6))
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_samples_that_are_not_finite_are_skipped(place, value):
    good, mean = (np.zeros(6), wrench_at([0.001, 0.002])), ContactPointMean(0.5, 10.0)
    mean.add(*good)
    broken = [array.copy() for array in good]
    broken[0][place] = value
    mean.add(*broken)
    broken = [array.copy() for array in good]
    broken[1][place] = value
    mean.add(*broken)
    assert mean.count == 1.0
    np.testing.assert_allclose(mean.mean, [0.001, 0.002])
