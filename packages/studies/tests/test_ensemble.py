"""Command that writes the mean of several runs' policies, which is evaluated like a run."""

import json
import shutil

import numpy as np
import pytest

import guiderail
from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.cli.main import main
from guiderail.tools.evaluation.step_log import read_step_log
from guiderail_studies.ensemble import write_ensemble


def test_ensemble_of_runs_is_evaluated_like_a_run(bead_run, tmp_path, capsys):
    other, out = tmp_path / "other", tmp_path / "mean"
    shutil.copytree(bead_run, other)
    changed = Policy.load(other)
    Policy([(weight + np.float32(0.1), bias) for weight, bias in changed.layers], changed.description).save(other)
    with pytest.raises(SystemExit) as end:
        main(["ensemble", str(bead_run), str(other), "--out", str(out), "--json"])
    assert end.value.code == 0
    assert json.loads(capsys.readouterr().out) == {"policy": str(out), "networks": 2}
    evaluation = guiderail.evaluate(out, episodes=2, baselines=[], processes=1, steps=tmp_path / "steps")
    assert evaluation["trained_episodes"] is None
    steps = read_step_log(tmp_path / "steps")
    assert len(steps) == evaluation.rows["policy"]["steps"].sum()
    assert (steps["disagreement"] > 0.0).all()
    assert "disagreement" not in read_step_log(bead_run / "steps")
    with pytest.raises(InputError, match="already exists"):
        guiderail.evaluate(out, episodes=2, baselines=[], steps=tmp_path / "steps")
    with pytest.raises(InputError, match="name at least two"):
        write_ensemble([bead_run], tmp_path / "one")
    with pytest.raises(InputError, match="already exists"):
        write_ensemble([bead_run, other], out)
