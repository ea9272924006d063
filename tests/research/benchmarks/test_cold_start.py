import subprocess
from pathlib import Path

import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.learning.trainer import train
from research.benchmarks import cold_start


def test_both_kinds_of_each_seed_are_timed_and_judged(monkeypatch, bead_config, capsys):
    asked = []

    def run(words, **_):
        asked.append(words[words.index("--set") + 1])
        assert words[words.index("--import") + 1] == "bead"
        train(RunFolder(Path(words[words.index("--out") + 1])), bead_config)
        return subprocess.CompletedProcess(words, 0)

    monkeypatch.setattr(cold_start.subprocess, "run", run)
    found = cold_start.measure("Bead", None, ("bead",), episodes=1, seeds=range(2, 4), held_out=3)
    kinds = list(cold_start.KINDS)
    assert [(run["seed"], run["kind"]) for run in found["runs"]] == [(s, k) for s in (2, 3) for k in kinds]
    assert asked == ["pipelined=false", "pipelined=true"] * 2
    assert all(run["seconds"] > 0.0 and 0.0 <= run["success_rate"] <= 1.0 for run in found["runs"])
    cold_start.show(found)
    assert "seed 3" in capsys.readouterr().out


def test_a_run_that_fails_says_why(monkeypatch):
    said = subprocess.CompletedProcess([], 2, stderr="at work\nguiderail: hold must be at least 1\n")
    monkeypatch.setattr(cold_start.subprocess, "run", lambda *_, **__: said)
    with pytest.raises(InputError, match="hold must be at least 1"):
        cold_start.measure("NarrowPassage", {"action_repeat": -1}, episodes=1)
