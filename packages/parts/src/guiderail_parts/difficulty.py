"""Calibration of difficulty="hard" for a task of two parts, from the success of baseline policies on it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from guiderail.diagrams.tasks.registry import register_task
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import MM
from guiderail.models.primitives import Demonstrations
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.baselines import make_baseline
from guiderail.tools.evaluation.rollout import rollout
from guiderail_parts.geometry.demonstrator import SEARCH_END
from guiderail_parts.isolation import IsolatedError, run_isolated
from guiderail_parts.task import TIME, Z, load_task_folder
from guiderail_parts.task_file import IN_SOCKET, PartTaskFile, read_task_file

MAX_RANDOM, MIN_SCRIPTED = 0.2, 0.9  # success rates of random actions and of the search in a hard setting
SEED = 3_000_000  # seed of the first episode; conditions are sampled as in training
REACH = 1.9 * MM  # displacement of the command by an action of 1 at action_scale 1 [m]
MARGIN = 0.75 * MM  # distance from the offset to the bound of commands [m]
MIN_FORCE, FORCE_RATIO = 10.0, 2.5  # smallest force limit [N]; ratio of force limit to peak force when aligned
MAX_TURN = 3.0  # largest turn of the socket [degrees]
MAX_SECONDS = 300  # CPU time after which a calibration is stopped [s]
SEATING_TIME = 1.0  # time after the search in which the push may still seat the plug [s]
NAME = "create-task/calibration"  # name of the task in the process that calibrates it


@dataclass(frozen=True)
class Setting:
    """Difficulty that a calibration can choose."""

    offset: float  # largest offset of the socket [m]; the smallest offset is 85 % of it
    action_repeat: int = 5  # control steps per action; random actions that change more often move the plug less far

    def options(self, force_limit: float, turn: float) -> dict[str, Any]:
        """Return the options of the environment for a force limit [N] and a largest turn of the socket [degrees]."""
        return {
            "guidance": "kgrl",
            "fixture_offset": "per_episode",
            "offset_range": [round(0.85 * self.offset, 6), self.offset],
            "fixture_turn": turn,
            "bound": round(self.offset + MARGIN, 6),
            "action_scale": max(1.0, math.ceil(100.0 * self.offset / REACH) / 100.0),
            "force_limit": force_limit,
            "observation": "center_of_pressure",
            "action_repeat": self.action_repeat,
        }


SETTINGS = (
    *(Setting(offset * MM) for offset in (1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0)),
    Setting(4.0 * MM, 3),
    Setting(4.0 * MM, 2),
)
"""Settings, the easiest for random actions first."""
FIRST = 4  # index of the first setting that is tried


@dataclass(frozen=True)
class Score:
    """Successes of the baseline policies with one setting."""

    random: int  # number of successes of uniform random actions
    random_episodes: int  # number of episodes of random actions; fewer than requested if fewer decide the result
    scripted: int  # number of successes of the scripted search
    scripted_episodes: int  # number of episodes of the search; 0 if random actions succeed too often

    @property
    def is_too_easy(self) -> bool:
        """True if random actions succeed too often."""
        return self.random > MAX_RANDOM * self.random_episodes

    @property
    def is_too_hard(self) -> bool:
        """True if the scripted search succeeds too seldom; False if it was not run."""
        return self.scripted < MIN_SCRIPTED * self.scripted_episodes

    @property
    def is_suitable(self) -> bool:
        """True if both success rates are as required."""
        return not (self.is_too_easy or self.is_too_hard)

    @property
    def margin(self) -> float:
        """Success rate of the search minus that of random actions; a search that was not run counts as −1."""
        scripted = self.scripted / self.scripted_episodes if self.scripted_episodes else -1.0
        return scripted - self.random / self.random_episodes

    def __str__(self) -> str:
        return (
            f"uniform random actions {self.random} of {self.random_episodes}, scripted search {self.scripted} of "
            f"{self.scripted_episodes}"
        )


def choose_setting(score: Callable[[Setting], Score]) -> tuple[Setting, Score, bool]:
    """Return one of `SETTINGS`, its score, and True if it has the required success rates.

    The search begins at the index `FIRST`. If a setting is too easy, the next harder setting is tried; if it is too
    hard, the next easier one. The search ends at a setting with the required rates, at a setting that was already
    tried, or at the end of the list. Without a setting with the required rates, the setting with the largest `margin`
    is returned, and the easiest of several with the same margin.
    """
    tried: dict[int, Score] = {}
    number = FIRST
    while 0 <= number < len(SETTINGS) and number not in tried:
        result = tried[number] = score(SETTINGS[number])
        if result.is_too_easy == result.is_too_hard:
            break
        number += 1 if result.is_too_easy else -1
    best = max(sorted(tried), key=lambda index: (tried[index].is_suitable, tried[index].margin))
    return SETTINGS[best], tried[best], tried[best].is_suitable


def count_successes(
    run: Callable[[int], bool], episodes: int, *, most_successes: float = math.inf, most_failures: float = math.inf
) -> tuple[int, int]:
    """Run at most `episodes` episodes; return the number of successes and the number of episodes.

    `run` returns the success of the episode with an index. The loop ends early after more than `most_successes`
    successes or `most_failures` failures.
    """
    successes = 0
    for index in range(episodes):
        successes += bool(run(index))
        if successes > most_successes or index + 1 - successes > most_failures:
            return successes, index + 1
    return successes, episodes


class StopOnRim(gymnasium.Wrapper):
    """Wrapper that truncates an episode if the plug is still on the rim `SEATING_TIME` after the search."""

    def __init__(self, env: gymnasium.Env, file: PartTaskFile):
        super().__init__(env)
        numbers = file.motion
        times, _ = numbers.plan_search()
        self._progress = 2.0 * (times[SEARCH_END] + SEATING_TIME) / times[-1] - 1.0
        self._height = 2.0 * (numbers.first_contact - IN_SOCKET) / numbers.travel - 1.0

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Return the result of the environment's step, truncated if the plug is still on the rim."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        is_late = observation[TIME] > self._progress and observation[Z] > self._height
        return observation, reward, terminated, truncated or bool(is_late), info


def score_setting(task: str, file: PartTaskFile, options: dict[str, Any], episodes: int) -> Score:
    """Return the successes of uniform random actions and of the scripted search in at most `episodes` episodes each."""
    env = StopOnRim(make_environment(task, options), file)

    def count(name: str, **limits: float) -> tuple[int, int]:
        act: Any = make_baseline(task, name)(env)

        def run(index: int) -> bool:
            if (start := getattr(act, "start_episode", None)) is not None:
                start(index)
            return bool(rollout(env, act, index=index, seed=SEED + index)["success"])

        return count_successes(run, episodes, **limits)

    try:
        random = Score(*count("uniform_random", most_successes=MAX_RANDOM * episodes + 1e-9), 0, 0)
        if random.is_too_easy:
            return random
        scripted, scripted_episodes = count("scripted", most_failures=(1.0 - MIN_SCRIPTED) * episodes + 1e-9)
        return replace(random, scripted=scripted, scripted_episodes=scripted_episodes)
    finally:
        env.close()


def force_limit_of(file: PartTaskFile, peak_force: float) -> float:
    """Return the force limit [N] for the peak force of an aligned insertion [N].

    It is a multiple of the peak force, at least `MIN_FORCE` and at most the task's limit.
    """
    return float(min(file.force_limit, max(MIN_FORCE, math.ceil(FORCE_RATIO * peak_force))))


def turn_of(clearance: float, radius: float) -> float:
    """Return the largest turn of the socket that the clearance allows, at most `MAX_TURN` [degrees].

    Args:
        clearance: Clearance between the walls [m]; 0 without walls.
        radius: Largest distance of the plug from the axis [m].
    """
    if clearance <= 0.0:
        return 0.0
    return round(min(MAX_TURN, math.degrees(clearance / max(radius, clearance))), 2)


def calibrate(
    folder: Path, file: PartTaskFile, radius: float, episodes: int, log: Callable[[str], None]
) -> PartTaskFile:
    """Return the task file with options `hard` and the results of their calibration.

    If no setting has the required success rates, the options of the best setting are used. Without a calibration, and
    if it fails, they are those of the setting that a calibration tries first.

    Args:
        folder: Task folder, which must contain `file`.
        file: Task file.
        radius: Largest distance of the plug from the axis [m].
        episodes: Largest number of episodes of each policy with each setting; 0: no calibration.
        log: Function called with a sentence on the result.
    """
    force_limit = force_limit_of(file, float(file.measured["force"]))
    turn = file.motion.search_turn or turn_of(file.clearance, radius)
    first = file.model_copy(update={"hard": SETTINGS[FIRST].options(force_limit, turn)})
    if not episodes:
        return first
    try:
        read_task_file(folder).demonstrations.reference(folder)  # fits the written file; the child inherits the cache
        setting, score, is_hard = run_isolated(
            _choose_for, folder, force_limit, turn, episodes, cpu_seconds=MAX_SECONDS
        )
    except (IsolatedError, InputError) as error:
        log(f"difficulty=hard is not calibrated: {error}")
        return first
    demonstrations = Demonstrations.load(folder / file.demonstrations.file)
    seconds = float(np.mean([times[-1] - times[0] for times in demonstrations.times]))
    options = setting.options(force_limit, turn)
    nearest, farthest = options["offset_range"]
    result = {
        "offset_mm": [round(nearest / MM, 3), round(farthest / MM, 3)],
        "turn_degrees": turn,
        "force_limit": force_limit,
        "time_s": round(seconds, 2),
        "uniform_random": f"{score.random} of {score.random_episodes}",
        "scripted": f"{score.scripted} of {score.scripted_episodes}",
        "calibrated": is_hard,
    }
    log(
        f"difficulty=hard: socket {nearest / MM:.2f} to {farthest / MM:.2f} mm off, turned by up to {turn:g}°, force "
        f"limit {force_limit:g} N, {seconds:.1f} s: {score}"
        + ("" if is_hard else f"; no setting has ≤ {MAX_RANDOM:.0%} random and ≥ {MIN_SCRIPTED:.0%} scripted successes")
    )
    return file.model_copy(update={"hard": options, "measured": {**file.measured, "hard": result}})


def _choose_for(folder: Path, force_limit: float, turn: float, episodes: int) -> tuple[Setting, Score, bool]:
    """Return the setting for a task folder; run in a child process, because it registers a task."""
    task = load_task_folder(folder)
    register_task(NAME)(task)
    return choose_setting(lambda setting: score_setting(NAME, task.file, setting.options(force_limit, turn), episodes))
