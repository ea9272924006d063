import numpy as np

from research.benchmarks import loop


def test_every_part_is_measured_against_its_period(monkeypatch, capsys):
    monkeypatch.setattr(loop, "SECONDS", 0.3)
    rows = loop._parts()
    assert [round(row["period_ms"], 6) for row in rows] == [200.0, 20.0, 5.0]
    for row in rows:
        assert 0.0 < row["median_ms"] <= row["p99_ms"] <= row["worst_ms"]
        assert row["over"] <= row["number"]
    loop.show({"as it is": rows})
    assert "station, with what guards it" in capsys.readouterr().out


def test_an_answer_that_is_lost_leaves_the_others_their_numbers():
    seconds = np.append(np.linspace(0.001, 0.002, 299), np.inf)
    row = loop._row("there and back over LCM", 0.005, seconds)
    assert 1.0 < row["median_ms"] < 1.6
    assert row["median_ms"] < row["p99_ms"] < 2.0
    assert row["worst_ms"] == np.inf
    assert (row["over"], row["number"]) == (1, 300)
    one_of_few = loop._row("there and back over LCM", 0.005, np.append(np.full(10, 0.001), np.inf))
    assert one_of_few["median_ms"] == 1.0


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
