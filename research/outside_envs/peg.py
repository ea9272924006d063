"""`peg-insert-side-v3` of metaworld, with a hole at an unknown offset."""

from typing import Any

import numpy as np
from metaworld.envs.sawyer_peg_insertion_side_v3 import SawyerPegInsertionSideEnvV3
from metaworld.policies.sawyer_peg_insertion_side_v3_policy import SawyerPegInsertionSideV3Policy

from research.outside_envs.sawyer import (
    CLOSED,
    OPEN,
    PERIOD,
    HiddenGoal,
    close_at_end,
    pose,
    record,
    scripted,
    to_action,
)
from research.outside_envs.task import LearnerSettings, OutsideTask, Part, Recording, num_steps

OFFSETS = (0.025, 0.05)  # smallest and largest distance of the assumed hole from the true hole in y [m]
HEIGHT_OFFSET = 0.015  # largest distance of the assumed hole from the true hole in z [m]
MAX_LAG = 0.035  # lag of the hand that ends the first two attempts, because the peg is pressed on the box [m]
OUTSIDE = 0.7  # fraction of an insertion after which the peg enters the hole
MIN_HEIGHT = 0.045  # smallest commanded height of the hand above the table, for the highest assumed hole [m]


def is_blocked(env: Any, observation: Any) -> bool:
    """Return True if the hand lags more than `MAX_LAG` behind its command along the hole's axis."""
    return bool(env.unwrapped.data.mocap_pos[0][0] - env.raw[0] < -MAX_LAG)


# `MIN_HEIGHT` in each frame. The assumed hole is at most 0.13 m + `HEIGHT_OFFSET` above the table. If the assumed hole
# is lower, the smallest height above the table is lower, too.
_FLOORS = {"object_start": MIN_HEIGHT, "assumed_goal": MIN_HEIGHT - 0.13 - HEIGHT_OFFSET}
LOWER = {name: np.array([-np.inf, -np.inf, height]) for name, height in _FLOORS.items()}
# A retraction that began at the end of the insertion would first push the blocked peg 1 cm further through the hand.
_RETRACT = Part(
    24, "assumed_goal", CLOSED, source="insert", until_fraction=OUTSIDE, is_reversed=True, lower=LOWER["assumed_goal"]
)
PARTS = {
    "reach": Part(30, "object_start", OPEN, lower=LOWER["object_start"]),
    "grasp": Part(28, "object_start", close_at_end, dwell=22, lower=LOWER["object_start"]),
    "carry": Part(34, "assumed_goal", CLOSED, lower=LOWER["assumed_goal"]),
    "insert": Part(40, "assumed_goal", CLOSED, dwell=10, lower=LOWER["assumed_goal"], until=is_blocked),
    # Two more attempts: retract along the insertion and insert again, with the demonstrations of the first insertion.
    "retract": _RETRACT,
    "insert 2": Part(
        40, "assumed_goal", CLOSED, dwell=10, source="insert", lower=LOWER["assumed_goal"], until=is_blocked
    ),
    "retract 2": _RETRACT,
    "insert 3": Part(40, "assumed_goal", CLOSED, dwell=40, source="insert", lower=LOWER["assumed_goal"]),
}
LENGTH = num_steps(PARTS)


class _Env(SawyerPegInsertionSideEnvV3):
    """Environment with zeros for the peg's quaternion, which is unused here and takes a fifth of a step's time."""

    def _get_quat_objects(self) -> np.ndarray:
        return np.zeros(4)


class HiddenHole(HiddenGoal):
    """Environment in which a success requires a peg 5 cm deep in the hole.

    Metaworld's criterion, at most 7 cm from the goal, is already satisfied at the hole's mouth.
    """

    def __init__(self, seed: int = 0, length: int = LENGTH):
        super().__init__(_Env(), seed, length, OFFSETS, HEIGHT_OFFSET, "box", 5.0, is_blocked)

    def has_succeeded(self, info: dict[str, Any]) -> bool:
        """Return True if the peg is at least 5 cm deep in the hole."""
        depth, y, z = self.head()
        return bool(depth < 0.015 and max(abs(y), abs(z)) < 0.03)

    def head(self) -> np.ndarray:
        """Return the position of the peg's head (3,) relative to a point 6.6 cm inside the true hole [m]."""
        return self.unwrapped._get_site_pos("pegHead") - self.unwrapped._target_pos

    def observe(self) -> np.ndarray:
        """Return the observation (22,)."""
        env = self.unwrapped
        hand, peg, head = self.raw[:3], self.raw[4:7], env._get_site_pos("pegHead")
        axis = env.data.site("pegHead").xmat.reshape(3, 3)[:, 0]
        parts = [
            5 * (hand - self.assumed_goal), 10 * (head - self.assumed_goal), 10 * (peg - hand), 5 * axis[1:],
            [self.raw[3]], 20 * (env.data.mocap_pos[0] - hand), 5 * (self.object_start - hand)[:2], [axis[0]],
            [hand[2]], self.last_blocked,
        ]  # fmt: skip
        return np.concatenate(parts).astype(np.float32)


def _signal(env: HiddenHole) -> tuple[bool, bool, bool]:
    """Return three flags: the hand is near the peg; it is near, low and closing; the peg is aligned with the hole."""
    raw = env.raw
    near = bool(np.linalg.norm(raw[:2] - raw[4:6]) <= 0.04)
    aligned = bool(np.linalg.norm((raw[4:7] - [0, env.unwrapped._target_pos[1], 0.16])[1:]) <= 0.03)
    return near, near and abs(raw[2] - raw[6]) <= 0.025 and raw[3] < 0.4, aligned


def record_peg(count: int, seed: int) -> list[Recording]:
    """Return recordings of metaworld's scripted policy.

    They end deeper in the hole than a success requires, because the position of the grasp on the peg varies by 1 cm.
    """
    policy = SawyerPegInsertionSideV3Policy()
    return record(HiddenHole(seed, 250), policy, _signal, lambda env: env.head()[0] < -0.01, 130, count, seed)


TASK = OutsideTask(
    parts=PARTS,
    outputs=("x [m]", "y [m]", "z [m]"),
    period=PERIOD,
    make_env=HiddenHole,
    record=record_peg,
    pose=pose,
    to_action=to_action,
    scripted=scripted(SawyerPegInsertionSideV3Policy()),
    # Grasp along the peg, last blocked position, phase. With all 26 entries, the policy would depend on irrelevant
    # entries, such as the peg's first position.
    observed=(6, 19, 20, 21, 22),
    action_dims=(1, 2),
    decisions=("retract", "retract 2"),  # one action per attempt
    settings=LearnerSettings(60, 20, 3, 0.97, (-1.0, -4.0)),
    schedule={
        "reach": np.array([-0.6, 0.3]),
        "retract": np.array([0.5, 0.3]),
        "retract 2": np.array([0.9, 0.3]),
    },
)
