"""Environments of metaworld with a goal at an unknown offset, and recordings in them."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import mujoco
import numpy as np

from guiderail import find_events
from research.outside_envs.task import REWARD_SCALE, SUCCESS_REWARD, Recording

warnings.filterwarnings("ignore", message="Constant")  # a constant of metaworld's scripted policies
PERIOD = 0.0125  # duration of a step of metaworld [s]
OPEN, CLOSED = -1.0, 0.6  # gripper's effort
MIN_SAMPLES = 4  # smallest number of samples of a recorded part


def close_at_end(phase: float, is_held: bool) -> float:
    """Return the gripper's effort in a segment that closes the gripper while the last point is held."""
    return CLOSED if is_held else OPEN


class HiddenGoal(gymnasium.Wrapper):
    """Environment of metaworld with another observation, reward and criterion of success.

    The observation has the assumed position of the goal, which lies left or right of the true position. The reward is
    metaworld's privileged reward, scaled to be negative before success.

    Args:
        env: Environment of metaworld.
        seed: Seed of the scene and of the offset.
        length: Steps after which an episode is truncated.
        offsets: Smallest and largest distance of the assumed goal from the true goal in y, on either side [m].
        height_offset: Largest distance of the assumed goal from the true goal in z [m].
        obstacle: Body whose contact force is measured.
        max_reward: Upper limit to which metaworld's reward is clipped before success.
        is_blocked: (env, observation) → true if the object presses against the obstacle; None: never.

    Attributes:
        true_goal: Position (3,) of the goal [m].
        assumed_goal: Position (3,) of the goal that the robot assumes [m].
        object_start: Position (3,) of the object at reset, with height 0 [m].
        side: Side of the assumed goal, −1 or 1.
        steps: Steps since the reset.
        length: Steps after which an episode is truncated.
        raw: Observation of metaworld.
        last_blocked: y and z of the hand in the frame of the assumed goal when it was last blocked [1/20 m], and 1,
            (3,); zeros if it was not blocked yet.
        is_success: True if the last step succeeded.
    """

    def __init__(
        self, env: Any, seed: int, length: int, offsets: tuple[float, float], height_offset: float, obstacle: str,
        max_reward: float, is_blocked: Callable[[Any, Any], bool] | None = None,
    ):  # fmt: skip
        env._set_task_called, env._freeze_rand_vec, env.seeded_rand_vec = True, False, True
        env._partially_observable = False
        env.__dict__.pop("sawyer_observation_space", None)  # cached with the goal at zero
        env.max_path_length = 10 * length
        env.seed(seed)
        super().__init__(env)
        self.length, self.steps = length, 0
        self._offsets, self._height_offset, self._max_reward = offsets, height_offset, max_reward
        self._is_blocked = is_blocked or (lambda env, observation: False)
        self._rng = np.random.default_rng([seed, 1])
        body = env.model.body(obstacle).id
        self._geoms = {g for g in range(env.model.ngeom) if env.model.body_rootid[env.model.geom_bodyid[g]] == body}
        observation, _ = self.reset(seed=seed)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, observation.shape, np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Reset the environment; the option `side` (−1 or 1) chooses the side of the offset."""
        env = self.unwrapped
        if seed is not None:
            env.seed(seed)
            self._rng = np.random.default_rng([seed, 1])
        self.raw, _ = env.reset()
        self.side = float((options or {}).get("side", self._rng.choice([-1.0, 1.0])))
        distance, height = self._rng.uniform(*self._offsets), self._rng.uniform(-1, 1) * self._height_offset
        self.true_goal = np.array(env._target_pos)
        self.assumed_goal = self.true_goal + [0.0, self.side * distance, height]
        self.object_start = self.raw[4:7] * [1, 1, 0]
        self.steps, self._peak_force, self.is_success, self.last_blocked = 0, 0.0, False, np.zeros(3)
        return self.observe(), {}

    @property
    def hidden(self) -> np.ndarray:
        """Offset of the true goal from the assumed goal in y and z (2,) [1/20 m], for a privileged critic only."""
        return 20.0 * (self.true_goal - self.assumed_goal)[1:]

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Step the environment and measure success and force."""
        self.raw, package_reward, _, _, info = self.unwrapped.step(np.asarray(action, dtype=np.float32))
        self.steps += 1
        if self._is_blocked(self, None):
            self.last_blocked = np.append(20.0 * (self.raw[1:3] - self.assumed_goal[1:]), 1.0)
        self.is_success = success = self.has_succeeded(info)
        self._peak_force = max(self._peak_force, self._force())
        fraction = min(float(package_reward), self._max_reward) / 10.0
        reward = SUCCESS_REWARD if success else REWARD_SCALE * (fraction - 1.0)
        info = {"is_success": success, "peak_force": self._peak_force, "side": self.side}
        return self.observe(), reward, success, self.steps >= self.length and not success, info

    def has_succeeded(self, info: dict[str, Any]) -> bool:
        """Return True if the task is done."""
        raise NotImplementedError

    def observe(self) -> np.ndarray:
        """Return the observation, with entries scaled to the order of 1."""
        raise NotImplementedError

    def _force(self) -> float:
        """Return the largest contact force between the obstacle and other bodies [N]."""
        env, wrench, largest = self.unwrapped, np.zeros(6), 0.0
        pairs = env.data.contact.geom.tolist() if env.data.ncon else []
        for i, (first, second) in enumerate(pairs):
            if (first in self._geoms) != (second in self._geoms):
                mujoco.mj_contactForce(env.model, env.data, i, wrench)
                largest = max(largest, abs(wrench[0]))
        return largest


def pose(env: Any, observation: Any) -> np.ndarray:
    """Return the commanded position of the hand (3,) [m]; metaworld moves a mocap body that the hand follows."""
    return env.unwrapped.data.mocap_pos[0].copy()


def to_action(env: Any, observation: Any, command: np.ndarray, grip: float) -> np.ndarray:
    """Return metaworld's action: a displacement of at most 1 cm, and the gripper's effort."""
    inner = env.unwrapped
    return np.append(np.clip((command - inner.data.mocap_pos[0]) / inner.action_scale, -1, 1), grip)


def record(
    env: HiddenGoal, policy: Any, signal: Callable[[HiddenGoal], Sequence[bool]], is_over: Callable[[HiddenGoal], bool],
    longest: int, count: int, seed: int, noise: float = 0.1,
) -> list[Recording]:  # fmt: skip
    """Return successful recordings of a scripted policy, alternately for both sides.

    Args:
        env: Environment.
        policy: Scripted policy of metaworld, which observes the true goal.
        signal: (env) → for each recorded part after the first, True from its beginning on.
        is_over: (env) → true at the end of a recording, called after each step.
        longest: Largest number of steps of a recording.
        count: Number of recordings.
        seed: Seed of the noise.
        noise: Standard deviation of noise added to the actions, relative to their range.
    """
    rng = np.random.default_rng(seed)
    recordings: list[Recording] = []
    while len(recordings) < count:
        env.reset(options={"side": (-1.0) ** len(recordings)})
        samples, success = [], False
        for _ in range(longest):
            samples.append([*env.raw[:3], *signal(env)])
            action = policy.get_action(env.raw)
            action[:3] = np.clip(action[:3], -1, 1) + noise * rng.standard_normal(3)
            *_, info = env.step(np.clip(action, -1, 1))
            success = success or info["is_success"]
            if is_over(env):
                break
        if not info["is_success"]:
            continue
        rows = np.array([*samples, [*env.raw[:3], *np.zeros(len(samples[0]) - 3)]])
        try:
            (events,) = find_events([rows], [_is_true(k) for k in range(3, rows.shape[1])])
        except ValueError:
            continue
        if min(np.diff([0, *events, len(rows) - 1])) >= MIN_SAMPLES:
            origins = {"object_start": env.object_start, "assumed_goal": env.assumed_goal}
            recordings.append(Recording(rows[:, :3], events, origins))
    return recordings


def scripted(policy: Any) -> Callable[[Any], np.ndarray]:
    """Return (env) → the action of a scripted policy of metaworld."""
    return lambda env: np.clip(policy.get_action(env.raw), -1.0, 1.0)


def _is_true(column: int) -> Callable[[np.ndarray], bool]:
    return lambda sample: sample[column] > 0
