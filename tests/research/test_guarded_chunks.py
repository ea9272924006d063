"""Check of commands just below and above each limit, and the comparison of guards."""

import numpy as np
import pandas as pd
import pytest

import research.guarded_chunks as guarded
from guiderail.models.common.errors import InputError

PERIOD, ONES = 0.5, np.ones(2)


def check(commands, **limits):
    """Check commands (N, 2) against wide limits, some of which are replaced; return the counts and excesses."""
    arguments = {"lower": -ONES, "upper": ONES, "speed": 1e3 * ONES, "jerk": 1e3 * ONES, "period": PERIOD} | limits
    return guarded.check_commands(np.asarray(commands, float), **arguments)


def test_check_counts_commands_beyond_each_limit_only():
    ramp = np.outer(np.arange(6), [0.1, 0.0])
    assert check(ramp, upper=np.array([0.5, 1.0]))["bound_violations"] == 0
    assert check(ramp, upper=np.array([0.45, 1.0]))["bound_violations"] == 1
    assert check(ramp, speed=np.array([0.2, 1.0]))["speed_violations"] == 0
    assert check(ramp, speed=np.array([0.199, 1.0]))["speed_violations"] == 5
    cubic = np.outer(np.arange(6) ** 3, [0.01, 0.0])  # the third difference is 0.06 at each of 3 steps
    assert check(cubic, jerk=np.array([0.06 / PERIOD**3, 1.0]), upper=9 * ONES)["jerk_violations"] == 0
    result = check(cubic, jerk=np.array([0.03 / PERIOD**3, 1.0]), upper=9 * ONES)
    assert result["jerk_violations"] == 3
    assert result["jerk_ratio"] == pytest.approx(2.0)
    assert check(cubic)["bound_excess"] == pytest.approx(0.25)


def test_check_counts_nan_as_a_violation_of_each_limit():
    result = check(np.full((6, 2), np.nan))
    assert [result[f"{name}_violations"] for name in ("bound", "speed", "jerk")] == [6, 5, 3]


def test_comparison_counts_paired_outcomes_and_stores_blocks(tmp_path, monkeypatch):
    evaluated = []

    def evaluate(guard, base_policy, episodes, seed):
        evaluated.append((guard, seed))
        rows = {"success": [int(guard != "none"), 1], "fallback_steps": 0, "steps": 400, "peak_force": 12.0}
        zeros = dict.fromkeys((*guarded.EXCESSES, "bound_violations", "speed_violations", "jerk_violations"), 0)
        return pd.DataFrame(rows | zeros)

    monkeypatch.setattr(guarded, "evaluate_guard", evaluate)
    rows = guarded.compare_guards(tmp_path, episodes=2)
    assert [row["success_rate"] for row in rows] == [0.5, 1.0, 1.0]
    assert [row["only_with_guard"] for row in rows] == [0, 1, 1]
    assert rows == guarded.compare_guards(tmp_path, episodes=2)
    assert len(evaluated) == 3
    for number, weights in enumerate((b"first", b"second")):
        (tmp_path / "policy.safetensors").write_bytes(weights)
        guarded.compare_guards(tmp_path, base_policy=str(tmp_path), episodes=2)
        assert len(evaluated) == 6 + 3 * number
    with pytest.raises(InputError, match="at least one"):
        guarded.compare_guards(tmp_path, episodes=0)
