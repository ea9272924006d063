import io
import math

from rich.console import Console

from guiderail.systems.command_checks import ConstraintViolation
from guiderail.tools.evaluation.metrics import UNCONSTRAINED
from guiderail.tools.progress import EpisodeProgress


def rows(count):
    return [
        {"episode": i, "success": int(i % 2), "return": 10.0, "max_commanded_violation": -1.0 if i < 3 else 2e-3}
        for i in range(count)
    ]


def printed(terminal):
    text = io.StringIO()
    with EpisodeProgress(4, console=Console(file=text, force_terminal=terminal, width=140)) as progress:
        for row in rows(4):
            progress.update(row)
    return text.getvalue()


def test_log_file_contains_the_lines_of_the_bar():
    text = printed(terminal=False)
    assert "\x1b" not in text
    first, last = text.splitlines()[0], text.splitlines()[-1]
    assert "1/4" in first
    assert "violation none" in first
    for word in ("4/4", "success 50%", "return 10.0", "violation 2.0e-03 m", "done in"):
        assert word in last


def test_status_averages_all_episodes_without_a_window():
    windowed, whole = EpisodeProgress(40), EpisodeProgress(40, window=None)
    for i in range(40):
        for progress in (windowed, whole):
            progress.update({"episode": i, "success": int(i >= 30), "return": 0.0, "max_commanded_violation": -1.0})
    assert windowed.status().startswith("last 10: success 100%")
    assert whole.status().startswith("success 25%")


def test_terminal_shows_a_bar():
    text = printed(terminal=True)
    for word in ("4/4", "success 50%", "return 10.0", "violation 2.0e-03 m"):
        assert word in text


def test_violation_that_is_not_a_number_is_shown():
    progress = EpisodeProgress(2)
    for episode, violation in enumerate((math.nan, 0.0)):
        progress.update({"episode": episode, "success": 1, "return": 0.0, "max_commanded_violation": violation})
    assert "largest violation nan" in progress.status()


def test_status_omits_success_when_none_is_reported():
    progress = EpisodeProgress(2)
    row = {"episode": 0, "success": 0, "return": 2.0, "reports_success": 0}
    progress.update(row)
    assert progress.status() == "last 1: return 2.0  largest violation unconstrained"
    progress.update(row | {"episode": 1, "reports_success": 1})
    assert progress.status().startswith("last 2: success 0%")


def test_status_says_unconstrained_without_constraints():
    progress = EpisodeProgress(1)
    progress.update({"episode": 0, "success": 1, "return": 0.0, "max_commanded_violation": UNCONSTRAINED})
    assert progress.status().endswith("largest violation unconstrained")
    assert UNCONSTRAINED == ConstraintViolation.UNCONSTRAINED
