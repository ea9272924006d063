"""`assembly-v3` of metaworld: a ring with a handle is put over a peg."""

import warnings
from typing import Any

import gymnasium
import numpy as np
from metaworld.envs.sawyer_assembly_peg_v3 import SawyerNutAssemblyEnvV3
from metaworld.policies.sawyer_assembly_v3_policy import SawyerAssemblyV3Policy

from guiderail import Demonstrations, Frame, GuidedEnv, LinearConstraints, Segment, cut_demonstrations, find_events
from guiderail.models.primitives.bounds import compute_bounds
from research.outside_envs.peg import CLOSED, OPEN, PERIOD, RepeatedAction, pose, to_action

warnings.filterwarnings("ignore", message="Constant")
SEGMENTS = {"reach": (30, 0), "grasp": (28, 22), "lift": (30, 0), "place": (40, 30)}  # steps, and steps of dwell
LENGTH = sum(steps + dwell for steps, dwell in SEGMENTS.values())
MIN_OFFSET, MAX_OFFSET = 0.02, 0.04  # distance of the believed peg from the true one in y, on either side [m]


class HiddenPeg(gymnasium.Wrapper):
    """Environment whose observation has the believed position of the peg; the reward is metaworld's (privileged)."""

    def __init__(self, seed: int = 0, length: int = LENGTH):
        env = SawyerNutAssemblyEnvV3()
        env._set_task_called, env._freeze_rand_vec, env.seeded_rand_vec = True, False, True
        env._partially_observable = False
        env.__dict__.pop("sawyer_observation_space", None)  # cached with the goal at zero
        env.max_path_length = 10 * length
        env.seed(seed)
        super().__init__(env)
        self.length, self._rng = length, np.random.default_rng([seed, 1])
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (15,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Reset the environment; the option `side` (−1 or 1) chooses the side of the offset."""
        env = self.unwrapped
        if seed is not None:
            env.seed(seed)
            self._rng = np.random.default_rng([seed, 1])
        self.raw, _ = env.reset()
        self.side = float((options or {}).get("side", self._rng.choice([-1.0, 1.0])))
        self.believed_peg = env._target_pos + [0.0, self.side * self._rng.uniform(MIN_OFFSET, MAX_OFFSET), 0.0]
        self.ring_start = self.raw[4:7] * [1, 1, 0]  # on the table: heights are the world's
        self._steps = 0
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Step the environment; its own success ends the episode."""
        self.raw, theirs, _, _, info = self.unwrapped.step(np.asarray(action, dtype=np.float32))
        self._steps += 1
        success = bool(info["success"])
        reward = 0.0 if success else 0.2 * (min(float(theirs), 10.0) / 10.0 - 1.0)
        info = {"is_success": success, "side": self.side}
        return self._observe(), reward, success, self._steps >= self.length and not success, info

    def _observe(self) -> np.ndarray:
        hand, ring = self.raw[:3], self.raw[4:7]
        command = self.unwrapped.data.mocap_pos[0]
        parts = [
            5 * (hand - self.believed_peg), 10 * (ring - hand), 10 * (ring - self.believed_peg), [self.raw[3]],
            20 * (command - hand), 5 * (self.ring_start - hand)[:2],
        ]  # fmt: skip
        return np.concatenate(parts).astype(np.float32)


def demonstrate(count: int = 10, seed: int = 1000, noise: float = 0.1) -> dict[str, Demonstrations]:
    """Return demonstrations of metaworld's scripted policy, which sees the true peg, cut into the segments.

    Args:
        count: Number of successful demonstrations, alternately for both sides.
        seed: Seed of the environment and of the noise.
        noise: Standard deviation of noise added to the actions, relative to their range.
    """
    policy, rng, env = SawyerAssemblyV3Policy(), np.random.default_rng(seed), HiddenPeg(seed, 300)
    recordings: list[tuple[np.ndarray, list[int], np.ndarray, np.ndarray]] = []
    while len(recordings) < count:
        env.reset(options={"side": (-1.0) ** len(recordings)})
        samples, success = [], False
        for _ in range(200):
            raw = env.raw
            hold = raw[4:7] + [-0.02, 0.0, 0.0]
            near = np.linalg.norm(raw[:2] - hold[:2]) <= 0.02
            samples.append([*raw[:3], near, near and raw[3] < 0.5, raw[6] > 0.15])
            action = policy.get_action(raw)
            action[:3] = np.clip(action[:3], -1, 1) + noise * rng.standard_normal(3)
            *_, success, _, _ = env.step(np.clip(action, -1, 1))
            if success:
                break
        if not success:
            continue
        signal = np.array([*samples, [*env.raw[:3], False, False, False]])
        try:
            (events,) = find_events([signal], [lambda s: s[3] > 0, lambda s: s[4] > 0, lambda s: s[5] > 0])
        except ValueError:
            continue
        if min(np.diff([0, *events, len(signal) - 1])) >= 4:
            recordings.append((signal[:, :3], events, env.ring_start, env.believed_peg))
    clocks = [PERIOD * np.arange(len(path)) for path, *_ in recordings]
    whole = Demonstrations(clocks, [path for path, *_ in recordings], ["x [m]", "y [m]", "z [m]"])
    result = {}
    for name, part in zip(SEGMENTS, cut_demonstrations(whole, [r[1] for r in recordings]), strict=True):
        at = 2 if name in ("reach", "grasp", "lift") else 3
        outputs = [y - r[at] for y, r in zip(part.outputs, recordings, strict=True)]
        result[name] = Demonstrations(part.times, outputs, part.names)
    return result


def make_segments(count: int = 10, seed: int = 1000) -> list[Segment]:
    """Return the segments: reach, grasp and lift in the ring's frame, place in that of the believed peg."""
    segments = []
    for name, demonstrations in demonstrate(count, seed).items():
        steps, dwell = SEGMENTS[name]
        at_ring = name != "place"
        bounds = compute_bounds(demonstrations, 1, 0.15, 0.01)
        grip = {"reach": OPEN, "grasp": lambda phase, is_held: CLOSED if is_held else OPEN}.get(name, CLOSED)
        segments.append(
            Segment(
                demonstrations,
                frame=(lambda env, _: Frame(env.ring_start)) if at_ring else (lambda env, _: Frame(env.believed_peg)),
                constraints=LinearConstraints.box(bounds.lower[0], bounds.upper[0]),
                extra=grip, num_steps=steps, dwell=dwell, floor=2e-3, name=name,
            )
        )  # fmt: skip
    return segments


def make(guidance: str, seed: int, segments: list[Segment], action_repeat: int = 5) -> gymnasium.Env:
    """Return the guided environment, or for guidance="none" the bare one with repeated actions."""
    if guidance == "none":
        return RepeatedAction(HiddenPeg(seed), segments, action_repeat)
    return GuidedEnv(
        HiddenPeg(seed), demonstrations=segments, pose=pose, to_action=to_action, guidance=guidance, period=PERIOD,
        action_repeat=action_repeat,
    )  # fmt: skip
