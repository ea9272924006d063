"""Benchmark of the time that a training run spends on saving."""

from research.benchmarks import saving
from research.benchmarks.saving import saving_share, timed


def test_saving_share_counts_saving_only(monkeypatch, bead_config):
    monkeypatch.setattr(saving, "configure", lambda *_, **__: bead_config)
    result = saving_share("Bead", bead_config.episodes)
    assert 1 <= result["checkpoints"] <= bead_config.episodes
    assert 0 < result["step_log_share"] < 1
    assert 0 < result["step_log_ms_per_episode"] < 1e3 * result["seconds"]


def test_timed_restores_the_function():
    class Owner:
        def method(self):
            return 3

    before = Owner.method
    with timed(Owner, "method") as spent:
        assert Owner().method() == 3
    assert len(spent) == 1
    assert Owner.method is before
