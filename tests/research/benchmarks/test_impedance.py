"""Benchmark of the gantry's impedances, with simulations replaced by constant results."""

import numpy as np
import pytest

from research.benchmarks import impedance


@pytest.fixture
def results(monkeypatch):
    """Return the results of the benchmark, whose positions differ by the time step and by 1 mm between impedances."""

    def insertion(control, time_step):
        pose = np.zeros((3, 6))
        pose[:, 0] = time_step + (0.001 if control == "cartesian" else 0.0)
        row = {"control": control, "time_step": time_step, "seconds": 1.0, "locks": True, "peak_force": 12.0}
        return row, pose

    def episodes(difficulty, name, control):
        row = {"difficulty": difficulty, "policy": name, "control": control, "seconds_per_1000_steps": 2.0}
        return row | dict.fromkeys(impedance.STATISTICS, 0.5)

    monkeypatch.setattr(impedance, "insertion", insertion)
    monkeypatch.setattr(impedance, "_episodes", episodes)
    response = [[0.5] * 6] * impedance.RESPONSE
    monkeypatch.setattr(impedance, "step_response", lambda control: {"control": control, "response": response})
    return impedance.measure()


def test_motions_are_compared_with_the_finest_step(results):
    rows = {(row["control"], round(1e5 * row["time_step"])): row for row in results["motion"]}
    assert rows["joint", 125]["own_position_rms"] == rows["cartesian", 125]["own_position_rms"] == 0.0
    assert rows["joint", 1000]["own_position_rms"] == pytest.approx(0.01 - 0.00125)
    assert rows["cartesian", 125]["joint_position_rms"] == pytest.approx(0.001)
    assert "joint_position_rms" not in rows["cartesian", 500]
    assert len(results["episodes"]) == 8


def test_show_prints_a_line_per_result(results, capsys):
    impedance.show(results)
    output = capsys.readouterr().out
    assert output.count(" yes ") == 7
    assert "1.000 mm to the joint impedance" in output
    assert "hard, scripted, cartesian" in output
