"""The shared control template of pouring, for vessels of any size."""

from __future__ import annotations

from guiderail.diagrams.stations.pouring import PouringConfig
from guiderail.models.skills import Skill, load_skill

FULL_SPEED = 0.15  # [m/s] of a full input, along one axis
FULL_TILT = 0.8  # [rad/s]
# What is rewarded only once it is done is found only if random inputs sometimes do it.
SPARSE_INPUT_SPEED = 1.7


def make_skill(config: PouringConfig, input_speed: float = 1.0) -> Skill:
    """The pouring template for this scene's vessels; `input_speed` times as fast as it is meant."""
    return load_skill(
        "pouring",
        full_speed_m_per_s=input_speed * FULL_SPEED,
        full_tilt_rad_per_s=input_speed * FULL_TILT,
        mug_radius_m=config.mug.outer_radius,
        thermos_radius_m=config.thermos.outer_radius,
    )
