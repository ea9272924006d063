"""Outputs of systems with updates at control instants are the same for each start time on a multiple of the period."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail import systems
from guiderail.models.control.command_filters import BarrierFilter
from guiderail.models.control.keep_out import KeepOut
from guiderail.models.primitives import LinearConstraints
from guiderail.models.primitives.stepper import StateProgress
from guiderail_lerobot.chunk_guard import ChunkGuard
from guiderail_lerobot.chunk_safety_limiter import ChunkSafetyLimiter

PERIOD = 0.02
BOX = LinearConstraints.box([-1.0], [1.0])


def chunk_limiter():
    return ChunkSafetyLimiter(ChunkGuard(BOX, [1.0], [90.0], period=PERIOD, start=[0.0]), 8, 3, PERIOD)


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
    "chunk limiter": (chunk_limiter, {"chunk": np.full(8, 0.5), "pose": [0.0]}),
    "disturbance": (lambda: systems.CommandDisturbance(1, PERIOD, 0.0, 2), {"command": [1.0], "pose": [0.0]}),
    "monitor": (episode_monitor, {"x": [1.0]}),
}


def run(make, inputs, start):
    """Return the first output at the initialization at time `start` and in the middle of six control steps.

    Args:
        make: Function that returns the system.
        inputs: Values of the input ports by name.
        start: Start time [s].
    """
    system = make()
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    context.SetTime(start)
    for name, value in inputs.items():
        system.GetInputPort(name).FixValue(context, value)
    simulator.Initialize()
    values = [system.get_output_port(0).Eval(context)]
    for step in range(6):
        simulator.AdvanceTo(start + (step + 0.5) * PERIOD)
        values.append(system.get_output_port(0).Eval(context))
    return values


@pytest.mark.parametrize("steps", [1, 29, 50, 43210])
@pytest.mark.parametrize("case", CASES)
def test_outputs_are_the_same_when_the_start_time_is_not_zero(case, steps):
    expected = run(*CASES[case], 0.0)
    assert len(np.unique(expected, axis=0)) > 1
    np.testing.assert_allclose(run(*CASES[case], steps * PERIOD), expected, rtol=0.0, atol=1e-9)
