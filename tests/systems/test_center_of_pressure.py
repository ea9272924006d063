import numpy as np
import pytest

from guiderail.systems.wrench_signals import CenterOfPressure


def center_of_pressure(wrench, min_force=0.5):
    """Return the center of pressure (2,) [m] of a wrench (6,), force first."""
    system = CenterOfPressure(min_force)
    context = system.CreateDefaultContext()
    system.get_wrench_input_port().FixValue(context, wrench)
    return system.get_center_of_pressure_output_port().Eval(context)


@pytest.mark.parametrize("force", [0.5, 2.0, 30.0])
def test_center_of_pressure_is_the_point_of_a_point_force(force):
    point = np.array([0.003, -0.004, 0.0])
    f = np.array([0.0, 0.0, force])
    np.testing.assert_allclose(center_of_pressure([*f, *np.cross(point, f)]), point[:2])


@pytest.mark.parametrize("force", [0.49, 0.0, -5.0, np.nan])
def test_center_of_pressure_is_zero_when_the_force_is_small(force):
    np.testing.assert_array_equal(center_of_pressure([0.0, 0.0, force, 0.1, 0.1, 0.0]), np.zeros(2))
