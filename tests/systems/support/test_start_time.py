"""Outputs of systems with updates at control instants are the same for each start time on a multiple of the period."""

import numpy as np
import pytest

from guiderail import systems
from guiderail.models.control.command_filters import BarrierFilter, KeepOut
from guiderail.models.laws import StateProgress
from guiderail.models.primitives import LinearConstraints
from oracles.systems import check_start_time

PERIOD = 0.02
BOX = LinearConstraints.box([-1.0], [1.0])


def command_filter():
    return systems.CommandFilter(BarrierFilter(KeepOut(np.zeros((0, 1)), np.zeros((0, 1)), BOX, 0.0), 0.5), PERIOD)


def episode_monitor():
    return systems.EpisodeMonitor([systems.TerminationTerm("success", {"x": 1}, lambda x: True, steps=3)], PERIOD)


CASES = {
    "history": (lambda: systems.HistoryBuffer(1, 3, PERIOD), {"output": [1.0], "initial_output": [9.0]}),
    "filter": (command_filter, {"desired_pose": [5.0], "pose": [0.0]}),
    "recorder": (lambda: systems.Recorder({"x": 1}, 9, PERIOD), {"x": [1.0]}),
    "clock": (
        lambda: systems.ProgressClock(StateProgress((0.01, 0.1), 2), 1, PERIOD),
        {"command": [1.0], "pose": [0.0]},
    ),
    "disturbance": (lambda: systems.CommandDisturbance(1, PERIOD, 0.0, 2), {"command": [1.0], "pose": [0.0]}),
    "monitor": (episode_monitor, {"x": [1.0]}),
}


@pytest.mark.parametrize("steps", [1, 29, 50, 43210])
@pytest.mark.parametrize("case", CASES)
def test_outputs_are_the_same_when_the_start_time_is_not_zero(case, steps):
    check_start_time(*CASES[case], PERIOD, steps)
