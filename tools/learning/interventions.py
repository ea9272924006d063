"""A person who watches a run learn: pushes, stops, and says what was a success.

What a person does is recorded with the run. A push replaces the policy's action, as far as actions reach, so that it is
remembered as a transition like any other; and it becomes via-points where the tool should have been, through which the
demonstrations pass from the next episode on. Both go through guidance: a command that a person led to keeps the
constraints as every other does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.options import kernel_from_options
from guiderail.models.common.errors import InputError
from guiderail.models.primitives.reference import pass_through
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.rollout import Callback, EnvCallback, PolicyFn, Transition, rollout
from guiderail.tools.learning.run_folder import RunConfig

WORTH = {"success": 50.0, "failure": -50.0}  # of what a person says, added to the reward
APART = 5  # control steps between two via-points of a push


class Supervisor:
    """Who watches; this one does nothing."""

    def begin(self, env: gymnasium.Env) -> None:
        """An episode begins."""

    def push(self, observation: np.ndarray) -> np.ndarray | None:
        """How far beside the demonstrations the tool should be, (A,), in what a full action reaches; None for as it is.

        Beyond ±1 an action can't lead in this episode; the next one starts from there.
        """
        return None

    def says(self) -> str | None:
        """What was said since it was last asked: "success", "failure" or "stop"."""
        return None


class SupervisedEnv(gymnasium.Wrapper):
    """An environment whose episodes a person may end."""

    def __init__(self, env: gymnasium.Env, person: Supervisor):
        """
        Args:
            env: the environment.
            person: who watches.
        """
        super().__init__(env)
        self._person = person

    def step(self, action: Any) -> Any:
        """One decision; an episode of which a person says how it went ends there."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        said = None if terminated or truncated else self._person.says()
        if said is None:
            return observation, reward, terminated, truncated, info
        info = {**info, "is_success": said == "success", "termination": said}
        worth = WORTH.get(said, 0.0)
        return observation, float(reward) + worth, said in WORTH, said not in WORTH, info


class InterventionPolicy(Callback):
    """Acts as the policy does, but where a person pushes; afterwards it knows the via-points of that.

    Attributes:
        interventions: how often the person began to push in this episode.
        via_points: of all episodes, as the option of that name: a step and an output each, one after another.
    """

    def __init__(self, env: gymnasium.Env, person: Supervisor, act: PolicyFn, known: ViaPointCorrections):
        """
        Args:
            env: the environment.
            person: who pushes.
            act: what acts otherwise.
            known: of the environment, with what was corrected before.
        """
        self._env, self._person, self._act, self._known = env, person, act, known
        self._pushed: dict[int, np.ndarray] = {}
        self._push: np.ndarray | None = None
        self.interventions = 0

    @property
    def via_points(self) -> tuple[float, ...]:
        """With those of this episode."""
        return self._known.with_pushes(self._pushed, still_pushing=self._push is not None)

    def on_episode_start(self) -> None:
        """An episode begins."""
        self._pushed, self._push, self.interventions = {}, None, 0
        self._person.begin(self._env)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """The policy's action, or as much of the push as an action reaches."""
        push = self._person.push(observation)
        if push is not None and self._push is None:
            self.interventions += 1
        self._push = push
        return self._act(observation) if push is None else np.clip(push, -1.0, 1.0).astype(np.float32)

    def on_step(self, decision: Transition) -> None:
        """Remembers where the tool should have been by then."""
        if self._push is not None:
            self._pushed[int(decision.info["control_steps"]) - 1] = self._push

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """How often the person intervened."""
        return {"interventions": self.interventions}


class ViaPointCorrections:
    """Where pushes lead in an environment's demonstrations.

    Attributes:
        points: via-points so far.
    """

    def __init__(self, task: str, environment: Mapping[str, Any]):
        """
        Args:
            task: its name.
            environment: its options.

        Raises:
            InputError: for guidance that has no demonstrations to correct.
        """
        config = EnvConfig.resolve(task, environment)
        declared, kind = config.make_task(), config.guidance_kind
        if "demonstrations" not in {one for needed in kind.needs for one in needed}:
            raise InputError(
                f"a person corrects demonstrations, which guidance {kind.name!r} does without: choose another, such as "
                "kgrl"
            )
        values = config.options
        self.points = tuple(values["via_points"])
        shown = declared.reference()
        self._reference = pass_through(shown, self.points, kernel_from_options(values))
        action_dims = values["action_dims"]
        self._explored = list(range(shown.num_outputs)) if action_dims is None else list(action_dims)
        spread = np.sqrt(np.mean(shown.standard_deviations**2, axis=0))
        self.reach = np.sqrt(3.0) * values["action_scale"] * spread[self._explored]
        """(A,): how far a full action leads on average [output]."""
        self._constraints = declared.constraints()

    def with_pushes(self, pushes: Mapping[int, np.ndarray], *, still_pushing: bool = False) -> tuple[float, ...]:
        """The via-points with those of an episode's pushes; a newer one replaces older ones beside it.

        Args:
            pushes: by control step, (A,) in what a full action reaches.
            still_pushing: whether the person had not let go when the episode ended: then the last push is meant for the
                rest of the motion, too.
        """
        if not pushes:
            return self.points
        steps, last = sorted(pushes), self._reference.num_steps - 1
        meant = {min(step, last): pushes[step] for step in steps}
        if still_pushing:
            meant |= dict.fromkeys([*range(steps[-1], last, APART), last], pushes[steps[-1]])
        kept: dict[int, np.ndarray] = {}
        for step in sorted(meant):
            if not kept or step - max(kept) >= APART or step == max(meant):
                kept[step] = self._led_to(step, meant[step])
        size = 1 + self._reference.num_outputs
        older = {int(row[0]): row[1:] for row in np.reshape(self.points, (-1, size))}
        first, end = min(kept) - APART, max(kept) + APART
        merged = {step: point for step, point in older.items() if not first < step < end} | kept
        return tuple(float(number) for step in sorted(merged) for number in (step, *merged[step]))

    def _led_to(self, step: int, push: np.ndarray) -> np.ndarray:
        """The allowed output (O,) nearest to where a push leads."""
        output = self._reference.means[step].copy()
        output[self._explored] += push * self.reach
        return output if self._constraints is None else self._constraints.nearest(output, step)


class SupervisedTraining:
    """A run's episodes with a person beside them: each in an environment that knows what was corrected before it.

    Attributes:
        env: the present environment.
    """

    def __init__(self, config: RunConfig, person: Supervisor, state: Mapping[str, Any]):
        """
        Args:
            config: of the run.
            person: who watches.
            state: of the checkpoint from which the run goes on; empty where it begins.

        Raises:
            InputError: for guidance that has no demonstrations to correct.
        """
        self._config, self._person = config, person
        self._enter(tuple(state.get("via_points", config.environment.get("via_points", ()))))

    @property
    def points(self) -> tuple[float, ...]:
        """Via-points so far."""
        return self._corrections.points

    @property
    def config(self) -> RunConfig:
        """The run's configuration, with what was corrected so far: in its environment whoever judges it acts, too."""
        return replace(self._config, environment={**self._config.environment, "via_points": self.points})

    def state(self) -> dict[str, Any]:
        """What a checkpoint has to know."""
        return {"via_points": list(self.points)}

    def rollout(self, act: PolicyFn, *observers: Callback, index: int) -> dict[str, Any]:
        """One episode; its row says how often the person intervened, and the next one knows the via-points of that."""
        corrected = InterventionPolicy(self.env, self._person, act, self._corrections)
        row = rollout(SupervisedEnv(self.env, self._person), corrected, *observers, index=index)
        if corrected.via_points != self.points:
            drawn = self.env.unwrapped.np_random.bit_generator.state
            self.env.close()
            self._enter(corrected.via_points)
            self.env.unwrapped.np_random.bit_generator.state = drawn
            for observer in observers:
                if isinstance(observer, EnvCallback):
                    observer.env, observer.base = self.env, self.env.unwrapped
        return row

    def _enter(self, points: tuple[float, ...]) -> None:
        environment = {**self._config.environment, "via_points": points}
        self._corrections = ViaPointCorrections(self._config.task, environment)
        self.env: Any = make_environment(self._config.task, environment)
        self.env.reset(seed=self._config.seed)  # what is hidden and constant in a run is sampled here, as in training
