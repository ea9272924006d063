"""Human-in-the-loop training: a supervisor corrects the policy, stops episodes and labels them.

Interventions are recorded with the run. A correction, clipped to the action's limits, replaces the policy's action,
and an off-policy learner stores it as a transition. It also becomes via-points through which the demonstrations pass
from the next episode on. Guidance processes both, so that all resulting commands satisfy the constraints.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.options import kernel_from_options
from guiderail.models.common.arrays import as_numbers, is_finite
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.termination import Termination
from guiderail.models.primitives.gains import deviation
from guiderail.models.primitives.reference import pass_through
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.episode import Callback, EnvCallback, PolicyFn, Transition
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.learning.episodes import Episodes
from guiderail.tools.learning.learner import Learner
from guiderail.tools.learning.run_folder import RunConfig

LABEL_REWARDS: dict[str, float] = {
    Termination.SUCCESS: 50.0,
    Termination.FAILURE: -50.0,
}  # added to the reward when the supervisor labels an episode
VIA_POINT_SPACING = 5  # control steps between two via-points of a correction


class Supervisor:
    """Interface of a supervisor; the base class does not intervene."""

    def on_episode_start(self, env: gymnasium.Env) -> None:
        """Start an episode of `env`."""

    def correction(self, observation: np.ndarray) -> np.ndarray | None:
        """Return the desired offset from the demonstrations, (A,), in units of a full action; None for no correction.

        In this episode the offset is clipped to ±1. The next episode's demonstrations pass through the full offset.
        """
        return None

    def label(self) -> str | None:
        """Return the label since the last call: "success", "failure" or "stop"; None if there is none."""
        return None


class SupervisedEnv(gymnasium.Wrapper):
    """Environment whose episodes a supervisor can end."""

    def __init__(self, env: gymnasium.Env, supervisor: Supervisor):
        super().__init__(env)
        self._supervisor = supervisor

    def step(self, action: Any) -> Any:
        """Step the environment; a label of the supervisor ends the episode."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        label = None if terminated or truncated else self._supervisor.label()
        if label is None:
            return observation, reward, terminated, truncated, info
        info = {**info, "is_success": label == Termination.SUCCESS, "termination": Termination(label).value}
        reward = float(reward) + LABEL_REWARDS.get(label, 0.0)
        return observation, reward, label in LABEL_REWARDS, label not in LABEL_REWARDS, info


class InterventionPolicy(Callback):
    """Policy that a supervisor's corrections override, and the resulting via-points.

    Attributes:
        interventions: Number of corrections that began in this episode.
    """

    def __init__(self, env: gymnasium.Env, supervisor: Supervisor, act: PolicyFn, corrections: ViaPointCorrections):
        """Construct the policy.

        Args:
            env: Environment of the episode.
            supervisor: Supervisor whose corrections override the policy.
            act: Policy that acts while there is no correction.
            corrections: Via-points of `env` so far.
        """
        self._env, self._supervisor, self._act, self._corrections = env, supervisor, act, corrections
        self._offsets: dict[int, np.ndarray] = {}
        self._offset: np.ndarray | None = None
        self.interventions = 0

    @property
    def via_points(self) -> tuple[float, ...]:
        """Via-points so far and of this episode, as the option `via_points` (step, output, step, output, …)."""
        return self._corrections.with_offsets(self._offsets, is_held=self._offset is not None)

    def on_episode_start(self) -> None:
        """Start an episode without corrections."""
        self._offsets, self._offset, self.interventions = {}, None, 0
        self._supervisor.on_episode_start(self._env)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the policy's action (A,), or the correction clipped to the action's limits.

        Raises:
            InputError: If the correction is not (A,) or not finite.
        """
        correction = self._supervisor.correction(observation)
        offset = None if correction is None else self._corrections.check_offset(correction)
        if offset is not None and self._offset is None:
            self.interventions += 1
        self._offset = offset
        return self._act(observation) if offset is None else np.clip(offset, -1.0, 1.0).astype(np.float32)

    def on_step(self, transition: Transition) -> None:
        """Store the correction at the last completed control step.

        If the simulation failed in the first step, no step is completed.
        """
        if self._offset is not None and transition.info["control_steps"]:
            self._offsets[int(transition.info["control_steps"]) - 1] = self._offset

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the column `interventions`."""
        return {"interventions": self.interventions}


class ViaPointCorrections:
    """Via-points of an environment's demonstrations, computed from a supervisor's corrections.

    Attributes:
        points: Via-points so far, as the option `via_points`.
        reach: RMS displacement over the motion by a full action, (A,) [unit of the output].
    """

    def __init__(self, task: str, environment: Mapping[str, Any]):
        """Construct the via-points for a task and the options of its environment.

        Raises:
            InputError: If the guidance has no demonstrations to correct.
        """
        config = EnvConfig.resolve(task, environment)
        kind, reference = config.guidance_kind, config.reference()
        if not any("demonstrations" in alternative for alternative in kind.needs):
            raise InputError(f"guidance {kind.name!r} has no demonstrations to correct: choose another, such as kgrl")
        values = config.options
        self.points = tuple(values["via_points"])
        assert reference is not None
        self._reference = pass_through(reference, self.points, kernel_from_options(values))
        action_dims = values["action_dims"]
        self._action_dims = list(range(reference.num_outputs)) if action_dims is None else list(action_dims)
        self.reach = np.sqrt(3.0) * values["action_scale"] * deviation(reference)[self._action_dims]
        self._constraints = config.constraints()

    def check_offset(self, offset: np.ndarray) -> np.ndarray:
        """Return a correction (A,) as doubles; raise an `InputError` unless it has this shape and is finite."""
        numbers = as_numbers(offset, "a correction")
        if numbers.shape != self.reach.shape or not is_finite(numbers):
            raise InputError(f"a correction must be {len(self.reach)} finite numbers, not {brief(offset)}")
        return numbers

    def with_offsets(self, offsets: Mapping[int, np.ndarray], *, is_held: bool = False) -> tuple[float, ...]:
        """Return the via-points so far, updated by the corrections of an episode.

        Old via-points between the first and the last new one, and less than `VIA_POINT_SPACING` steps outside of this
        interval, are removed.

        Args:
            offsets: Corrections (A,) by control step, in units of a full action.
            is_held: True if the last correction was held until the episode's end; it then applies to the rest of the
                motion.
        """
        if not offsets:
            return self.points
        steps, last = sorted(offsets), self._reference.num_steps - 1
        points = {min(step, last): offsets[step] for step in steps}
        if is_held:
            points |= dict.fromkeys([*range(steps[-1], last, VIA_POINT_SPACING), last], offsets[steps[-1]])
        new: dict[int, np.ndarray] = {}
        for step in sorted(points):
            if not new or step - max(new) >= VIA_POINT_SPACING or step == max(points):
                new[step] = self._displaced(step, points[step])
        size = 1 + self._reference.num_outputs
        old = {int(row[0]): row[1:] for row in np.reshape(self.points, (-1, size))}
        first, end = min(new) - VIA_POINT_SPACING, max(new) + VIA_POINT_SPACING
        merged = {step: point for step, point in old.items() if not first < step < end} | new
        return tuple(float(number) for step in sorted(merged) for number in (step, *merged[step]))

    def _displaced(self, step: int, offset: np.ndarray) -> np.ndarray:
        """Return the output (O,) within the constraints that is nearest to the displaced demonstration."""
        output = self._reference.means[step].copy()
        output[self._action_dims] += offset * self.reach
        return output if self._constraints is None else self._constraints.nearest(output, step)


class SupervisedTraining(Episodes):
    """Episodes of a run with a supervisor, each in an environment with the via-points of all previous episodes."""

    def __init__(self, config: RunConfig, supervisor: Supervisor):
        """Construct the episodes from the via-points of the configuration.

        Raises:
            InputError: If the guidance has no demonstrations to correct.
        """
        self._supervisor = supervisor
        super().__init__(config, self._make_environment(config))

    @property
    def points(self) -> tuple[float, ...]:
        """Via-points so far, as the option `via_points`."""
        return self._corrections.points

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return the via-points so far."""
        return {}, {"via_points": list(self.points)}

    def restore(self, rows: list[dict[str, Any]], arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> None:
        """Restore the via-points of a result of `state`."""
        self._pass_through(tuple(values["via_points"]))

    def run(self, learner: Learner, *callbacks: Callback, index: int) -> dict[str, Any]:
        """Run one episode and return its row with the column `interventions`; build the next environment."""
        act = InterventionPolicy(self.env, self._supervisor, self.policy(learner, index), self._corrections)
        row = rollout(SupervisedEnv(self.env, self._supervisor), act, learner, *callbacks, index=index)
        if act.via_points != self.points:
            self._pass_through(act.via_points)
            for callback in callbacks:
                if isinstance(callback, EnvCallback):
                    callback.env, callback.base = self.env, self.env.unwrapped
        return row

    def _pass_through(self, points: tuple[float, ...]) -> None:
        """Replace the environment by one whose demonstrations pass through the points, with the same random state."""
        random_state = self.env.unwrapped.np_random.bit_generator.state
        self.env.close()
        self.config = replace(self.config, environment={**self.config.environment, "via_points": points})
        self.env = self._make_environment(self.config)
        self.env.unwrapped.np_random.bit_generator.state = random_state

    def _make_environment(self, config: RunConfig) -> Any:
        self._corrections = ViaPointCorrections(config.task, config.environment)
        env: Any = make_environment(config.task, config.environment)
        env.reset(seed=config.seed)  # samples the hidden offset of the run, as in training
        return env
