"""Reference governor as a system; `tests/diagrams/tasks/test_bounded_force.py` tests the physics."""

import numpy as np
import pytest

from guiderail.models.control.wrench import MovingInertia, WrenchBound
from guiderail.systems import ReferenceGovernor

STIFFNESS, DAMPING = np.r_[np.full(3, 1500.0), np.full(3, 30.0)], np.r_[np.full(3, 95.0), np.full(3, 0.5)]
BOUND = WrenchBound(np.array([9.0, 9.0, 15.0, 1.0, 2.0, 3.0]), 17.0, 3.5, 2.5e4)  # [x y z Rx Ry Rz]
ZEROS = np.zeros(6)


def reference_pose(desired, velocity=ZEROS, pose=ZEROS, max_wrench=None):
    """Return the reference pose (6,) of the governor."""
    system = ReferenceGovernor(STIFFNESS, DAMPING, MovingInertia(1.5, 2e-3), 0.01, BOUND)
    context = system.CreateDefaultContext()
    system.get_desired_pose_input_port().FixValue(context, desired)
    system.get_state_input_port().FixValue(context, np.r_[pose, velocity])
    if max_wrench is not None:
        system.get_max_wrench_input_port().FixValue(context, max_wrench)
    return system.get_reference_pose_output_port().Eval(context)


def test_reference_is_the_desired_pose_within_the_bound():
    pose, change = np.full(6, 0.3), np.r_[0.003, -0.002, 0.004, 0.02, 0.01, -0.01]
    np.testing.assert_allclose(reference_pose(pose + change, pose=pose), pose + change, atol=1e-15)


def test_angles_have_the_limits_of_their_axes():
    reference = reference_pose(np.r_[0.0, 0.0, 0.0, 1.0, 0.0, 0.0])  # Rz
    assert STIFFNESS[3] * reference[3] == pytest.approx(3.0)
    reference = reference_pose(np.r_[0.0, 0.0, 0.0, 0.0, 0.0, 1.0])  # Rx
    assert STIFFNESS[5] * reference[5] == pytest.approx(1.0)


def test_max_wrench_lowers_the_bound():
    down = np.r_[0.0, 0.0, -1.0, 0.0, 0.0, 0.0]
    assert STIFFNESS[2] * reference_pose(down)[2] == pytest.approx(-15.0)
    lower = np.r_[4.0, 4.0, 6.0, np.full(3, np.inf), np.inf, np.inf]
    assert STIFFNESS[2] * reference_pose(down, max_wrench=lower)[2] == pytest.approx(-6.0)
    assert STIFFNESS[2] * reference_pose(down, max_wrench=np.full(8, 100.0))[2] == pytest.approx(-15.0)
    np.testing.assert_array_equal(reference_pose(down, max_wrench=np.full(8, np.nan)), 0.0)


def test_spring_force_is_reduced_by_damping_and_speed_limit():
    down, velocity = np.r_[0.0, 0.0, -1.0, 0.0, 0.0, 0.0], np.r_[0.0, 0.0, 0.05, 0.0, 0.0, 0.0]
    force_while_moving_up = STIFFNESS[2] * reference_pose(down, velocity)[2]
    assert force_while_moving_up == pytest.approx(-15.0 + (15.0 + 95.0) * 0.05)
    force_while_moving_down = STIFFNESS[2] * reference_pose(down, -velocity)[2]
    assert force_while_moving_up < force_while_moving_down < 0.0  # the speed limit reduces the force further
