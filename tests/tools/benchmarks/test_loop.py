from guiderail.tools.benchmarks import loop


def test_every_part_is_measured_against_its_period(monkeypatch, capsys):
    monkeypatch.setattr(loop, "SECONDS", 0.3)
    rows = loop._parts()
    assert [round(row["period_ms"], 6) for row in rows] == [200.0, 20.0, 5.0]
    for row in rows:
        assert 0.0 < row["median_ms"] <= row["p99_ms"] <= row["worst_ms"]
        assert row["over"] <= row["number"]
    loop.show({"as it is": rows})
    assert "station, with what guards it" in capsys.readouterr().out
