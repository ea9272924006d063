"""Minimal environment with the `info` and trace of guiderail's environments: a point moves to a goal up to a wall."""

from types import SimpleNamespace

import gymnasium
import numpy as np
from gymnasium import spaces

from guiderail.diagrams.envs.trace import EpisodeTrace
from guiderail.models.common.errors import InputError

VIOLATIONS = {"commanded_violation": 1, "measured_violation": 1}


class Bead(gymnasium.Env):
    metadata = {"render_modes": ["human"]}

    def __init__(
        self, guidance="skgrl", reward="shaped", observation="state", action_repeat=1, wall=1.0, render_mode=None
    ):
        if guidance not in ("kmp", "skgrl"):
            raise InputError(f"Bead has no guidance {guidance!r}: choose kmp or skgrl")
        self.observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float32)
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self.action_repeat, self.wall, self.render_mode = action_repeat, wall, render_mode
        self.diagram = SimpleNamespace(num_steps=12, reward_terms=("goal_distance",), control_period=0.1)
        self.diagram.symmetry = self.diagram.near_symmetry = None
        self.trace, self.length = EpisodeTrace(250, 2, 0.1, VIOLATIONS), 12

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.trace.clear()
        start = 0.3 if (options or {}).get("held_out") else -0.3
        self.x = np.array([start, 0.0]) + 0.1 * self.np_random.standard_normal(2)
        return self._observation(), self._info("", 0.0)

    def render(self):
        return len(self.trace)

    def _observation(self):
        return np.append(self.x, len(self.trace) / self.length).astype(np.float32)

    def _info(self, termination, reward):
        info = {"is_success": termination == "success", "termination": termination, "goal_distance": reward}
        violation = float(self.x[0] - 1.0)
        return info | {"constraint_violation": violation, "measured_violation": violation, "contact_force": 1.0}

    def step(self, action):
        total = 0.0
        for _ in range(self.action_repeat):
            self.x = np.minimum(self.x + 0.1 * np.asarray(action, float), self.wall)
            reward = -float(np.linalg.norm(self.x - [0.5, 0.5]))
            violation = self.x[:1] - 1.0
            self.trace.append(self.x, self.x, 1.0, reward, dict.fromkeys(VIOLATIONS, violation))
            total += reward
            if done := reward > -0.2 or len(self.trace) == self.length:
                break
        termination = ("success" if reward > -0.2 else "time_limit") if done else ""
        info = self._info(termination, total)
        return self._observation(), total, termination == "success", termination == "time_limit", info


def register():
    if "guiderail/Bead-v0" not in gymnasium.registry:
        gymnasium.register("guiderail/Bead-v0", entry_point=Bead)
