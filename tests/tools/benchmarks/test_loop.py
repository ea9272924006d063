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


def test_an_answer_that_is_late_is_not_the_next_ones():
    answers = loop._Answers()
    first = answers.say(1.0)
    second = answers.say(2.0)
    answers.hear(first, 2.5)
    assert not answers.is_answered()
    answers.hear(second, 2.75)
    answers.hear(second, 9.0)
    assert answers.is_answered()
    answers.say(3.0)
    assert answers.seconds() == [1.5, 0.75, float("inf")]
