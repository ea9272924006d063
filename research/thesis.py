"""Differences between a run and the thesis.

`THESIS` has the settings that the thesis states, with their sections. For settings that the thesis omits, remarks
describe the choice of this project. Options that differ from this project's defaults are listed as well.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from guiderail.diagrams.envs.options import STANDARD
from guiderail.diagrams.guidance.registry import GUIDANCE
from guiderail.diagrams.tasks.registry import TASKS
from guiderail.models.common.transforms import MM
from guiderail.models.objects.bnc_connector import BncDimensions
from guiderail.tools.learning.learner_config import PRESETS, OffPolicyConfig, action_gamma
from guiderail.tools.learning.run_folder import RunConfig

HISTORY = ("history", "history.variance", "history.source", "history.adaptive")
NEUTRAL = {
    "guidance": "the method, which is named next to the differences",
    "kernel.parameters": "parameters of a kernel other than the thesis's",
    "driver": "the program that drives a robot",
    "robot_url": "the address of a robot's messages",
    "robot_timeout": "the time without messages after which the connection to a robot counts as lost",
}
"""Options that are never a difference, with the reason."""


@dataclass(frozen=True)
class Setting:
    """Settings of the thesis for a task.

    Attributes:
        section: Sections of the thesis that state the settings.
        options: Values of the environment's options; several values if the thesis has several.
        preset: Name of the preset with the thesis's table of the learner's settings.
        algorithms: Names of the learners.
        remarks: Pairs of a text and a predicate of the environment's options. If the predicate is true for a run, the
            text is a difference of the run. It is a format string of the environment's options.
        control_period: Time of the control steps that `action_repeat` counts [s], if the thesis states the rate of
            actions; None: those of the run.
    """

    section: str
    options: Mapping[str, tuple[Any, ...]]
    preset: str
    algorithms: tuple[str, ...]
    remarks: tuple[tuple[str, Callable[[Mapping[str, Any]], bool]], ...] = ()
    control_period: float | None = None

    def action_repeat(self, config: RunConfig) -> float:
        """Return the number of control steps of an action of a run."""
        period = config.environment.get("control_period")
        scale = 1.0 if period is None or self.control_period is None else period / self.control_period
        return round(config.action_repeat * scale, 9)


def _always(environment: Mapping[str, Any]) -> bool:
    return True


def _where(option: str, *values: Any) -> Callable[[Mapping[str, Any]], bool]:
    return lambda environment: environment.get(option) in values


_PRIMITIVE = {
    "action_repeat": (1,),  # algorithms 2 and 3: an action at every time step
    "action_dims": (None,),
    "history": (10,),
    "history.source": ("measured",),  # algorithm 3, line 18
    "history.adaptive": (False,),
    "horizon": (40,),
    "lambda_": (6.0,),
    "beta": (6.0,),
    "kernel": ("squared_exponential",),  # section 4.3.3, "the same kernel in all our experiments"
    "length_scale": (0.5,),  # the thesis's l = 2 is 1 / (2 ℓ²)
}
_IN_REMARKS = ("action_scale", "mouth_chamfer", "difficulty")  # options whose values are in the remarks
_SCALE = (
    "actions of ±1 are κ = {action_scale:g} standard deviations of the demonstrations (thesis: no scale given)",
    _always,
)
_SIMULATED = ("simulated (thesis: a real robot, the DLR SARA)", _always)
_HARDER = (
    "difficulty {difficulty!r}, added here: `guiderail list` has its numbers (thesis: one setting of each task)",
    lambda environment: environment.get("difficulty", STANDARD) != STANDARD,
)

THESIS = {
    "NarrowPassage": Setting(
        "4.4.1 and 5.4.1",
        {
            **_PRIMITIVE,
            "reward": ("sparse",),
            "observation": ("state", "image"),
            "history.variance": (1e-6,),
        },
        "table_4_1_simulation",
        ("tqc",),
        (
            _HARDER,
            ("own dimensions of passage, obstacle and goal (thesis: none given)", _always),
            ("nine demonstrations sampled by a program (thesis: from a person)", _always),
            _SCALE,
        ),
    ),
    "BncConnector": Setting(
        "4.4.2 and 5.4.2",
        {
            **_PRIMITIVE,
            "reward": ("sparse",),
            "observation": ("state",),
            "history.variance": (1e-8,),
            "bound": (2.0 * MM,),  # equation 4.26
            "fixture_offset": ("per_run",),
            "station": ("arm",),
        },
        "table_4_1_robot",
        ("tqc",),
        (
            _HARDER,
            _SIMULATED,
            ("{number} of a scripted motion (thesis: from a person)", _always),
            (
                "a plug with a lead-in chamfer of {mouth_chamfer_mm:g} mm (thesis: no dimensions given)",
                _always,
            ),
            ("force cost in units of 10 N and 0.5 Nm (thesis: none given)", _always),
            _SCALE,
        ),
    ),
    "GridClamp": Setting(
        "3.4.2",
        # 9820 time steps in 17 minutes: ten actions per second.
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
            ("a template that is slower upwards than downwards (thesis: no speeds given)",
             _where("guidance", "sct")),
        ),
        control_period=0.02,
    ),
    "Pouring": Setting(
        "3.4.1",
        # 9700 time steps in 16 minutes: ten actions per second.
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
            ("weights in equation 3.7: 0.2 m counts as much as the whole tilt (thesis: no weights)",
             _where("reward", "shaped")),
            ("inputs 1.7 times as fast as the template's (thesis: as fast)", lambda e: (
                e.get("reward"), e.get("guidance"), e.get("input_speed")) == ("sparse", "sct", None)),
            ("near means 0.07 m in equations 3.9 and 3.10 (thesis: 0.04 m)",
             _where("reward", "hand_shaped")),
            ("own template after table 3.3, for these vessels (thesis: the template of an earlier work)",
             _where("guidance", "sct")),
        ),
        control_period=0.01,
    ),
}  # fmt: skip

# Settings of the learner that the thesis does not have: name, predicate that is true if it is used, description.
_ADDITIONS: tuple[tuple[str, Callable[[OffPolicyConfig], bool], str], ...] = (
    (
        "greedy_episode_fraction",
        lambda p: p.greedy_episode_fraction > 0,
        "{greedy_episode_fraction:.0%} of the episodes are greedy",
    ),
    ("symmetry", lambda p: bool(p.symmetry), "symmetry data augmentation"),
    (
        "selection_window",
        lambda p: p.selection_window > 0,
        "checkpoint selection among the run's actors",
    ),
    ("num_envs", lambda p: p.num_envs > 0, "the acting policy is {num_envs} episodes older than the learned one"),
    ("actor_ema", lambda p: p.actor_ema > 0, "the policy is a moving average of actors"),
    ("layer_norm", lambda p: p.layer_norm, "layer normalization"),
    (
        "constant_episodes",
        lambda p: p.constant_episodes > 0 and not p.init_from,  # the episodes of the earlier run count as well
        "the first {constant_episodes} episodes repeat one action each",
    ),
    ("init_from", lambda p: bool(p.init_from), "learning continues from an earlier run"),
    ("ez_greedy", lambda p: p.ez_greedy > 0, "temporally extended exploration (εz-greedy)"),
    (
        "demonstration_episodes",
        lambda p: p.demonstration_episodes > 0,
        "the first {demonstration_episodes} episodes are demonstrations of a scripted policy",
    ),
    (
        "base_motion_steps",
        lambda p: p.base_motion_steps > 0,
        "actions other than zero become certain over {base_motion_steps} transitions",
    ),
)
_COMPARED = ("learning_rate", "tau", "train_freq", "gradient_steps", "ent_coef", "net_arch", "buffer_size")
# Settings that only table 3.2 has.
_TABLE_3_2_ONLY = ("learning_starts", "batch_size")


def describe_differences(config: RunConfig, *, learns: bool = True) -> list[str]:
    """Return the differences between a run and the thesis, one sentence fragment each.

    For a task that is not in the thesis, the only entry states this.

    Args:
        config: Configuration of the run.
        learns: True if the run trains a policy; otherwise the learner's settings are not compared.
    """
    setting = THESIS.get(config.task)
    if setting is None:
        return [f"it has no task {config.task}"]
    environment, differences = config.environment, []
    for name, values in setting.options.items():
        if name not in environment or not _is_given(name, environment):
            continue
        ours = setting.action_repeat(config) if name == "action_repeat" else environment[name]
        if not any(_is_same(ours, value) for value in values):
            differences.append(f"{_words(name)} {_format(ours)} (thesis: {_format_any(values)})")
    if learns:
        symmetry = config.learner.symmetry if _has_symmetry(config) else False
        differences += _learner_differences(
            replace(config, learner=replace(config.learner, symmetry=symmetry)), setting
        )
    differences += _non_defaults(config, setting)
    chamfer = environment.get("mouth_chamfer", BncDimensions().mouth_chamfer)
    number = "one demonstration" if environment.get("num_demonstrations") == 1 else "five demonstrations"
    remarked = {"action_scale": 1.0, "mouth_chamfer_mm": chamfer / MM, "number": number, **environment}
    return differences + [text.format(**remarked) for text, applies in setting.remarks if applies(environment)]


def _is_given(name: str, environment: Mapping[str, Any]) -> bool:
    """Return True if the thesis states a value of an option for the environment's guidance."""
    guidance = environment.get("guidance")
    return guidance == "skgrl" if name in HISTORY else guidance == "sct" or name != "active_constraints"


def _non_defaults(config: RunConfig, setting: Setting) -> list[str]:
    """Describe options that the thesis omits and that differ from the defaults of the task's difficulty."""
    from guiderail.tools.environments import beyond_defaults, check_environment  # imports Drake, which takes a second

    task, environment = config.task, config.environment
    chosen: dict[str, Any] = {
        key: environment[key] for key in ("guidance", "station", "difficulty") if key in environment
    }
    defaults = check_environment(task, chosen) | {"station": check_environment(task, {})["station"]}
    differences = []
    for name, value in beyond_defaults(task, environment).items():
        is_compared = name in setting.options and _is_given(name, environment)
        if is_compared or name in (*NEUTRAL, *_IN_REMARKS, *HISTORY):
            continue
        default = f" (default: {_format(defaults[name], 'unset')})" if name in defaults else ""
        differences.append(f"{_words(name)} {_format(value, 'unset')}{default}")
    return differences


def _has_symmetry(config: RunConfig) -> bool:
    """Return True if the task has a symmetry that holds for the guidance's actions."""
    from guiderail.diagrams.tasks.task import Task  # imports Drake, which takes a second

    guidance = config.environment.get("guidance")
    displaces = guidance in GUIDANCE.names() and GUIDANCE.get(guidance).displaces
    return displaces and TASKS.get(config.task).symmetries is not Task.symmetries


def _learner_differences(config: RunConfig, setting: Setting) -> list[str]:
    learner, table, differences = config.learner, PRESETS[setting.preset], []
    if learner.algorithm not in setting.algorithms:
        algorithms = " or ".join(algorithm.upper() for algorithm in setting.algorithms)
        differences.append(f"{learner.algorithm.upper()} (thesis: {algorithms})")
    if not isinstance(learner, OffPolicyConfig):
        return differences
    names = _COMPARED + (_TABLE_3_2_ONLY if setting.preset.startswith("table_3_2") else ())
    ours, theirs = asdict(learner), asdict(table)
    for name in names:
        if not _is_same(ours[name], theirs[name]):
            differences.append(f"{_words(name)} {_format(ours[name])} (thesis: {_format(theirs[name])})")
    (action_repeat_of_thesis,) = setting.options["action_repeat"]
    gammas = [
        action_gamma(settings, action_repeat) ** (1 / action_repeat)
        for settings, action_repeat in ((learner, setting.action_repeat(config)), (table, action_repeat_of_thesis))
    ]
    if not math.isclose(*gammas, rel_tol=1e-9):
        differences.append(f"gamma of a control step {gammas[0]:.4g} (thesis: {gammas[1]:.4g})")
    return differences + [text.format(**ours) for _, is_used, text in _ADDITIONS if is_used(learner)]


def _is_same(ours: Any, theirs: Any) -> bool:
    if isinstance(ours, list | tuple) or isinstance(theirs, list | tuple):
        return list(ours or ()) == list(theirs or ())
    return bool(ours == theirs)


_NAMES = {
    "action_repeat": "control steps of an action",
    "action_dims": "action dims",
    "history": "P =",
    "history.variance": "ρ =",
    "history.source": "history of poses:",
    "history.adaptive": "adaptive history:",
    "horizon": "H =",
    "lambda_": "λ =",
    "beta": "β =",
    "net_arch": "hidden units",
    "train_freq": "actions between trainings",
}


def _words(name: str) -> str:
    return _NAMES.get(name, name.rpartition(".")[2].replace("_", " "))


def _format(value: Any, none: str = "all") -> str:
    if value is None:
        return none
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return ", ".join(map(_format, value)) or "none"
    return f"{value:g}" if isinstance(value, float | int) else str(value)


def _format_any(values: tuple[Any, ...]) -> str:
    """Format alternatives; among several, None is left out."""
    named = [value for value in values if value is not None] if len(values) > 1 else values
    return " or ".join(map(_format, named))


if __name__ == "__main__":
    from research.command import run_program
    from research.reproduction.command import main

    run_program(main)
