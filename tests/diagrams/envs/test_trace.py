"""Signals and statistics of the control steps of an episode."""

import numpy as np
import pytest

from guiderail.diagrams.envs.trace import EpisodeTrace, mean_jerk

SIGNALS = {"commanded_violation": 1, "measured_violation": 1, "collision": 1, "saturation": 2, "fallback": 1}
NO_VIOLATION = {"commanded_violation": -1.0, "measured_violation": -1.0}


def trace_of(steps):
    """Return a trace of control steps with the signals and `force` [N] that `steps` has for each; default 0."""
    trace = EpisodeTrace(60, 2, 0.1, SIGNALS)
    for values in steps:
        signals = {
            name: np.broadcast_to({**NO_VIOLATION, **values}.get(name, 0.0), size) for name, size in SIGNALS.items()
        }
        trace.append(np.zeros(2), np.zeros(2), values.get("force", 0.0), 0.0, signals)
    return trace


def test_statistics_include_all_control_steps():
    rng = np.random.default_rng(0)
    forces, violations = rng.uniform(0, 9, 50), rng.normal(size=50)
    result = trace_of(
        {"force": force, "commanded_violation": violation, "measured_violation": 2 * violation}
        for force, violation in zip(forces, violations, strict=True)
    ).statistics()
    assert result["steps"] == 50
    assert result["peak_force"] == forces.max()
    assert result["mean_force"] == pytest.approx(forces.mean(), rel=1e-12)
    assert result["max_commanded_violation"] == violations.max()
    assert result["max_measured_violation"] == 2 * violations.max()


def test_largest_violation_includes_the_last_control_step():
    assert trace_of([{}, {"commanded_violation": 0.3}]).statistics()["max_commanded_violation"] == 0.3


def test_successive_contact_steps_are_one_collision():
    result = trace_of({"collision": touching} for touching in (0, 1, 1, 1, 0, 0, 1, 0, 1)).statistics()
    assert (result["collisions"], result["collision_steps"]) == (3, 5)
    assert trace_of([{"collision": 1.0}]).statistics()["collisions"] == 1


def test_saturated_steps_and_fallback_steps_are_counted():
    steps = (([0, 0], 1), ([0, -3], 0), ([1, 0], 1))
    result = trace_of(
        {"saturation": np.array(saturation, float), "fallback": fallback} for saturation, fallback in steps
    ).statistics()
    assert (result["saturated_steps"], result["fallback_steps"]) == (2, 2)


@pytest.mark.parametrize("last", [np.nan, 9.0])
def test_largest_violation_is_nan_when_a_step_is_nan(last):
    steps = [{"measured_violation": value} for value in (5.0, np.nan, last)]
    assert np.isnan(trace_of(steps).statistics()["max_measured_violation"])


def test_clear_deletes_every_control_step():
    trace = trace_of([{"commanded_violation": 1.0, "force": 4.0, "collision": 1.0}] * 3)
    trace.clear()
    empty = trace.statistics()
    assert empty.pop("max_commanded_violation") == empty.pop("max_measured_violation") == -np.inf
    assert set(empty.values()) == {0.0}
    assert len(trace) == len(trace.force) == 0


def test_mean_jerk_is_exact_for_a_cubic():
    times = 0.1 * np.arange(9)
    assert mean_jerk(np.column_stack([times**3, 0 * times]), 0.1) == pytest.approx(6.0, rel=1e-9)
    assert mean_jerk(np.zeros((3, 2)), 0.1) == 0.0


def test_unsafe_steps_violate_a_constraint_or_are_in_collision():
    steps = [
        {},
        {"commanded_violation": 1e-10},
        {"commanded_violation": 1e-8},
        {"measured_violation": 1e-3, "collision": 1.0},
        {"collision": 1.0},
        {"measured_violation": np.nan},
    ]
    trace = trace_of(steps)
    assert trace.unsafe().tolist() == [False, False, True, True, True, True]
    assert trace.unsafe(3).tolist() == [True, True, True]
    assert trace.statistics()["cost"] == 4


def test_quasi_static_force_lasts_half_a_second():
    forces = [0.0, 9.0, *[4.0, 5.0, 6.0, 5.0, 4.5], 0.0, 0.0, 8.0, 8.0, 8.0, 8.0, 0.0]
    assert trace_of({"force": force} for force in forces).statistics()["quasi_static_force"] == 4.0
    assert trace_of({"force": 9.0} for _ in range(4)).statistics()["quasi_static_force"] == 0.0
