"""Calibration of difficulty="hard": choice of a setting by success rates, force limit, turn and early stop."""

from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail_parts import difficulty
from guiderail_parts.create_task import create_task
from guiderail_parts.difficulty import (
    FIRST,
    MAX_TURN,
    SETTINGS,
    Score,
    calibrate,
    choose_setting,
    count_successes,
    force_limit_of,
    turn_of,
)
from guiderail_parts.task_file import MotionNumbers, PartTaskFile


def make_score(random, scripted):
    """Return a score function with given successes in ten episodes of each setting, and the list of its requests."""
    requests = []

    def score(setting):
        requests.append(SETTINGS.index(setting))
        return Score(random[requests[-1]], 10, scripted[requests[-1]], 10)

    return score, requests


@pytest.mark.parametrize(
    ("random", "scripted", "chosen", "tried"),
    [
        ([9, 9, 9, 9, 2, 0, 0, 0, 0], 9 * [10], 4, [4]),
        ([9, 9, 9, 9, 3, 3, 2, 0, 0], 9 * [10], 6, [4, 5, 6]),
        ([9, 1, 1, 0, 0, 0, 0, 0, 0], [10, 9, 8, 8, 8, 0, 0, 0, 0], 1, [4, 3, 2, 1]),
        (9 * [9], 9 * [10], None, [4, 5, 6, 7, 8]),
        (9 * [0], 9 * [5], None, [4, 3, 2, 1, 0]),
        ([9, 9, 9, 9, 1, 1, 1, 1, 1], [10, 10, 10, 9, 8, 0, 0, 0, 0], None, [4, 3]),  # too hard, then too easy
        (9 * [3], 9 * [8], None, [4]),  # too easy and too hard at once
    ],
)
def test_first_setting_with_the_required_rates_is_chosen(random, scripted, chosen, tried):
    score, requests = make_score(random, scripted)
    setting, result, is_hard = choose_setting(score)
    assert requests == tried
    assert is_hard is (chosen is not None)
    if chosen is not None:
        assert setting is SETTINGS[chosen]
    else:
        assert result.margin == pytest.approx(max(scripted[number] - random[number] for number in tried) / 10)


@pytest.mark.parametrize(
    ("counts", "too_easy", "too_hard"),
    [((2, 10, 9, 10), False, False), ((3, 10, 9, 10), True, False), ((2, 10, 8, 10), False, True)],
)
def test_setting_is_too_easy_or_too_hard_at_its_limits(counts, too_easy, too_hard):
    assert (Score(*counts).is_too_easy, Score(*counts).is_too_hard) == (too_easy, too_hard)


def test_score_without_scripted_episodes_has_a_low_margin():
    partial, complete = Score(3, 9, 0, 0), Score(2, 10, 1, 10)
    assert (partial.is_too_easy, partial.is_too_hard) == (True, False)
    assert Score(3, 3, 0, 0).margin < partial.margin < complete.margin


def test_count_successes_stops_when_a_limit_is_exceeded():
    assert count_successes(lambda index: True, 10, most_successes=2) == (3, 3)
    assert count_successes(lambda index: index % 2 == 0, 10, most_failures=1) == (2, 4)
    assert count_successes(lambda index: True, 4, most_failures=1) == (4, 4)


def test_settings_become_harder_with_the_socket_in_reach():
    order = [(setting.offset, -setting.action_repeat) for setting in SETTINGS]
    assert order == sorted(order)
    assert 0 <= FIRST < len(SETTINGS)
    for setting in SETTINGS:
        options = setting.options(20.0, 0.0)
        assert options["offset_range"][1] < options["bound"]
        assert options["offset_range"][1] <= options["action_scale"] * difficulty.REACH


def test_force_limit_and_turn_are_computed_from_the_part():
    file = SimpleNamespace(force_limit=35.0)
    assert [force_limit_of(file, peak) for peak in (1.0, 6.1, 30.0)] == [10.0, 16.0, 35.0]
    assert turn_of(0.0, 5e-3) == 0.0
    assert turn_of(0.1e-3, 10e-3) == pytest.approx(0.57)
    assert turn_of(1e-3, 5e-3) == MAX_TURN


class ObservationEnv(gymnasium.Env):
    """Environment with given observations of time [s] and height [m], for a motion with a travel of 10 mm."""

    def __init__(self, rows, duration):
        self._rows, self._duration = list(rows), duration

    def step(self, action):
        time, height = self._rows.pop(0)
        observation = np.zeros(17)
        observation[0], observation[3] = 2.0 * time / self._duration - 1.0, 2.0 * height / 0.010 - 1.0
        return observation, 0.0, False, False, {}


def test_episode_is_truncated_when_the_plug_is_on_the_rim():
    file = SimpleNamespace(motion=MotionNumbers(travel=0.010, first_contact=0.007))
    times = file.motion.plan_search()[0]
    stop = times[3] + difficulty.SEATING_TIME  # [s]
    rows = [(stop - 0.01, 0.007), (stop + 0.01, 0.0064), (stop + 0.01, 0.0066)]
    env = difficulty.StopOnRim(ObservationEnv(rows, times[-1]), file)
    assert [env.step(None)[3] for _ in rows] == [False, False, True]


def test_without_a_calibration_hard_is_the_first_setting_with_the_limits_of_the_part(tmp_path):
    messages = []
    motion = MotionNumbers(travel=0.010, first_contact=0.007)
    file = PartTaskFile.model_construct(measured={"force": 5.0, "clearance_mm": 1.0}, force_limit=35.0, motion=motion)
    for episodes in (0, 2):  # no calibration, and one that fails
        result = calibrate(tmp_path / "missing", file, 20e-3, episodes, messages.append)
        assert result.hard == SETTINGS[FIRST].options(13.0, 2.86)  # 2.5 times the force; 1 mm over 20 mm [degrees]
        assert "hard" not in result.measured
    (message,) = messages
    assert message.startswith("difficulty=hard is not calibrated: there is no task folder")


@pytest.mark.parametrize("episodes", [-1, 101])
def test_calibration_episodes_are_refused_when_out_of_range(episodes, tmp_path):
    with pytest.raises(InputError, match="--hard-episodes must be a whole number from 0 to 100"):
        create_task(Path("plug.stl"), Path("socket.stl"), tmp_path / "peg", hard_episodes=episodes)
