"""The shared control templates of pouring, for vessels of any size."""

from __future__ import annotations

from pydrake.math import RigidTransform

from guiderail.diagrams.stations.pouring import PouringConfig
from guiderail.models.skills import Skill, load_skill

FULL_SPEED = 0.15  # [m/s] of a full input, along one axis
FULL_TILT = 0.8  # [rad/s]
# What is rewarded only once it is done is found only if random inputs sometimes do it.
SPARSE_INPUT_SPEED = 1.7


def make_skill(config: PouringConfig, input_speed: float = 1.0) -> Skill:
    """The pouring template for this scene's vessels; `input_speed` times as fast as it is meant."""
    return _load("pouring", config, input_speed)


def make_aimed_skill(config: PouringConfig, input_speed: float, aim_speed: float, pour_speed: float) -> Skill:
    """The template whose Pour can be aimed; `aim_speed` and `pour_speed` are parts of the full speeds in Pour."""
    return _load("pouring_aimed", config, input_speed, aim_speed=aim_speed, pour_speed=pour_speed)


def _load(name: str, config: PouringConfig, input_speed: float, **others: float) -> Skill:
    return load_skill(
        name,
        full_speed_m_per_s=input_speed * FULL_SPEED,
        full_tilt_rad_per_s=input_speed * FULL_TILT,
        mug_radius_m=config.mug.outer_radius,
        thermos_radius_m=config.thermos.outer_radius,
        **others,
    )


def frames_of(skill: Skill, X_TMug: RigidTransform) -> dict[str, RigidTransform]:
    """The poses of a template's objects for a mug, or for where it is believed to be."""
    if "behind_mug" in skill.frames:
        return {"behind_mug": X_TMug @ RigidTransform([0.0, skill.parameters["behind_m"], 0.0])}
    return {"mug_tip": X_TMug}
