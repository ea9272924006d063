"""Benchmark of the cold start of training."""

import subprocess
from pathlib import Path

import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.learning.trainer import run_training
from research.benchmarks import cold_start


def test_measure_times_both_kinds_for_each_seed(monkeypatch, bead_config, capsys):
    settings = []

    def run(command, **_):
        settings.append(command[command.index("--set") + 1])
        assert command[command.index("--import") + 1] == "bead"
        run_training(RunFolder(Path(command[command.index("--out") + 1])), bead_config)
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(cold_start.subprocess, "run", run)
    result = cold_start.measure("Bead", None, ("bead",), episodes=1, seeds=range(2, 4), held_out=3)
    kinds = list(cold_start.KINDS)
    assert [(run["seed"], run["kind"]) for run in result["runs"]] == [(s, k) for s in (2, 3) for k in kinds]
    assert settings == ["num_envs=0", "num_envs=1"] * 2
    assert all(run["seconds"] > 0.0 and 0.0 <= run["success_rate"] <= 1.0 for run in result["runs"])
    cold_start.show(result)
    assert "seed 3" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("code", "stderr", "reason"),
    [(2, "progress\nguiderail: hold must be at least 1\n", "hold must be at least 1"), (-9, "", "exit status -9")],
)
def test_measure_reports_the_error_of_a_failed_run(code, stderr, reason, monkeypatch):
    completed = subprocess.CompletedProcess([], code, stderr=stderr)
    monkeypatch.setattr(cold_start.subprocess, "run", lambda *_, **__: completed)
    with pytest.raises(InputError, match=reason):
        cold_start.measure("NarrowPassage", {"action_repeat": -1}, episodes=1)
