"""Benchmark of the movement primitive."""

from research.benchmarks.primitive import REGIMES, SIZES, measure


def test_primitive_benchmark_satisfies_constraints(monkeypatch):
    for name, value in (("SIZES", SIZES[:1]), ("DENSE_SECONDS", 0.1), ("_MOTION", 100)):
        monkeypatch.setattr(f"research.benchmarks.primitive.{name}", value)
    (parts,) = measure(steps=400).values()
    assert set(parts["predict"]) == {*REGIMES, "together"}
    for row in parts["predict"].values():
        assert 0 < row["median_us"] <= row["p99_us"] <= row["worst_us"]
        assert row["max_commanded_violation"] <= 1e-9
        assert row["difference_to_dense"] < 1e-3
    assert parts["predict"]["slack"]["constrained"] == 0 < parts["predict"]["active"]["constrained"]
    assert all(row["difference_to_daqp"] < 1e-5 for row in parts["solvers"].values())
