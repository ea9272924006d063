"""Reflexes of the simulated Franka: limits whose violation stops the arm."""

import numpy as np
import pytest

from guiderail_hardware.drivers.fci_reflexes import Reflex, ReflexDetector

LIMIT = np.full(7, 2.0)


@pytest.fixture
def detector():
    detector = ReflexDetector(-LIMIT, LIMIT, LIMIT)
    detector.set_thresholds(np.full(7, 16.0), np.array([10.0] * 3 + [5.0] * 3))
    detector.begin()
    return detector


def detect(detector, **changes):
    """Return the reflex of a robot at rest without loads, except for entries of arguments: (index, value) by name."""
    arguments = {
        "command": np.zeros(7),
        "position": np.zeros(7),
        "velocity": np.zeros(7),
        "external_torque": np.zeros(7),
        "external_wrench": np.zeros(6),
    }
    for name, (index, value) in changes.items():
        arguments[name][index] = value
    return detector.detect(**arguments)


def test_no_reflex_within_the_limits(detector):
    assert detect(detector, position=(0, 1.9), velocity=(6, -1.9), external_torque=(1, -15.9)) is None
    assert detect(detector, external_wrench=(5, -4.9)) is None


@pytest.mark.parametrize(
    ("name", "index", "value", "reflex"),
    [
        ("position", 0, 2.01, Reflex.JOINT_POSITION_LIMITS_VIOLATION),
        ("position", 6, -2.01, Reflex.JOINT_POSITION_LIMITS_VIOLATION),
        ("velocity", 3, -2.01, Reflex.JOINT_VELOCITY_VIOLATION),
        ("external_torque", 2, -16.1, Reflex.JOINT_REFLEX),
        ("external_wrench", 2, 10.1, Reflex.CARTESIAN_REFLEX),
        ("external_wrench", 3, -5.1, Reflex.CARTESIAN_REFLEX),
        ("command", 4, 1.01, Reflex.CONTROLLER_TORQUE_DISCONTINUITY),
        ("position", 1, np.nan, Reflex.JOINT_POSITION_LIMITS_VIOLATION),
        ("velocity", 1, np.nan, Reflex.JOINT_VELOCITY_VIOLATION),
        ("external_torque", 1, np.nan, Reflex.JOINT_REFLEX),
        ("external_wrench", 1, np.nan, Reflex.CARTESIAN_REFLEX),
        ("command", 1, np.nan, Reflex.CONTROLLER_TORQUE_DISCONTINUITY),
    ],
)
def test_reflex_is_detected_beyond_a_limit(detector, name, index, value, reflex):
    assert detect(detector, **{name: (index, value)}) == reflex


def test_torque_jump_is_not_compared_across_motions(detector):
    for torque in (1.0, 2.0, 1.0):
        assert detect(detector, command=(0, torque)) is None
    detector.begin()
    assert detect(detector, command=(0, 2.0)) == Reflex.CONTROLLER_TORQUE_DISCONTINUITY
