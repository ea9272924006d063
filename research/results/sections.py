"""Methods and baseline policies of every task, and the studies that have their results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

BASELINES = ("demonstration alone", "uniform random actions", "best constant action", "scripted policy")
NO_DEMONSTRATION = ("zero action", *BASELINES[1:])  # a template has no demonstration


@dataclass(frozen=True)
class Row:
    """A method of a study.

    Attributes:
        name: Name in the table.
        study: Study that has its results.
        method: Name of the method in the study.
        eval_set: Evaluation set, if the study has several.
    """

    name: str
    study: str
    method: str
    eval_set: str | None = None


@dataclass(frozen=True)
class Section:
    """Methods that were trained and evaluated under the same conditions.

    Attributes:
        title: Title of the table.
        rows: Methods, guided ones first.
        guided: Names of the guided methods in the table of hard tasks; empty if it omits the section.
        is_brief: True if the table has success, stops and violations only; the others are in the tables of the studies.
    """

    title: str
    rows: Sequence[Row]
    guided: Sequence[str] = ()
    is_brief: bool = False


def _baselines(
    study: str, methods: Sequence[str], eval_set: str | None = None, names: Sequence[str] = BASELINES
) -> list[Row]:
    return [Row(name, study, method, eval_set) for name, method in zip(names, methods, strict=True)]


def _guided_and_residual(study: str) -> list[Row]:
    names = {
        "KGRL": "kgrl", "sKGRL, adaptive history": "skgrl_adaptive", "residual RL": "residual",
        "safe residual RL": "safe_residual",
    }  # fmt: skip
    return [Row(name, study, method) for name, method in names.items()]


# Methods of the baseline policies in most studies, in the order of `BASELINES`.
_ALL = ("demonstration", "uniform_random", "best_constant", "scripted")
_ALL_ZERO = ("zero", "uniform_random", "best_constant", "scripted")
_NOT_CONSTANT = ("demonstration", "uniform_random", "scripted")
_NAMES_NOT_CONSTANT = (*BASELINES[:2], BASELINES[3])

# Studies that the pages only name: they repeat a method of a table, or a comparison in an earlier contact.
ONLY_NAMED = (
    "connector_disc_transfer", "connector_guidance", "connector_hard_fine_transfer", "connector_learners",
    "grid_clamp_guidance",
)  # fmt: skip

SECTIONS: dict[str, list[Section]] = {
    "BncConnector": [
        Section(
            "Connector, hard, converged contact",
            [
                *_guided_and_residual("connector_hard_converged"),
                *_baselines("connector_hard_converged", _NOT_CONSTANT, names=_NAMES_NOT_CONSTANT),
            ],
            guided=("KGRL", "sKGRL, adaptive history"),
        ),
        Section(
            "Connector, hard, on an iiwa with a robot's sensors, contact at 10 ms",
            [
                Row("KGRL", "connector_robot_sensing", "kgrl"),
                Row("KGRL, 80 episodes, then 60 with finer contact", "connector_robot_sensing_fine", "kgrl", "fresh"),
                Row(
                    "KGRL, 80 episodes, then 60 with finer contact, in MuJoCo",
                    "connector_robot_sensing_fine",
                    "kgrl",
                    "MuJoCo",
                ),
                Row("KGRL, light push", "connector_robot_sensing", "light_push"),
                Row("KGRL, critic without privileged observation", "connector_robot_sensing", "own_observation"),
                Row("residual RL", "connector_robot_sensing", "residual"),
                Row("residual RL, force not bounded", "connector_robot_sensing", "residual_unbounded"),
                *_baselines("connector_robot_sensing_baselines", _NOT_CONSTANT, names=_NAMES_NOT_CONSTANT),
            ],
            guided=("KGRL",),
            is_brief=True,
        ),
        Section(
            "Connector, hard, contact at 10 ms",
            [
                *_guided_and_residual("peers_connector_hard"),
                Row("residual RL, covariance without constraints", "peers_connector_hard", "residual_covariance"),
                Row("residual RL, control barrier function", "peers_connector_hard", "residual_cbf"),
                Row("residual RL, tangent space", "peers_connector_hard", "residual_tangent"),
                Row("Policy Decorator", "peers_connector_hard", "policy_decorator"),
                Row("CrossQ", "peers_connector_hard", "crossq"),
                Row("behavior cloning", "peers_connector_hard", "bc"),
                Row("RLPD", "peers_connector_hard", "rlpd"),
                Row("DroQ", "peers_connector_hard", "droq"),
                *_baselines("peers_connector_hard", _NOT_CONSTANT, names=_NAMES_NOT_CONSTANT),
            ],
            guided=("KGRL", "sKGRL, adaptive history"),
            is_brief=True,
        ),
        Section(
            "Connector, hard, force not bounded (40 N per axis)",
            [
                Row("KGRL", "connector_hard", "kgrl"),
                Row("sKGRL, adaptive history", "connector_hard", "skgrl_adaptive"),
                Row("sKGRL", "connector_hard", "skgrl"),
                Row("residual RL", "connector_hard", "residual"),
                Row("safe residual RL", "connector_hard", "safe_residual"),
                Row("residual RL with a larger action scale", "connector_hard", "residual_far"),
                *_baselines("connector_hard_baselines", _ALL),
            ],
            is_brief=True,
        ),
        Section(
            "Connector, hard, from one demonstration",
            [
                Row("KGRL", "connector_hard_one_demonstration", "kgrl"),
                *_baselines("connector_hard_one_demonstration", ("demonstration",), names=BASELINES[:1]),
            ],
            is_brief=True,
        ),
        Section(
            "Connector, hard, on a base policy",
            [
                Row("KGRL on the base policy", "connector_hard_base_policy", "kgrl"),
                Row("Policy Decorator", "connector_hard_base_policy", "policy_decorator"),
                Row("base policy alone", "connector_hard_base_policy", "base"),
            ],
            is_brief=True,
        ),
        Section(
            "Connector, hard, commands within 2.8 mm",
            [
                *_guided_and_residual("connector_hard_safety"),
                *_baselines("connector_hard_safety", _NOT_CONSTANT, names=_NAMES_NOT_CONSTANT),
            ],
            is_brief=True,
        ),
        Section(
            "Connector, one unobserved offset per training run",
            [
                Row("KGRL", "connector", "kgrl"),
                Row("sKGRL", "connector", "skgrl"),
                Row("residual RL", "connector_guidance", "residual"),
                *_baselines("connector_baselines", _ALL, "per_run"),
            ],
            guided=("KGRL", "sKGRL"),
            is_brief=True,
        ),
        Section(
            "Connector, another unobserved offset in every episode",
            [
                Row("KGRL", "connector_disc", "kgrl"),
                Row("sKGRL", "connector_disc", "skgrl"),
                *_baselines("connector_baselines", _ALL, "per_episode"),
            ],
            is_brief=True,
        ),
        Section(
            "Connector, with every setting of the thesis",
            [
                Row("KGRL", "connector_thesis", "kgrl"),
                Row("sKGRL", "connector_thesis", "skgrl"),
                *_baselines("connector_thesis", _ALL[:2], names=BASELINES[:2]),
            ],
            is_brief=True,
        ),
    ],
    "GridClamp": [
        Section(
            "Grid clamp, hard",
            [
                Row("RL-SCT, 3 demonstration episodes", "grid_clamp_hard_3s", "sct"),
                Row("RL-SCT", "grid_clamp_hard_3s", "sct_alone"),
                Row("residual RL", "grid_clamp_hard_3s", "residual"),
                Row("straight down", "grid_clamp_hard_3s", "straight"),
                Row("random residual actions", "grid_clamp_hard_3s", "uniform_random_residual"),
                *_baselines(
                    "grid_clamp_hard_3s", ("zero", *_NOT_CONSTANT[1:]), names=("zero action", *_NAMES_NOT_CONSTANT[1:])
                ),
            ],
            guided=("RL-SCT, 3 demonstration episodes",),
        ),
        Section(
            "Grid clamp, hard, 6 s, on an iiwa with a robot's sensors",
            [
                Row("RL-SCT, 3 demonstration episodes", "grid_clamp_robot_sensing", "sct"),
                Row("RL-SCT", "grid_clamp_robot_sensing", "sct_not_shown"),
                Row("residual RL", "grid_clamp_robot_sensing", "residual"),
                Row("residual RL, force not bounded", "grid_clamp_robot_sensing", "residual_unbounded"),
                Row("straight down", "grid_clamp_robot_sensing", "straight"),
                *_baselines("grid_clamp_robot_sensing", _NOT_CONSTANT[1:], names=_NAMES_NOT_CONSTANT[1:]),
            ],
            guided=("RL-SCT, 3 demonstration episodes",),
        ),
        Section(
            "Grid clamp, hard, 6 s",
            [
                Row("RL-SCT, 3 demonstration episodes", "peers_grid_clamp_hard", "sct"),
                Row("RL-SCT", "peers_grid_clamp_hard", "sct_alone"),
                Row("RL-SCT by CrossQ", "peers_grid_clamp_hard", "sct_crossq"),
                Row("RL-SCT by behavior cloning", "peers_grid_clamp_hard", "sct_bc"),
                Row("RL-SCT by RLPD", "peers_grid_clamp_hard", "sct_rlpd"),
                Row("RL-SCT by DroQ", "peers_grid_clamp_hard", "sct_droq"),
                Row("residual RL", "peers_grid_clamp_hard", "residual"),
                Row("CrossQ", "peers_grid_clamp_hard", "crossq"),
                Row("Policy Decorator", "peers_grid_clamp_hard", "policy_decorator"),
                Row("DroQ", "peers_grid_clamp_hard", "droq"),
                Row("RL of 6D velocities", "peers_grid_clamp_hard", "none"),
                Row("CrossQ of 6D velocities", "peers_grid_clamp_hard", "none_crossq"),
                *_baselines("grid_clamp_hard_baselines", _ALL_ZERO, names=NO_DEMONSTRATION),
            ],
            guided=("RL-SCT",),
        ),
        Section(
            "Grid clamp, hard, 6 s, force not bounded",
            [
                Row("RL-SCT, 3 demonstration episodes", "peers_grid_clamp_hard_unbounded", "sct"),
                Row("RL-SCT", "peers_grid_clamp_hard_unbounded", "sct_alone"),
                Row("residual RL", "peers_grid_clamp_hard_unbounded", "residual"),
                Row("residual RL, 400 episodes", "peers_grid_clamp_hard_unbounded", "residual_400"),
                Row("CrossQ", "peers_grid_clamp_hard_unbounded", "crossq"),
                Row("Policy Decorator", "peers_grid_clamp_hard_unbounded", "policy_decorator"),
                Row("Policy Decorator, 400 episodes", "peers_grid_clamp_hard_unbounded", "policy_decorator_400"),
                Row("DroQ", "peers_grid_clamp_hard_unbounded", "droq"),
                Row("RL of 6D velocities", "peers_grid_clamp_hard_unbounded", "none"),
                Row("straight down", "peers_grid_clamp_hard_unbounded", "straight"),
                *_baselines("peers_grid_clamp_hard_unbounded", _NOT_CONSTANT[1:], names=_NAMES_NOT_CONSTANT[1:]),
            ],
            guided=("RL-SCT, 3 demonstration episodes",),
        ),
        Section(
            "Grid clamp",
            [
                Row("RL-SCT", "grid_clamp", "sct"),
                Row("residual RL", "grid_clamp_guidance", "residual"),
                Row("RL of 6D velocities", "grid_clamp_guidance", "none"),
                *_baselines("grid_clamp_baselines", _ALL_ZERO, names=NO_DEMONSTRATION),
            ],
            guided=("RL-SCT",),
            is_brief=True,
        ),
    ],
    "Pouring": [
        Section(
            "Pouring, hard",
            [
                Row("RL-SCT", "pouring_hard_shield", "rl_sct"),
                Row("RL-SCT without the shield", "pouring_hard", "rl_sct_longer"),
                Row("RL-SCT without the shield, 100 episodes", "pouring_hard", "rl_sct"),
                Row("RL, reward shaped by hand", "pouring_hard", "rl"),
                *_baselines("pouring_hard_shield", _ALL_ZERO, names=NO_DEMONSTRATION),
            ],
            guided=("RL-SCT",),
        ),
        Section(
            "Pouring",
            [
                Row("RL-SCT, shaped reward", "pouring_sac", "rl_sct_shaped"),
                Row("RL-SCT, sparse reward", "pouring_sac", "rl_sct_sparse"),
                Row("RL, reward shaped by hand", "pouring_sac", "rl_shaped"),
                *_baselines("pouring_baselines", (*_ALL_ZERO[:3], "scripted_pour"), names=NO_DEMONSTRATION),
            ],
            guided=("RL-SCT, shaped reward",),
            is_brief=True,
        ),
    ],
    "NarrowPassage": [
        Section(
            "Narrow passage, hard",
            [
                Row("KGRL", "peers_narrow_passage_hard", "kgrl"),
                Row("sKGRL", "peers_narrow_passage_hard", "skgrl"),
                Row("residual RL", "peers_narrow_passage_hard", "residual"),
                Row("safe residual RL", "peers_narrow_passage_hard", "safe_residual"),
                Row("residual RL, covariance without constraints", "peers_narrow_passage_hard", "residual_covariance"),
                Row("residual RL, control barrier function", "peers_narrow_passage_hard", "residual_cbf"),
                Row("residual RL, tangent space", "peers_narrow_passage_hard", "residual_tangent"),
                Row("Policy Decorator", "peers_narrow_passage_hard", "policy_decorator"),
                Row("CrossQ", "peers_narrow_passage_hard", "crossq"),
                Row("RLPD", "peers_narrow_passage_hard", "rlpd"),
                Row("DroQ", "peers_narrow_passage_hard", "droq"),
                *_baselines("narrow_passage_hard_baselines", [f"skgrl_{name}" for name in _ALL]),
            ],
            guided=("sKGRL", "KGRL"),
        ),
        Section(
            "Narrow passage",
            [
                Row("KGRL", "narrow_passage", "kgrl"),
                Row("residual RL", "narrow_passage", "residual"),
                Row("safe residual RL", "narrow_passage", "safe_residual"),
                *_baselines("narrow_passage_baselines", _ALL[:3], names=BASELINES[:3]),
            ],
            guided=("KGRL",),
            is_brief=True,
        ),
    ],
}
