"""Package of a lab with a task, guidance, a kernel, a learner with settings, and an environment without guiderail."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

import guiderail as gr
from guiderail.models.objects.narrow_passage import PassageGeometry
from guiderail.models.policy import FORMAT

NUM_STEPS, PERIOD = 80, 0.02


@gr.register_task("peglab/Slot")
class Slot(gr.Task):
    """Task of moving through a slot to a goal that the reference trajectory does not reach."""

    station, clip, has_held_out_distribution = gr.PlaneStation, 1.0, True
    defaults = {"guidance": "kgrl", "action_repeat": 5}
    width: float = Field(0.14, ge=0.05, le=0.3, description="width of the slot [m]")

    def workcell(self) -> PassageGeometry:
        gap = (0.35 - self.width / 2, 0.35 + self.width / 2)
        return PassageGeometry(start=(0.35, 0.1), goal=(0.42, 0.9), goal_radius=0.06, gap_x=gap)

    def prior(self) -> gr.Prior:
        phase = np.linspace(0.0, 1.0, NUM_STEPS)
        means = np.column_stack([np.full(NUM_STEPS, 0.35), 0.1 + 0.8 * phase])
        covariances = np.tile(0.04**2 * np.eye(2), (NUM_STEPS, 1, 1))
        reference = gr.ReferenceTrajectory(PERIOD * np.arange(NUM_STEPS), means, covariances)
        return gr.Prior(reference, gr.LinearConstraints.box([0.25, -np.inf], [0.45, np.inf]))

    def observe(self) -> Sequence[gr.ObservationTerm]:
        return (gr.ObservationTerm("phase"), gr.ObservationTerm("pose", 0.5, 0.5))

    def rewards(self) -> Mapping[str, Callable[..., float]]:
        goal = np.array(self.workcell().goal)
        return {"nearness": lambda pose: -float(np.linalg.norm(pose - goal))}

    def done(self) -> Mapping[str, Callable[..., bool]]:
        return {"success": self.workcell().at_goal}

    def reset(self, world: gr.World, rng: np.random.Generator, given: Any) -> dict[str, Any]:
        start = np.array([0.35, 0.1]) + (0.01 if given.held_out else 0.002) * rng.standard_normal(2)
        world.set_pose(start)
        return {"start": start}


class OffsetOptions(gr.Options):
    """Options of the guidance `peglab_offset`."""

    reach: float = Field(0.05, gt=0, description="distance from the measured pose that an action of 1 commands [m]")


@gr.register_guidance("peglab_offset", label="offset", options=OffsetOptions)
class Offset(gr.Law):
    """Law that commands the measured pose plus the action."""

    def command(self, last: np.ndarray, action: np.ndarray, pose: np.ndarray, wrench: np.ndarray) -> np.ndarray:
        return pose + self.known.options["reach"] * action


class RationalQuadratic:
    """Rational quadratic kernel k(ζ, ζ') = (1 + ‖ζ − ζ'‖² / (2 a ℓ²))⁻ᵃ."""

    stationary = True

    def __init__(self, length_scale: float, mixture: float = 1.0):
        self.length_scale, self.mixture = length_scale, mixture

    def __call__(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        a, b = (np.reshape(x, (len(x), -1)) for x in (a, b))
        squared = ((a[:, None] - b[None]) ** 2).sum(axis=-1)
        return (1 + squared / (2 * self.mixture * self.length_scale**2)) ** -self.mixture


class Reach(gymnasium.Env):
    """Environment without guiderail, in which the action moves a point to the origin."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.point, self.steps = self.np_random.uniform(-1, 1, 2), 0
        return self.point.astype(np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.point, self.steps = self.point + 0.3 * np.clip(action, -1, 1), self.steps + 1
        distance = float(np.linalg.norm(self.point))
        is_success = bool(distance < 0.1)
        return self.point.astype(np.float32), -distance, is_success, self.steps == 10, {"success": is_success}


@dataclass(frozen=True)
class HillClimbingConfig(gr.LearnerConfig):
    deviation: float = Field(0.3, gt=0)  # standard deviation of a step in the parameters


@gr.register_learner("peglab_hill_climbing")
class HillClimbing(gr.Learner):
    """Hill climbing: each episode tests a random change of the best linear policy so far."""

    Config = HillClimbingConfig

    def __init__(self, config: HillClimbingConfig, env: Any, *, seed: int, **unused: Any):
        self.config, self.space = config, env.action_space
        self.rng = np.random.default_rng(seed)
        self.best = np.zeros((self.space.shape[0], env.observation_space.shape[0] + 1))
        self.score, self.candidate, self.total = -np.inf, self.best, 0.0

    def on_episode_start(self) -> None:
        self.candidate = self.best + self.config.deviation * self.rng.standard_normal(self.best.shape)
        self.total = 0.0

    def act(self, observation: np.ndarray) -> np.ndarray:
        return np.tanh(self.candidate @ np.append(observation, 1.0)).astype(np.float32)

    def on_step(self, transition: gr.Transition) -> None:
        self.total += transition.reward

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        if self.total > self.score:
            self.best, self.score = self.candidate, self.total
        return {}

    def policy(self, description: Mapping[str, Any]) -> gr.Policy:
        limits = {"action_low": self.space.low.tolist(), "action_high": self.space.high.tolist()}
        layer = (self.best[:, :-1].astype(np.float32), self.best[:, -1].astype(np.float32))
        return gr.Policy([layer], {"format": FORMAT, "pool": 1, "squash": "tanh", **limits, **description})

    def has_diverged(self) -> bool:
        return not np.isfinite(self.best).all()

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        return {"best": self.best}, {"score": self.score, "random": self.rng.bit_generator.state}

    def restore(self, arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> None:
        self.best, self.score = arrays["best"], values["score"]
        self.rng.bit_generator.state = values["random"]
