import pandas as pd
import pytest

from guiderail.tools.evaluation.metrics import wilson
from guiderail.tools.experiments.declaration import Study
from guiderail.tools.experiments.study import _success, draw_sweeps


def rows(*rates):
    found = [
        {"method": "one", "eval_set": "x", "seed": k, "after_episodes": 60, "episodes": 50} for k in range(len(rates))
    ]
    return pd.DataFrame(found, dtype=object).assign(success_rate=rates)


def test_band_spans_the_intervals_of_all_seeds():
    assert _success(rows(0.8), "one", "x") == pytest.approx((0.8, *wilson(40, 50)))
    assert _success(rows(1.0, 0.0), "one", "x") == pytest.approx((0.5, wilson(0, 50)[0], wilson(50, 50)[1]))
    assert _success(rows(1.0, 1.0), "one", "x") == pytest.approx((1.0, *wilson(50, 50)))
    assert _success(rows(1.0), "another", "x") is None


def test_sweep_of_one_value_is_drawn(tmp_path):
    study = Study.model_validate(
        {"name": "one", "task": "Bead", "methods": {"one": {"policy": "zero"}}, "seeds": [0], "eval_set": [],
         "sweeps": [{"quantity": "x", "at": {1.0: {}}}]}
    )  # fmt: skip
    found = rows(0.5).assign(eval_set="x 1")
    assert draw_sweeps(study, found, tmp_path / "one.png").is_file()
