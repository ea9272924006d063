"""How an episode of pouring ends."""

from __future__ import annotations

import numpy as np

from guiderail.diagrams.stations.pouring import PouringConfig
from guiderail.systems.episode_monitor import Condition


def conditions(config: PouringConfig, needed: int) -> list[Condition]:
    """How an episode ends. A collision comes first: nothing that touched the mug on its way is a success.

    Args:
        config: of the scene.
        needed: how many balls have to be in the mug; when so many have fallen that this can't be, they are spilled.
    """
    mug, thermos, radius = config.mug, config.thermos, config.ball.diameter / 2
    fall = config.mug.height + config.stand_height

    def positions(balls: np.ndarray) -> np.ndarray:
        return balls.reshape(-1, 6)[:, :3]

    def poured(balls_in_mug: np.ndarray) -> bool:
        return sum(mug.contains(p_MB) for p_MB in positions(balls_in_mug)) >= needed

    def spilled(balls_in_mug: np.ndarray, balls_in_thermos: np.ndarray) -> bool:
        # A ball that is in neither of them and has fallen to the table, or past it.
        fallen = sum(
            p_MB[2] < radius - fall + 0.01 and not mug.contains(p_MB) and not thermos.contains(p_PB, 0.01)
            for p_MB, p_PB in zip(positions(balls_in_mug), positions(balls_in_thermos), strict=True)
        )
        return bool(fallen > config.num_balls - needed)

    balls = {"balls_in_mug": 6 * config.num_balls, "balls_in_thermos": 6 * config.num_balls}
    return [
        Condition("collision", {"touched": 1}, lambda touched: touched[0] > 0),
        # For a tenth of a second: a ball can bounce out again.
        Condition("success", {"balls_in_mug": 6 * config.num_balls}, poured, steps=10),
        Condition("spill", balls, spilled),
    ]
