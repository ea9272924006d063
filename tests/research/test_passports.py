"""Passports of several policies."""

import json

import pandas as pd
import pytest

from research import passports


@pytest.mark.parametrize(("in_mujoco", "within"), [(1.0, 1.0), (0.5, 0.0)])
def test_each_engine_is_predicted_from_the_others(tmp_path, monkeypatch, capsys, in_mujoco, within):
    asked = []

    def evaluate(subject, found, out, *, episodes, seed, processes):
        asked.extend(condition.name for condition in found)
        rates = [in_mujoco if condition.engine == "mujoco" else 1.0 for condition in found]
        columns = {"peak_force": 10.0, "peak_contact_force": 12.0}
        return [pd.DataFrame({"success": [i < rate * episodes for i in range(episodes)], **columns}) for rate in rates]

    monkeypatch.setattr(passports, "installed_engines", lambda: "drake,mujoco")
    monkeypatch.setattr(passports, "evaluate_conditions", evaluate)
    passports.main(["pretrained:connector", "--out", str(tmp_path), "--episodes", "20", "--json"])
    assert {"Drake, 5 ms", "MuJoCo, 1 ms"} <= set(asked)
    assert sum("×" in name for name in asked) == 3
    assert not any(name.startswith("MuJoCo") and "×" in name for name in asked)
    result = json.loads(capsys.readouterr().out)
    assert (result["policies"], result["within_5_points"]) == (1, within)
    rows = pd.read_csv(tmp_path / "predictions.csv")
    assert rows["left_out"].tolist() == ["Drake", "MuJoCo"]
    assert rows["error"].abs().max() == pytest.approx(1.0 - in_mujoco)
