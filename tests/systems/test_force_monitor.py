import numpy as np
import pytest

from guiderail.systems.wrench_signals import ForceMonitor

LIMITS = np.array([40.0, 40.0, 40.0, 3.0, 3.0, 3.0])


def read(wrench, limits=LIMITS):
    """Return the force [N] and the saturation of an impedance wrench (6,)."""
    monitor = ForceMonitor(limits)
    context = monitor.CreateDefaultContext()
    monitor.get_impedance_wrench_input_port().FixValue(context, wrench)
    force, saturation = monitor.get_impedance_force_output_port(), monitor.get_saturation_output_port()
    return force.Eval(context)[0], saturation.Eval(context)[0]


def test_forces_are_the_norms_of_their_own_wrenches():
    assert read([3.0, 4.0, 12.0, 2.0, 2.0, 2.0]) == (13.0, 0.0)
    monitor = ForceMonitor(LIMITS)
    context = monitor.CreateDefaultContext()
    monitor.get_contact_wrench_input_port().FixValue(context, [0.0, -6.0, 8.0, 9.0, 9.0, 9.0])
    assert monitor.get_contact_force_output_port().Eval(context)[0] == 10.0
    monitor.get_impedance_wrench_input_port().FixValue(context, np.zeros(6))
    assert monitor.get_impedance_force_output_port().Eval(context)[0] == 0.0


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_saturation_is_reported_when_any_axis_is_at_its_limit(axis, sign):
    wrench = np.zeros(6)
    for share, expected in ((0.9989, 0.0), (0.9991, 1.0), (1.0, 1.0), (2.0, 1.0)):
        wrench[axis] = share * sign * LIMITS[axis]
        assert read(wrench)[1] == expected


def test_saturation_begins_at_exactly_0_999_of_a_limit():
    limits = np.full(6, 1000.0)
    assert read([np.nextafter(999.0, 0.0)] + [0.0] * 5, limits)[1] == 0.0
    assert read([999.0] + [0.0] * 5, limits)[1] == 1.0
