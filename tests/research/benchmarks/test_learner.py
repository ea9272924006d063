"""Benchmark of learners."""

from guiderail.tools.learning.learner_config import PRESETS
from research.benchmarks import learner


def test_measure_covers_algorithms_and_presets(monkeypatch):
    assert set(learner.PRESETS) <= set(PRESETS)
    monkeypatch.setattr(learner, "PRESETS", ("tqc_contact",))
    monkeypatch.setattr(learner, "_TRANSITIONS", 100)
    result = learner.measure(turns=1)
    assert set(result) == {"tqc tqc_contact", "sac tqc_contact", "fast_enough"}
    for row in (result["tqc tqc_contact"], result["sac tqc_contact"]):
        assert 0.0 < row["step_ms"] < row["stable_baselines3_ms"]
