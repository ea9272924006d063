"""Chunk guard: every command is within the limits, and a chunk within the limits is reproduced."""

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import LinearConstraints
from guiderail_lerobot.chunk_guard import ChunkGuard

PERIOD, STEPS = 0.02, 12
VELOCITY, JERK = np.array([0.1, 0.2]), np.array([50.0, 100.0])
BOUND = np.array([0.05, 0.03])


def make_guard(**arguments):
    box = LinearConstraints.box(-BOUND, BOUND)
    return ChunkGuard(box, VELOCITY, JERK, **({"period": PERIOD, "start": np.zeros(2)} | arguments))


def execute(guard, chunks, number=4):
    """Return the executed outputs (3 + n, 2), after three outputs at rest, and the result of each chunk."""
    results = [guard.guard(chunk, number) for chunk in chunks]
    return np.concatenate([np.zeros((3, 2)), *(result.outputs[:number] for result in results)]), results


@pytest.mark.parametrize("mode", ["projection", "slowdown"])
def test_every_step_is_within_the_limits_for_any_chunks(mode):
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(30, STEPS, 2)) * np.array([0.0, 1e-3, 0.1])[np.arange(30) % 3, None, None]
    jumps = rng.uniform(-0.2, 0.2, (30, 1, 2)) + noise
    motion, results = execute(make_guard(mode=mode), jumps)
    assert (np.abs(np.diff(motion, axis=0)) <= VELOCITY * PERIOD).all()
    assert (np.abs(np.diff(motion, n=3, axis=0)) <= JERK * PERIOD**3).all()
    assert (np.abs(motion) <= BOUND).all()
    assert not all(result.is_fallback for result in results)
    assert np.ptp(motion, axis=0).min() > 0.005  # each output moves by more than 5 mm


@pytest.mark.parametrize("mode", ["projection", "slowdown"])
def test_chunk_within_the_limits_is_reproduced(mode):
    phase = np.minimum(np.arange(1, 31) / 28, 1.0)[:, None]
    smooth = (10 * phase**3 - 15 * phase**4 + 6 * phase**5) * [0.02, -0.01]
    smooth[-3:] = smooth[-1]
    result = make_guard(mode=mode).guard(smooth)
    assert result.rate == 1.0
    assert not result.is_fallback
    np.testing.assert_allclose(result.outputs, smooth, atol=1e-6)


def test_slowdown_preserves_the_path_of_a_fast_chunk():
    line = np.outer(np.minimum(np.arange(1, 31) / 10, 1.0), [0.04, 0.02])
    slow, straight = (make_guard(mode=mode).guard(line) for mode in ("slowdown", "projection"))
    across = lambda outputs: np.abs(outputs @ [0.02, -0.04] / np.hypot(0.02, 0.04)).max()  # noqa: E731
    assert slow.rate < 1.0
    assert across(slow.outputs) <= 1e-3
    assert across(slow.outputs) < across(straight.outputs) + 1e-9


def test_guard_refuses_invalid_arguments():
    arguments = [{"start": np.array([0.06, 0.0])}, {"mode": "brake"}, {"period": 0.0}]
    arguments += [{"tolerance": np.ones(3)}, {"tolerance": np.array([0.0, 1.0])}]
    for argument in arguments:
        with pytest.raises(InputError):
            make_guard(**argument)
    make_guard(start=np.array([0.05, 0.0]))
    with pytest.raises(InputError, match="positive"):
        ChunkGuard(LinearConstraints.none(2), [0.0, 1.0], JERK, period=PERIOD, start=np.zeros(2))
    for chunk in (np.zeros((3, 2)), np.zeros((4, 3)), np.full((4, 2), np.nan)):
        with pytest.raises(InputError, match="chunk"):
            make_guard().guard(chunk)
    make_guard().guard(np.zeros((4, 2)))
    refusing, plain = make_guard(), make_guard()
    for number in (-1, 5, 1.5, "a", np.array([1, 2])):
        with pytest.raises(InputError, match="executed"):
            refusing.guard(np.full((4, 2), 0.01), number)
    assert len(make_guard().guard(np.zeros((4, 2)), 2.0).outputs) == 4
    outputs = [guard.guard(np.full((4, 2), 0.01)).outputs for guard in (refusing, plain)]
    np.testing.assert_array_equal(*outputs)


@pytest.mark.parametrize(("velocity", "margin"), [(VELOCITY, 0.5 * JERK * PERIOD**3), (1e-3 * VELOCITY, 2e-6)])
def test_first_step_from_a_measured_start_is_within_the_limits(velocity, margin):
    guard = ChunkGuard(LinearConstraints.box(-BOUND, BOUND), velocity, JERK, period=PERIOD, start=np.zeros(2))
    start = BOUND + [np.min(margin) * (1 - 1e-9), 0.0]
    guard.reset_near(start)
    outputs = guard.guard(np.tile([0.2, -0.2], (STEPS, 1))).outputs
    motion = np.concatenate([np.tile(start, (3, 1)), outputs])
    assert (np.abs(np.diff(motion, axis=0)) <= velocity * PERIOD).all()
    assert (np.abs(np.diff(motion, n=3, axis=0)) <= JERK * PERIOD**3 * (1 + 1e-9)).all()
    assert (np.abs(outputs) <= BOUND + 1e-9).all()
    guard.reset_near(start)
    for start in (BOUND + [1.01 * np.min(margin), 0.0], np.full(2, np.nan), np.zeros(3)):
        with pytest.raises(InputError, match="measured start"):
            guard.reset_near(start)


def test_constraint_on_two_outputs_does_not_affect_a_third():
    slanted = LinearConstraints([[-1.0, -1.0, 0.0]], [-0.02])  # x + y <= 0.02
    limits = (np.full(3, 0.2), np.full(3, 100.0))
    coupled = ChunkGuard(slanted, *limits, period=PERIOD, start=np.zeros(3))
    outputs = coupled.guard(np.tile([0.02, 0.02, 0.03], (30, 1))).outputs
    assert (outputs[:, 0] + outputs[:, 1] <= 0.02).all()
    np.testing.assert_allclose(outputs[-1], [0.01, 0.01, 0.03], atol=1e-4)
    separate = ChunkGuard(LinearConstraints.none(1), [0.2], [100.0], period=PERIOD, start=np.zeros(1))
    np.testing.assert_allclose(outputs[:, 2:], separate.guard(np.full((30, 1), 0.03)).outputs, atol=1e-9)


def test_guard_is_at_rest_after_a_reset():
    guard, chunk = make_guard(), np.tile([0.01, -0.02], (STEPS, 1))
    first = guard.guard(chunk, 4).outputs
    assert (guard.guard(chunk, 4).outputs != first).any()
    guard.reset(np.zeros(2))
    assert (guard.guard(chunk, 4).outputs == first).all()
    with pytest.raises(InputError, match="inside"):
        guard.reset(np.array([0.0, 0.031]))
