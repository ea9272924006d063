"""Publisher of desired poses in the frame of the robot's base."""

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator

from guiderail_hardware.systems.pose_publisher import PosePublisher
from guiderail_hardware.systems.torque_safety_limiter import ArmState

X_BaseTarget = RigidTransform([0.5, 0.0, 0.25])
POSE = np.array([0.125, 0.0, 0.0, 0.0, 0.0, 0.0])


def publish(state, pose=POSE):
    """Return the calls of three periods in a state of the arm: the position of each pose [m], or "stop"."""
    calls = []
    system = PosePublisher(
        lambda X, time: calls.append(tuple(X.translation())), lambda: calls.append("stop"), X_BaseTarget, period=0.5
    )
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.get_pose_input_port().FixValue(context, pose)
    system.get_arm_state_input_port().FixValue(context, [state])
    simulator.AdvanceTo(1.0)
    return calls


@pytest.mark.parametrize("state", [ArmState.RAMPING, ArmState.RUNNING])
def test_pose_is_sent_in_the_base_frame_while_arm_is_controlled(state):
    assert publish(state) == [(0.625, 0.0, 0.25)] * 3


@pytest.mark.parametrize("state", [ArmState.DAMPING, ArmState.OFF])
def test_robot_is_stopped_while_the_arm_is_damped_or_off(state):
    assert publish(state) == ["stop"] * 3


def test_nothing_is_sent_before_the_arm_is_controlled():
    assert publish(ArmState.WAITING) == []


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_robot_is_stopped_when_the_pose_is_not_finite(value):
    assert publish(ArmState.RUNNING, np.full(6, value)) == ["stop"] * 3
