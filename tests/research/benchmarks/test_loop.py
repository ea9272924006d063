"""Benchmark of the control loop."""

import operator
import os

import numpy as np
import pytest

from research.benchmarks import loop


def test_times_of_parts_are_measured_with_their_periods(monkeypatch, capsys):
    monkeypatch.setattr(loop, "SECONDS", 0.3)
    rows = loop._parts()
    assert [round(row["period_ms"], 6) for row in rows] == [200.0, 20.0, 5.0]
    for row in rows:
        assert 0.0 < row["median_ms"] <= row["p99_ms"] <= row["worst_ms"]
        assert row["over"] <= row["number"]
    loop.show({"as it is": rows})
    assert "station with its monitors" in capsys.readouterr().out


def test_missing_answer_counts_as_infinite():
    seconds = np.append(np.linspace(0.001, 0.002, 299), np.inf)
    row = loop._row("round trip over LCM", 0.005, seconds)
    assert 1.0 < row["median_ms"] < 1.6
    assert row["median_ms"] < row["p99_ms"] < 2.0
    assert row["worst_ms"] == np.inf
    assert (row["over"], row["number"]) == (1, 300)
    few = loop._row("round trip over LCM", 0.005, np.append(np.full(10, 0.001), np.inf))
    assert few["median_ms"] == 1.0


def test_late_answer_belongs_to_its_own_message():
    answers = loop._Answers()
    first = answers.send(1.0)
    second = answers.send(2.0)
    answers.receive(first, 2.5)
    assert not answers.is_answered()
    answers.receive(second, 2.75)
    answers.receive(second, 9.0)
    assert answers.is_answered()
    answers.send(3.0)
    assert answers.seconds() == [1.5, 0.75, float("inf")]


def test_transport_raises_when_the_sender_fails(monkeypatch):
    monkeypatch.delenv("DRAKE_ALLOW_NETWORK", raising=False)
    monkeypatch.setattr(loop, "_send_statuses", operator.sub)  # the difference of a pipe and a URL raises a TypeError
    with pytest.raises(EOFError):
        loop._transport()
    assert "DRAKE_ALLOW_NETWORK" not in os.environ  # otherwise Meshcat would be forbidden for the whole process
