"""A task in an environment of another package: the segments of its motion, with and without guidance."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
from gymnasium.wrappers import TransformObservation

from guiderail import Demonstrations, Frame, GuidedEnv, LinearConstraints, Segment, cut_demonstrations
from guiderail.models.primitives.demonstrations import compute_bounds
from guiderail.tools.guided.guide import Guide

ACTION_REPEAT = 5  # steps of the environment for which an action is applied, with and without guidance
# With a larger factor of the package's own reward, pressing the part near its goal would be worth more than a success.
SUCCESS_REWARD, REWARD_SCALE = 10.0, 0.01  # reward of a success; factor of the package's own reward before a success
BOX_MARGIN, MIN_BOX_MARGIN = 0.15, 0.01  # margin of a segment's box, as a fraction of the demonstrated range and [m]
FLOOR = 2e-3  # standard deviation added to every covariance [unit of the output]


@dataclass(frozen=True)
class Part:
    """One segment of a task's motion.

    Attributes:
        steps: Control steps.
        frame: Name of the environment's attribute with the frame's origin (O,).
        extra: Discrete output, as in `Segment`.
        dwell: Control steps for which the last point is commanded after the motion.
        source: Name of the part whose recording is used; empty for the part's own recording.
        until_fraction: Fraction of the recording's samples that is used, from the first sample.
        is_reversed: True to run the recording backwards.
        lower: Lower limits (O,) of the commands in the frame, used if they are above the demonstrated limits.
        until: Predicate (env, observation) that ends the segment early.
    """

    steps: int
    frame: str
    extra: Any
    dwell: int = 0
    source: str = ""
    until_fraction: float = 1.0
    is_reversed: bool = False
    lower: float | np.ndarray = -np.inf
    until: Callable[[Any, Any], bool] | None = None


@dataclass(frozen=True)
class Recording:
    """One demonstration.

    Attributes:
        path: Outputs (N, O) in the world.
        events: Samples at which the recorded parts after the first begin.
        origins: Origins of the frames (O,), by the name of the environment's attribute.
    """

    path: np.ndarray
    events: list[int]
    origins: dict[str, np.ndarray]


@dataclass(frozen=True)
class LearnerSettings:
    """Settings of TQC that depend on the number of transitions of an episode.

    Attributes:
        learning_starts: Transitions with random actions.
        gradient_steps: Gradient steps per transition.
        return_steps: Number n of transitions in an n-step return.
        average_decay: Decay per transition of the running average of the actor's weights. The average is evaluated.
        entropy_per_action: Target entropy of the policy for each entry of an action, at the beginning and at the end
            of the training. Stable-Baselines3's default is −1; with less noise, fewer attempts fail.
    """

    learning_starts: int = 120
    gradient_steps: int = 2
    return_steps: int = 5  # the reward of a success follows after about forty decisions
    average_decay: float = 0.999
    entropy_per_action: tuple[float, float] = (-2.0, -2.0)


@dataclass(frozen=True)
class OutsideTask:
    """A task in an environment of another package.

    Attributes:
        parts: Segments of the motion by name, in their order.
        outputs: Names of the outputs.
        period: Duration of a step of the environment [s].
        make_env: (seed) → environment whose `info` has `is_success`, `side` and `peak_force` [N].
        record: (count, seed) → successful recordings of the package's scripted policy, which observes the hidden goal.
        pose: (env, observation) → commanded pose (O,), at which a motion begins.
        to_action: (env, observation, command, extra) → the environment's own action.
        scripted: (env) → the environment's own action by the scripted policy, which observes the hidden goal.
        schedule: Fixed action in each segment in which a decision is made; the sequence of these actions is a search
            without observations.
        observed: Indices of the entries that a policy with guidance observes; all entries if empty. The entries are the
            environment's observation, the phase and the command.
        action_dims: Indices of the outputs that an action moves; all by default.
        decisions: Names of segments; an action is applied until one of them begins. If empty, an action is applied for
            `ACTION_REPEAT` steps.
        settings: Settings of the learner with guidance.
    """

    parts: Mapping[str, Part]
    outputs: tuple[str, ...]
    period: float
    make_env: Callable[[int], gymnasium.Env]
    record: Callable[[int, int], list[Recording]]
    pose: Callable[[Any, Any], np.ndarray]
    to_action: Callable[[Any, Any, np.ndarray, Any], np.ndarray]
    scripted: Callable[[Any], np.ndarray]
    schedule: Mapping[str, np.ndarray] = field(default_factory=dict)
    observed: Sequence[int] = ()
    action_dims: Sequence[int] | None = None
    decisions: Sequence[str] = ()
    settings: LearnerSettings = LearnerSettings()

    def make_segments(self, count: int = 10, seed: int = 1000) -> list[Segment]:
        """Record `count` demonstrations with a seed, and return the segments of the motion."""
        recorded = [name for name, part in self.parts.items() if not part.source]
        recordings = self.record(count, seed)
        clocks = [self.period * np.arange(len(recording.path)) for recording in recordings]
        whole = Demonstrations(clocks, [recording.path for recording in recordings], list(self.outputs))
        events = [recording.events for recording in recordings]
        cut = dict(zip(recorded, cut_demonstrations(whole, events), strict=True))
        segments, local = [], {}
        for name, each in cut.items():
            origins = [recording.origins[self.parts[name].frame] for recording in recordings]
            outputs = [y - origin for y, origin in zip(each.outputs, origins, strict=True)]
            local[name] = Demonstrations(each.times, outputs, each.names)
        for name, part in self.parts.items():
            demonstrations = _first(local[part.source or name], part.until_fraction)
            if part.is_reversed:
                backwards = [y[::-1] for y in demonstrations.outputs]
                demonstrations = Demonstrations(demonstrations.times, backwards, demonstrations.names)
            bounds = compute_bounds(demonstrations, 1, BOX_MARGIN, MIN_BOX_MARGIN)
            segments.append(
                Segment(
                    demonstrations, frame=_origin_of(part.frame),
                    constraints=LinearConstraints.box(np.maximum(bounds.lower[0], part.lower), bounds.upper[0]),
                    until=part.until, extra=part.extra, num_steps=part.steps, dwell=part.dwell, floor=FLOOR, name=name,
                )
            )  # fmt: skip
        return segments

    def make(self, guidance: str | Guide, seed: int, segments: list[Segment]) -> gymnasium.Env:
        """Return the guided environment; for guidance="none", the package's own environment with repeated actions."""
        env = self.make_env(seed)
        if guidance == "none":
            return RepeatedAction(env, segments, self.pose)
        is_fitted = isinstance(guidance, Guide)
        guided: gymnasium.Env = GuidedEnv(
            env, demonstrations=None if is_fitted else segments, action_dims=None if is_fitted else self.action_dims,
            guidance=guidance, pose=self.pose, to_action=self.to_action, period=self.period,
            action_repeat=ACTION_REPEAT, history=4, horizon=20,  # as in the stored results
        )  # fmt: skip
        if self.decisions:
            guided = HeldAction(guided, self.decisions)
        if not self.observed:
            return guided
        observed = np.array(self.observed)
        space = gymnasium.spaces.Box(-np.inf, np.inf, observed.shape, np.float32)
        return TransformObservation(guided, lambda observation: observation[observed], space)


def num_steps(parts: Mapping[str, Part]) -> int:
    """Return the largest number of control steps of a motion."""
    return sum(part.steps + part.dwell for part in parts.values())


class HeldAction(gymnasium.Wrapper):
    """Wrapper that applies an action until one of the segments `decisions` begins, or until the episode ends."""

    def __init__(self, env: GuidedEnv, decisions: Sequence[str]):
        super().__init__(env)
        self._decisions = tuple(decisions)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Apply an action (A,); return the sum of the rewards and fallbacks, and the largest violation."""
        total, worst, fallbacks, has_begun = 0.0, -np.inf, 0, False
        guide, terminated, truncated = self.env.get_wrapper_attr("guide"), False, False
        while not (has_begun or terminated or truncated):
            before = guide.segment_name
            observation, reward, terminated, truncated, info = self.env.step(action)
            total, fallbacks = total + float(reward), fallbacks + info["fallback"]
            worst = float(np.maximum(worst, info["constraint_violation"]))  # NaN if one is NaN
            has_begun = guide.segment_name != before and guide.segment_name in self._decisions
        info = {**info, "constraint_violation": worst, "fallback": fallbacks}
        return observation, total, terminated, truncated, info


class RepeatedAction(gymnasium.Wrapper):
    """Wrapper that repeats the environment's own action and appends the time, from −1 to 1, to the observation.

    A command violates the constraints if it is outside of the box of every segment.
    """

    def __init__(self, env: Any, segments: list[Segment], pose: Callable[[Any, Any], np.ndarray]):
        super().__init__(env)
        self._segments, self._pose = segments, pose
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, env.action_space.shape, np.float32)
        size = env.observation_space.shape[0] + 1
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Reset the environment."""
        observation, info = self.env.reset(seed=seed, options=options)
        return self._with_time(observation), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Apply an action (A,) for several steps."""
        total, worst = 0.0, -np.inf
        for _ in range(ACTION_REPEAT):
            observation, reward, terminated, truncated, info = self.env.step(action)
            total += reward
            pose = self._pose(self.env, observation)
            violations = [s.constraints.violation(pose - s.frame(self.env, None).p) for s in self._segments]
            worst = float(np.maximum(worst, np.min(violations)))  # NaN if one is NaN
            if terminated or truncated:
                break
        info = {**info, "constraint_violation": worst, "fallback": 0, "segment": ""}
        return self._with_time(observation), total, terminated, truncated, info

    def _with_time(self, observation: np.ndarray) -> np.ndarray:
        return np.append(observation, 2.0 * self.env.steps / self.env.length - 1.0).astype(np.float32)


def _first(demonstrations: Demonstrations, fraction: float) -> Demonstrations:
    """Return the first samples of every demonstration."""
    counts = [round(fraction * len(times)) for times in demonstrations.times]
    times = [each[:count] for each, count in zip(demonstrations.times, counts, strict=True)]
    outputs = [each[:count] for each, count in zip(demonstrations.outputs, counts, strict=True)]
    return Demonstrations(times, outputs, demonstrations.names)


def _origin_of(name: str) -> Callable[[Any, Any], Frame]:
    return lambda env, _: Frame(getattr(env, name))
