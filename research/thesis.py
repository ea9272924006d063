"""What a run differs in from the thesis: the thesis's settings as data, and what a configuration makes of them.

Numbers are the thesis's own, with the place where it says so; where it says nothing there is nothing to differ from,
and what takes its place is among the remarks. What is not even what this project takes in its place is named as well.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from guiderail.diagrams.envs.options import STANDARD
from guiderail.diagrams.guidance.registry import GUIDANCE
from guiderail.diagrams.tasks.registry import TASKS
from guiderail.models.common.units import MM
from guiderail.models.objects.bnc_connector.geometry import BncDimensions
from guiderail.tools.learning.config import PRESETS, LearnerConfig, action_gamma
from guiderail.tools.learning.run_folder import RunConfig

HISTORY = ("history", "history_variance", "history_source", "adaptive_history")
NEUTRAL = {
    "guidance": "the method, whose name stands beside",
    "solver": "three of one problem, with one solution",
    "kernel_parameters": "of a kernel that is not the thesis's, which has none",
    "lcm_url": "where a robot's messages are",
    "robot_timeout": "after which a robot that is silent is given up",
}
"""Options in which nobody differs from the thesis, and why."""


@dataclass(frozen=True)
class Setting:
    """What the thesis did with a task.

    Attributes:
        section: where it says so.
        options: values of the environment's options, one or several that it has.
        preset: the table of the learner's settings, as a preset.
        algorithms: the learners.
        remarks: in what every run here differs, and in what one with some option does.
    """

    section: str
    options: Mapping[str, tuple[Any, ...]]
    preset: str
    algorithms: tuple[str, ...]
    remarks: tuple[tuple[str, Callable[[Mapping[str, Any]], bool]], ...] = ()


def _always(environment: Mapping[str, Any]) -> bool:
    return True


def _where(option: str, *values: Any) -> Callable[[Mapping[str, Any]], bool]:
    return lambda environment: environment.get(option) in values


_PRIMITIVE = {
    "action_repeat": (1,),  # algorithms 2 and 3: an action every time step
    "action_dims": (None,),
    "history": (10,),
    "history_source": ("measured",),  # algorithm 3, line 18
    "adaptive_history": (False,),
    "horizon": (40,),
    "lambda_": (6.0,),
    "beta": (6.0,),
    "kernel": ("squared_exponential",),  # section 4.3.3, "the same kernel in all our experiments"
    "length_scale": (0.5,),  # its l = 2 is 1 / (2 ℓ²)
}
_TOLD = ("action_scale", "mouth_chamfer", "difficulty")  # options that remarks tell the value of
_SCALE = (
    "actions of ±1 are κ = {action_scale:g} standard deviations of the demonstrations (thesis: no scale is given)",
    _always,
)
_SIMULATED = ("simulated (thesis: a real robot, the DLR SARA)", _always)
_HARDER = (
    "difficulty {difficulty!r}, which is ours: `guiderail list` has its numbers (thesis: one setting of each task)",
    lambda environment: environment.get("difficulty", STANDARD) != STANDARD,
)

THESIS = {
    "NarrowPassage": Setting(
        "4.4.1 and 5.4.1",
        {
            **_PRIMITIVE,
            "reward": ("sparse",),
            "observation": ("state", "image"),
            "history_variance": (1e-6,),
        },
        "table_4_1_simulation",
        ("tqc",),
        (
            _HARDER,
            ("passage, obstacle and goal of our own dimensions (thesis: none are given)", _always),
            ("nine demonstrations that a program draws at random (thesis: of a person)", _always),
            _SCALE,
        ),
    ),
    "BncConnector": Setting(
        "4.4.2 and 5.4.2",
        {
            **_PRIMITIVE,
            "reward": ("sparse",),
            "observation": ("state",),
            "history_variance": (1e-8,),
            "bound": (2.0 * MM,),  # equation 4.26
            "fixture_offset": ("per_run",),
            "station": ("arm",),
        },
        "table_4_1_robot",
        ("tqc",),
        (
            _HARDER,
            _SIMULATED,
            ("five demonstrations of a script (thesis: of a hand)", _always),
            (
                "a plug whose mouth leads in by a chamfer of {mouth_chamfer_mm:g} mm (thesis: no dimensions are given)",
                _always,
            ),
            ("a cost of force in units of 10 N and 0.5 Nm (thesis: none are given)", _always),
            _SCALE,
        ),
    ),
    "GridClamp": Setting(
        "3.4.2",
        # 9820 time steps are 17 minutes: ten decisions a second.
        {
            "action_repeat": (5,),
            "reward": ("shaped", "no_force"),
            "fixture_offset": ("per_run",),
            "station": ("arm",),
            "active_constraints": (None, True),
        },
        "table_3_2_sara",
        ("sac",),
        (
            _HARDER,
            _SIMULATED,
            ("a template that is slower upwards than downwards (thesis: no speeds are given)",
             _where("guidance", "sct")),
        ),
    ),
    "Pouring": Setting(
        "3.4.1",
        # 9700 time steps are 16 minutes: ten decisions a second.
        {
            "action_repeat": (10,),
            "reward": ("shaped", "sparse", "hand_shaped"),
            "input_speed": (None, 1.0),
            "mug_offset": (0.0,),
            "balls": (2,),
            "ball_diameter": (0.04,),
            "active_constraints": (None, True),
        },
        "table_3_2_iiwa",
        ("sac", "tqc"),
        (
            _HARDER,
            ("distances of equation 3.7 are weighted: 0.2 m count as much as the whole tilt (thesis: no weights)",
             _where("reward", "shaped")),
            ("inputs 1.7 times as fast as the template's (thesis: the template's)", lambda e: (
                e.get("reward"), e.get("guidance"), e.get("input_speed")) == ("sparse", "sct", None)),
            ("near is 0.07 m in equations 3.9 and 3.10 (thesis: 0.04 m)",
             _where("reward", "hand_shaped")),
            ("a template of our own after table 3.3, for these vessels (thesis: that of an earlier work)",
             _where("guidance", "sct")),
        ),
    ),
}  # fmt: skip

# A setting of the learner that the thesis has no word for, and what it does.
_ADDITIONS: tuple[tuple[str, Callable[[LearnerConfig], bool], str], ...] = (
    (
        "greedy_episode_fraction",
        lambda p: p.greedy_episode_fraction > 0,
        "{greedy_episode_fraction:.0%} of the episodes are greedy",
    ),
    ("symmetry", lambda p: bool(p.symmetry), "what was seen is also learned from as seen from other sides"),
    (
        "selection_window",
        lambda p: p.selection_window > 0,
        "the policy is one of the run's actors: checkpoint selection",
    ),
    ("pipelined", lambda p: p.pipelined, "acting knows what was learned an episode before"),
    ("actor_ema", lambda p: p.actor_ema > 0, "the policy is an average over actors"),
    ("layer_norm", lambda p: p.layer_norm, "hidden layers are normalized"),
    (
        "constant_episodes",
        lambda p: p.constant_episodes > 0,
        "the first {constant_episodes} episodes repeat one action each",
    ),
    ("ez_greedy", lambda p: p.ez_greedy > 0, "exploring takes temporally extended actions (εz-greedy)"),
    (
        "demonstration_episodes",
        lambda p: p.demonstration_episodes > 0,
        "a rule written by hand acts in the first {demonstration_episodes} episodes, which are learned from",
    ),
    ("n_steps", lambda p: p.n_steps > 1, "returns are of {n_steps} decisions"),
)
_COMPARED = ("learning_rate", "tau", "train_freq", "gradient_steps", "ent_coef", "net_arch", "buffer_size")
# What only one of its tables says.
_TABLE_3_2_ONLY = ("learning_starts", "batch_size")


def differences(config: RunConfig, *, learns: bool = True) -> list[str]:
    """What a run differs in from the thesis, in words; that there is no such task in it, if there is none.

    Args:
        config: of the run.
        learns: whether somebody learns in it; otherwise the learner's settings say nothing.
    """
    setting = THESIS.get(config.task)
    if setting is None:
        return [f"it has no task {config.task}"]
    environment, found = config.environment, []
    for name, values in setting.options.items():
        if name not in environment or not _says(name, environment):
            continue
        if not any(_same(environment[name], value) for value in values):
            found.append(f"{_words(name)} {_value(environment[name])} (thesis: {_either(values)})")
    if learns:
        sided = replace(config.learner, symmetry=config.learner.symmetry if _has_sides(config) else False)
        found += _learner_differences(replace(config, learner=sided), setting)
    found += _unlike_defaults(config, setting)
    chamfer = environment.get("mouth_chamfer", BncDimensions().mouth_chamfer)
    known = {"action_scale": 1.0, "mouth_chamfer_mm": chamfer / MM, **environment}
    found += [words.format(**known) for words, holds in setting.remarks if holds(environment)]
    return found


def _says(name: str, environment: Mapping[str, Any]) -> bool:
    """Whether the thesis says something of an option with the guidance that there is."""
    guidance = environment.get("guidance")
    return guidance == "skgrl" if name in HISTORY else guidance == "sct" or name != "active_constraints"


def _unlike_defaults(config: RunConfig, setting: Setting) -> list[str]:
    """The options of which the thesis says nothing and that are not what the task's difficulty stands for."""
    from guiderail.tools.environments import (
        beyond_defaults,
        check_environment,
    )  # Drake takes a second

    task, environment = config.task, config.environment
    chosen: dict[str, Any] = {
        key: environment[key] for key in ("guidance", "station", "difficulty") if key in environment
    }
    usual = check_environment(task, chosen) | {"station": check_environment(task, {})["station"]}
    found = []
    for name, value in beyond_defaults(task, environment).items():
        compared = name in setting.options and _says(name, environment)
        if compared or name in (*NEUTRAL, *_TOLD, *HISTORY):
            continue
        default = f" (default: {_value(usual[name], 'unset')})" if name in usual else ""
        found.append(f"{_words(name)} {_value(value, 'unset')}{default}")
    return found


def _has_sides(config: RunConfig) -> bool:
    """Whether the task has a symmetry that holds for the guidance's actions."""
    from guiderail.diagrams.tasks.task import Task  # Drake takes a second

    guidance = config.environment.get("guidance")
    displaces = guidance in GUIDANCE.names() and GUIDANCE.get(guidance).displaces
    return displaces and TASKS.get(config.task).symmetry is not Task.symmetry


def _learner_differences(config: RunConfig, setting: Setting) -> list[str]:
    learner, table, found = config.learner, PRESETS[setting.preset], []
    if learner.algorithm not in setting.algorithms:
        algorithms = " or ".join(algorithm.upper() for algorithm in setting.algorithms)
        found.append(f"{learner.algorithm.upper()} (thesis: {algorithms})")
    printed = _COMPARED + (_TABLE_3_2_ONLY if setting.preset.startswith("table_3_2") else ())
    ours, theirs = asdict(learner), asdict(table)
    for name in printed:
        if not _same(ours[name], theirs[name]):
            found.append(f"{_words(name)} {_value(ours[name])} (thesis: {_value(theirs[name])})")
    (its_hold,) = setting.options["action_repeat"]
    per_step = [
        action_gamma(one, action_repeat) ** (1 / action_repeat)
        for one, action_repeat in ((learner, config.action_repeat), (table, its_hold))
    ]
    if not math.isclose(*per_step, rel_tol=1e-9):
        found.append(f"discount of a control step {per_step[0]:.4g} (thesis: {per_step[1]:.4g})")
    return found + [words.format(**ours) for _, holds, words in _ADDITIONS if holds(learner)]


def _either(values: tuple[Any, ...]) -> str:
    """Alternatives in words; of several, none is no word."""
    told = [value for value in values if value is not None] if len(values) > 1 else values
    return " or ".join(map(_value, told))


def _same(ours: Any, theirs: Any) -> bool:
    if isinstance(ours, list | tuple) or isinstance(theirs, list | tuple):
        return list(ours or ()) == list(theirs or ())
    return bool(ours == theirs)


_NAMES = {
    "action_repeat": "control steps of a decision",
    "action_dims": "explored outputs",
    "history": "P =",
    "history_variance": "ρ =",
    "history_source": "history of poses that were",
    "adaptive_history": "history that shrinks in contact:",
    "horizon": "H =",
    "lambda_": "λ =",
    "beta": "β =",
    "net_arch": "hidden units",
    "train_freq": "decisions between trainings",
}


def _words(name: str) -> str:
    return _NAMES.get(name, name.replace("_", " "))


def _value(value: Any, none: str = "all") -> str:
    if value is None:
        return none
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return ", ".join(map(_value, value)) or "none"
    return f"{value:g}" if isinstance(value, float | int) else str(value)
