"""Gymnasium environment without guiderail: velocity actions move a point to a target and close a gripper."""

import gymnasium
import numpy as np

from guiderail import Demonstrations, GuidedEnv

PERIOD = 0.05  # of a step [s]
MAX_STEP = 0.04  # largest displacement along each axis in a step [m]


class PointEnv(gymnasium.Env):
    """Point at `p` [m]. The episode succeeds within 10 mm of `target` while the gripper action is positive.

    Args:
        kind: Observation space: "box", "dict", "dict_with_phase" or "image".
    """

    def __init__(self, kind="box"):
        spaces = gymnasium.spaces
        self.kind, box = kind, spaces.Box(-np.inf, np.inf, (6,), np.float64)
        self.observation_space = spaces.Dict({"state": box}) if kind == "dict" else box
        if kind == "dict_with_phase":
            self.observation_space = spaces.Dict({"state": box, "phase": spaces.Discrete(2)})
        if kind == "image":
            self.observation_space = spaces.Box(0, 255, (4, 4, 3), np.uint8)
        self.action_space = spaces.Box(-1.0, 1.0, (4,), np.float32)
        self.commands = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.p = self.np_random.uniform(-0.02, 0.02, 3)
        self.target = np.array([0.5, 0.1, 0.2]) + self.np_random.uniform(-0.05, 0.05, 3)
        self.R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        return self._observe(), {"own": 1}

    def step(self, action):
        self.p = self.p + MAX_STEP * np.clip(action[:3], -1, 1)
        distance = np.linalg.norm(self.p - self.target)
        success = bool(distance < 0.01 and action[3] > 0)
        return self._observe(), -distance, success, False, {"is_success": success, "own": 2}

    def _observe(self):
        if self.kind == "image":
            return np.zeros((4, 4, 3), np.uint8)
        state = np.concatenate([self.p, self.target])
        return {"state": state} if self.kind == "dict" else state


def pose(env, observation):
    """Return the measured position (3,) [m]."""
    return env.unwrapped.p.copy()


def to_action(env, observation, command, extra):
    """Return the action that moves the point to the command, and record the command."""
    inner = env.unwrapped
    inner.commands.append(command.copy())
    return np.append(np.clip((command - inner.p) / MAX_STEP, -1, 1), 0.0 if extra is None else extra)


def demonstrations(end=(0.0, 0.0, 0.0), steps=25, count=5, seed=0, start=(-0.5, -0.1, -0.2)):
    """Return curved motions from `start` to `end` (3,) [m], in the frame of the target."""
    rng, t = np.random.default_rng(seed), PERIOD * np.arange(steps)
    s = np.linspace(0, 1, steps)[:, None]
    outputs = []
    for _ in range(count):
        bend = rng.normal(scale=0.03, size=3)
        outputs.append((1 - s) * np.array(start) + s * np.array(end) + 4 * s * (1 - s) * bend)
    return Demonstrations([t] * count, outputs)


def guided(env, **more):
    """Return the environment with guidance to its target; `more` are arguments of `GuidedEnv`."""
    keywords = {"pose": pose, "to_action": to_action, "period": PERIOD, "demonstrations": demonstrations()}
    return GuidedEnv(env, frame=lambda env, observation: env.unwrapped.target, **keywords | more)
