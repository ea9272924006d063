from guiderail.tools.learning.config import PRESETS
from research.benchmarks import learner


def test_reports_every_pair_and_what_is_asked_of_one(monkeypatch):
    assert set(learner.PRESETS) <= set(PRESETS)
    monkeypatch.setattr(learner, "PRESETS", ("tqc_contact",))
    monkeypatch.setattr(learner, "_DECISIONS", 100)
    result = learner.measure(turns=1)
    assert set(result) == {"tqc robust", "sac robust", "fast_enough"}
    for row in (result["tqc robust"], result["sac robust"]):
        assert 0.0 < row["step_ms"] < row["stable_baselines3_ms"]
