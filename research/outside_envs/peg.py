"""`peg-insert-side-v3` of metaworld, with a hole that is not where the robot believes it to be."""

import warnings
from typing import Any

import gymnasium
import mujoco
import numpy as np
from metaworld.envs.sawyer_peg_insertion_side_v3 import SawyerPegInsertionSideEnvV3
from metaworld.policies.sawyer_peg_insertion_side_v3_policy import SawyerPegInsertionSideV3Policy

from guiderail import Demonstrations, Frame, GuidedEnv, LinearConstraints, Segment, cut_demonstrations, find_events
from guiderail.models.primitives.bounds import compute_bounds

warnings.filterwarnings("ignore", message="Constant")
PERIOD = 0.0125  # duration of a step of metaworld [s]
SEGMENTS = {"reach": (30, 0), "grasp": (28, 22), "carry": (34, 0), "insert": (40, 10)}  # steps, and steps of dwell
# The second attempt: the insertion backwards, and once more. The demonstrations are those of the first.
ATTEMPTS = {"retract": (30, 0), "insert again": (40, 40)}
LENGTH = sum(steps + dwell for steps, dwell in (SEGMENTS | ATTEMPTS).values())
MIN_OFFSET, MAX_OFFSET = 0.025, 0.05  # distance of the believed hole from the true one in y, on either side [m]
MAX_LAG = 0.035  # lag of the hand behind its command at which the first attempt ends: it presses on the box [m]
MAX_HEIGHT_OFFSET = 0.015  # the same in z [m]
OPEN, CLOSED = -1.0, 0.6  # gripper's effort


class HiddenHole(gymnasium.Wrapper):
    """Environment with an observation, a reward and a success of its own.

    The observation does not contain the true hole; the reward is metaworld's, which does (privileged). Success is 5 cm
    inside of the hole: metaworld's own success, a radius of 7 cm, counts a peg at the mouth.
    """

    def __init__(self, seed: int = 0, length: int = LENGTH):
        env = SawyerPegInsertionSideEnvV3()
        env._set_task_called, env._freeze_rand_vec, env.seeded_rand_vec = True, False, True
        env._partially_observable = False
        env.__dict__.pop("sawyer_observation_space", None)  # cached with the goal at zero
        env.max_path_length = 10 * length
        env.seed(seed)
        super().__init__(env)
        self.length, self._rng = length, np.random.default_rng([seed, 1])
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (19,), np.float32)
        box = env.model.body("box").id
        self._box = {g for g in range(env.model.ngeom) if env.model.body_rootid[env.model.geom_bodyid[g]] == box}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Reset the environment; the option `side` (−1 or 1) chooses the side of the offset."""
        env = self.unwrapped
        if seed is not None:
            env.seed(seed)
            self._rng = np.random.default_rng([seed, 1])
        self.raw, _ = env.reset()
        self.side = float((options or {}).get("side", self._rng.choice([-1.0, 1.0])))
        distance, height = self._rng.uniform(MIN_OFFSET, MAX_OFFSET), self._rng.uniform(-1, 1) * MAX_HEIGHT_OFFSET
        self.believed_hole = env._target_pos + [0.0, self.side * distance, height]
        self.peg_start = self.raw[4:7] * [1, 1, 0]  # on the table: heights are the world's
        self._steps, self.peak_force = 0, 0.0
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Step the environment and measure success and force."""
        env = self.unwrapped
        self.raw, theirs, _, _, info = env.step(np.asarray(action, dtype=np.float32))
        self._steps += 1
        depth, y, z = self.head()
        success = bool(depth < 0.015 and max(abs(y), abs(z)) < 0.03)
        self.peak_force = max(self.peak_force, self._force())
        reward = 0.0 if success else 0.2 * (min(float(theirs), 5.0) / 10.0 - 1.0)
        info = {"is_success": success, "success_theirs": bool(info["success"]), "peak_force": self.peak_force}
        info["side"] = self.side
        return self._observe(), reward, success, self._steps >= self.length and not success, info

    def head(self) -> np.ndarray:
        """Return the position of the peg's head (3,) from a point 6.6 cm inside of the true hole [m]."""
        return self.unwrapped._get_site_pos("pegHead") - self.unwrapped._target_pos

    def _force(self) -> float:
        """Return the largest contact force between the box and anything else [N]."""
        env, wrench, largest = self.unwrapped, np.zeros(6), 0.0
        for i in range(env.data.ncon):
            contact = env.data.contact[i]
            if (contact.geom1 in self._box) != (contact.geom2 in self._box):
                mujoco.mj_contactForce(env.model, env.data, i, wrench)
                largest = max(largest, abs(wrench[0]))
        return largest

    def _observe(self) -> np.ndarray:
        env = self.unwrapped
        hand, peg, head = self.raw[:3], self.raw[4:7], env._get_site_pos("pegHead")
        axis = env.data.site("pegHead").xmat.reshape(3, 3)[:, 0]
        parts = [
            5 * (hand - self.believed_hole), 10 * (head - self.believed_hole), 10 * (peg - hand), 5 * axis[1:],
            [self.raw[3]], 20 * (env.data.mocap_pos[0] - hand), 5 * (self.peg_start - hand)[:2], [axis[0]], [hand[2]],
        ]  # fmt: skip
        return np.concatenate(parts).astype(np.float32)


def pose(env: Any, observation: Any) -> np.ndarray:
    """Return the commanded position of the hand (3,) [m]; metaworld moves a mocap body that the hand follows."""
    return env.unwrapped.data.mocap_pos[0].copy()


def is_blocked(env: Any, observation: Any) -> bool:
    """Return True if the hand lags behind its command along the hole's axis."""
    return bool(env.unwrapped.data.mocap_pos[0][0] - env.raw[0] < -MAX_LAG)


def to_action(env: Any, observation: Any, command: np.ndarray, grip: float) -> np.ndarray:
    """Return metaworld's action: a displacement of at most 1 cm, and the gripper's effort."""
    inner = env.unwrapped
    return np.append(np.clip((command - inner.data.mocap_pos[0]) / inner.action_scale, -1, 1), grip)


def demonstrate(count: int = 10, seed: int = 1000, noise: float = 0.1) -> dict[str, Demonstrations]:
    """Return demonstrations of metaworld's scripted policy, which sees the true hole, cut into the segments.

    Args:
        count: Number of successful demonstrations, alternately for both sides.
        seed: Seed of the environment and of the noise.
        noise: Standard deviation of noise added to the actions, relative to their range.
    """
    policy, rng, env = SawyerPegInsertionSideV3Policy(), np.random.default_rng(seed), HiddenHole(seed, 250)
    paths: list[np.ndarray] = []
    origins: list[tuple[np.ndarray, np.ndarray]] = []
    cuts: list[list[int]] = []
    while len(paths) < count:
        env.reset(options={"side": (-1.0) ** len(paths)})
        samples = []
        for _ in range(130):
            raw = env.raw
            near = np.linalg.norm(raw[:2] - raw[4:6]) <= 0.04
            aligned = np.linalg.norm((raw[4:7] - [0, env.unwrapped._target_pos[1], 0.16])[1:]) <= 0.03
            low = near and abs(raw[2] - raw[6]) <= 0.025 and raw[3] < 0.4
            samples.append([*raw[:3], near, low, aligned])
            action = policy.get_action(raw)
            action[:3] = np.clip(action[:3], -1, 1) + noise * rng.standard_normal(3)
            *_, info = env.step(np.clip(action, -1, 1))
            if env.head()[0] < -0.01:
                break  # deeper than necessary, because grasps differ by a centimetre
        if not info["is_success"]:
            continue
        signal = np.array([*samples, [*env.raw[:3], False, False, False]])
        try:
            (events,) = find_events([signal], [lambda s: s[3] > 0, lambda s: s[4] > 0, lambda s: s[5] > 0])
        except ValueError:
            continue
        if min(np.diff([0, *events, len(signal) - 1])) < 4:
            continue
        paths.append(signal[:, :3])
        cuts.append(events)
        origins.append((env.peg_start, env.believed_hole))
    clocks = [PERIOD * np.arange(len(path)) for path in paths]
    parts = cut_demonstrations(Demonstrations(clocks, paths, ["x [m]", "y [m]", "z [m]"]), cuts)
    result = {}
    for name, part in zip(SEGMENTS, parts, strict=True):
        at = 0 if name in ("reach", "grasp") else 1
        outputs = [y - origin[at] for y, origin in zip(part.outputs, origins, strict=True)]
        result[name] = Demonstrations(part.times, outputs, part.names)
    return result


def make_segments(count: int = 10, seed: int = 1000) -> list[Segment]:
    """Return the segments: reach and grasp in the peg's frame, carry and insert in that of the believed hole."""
    segments, recorded = [], demonstrate(count, seed)
    insert = recorded["insert"]
    backwards = [y[::-1] for y in insert.outputs]
    recorded |= {"retract": Demonstrations(insert.times, backwards, insert.names), "insert again": insert}
    for name, demonstrations in recorded.items():
        steps, dwell = (SEGMENTS | ATTEMPTS)[name]
        at_peg = name in ("reach", "grasp")
        bounds = compute_bounds(demonstrations, 1, 0.15, 0.01)
        floor = 0.045 if at_peg else 0.045 - 0.13 - MAX_HEIGHT_OFFSET  # above the table, in the frame [m]
        lower = np.maximum(bounds.lower[0], [-np.inf, -np.inf, floor])
        grip = {"reach": OPEN, "grasp": lambda phase, is_held: CLOSED if is_held else OPEN}.get(name, CLOSED)
        segments.append(
            Segment(
                demonstrations,
                frame=(lambda env, _: Frame(env.peg_start)) if at_peg else (lambda env, _: Frame(env.believed_hole)),
                constraints=LinearConstraints.box(lower, bounds.upper[0]),
                until=is_blocked if name == "insert" else None,
                extra=grip, num_steps=steps, dwell=dwell, floor=2e-3, name=name,
            )
        )  # fmt: skip
    return segments


def make(guidance: str, seed: int, segments: list[Segment], action_repeat: int = 5) -> gymnasium.Env:
    """Return the guided environment, or for guidance="none" the bare one with repeated actions."""
    if guidance == "none":
        return RepeatedAction(HiddenHole(seed), segments, action_repeat)
    return GuidedEnv(
        HiddenHole(seed), demonstrations=segments, pose=pose, to_action=to_action, guidance=guidance, period=PERIOD,
        action_repeat=action_repeat,
    )  # fmt: skip


class RepeatedAction(gymnasium.Wrapper):
    """The environment's own action, repeated; its commands are compared with the boxes of all segments together."""

    def __init__(self, env: gymnasium.Env, segments: list[Segment], action_repeat: int):
        super().__init__(env)
        self.segments, self.action_repeat = segments, action_repeat
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Apply an action (4,) for several steps."""
        total, worst = 0.0, -np.inf
        for _ in range(self.action_repeat):
            observation, reward, terminated, truncated, info = self.env.step(action)
            total += reward
            inside = [
                s.constraints.violation(pose(self, observation) - s.frame(self.env, observation).p)
                for s in self.segments
            ]
            worst = max(worst, min(inside))
            if terminated or truncated:
                break
        return observation, total, terminated, truncated, {**info, "constraint_violation": worst, "fallback": 0}
