"""`assembly-v3` of metaworld: a ring with a handle is put over a peg at an unknown offset."""

from typing import Any

import numpy as np
from metaworld.envs.sawyer_assembly_peg_v3 import SawyerNutAssemblyEnvV3
from metaworld.policies.sawyer_assembly_v3_policy import SawyerAssemblyV3Policy

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
from research.outside_envs.task import OutsideTask, Part, Recording, num_steps

OFFSETS = (0.02, 0.04)  # smallest and largest distance of the assumed peg from the true peg in y, on either side [m]
PARTS = {
    "reach": Part(30, "object_start", OPEN),
    "grasp": Part(28, "object_start", close_at_end, dwell=22),
    "lift": Part(30, "object_start", CLOSED),
    "place": Part(40, "assumed_goal", CLOSED, dwell=30),
}
LENGTH = num_steps(PARTS)


class HiddenPeg(HiddenGoal):
    """Environment with metaworld's criterion of success."""

    def __init__(self, seed: int = 0, length: int = LENGTH):
        super().__init__(SawyerNutAssemblyEnvV3(), seed, length, OFFSETS, 0.0, "peg", 10.0)

    def has_succeeded(self, info: dict[str, Any]) -> bool:
        """Return True if the ring is around the peg."""
        return bool(info["success"])

    def observe(self) -> np.ndarray:
        """Return the observation (15,)."""
        hand, ring = self.raw[:3], self.raw[4:7]
        command = self.unwrapped.data.mocap_pos[0]
        parts = [
            5 * (hand - self.assumed_goal), 10 * (ring - hand), 10 * (ring - self.assumed_goal), [self.raw[3]],
            20 * (command - hand), 5 * (self.object_start - hand)[:2],
        ]  # fmt: skip
        return np.concatenate(parts).astype(np.float32)


def _signal(env: HiddenPeg) -> tuple[bool, bool, bool]:
    """Return three flags: the hand is above the handle; it is there and closing; the ring is lifted."""
    raw = env.raw
    near = bool(np.linalg.norm(raw[:2] - (raw[4:7] + [-0.02, 0.0, 0.0])[:2]) <= 0.02)
    return near, near and raw[3] < 0.5, bool(raw[6] > 0.15)


def record_assembly(count: int, seed: int) -> list[Recording]:
    """Return recordings of metaworld's scripted policy."""
    env, policy = HiddenPeg(seed, 300), SawyerAssemblyV3Policy()
    return record(env, policy, _signal, lambda env: env.is_success, 200, count, seed)


TASK = OutsideTask(
    parts=PARTS,
    outputs=("x [m]", "y [m]", "z [m]"),
    period=PERIOD,
    make_env=HiddenPeg,
    record=record_assembly,
    pose=pose,
    to_action=to_action,
    scripted=scripted(SawyerAssemblyV3Policy()),
)
