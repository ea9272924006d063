"""Both impedances of the rails, compared: what is told, with motions that nobody simulates here."""

import numpy as np
import pytest

from research.benchmarks import impedance


@pytest.fixture
def results(monkeypatch):
    def insertion(control, time_step):
        pose = np.zeros((3, 6))
        pose[:, 0] = time_step + (0.001 if control == "cartesian" else 0.0)
        known = {"control": control, "time_step": time_step, "seconds": 1.0, "locks": True, "peak_force": 12.0}
        return known, pose

    def episodes(difficulty, name, control):
        known = {"difficulty": difficulty, "policy": name, "control": control, "seconds_per_1000_steps": 2.0}
        return known | dict.fromkeys(impedance.SHOWN, 0.5)

    monkeypatch.setattr(impedance, "insertion", insertion)
    monkeypatch.setattr(impedance, "_episodes", episodes)
    response = [[0.5] * 6] * impedance.RESPONSE
    monkeypatch.setattr(impedance, "step_response", lambda control: {"control": control, "response": response})
    return impedance.measure()


def test_each_is_compared_with_its_own_finest_step_and_the_finest_with_each_other(results):
    rows = {(row["control"], round(1e5 * row["time_step"])): row for row in results["motion"]}
    assert rows["joint", 125]["own_position_rms"] == rows["cartesian", 125]["own_position_rms"] == 0.0
    assert rows["joint", 1000]["own_position_rms"] == pytest.approx(0.01 - 0.00125)
    assert rows["cartesian", 125]["joint_position_rms"] == pytest.approx(0.001)
    assert "joint_position_rms" not in rows["cartesian", 500]
    assert len(results["episodes"]) == 8


def test_it_is_told_in_a_line_each(results, capsys):
    impedance.show(results)
    told = capsys.readouterr().out
    assert told.count(" yes ") == 7
    assert "1.000 mm to that of the rails' own" in told
    assert "hard, rule, cartesian" in told
