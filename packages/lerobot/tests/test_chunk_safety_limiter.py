"""Chunk guard in a diagram: limits of every command, replanning, fallbacks, and the start of the motion."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ZeroOrderHold

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import LinearConstraints
from guiderail_lerobot.chunk_guard import ChunkGuard
from guiderail_lerobot.chunk_safety_limiter import ChunkSafetyLimiter
from oracles.systems import check_start_time

PERIOD, STEPS, REPLAN = 0.02, 12, 4
VELOCITY, JERK, BOUND = np.array([0.1, 0.2]), np.array([50.0, 100.0]), np.array([0.05, 0.03])


def guard(mode="projection"):
    box = LinearConstraints.box(-BOUND, BOUND)
    return ChunkGuard(box, VELOCITY, JERK, period=PERIOD, start=np.zeros(2), mode=mode)


def run(chunks, pose=(0.0, 0.0), mode="projection"):
    """Return commands (n, 2), rates (n,) and fallbacks (n,) at the control steps of chunks (n, K, O)."""
    builder = DiagramBuilder()
    system = builder.AddSystem(ChunkSafetyLimiter(guard(mode), STEPS, REPLAN, PERIOD))
    hold = builder.AddSystem(ZeroOrderHold(PERIOD, STEPS * 2))  # the chunk is constant during a control step
    builder.Connect(hold.get_output_port(), system.get_chunk_input_port())
    builder.ExportInput(hold.get_input_port(), "chunk")
    builder.ExportInput(system.get_pose_input_port(), "pose")
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    diagram.GetInputPort("pose").FixValue(context, np.asarray(pose))
    port, result = diagram.GetInputPort("chunk").FixValue(context, np.ravel(chunks[0])), []
    ports = system.get_desired_pose_output_port(), system.get_rate_output_port(), system.get_fallback_output_port()
    for step, chunk in enumerate(chunks):
        port.GetMutableData().set_value(np.ravel(chunk))
        simulator.AdvanceTo(PERIOD * (step + 0.5))
        result.append(np.concatenate([output.Eval(system.GetMyContextFromRoot(context)) for output in ports]))
    return np.array(result)[:, :2], np.array(result)[:, 2], np.array(result)[:, 3]


@pytest.mark.parametrize("mode", ["projection", "slowdown"])
def test_every_command_is_within_the_limits_for_any_chunks(mode):
    chunks = np.random.default_rng(0).uniform(-0.2, 0.2, (60, 1, 2)) * np.ones((1, STEPS, 1))
    commands, _, fallback = run(chunks, mode=mode)
    motion = np.concatenate([np.zeros((3, 2)), commands])
    assert (np.abs(np.diff(motion, axis=0)) <= VELOCITY * PERIOD).all()
    assert (np.abs(np.diff(motion, n=3, axis=0)) <= JERK * PERIOD**3).all()
    assert (np.abs(motion) <= BOUND).all()
    assert np.ptp(commands, axis=0).min() > 0.005
    assert not fallback.all()


def test_commands_equal_those_of_the_guard_without_a_diagram():
    chunks, chunk_guard = np.random.default_rng(1).uniform(-0.02, 0.02, (12, STEPS, 2)), guard()
    replans = range(0, 12, REPLAN)
    expected = np.concatenate([chunk_guard.guard(chunks[step], REPLAN).outputs[:REPLAN] for step in replans])
    assert (run(chunks)[0] == expected).all()


@pytest.mark.parametrize("number", [np.nan, np.inf])
@pytest.mark.parametrize("entries", [np.s_[:], np.s_[0, 0]])
def test_previous_chunk_continues_when_a_chunk_is_not_finite(number, entries):
    chunks = np.zeros((5 * REPLAN, STEPS, 2))
    chunks[(slice(REPLAN, None), *np.atleast_1d(entries))] = number
    chunks[:REPLAN] = [0.03, 0.01]
    commands, rate, fallback = run(chunks)
    expected = guard().guard(chunks[0]).outputs
    assert (commands[:STEPS] == expected).all()
    assert (commands[STEPS:] == expected[-1]).all()  # at rest
    assert (fallback == np.repeat([0.0, 1.0, 1.0, 1.0, 1.0], REPLAN)).all()
    assert (rate == 1.0 - fallback).all()


@pytest.mark.parametrize("chunk", [[0.05, -0.03], [0.0, np.nan]])
@pytest.mark.parametrize(("x", "first"), [(0.02, 0.02), (0.0501, 0.05), (0.051, 0.051), (0.2, 0.2)])
def test_motion_from_the_measured_pose_is_within_the_limits(x, first, chunk):
    """The jerk limit admits 0.4 mm in the first step. Farther outside the bound of 50 mm, the pose is commanded."""
    commands, _, fallback = run(np.tile(chunk, (REPLAN, STEPS, 1)), [x, -0.03])
    motion = np.concatenate([np.tile([x, -0.03], (3, 1)), commands])
    assert (np.abs(np.diff(motion, axis=0)) <= VELOCITY * PERIOD).all()
    assert (np.abs(np.diff(motion, n=3, axis=0)) <= JERK * PERIOD**3 * (1 + 1e-9)).all()
    np.testing.assert_allclose(commands[0], [first, -0.03], atol=5e-4)
    is_outside = first > BOUND[0]
    assert fallback.all() == (is_outside or np.isnan(chunk[1]))
    assert (commands == [x, -0.03]).all() if is_outside else (np.abs(commands) <= BOUND).all()


def test_argument_is_refused_when_it_is_out_of_range():
    for steps, replan in ((3, 1), (12, 0), (12, 13), (2000, 2001)):
        with pytest.raises(InputError, match="chunk"):
            ChunkSafetyLimiter(guard(), steps, replan, PERIOD)
    with pytest.raises(InputError, match="period"):
        ChunkSafetyLimiter(guard(), 4, 4, 0.0)
    with pytest.raises(InputError, match="the period must be that of the guard"):
        ChunkSafetyLimiter(guard(), 4, 4, 2 * PERIOD)
    ChunkSafetyLimiter(guard(), 4, 4, PERIOD)
    ChunkSafetyLimiter(guard(), 4, 1, PERIOD)


def test_measured_pose_at_initialization_must_be_finite():
    with pytest.raises(InputError, match="measured pose must be finite"):
        run(np.zeros((1, STEPS, 2)), pose=(0.0, np.nan))


@pytest.mark.parametrize("steps", [1, 29, 50, 43210])
def test_outputs_are_the_same_when_the_start_time_is_not_zero(steps):
    def limiter():
        box = LinearConstraints.box([-1.0], [1.0])
        return ChunkSafetyLimiter(ChunkGuard(box, [1.0], [90.0], period=0.02, start=[0.0]), 8, 3, 0.02)

    check_start_time(limiter, {"chunk": np.full(8, 0.5), "pose": [0.0]}, 0.02, steps)
