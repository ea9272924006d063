import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.systems.impedance_monitor import ImpedanceMonitor

LIMITS = np.array([40.0, 40.0, 40.0, 3.0, 3.0, 3.0])


def read(wrench):
    monitor = ImpedanceMonitor(LIMITS)
    context = monitor.CreateDefaultContext()
    monitor.get_impedance_wrench_input_port().FixValue(context, wrench)
    force, saturation = monitor.get_contact_force_output_port(), monitor.get_saturation_output_port()
    return force.Eval(context)[0], saturation.Eval(context)[0]


def test_contact_force_is_the_norm_of_the_force_alone():
    assert read([3.0, 4.0, 12.0, 2.0, 2.0, 2.0]) == (13.0, 0.0)


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_saturation_is_reported_when_any_axis_is_at_its_limit(axis, sign):
    wrench = np.zeros(6)
    wrench[axis] = 0.99 * sign * LIMITS[axis]
    assert read(wrench)[1] == 0.0
    wrench[axis] = sign * LIMITS[axis]
    assert read(wrench)[1] == 1.0


@pytest.mark.parametrize("limits", [np.ones(5), np.zeros(6), np.full(6, np.nan)])
def test_constructor_refuses_limits_out_of_range(limits):
    with pytest.raises(InputError):
        ImpedanceMonitor(limits)
