"""Doubles and helpers that several tests of the hardware station share."""

import numpy as np


class ClockRecorder:
    """Station that records the clock [s] of each call of `receive`."""

    def __init__(self):
        self.clocks = []

    def receive(self, context, clock=None):
        self.clocks.append(clock)


def unplugged(*arguments):
    """Raise an error whose message has two successive spaces, which reports replace by one."""
    raise OSError("cable  unplugged")


def failed_checks(checks):
    """Return the names of the checks that failed; checks without a verdict did not fail."""
    return [check.name for check in checks if check.passed not in (True, None)]


def max_joint_speed(clock):
    """Return the largest joint speed [rad/s] of the simulated robot of a `SteppedRobotClock`."""
    plant = clock.robot.plant
    return np.abs(plant.GetVelocities(plant.GetMyContextFromRoot(clock.simulator.get_context()))).max()
