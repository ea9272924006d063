"""Wrappers that add guidance to any Gymnasium environment: the action moves a demonstrated motion in constraints."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from numbers import Real
from pathlib import Path
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from guiderail.models.common.arrays import as_numbers, is_whole
from guiderail.models.common.errors import InputError, brief
from guiderail.models.laws.law import Command, Law
from guiderail.models.primitives import Demonstrations
from guiderail.models.primitives.lc_ns_kmp import HISTORY, HORIZON
from guiderail.models.primitives.poses import Orientation, check_orientation
from guiderail.models.templates import SharedControlTemplate, load_template
from guiderail.tools.guided.guide import (
    Guide,
    GuideSettings,
    LawGuide,
    PrimitiveGuide,
    TemplateGuide,
    predict_request,
)
from guiderail.tools.guided.segment import Constraints, Segment
from guiderail.tools.spaces import check_reset_result, check_step_result, check_values, naming_wrong_counts

OBSERVED = ("phase", "command")
FAR_OUTSIDE = 10.0  # distance of an action from the action space that is refused, in widths of the space
SUCCESSES = ("is_success", "success")  # entries of `info` that report success


class GuidedEnv(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Environment whose actions move the command of a movement primitive or of a template, within its constraints.

    The action is (A,) in [−1, 1], one entry for each of `action_dims` or each input of the template. It is applied for
    `action_repeat` steps of the environment, whose rewards are added up. An episode is truncated when the motion has
    ended. `is_success` and `success` in `info` are true if they are true after any of the action's steps. `info` has
    these entries in addition to the environment's:

    - `constraint_violation`: largest violation by the commands of the action. It is negative inside the constraints,
      0 inside those of a template, and −inf without constraints. It is at most 1e-9 for guidance that enforces the
      constraints, except while a motion that began outside `MotionConstraints` or outside a template moves inside.
    - `fallback`: number of the action's steps with a fallback command: no solution was found, only braking was
      feasible, or a segment exceeded its largest acceleration to brake within its other constraints.
    - `phase`: phase of the motion, 0 to 1.
    - `command`: last command (O,) in the world.
    - `segment`: name of the segment or of the template's state.
    - `control_steps`: number of steps of `env` since the reset, unless its own `info` counts them.

    Args:
        env: Environment to wrap; its own action is what `to_action` returns.
        demonstrations: Demonstrations of one motion in the world or in `frame`, their file, or a list of `Segment`; at
            least three demonstrations for each, because the kernel is selected from their spread.
        pose: (env, observation) → measured outputs (O,) in the world, such as a position, or a position and an
            orientation (see `orientation`).
        to_action: (env, observation, command, extra) → action of `env` that reaches the command (O,); `extra` is the
            segment's discrete output, such as a gripper command.
        guidance: "kgrl", "skgrl", "kmp" (the demonstrated motion alone), "residual" (the action is added to the motion,
            without constraints), "clipped_residual" (as "residual", moved to the nearest point within the linear
            constraints), "template", a `Law`, or a `Guide`. A law or a guide replaces the arguments about the motion:
            settings such as `horizon` are ignored, and the others are refused. Each environment needs its own guide,
            which stores the state of an episode: give `Guide.copy()` to another environment.
        constraints: Constraints of a single motion without segments, as in `Segment`.
        frame: Frame of a single motion without segments, as in `Segment`.
        template: Template, or the name or file of one, for guidance="template".
        template_frames: (env, observation) → poses X_WF of the template's objects by name, called at reset; each is a
            `RigidTransform` of `guiderail.models.common.transforms` or of Drake.
        period: Duration of a step of `env` [s], positive; required for a template, for `MotionConstraints`, and unless
            every segment has `num_steps`.
        action_repeat: Steps of `env` for which an action is applied, at least 1.
        action_scale: κ. A constant action of ±1 displaces the motion by about √3 κ standard deviations of the
            demonstrations, and by exactly √3 κ declared standard deviations (`prior_std`).
        action_dims: Indices of the outputs that an action moves; all by default.
        history: P, number of past outputs that the motion of sKGRL passes through, at least 1.
        history_variance: ρ, variance of the past outputs [output²].
        horizon: H, number of future points at which the constraints are satisfied, at least 0.
        orientation: Representation of the last three of six outputs: "euler_zyx" for angles [Rz Ry Rx], or
            "rotation_vector". By default, "euler_zyx" if the demonstrations name them "Rz [rad]", "Ry [rad]",
            "Rx [rad]", otherwise "rotation_vector".
        observe: Terms appended to the observation: "phase" (1,), scaled to [−1, 1], and "command" (O,), the last
            command in the segment's frame, scaled to the demonstrations' range. The command of a template is in the
            template's first frame, in units of 0.2 m and π.
        check_env: True to check in the first episode that every observation of `env`, and every action of `to_action`,
            is within its space and has its data type. Shapes, rewards and the other results are checked in all
            episodes.

    Raises:
        InputError: If an argument is out of range.

    Attributes:
        guide: Guide, which computes the commands.
        action_repeat: Steps of the environment for each action.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        *,
        demonstrations: Demonstrations | Sequence[Segment] | str | Path | None = None,
        pose: Callable[[Any, Any], np.ndarray],
        to_action: Callable[[Any, Any, np.ndarray, Any], Any],
        guidance: str | Law | Guide = "skgrl",
        constraints: Constraints | Callable[[Any, Any], Constraints] | None = None,
        frame: Callable[[Any, Any], Any] | None = None,
        template: SharedControlTemplate | str | Path | None = None,
        template_frames: Callable[[Any, Any], Mapping[str, Any]] | None = None,
        period: float | None = None,
        action_repeat: int = 5,
        action_scale: float = 1.0,
        action_dims: Sequence[int] | None = None,
        history: int = HISTORY,
        history_variance: float = 1e-6,
        horizon: int = HORIZON,
        orientation: Orientation | None = None,
        observe: Sequence[str] = OBSERVED,
        check_env: bool = False,
    ):
        super().__init__(env)
        self._is_checked = check_env  # False after the first episode
        if not is_whole(action_repeat, 1):
            raise InputError(f"action_repeat is a number of steps, at least 1, not {brief(action_repeat)}")
        settings = GuideSettings(action_scale, action_dims, history, history_variance, horizon, orientation)
        if period is not None and not (isinstance(period, Real) and 0.0 < period < np.inf):
            raise InputError(f"the period of the environment must be a positive number of seconds, not {brief(period)}")
        if not all(name in OBSERVED for name in observe):
            raise InputError(f"observe has some of {', '.join(OBSERVED)}, not {brief(observe)}")
        if orientation is not None:
            check_orientation(orientation)
        if isinstance(guidance, Law):
            guidance = LawGuide(guidance)
        of_primitive = {"demonstrations": demonstrations, "constraints": constraints, "frame": frame}
        of_template = {"template": template, "template_frames": template_frames}
        if isinstance(guidance, Guide):
            chosen = {"action_dims": action_dims, "orientation": orientation}
            _refuse_unused("a guide", of_primitive | of_template | chosen)
            self.guide = guidance
        elif guidance == "template":
            if template is None or template_frames is None:
                raise InputError("guidance by a template needs template= and template_frames=")
            if orientation == "rotation_vector":
                raise InputError("poses of a template are [x y z Rz Ry Rx]: leave orientation out")
            _refuse_unused("guidance by a template", of_primitive)
            if not isinstance(template, SharedControlTemplate):
                template = load_template(template)
            self.guide = TemplateGuide(template, template_frames, period)
        else:
            _refuse_unused(f"guidance={guidance!r}", of_template)
            self.guide = PrimitiveGuide(_segments(demonstrations, constraints, frame), guidance, settings, period)
        self.action_repeat, self._observe = int(action_repeat), tuple(observe)
        self._pose, self._to_action = pose, to_action
        self._command: Command | None = None
        self._extra: Any = None
        self._is_pending = False  # True if an error prevented the step with `_command`
        self._observation: Any = None
        self._has_begun = False
        self._num_steps = 0
        self._terminated = self._truncated = False
        self.action_space = Box(-1.0, 1.0, (self.guide.num_actions,), np.float32)
        self.observation_space = self._extended_space(env.observation_space)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment and begin the motion at the measured pose.

        Raises:
            InputError: If the measured pose is not (O,) finite numbers, a frame or constraints are invalid, or the
                environment's reset does not return an observation of its space and a dictionary.
        """
        self._is_checked &= self._num_steps == 0  # the first episode has ended
        self._has_begun = False  # after an error below, no episode can be stepped
        self._observation, info = check_reset_result(self.env, self.env.reset(seed=seed, options=options))
        if self._is_checked:
            check_values(self.env, self._observation)
        self._terminated = self._truncated = self._is_pending = False
        self._num_steps = 0
        measured = self._measured()
        self.guide.reset(self.env, self._observation, measured)
        self._has_begun = True
        return self._extended(), {**info, "phase": self.guide.phase, "segment": self.guide.segment_name}

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Apply an action (A,) for `action_repeat` steps of the environment, or until the episode ends.

        Raises:
            InputError: If the action is not (A,) finite numbers, in which case the environment is not stepped, or the
                measured pose is not (O,) finite numbers.
            ResetNeeded: If no episode has begun, or the episode has ended.
        """
        self.begin_action(action)
        while not self.is_action_complete:
            self.advance(predict_request(self.request()))
        return self.end_action()

    def begin_action(self, action: Any) -> None:
        """Begin an action; `request`, `advance` and `end_action` apply it step by step, alongside other environments.

        Raises:
            InputError: If the action is not (A,) finite numbers; entries outside [−1, 1] are clipped.
            ResetNeeded: If no episode has begun, or the episode has ended.
        """
        if not self._has_begun:
            raise gymnasium.error.ResetNeeded("no episode has begun: call reset() first")
        if self._terminated or self._truncated:
            raise gymnasium.error.ResetNeeded("the episode has ended: call reset() first")
        checked = as_numbers(action, "an action")
        if checked.shape != (self.guide.num_actions,) or not np.isfinite(checked).all():
            raise InputError(f"an action must be {self.guide.num_actions} finite numbers, not {brief(action)}")
        self._action, self._count, self._reward = checked, 0, 0.0
        self._violation, self._fallbacks = -np.inf, 0
        self._info: dict[str, Any] = {}
        self._successes: dict[str, Any] = {}

    @property
    def is_action_complete(self) -> bool:
        """True after the last step of an action, or the end of the episode."""
        return self._count >= self.action_repeat or self._terminated or self._truncated

    def request(self) -> Any:
        """Return the request for the next step's prediction, or None if the step needs no prediction.

        After an error in `to_action`, the next step repeats the command and ignores the action.

        Raises:
            InputError: If the measured pose is not (O,) finite numbers.
        """
        measured = self._measured()
        return None if self._is_pending else self.guide.request(self.env, self._observation, self._action, measured)

    def advance(self, output: np.ndarray | None) -> None:
        """Step the environment with the predicted output (O,); None without a request or a solution.

        Raises:
            InputError: If `to_action` returns an invalid action, in which case the environment is not stepped, or the
                environment's step breaks Gymnasium's contract (`check_step_result`). After an error of the
                environment's step, the episode cannot be continued.
        """
        command = self._command
        if command is None or not self._is_pending:
            command, self._extra = self.guide.finish(output)
            self._command = command
        self._is_pending = True
        action = self._to_action(self.env, self._observation, command.pose, self._extra)
        self._check_action(action)
        if self._is_checked:
            check_values(self.env, self._observation, action)
        self._has_begun = self._is_pending = False  # after an error below, the episode cannot be continued
        with naming_wrong_counts():
            result: Any = self.env.step(action)
        result = check_step_result(self.env, result)
        self._observation, reward, self._terminated, self._truncated, self._info = result
        if self._is_checked:
            check_values(self.env, self._observation)
        self._has_begun = True
        self._reward += reward
        self._violation = float(np.maximum(self._violation, command.violation))  # NaN if one is NaN
        self._fallbacks += command.fallback
        self._successes |= {name: self._info[name] for name in SUCCESSES if np.any(self._info.get(name, False))}
        self._count += 1
        self._num_steps += 1
        self._truncated = bool(self._truncated) or (self.guide.is_finished and not self._terminated)

    def end_action(self) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Return observation, summed reward, terminated, truncated and info, as `step` does."""
        assert self._command is not None
        info = {
            "control_steps": self._num_steps,
            **self._info,
            **self._successes,
            "constraint_violation": self._violation,
            "fallback": self._fallbacks,
            "phase": self.guide.phase,
            "command": self._command.pose.copy(),
            "segment": self.guide.segment_name,
        }
        return self._extended(), self._reward, bool(self._terminated), bool(self._truncated), info

    def _check_action(self, action: Any) -> None:
        """Raise an InputError if the result of `to_action` does not have the shape of an action, or is not finite."""
        space = self.env.action_space
        if not isinstance(space, Box):
            return
        try:
            is_action = np.shape(action) == space.shape and bool(np.isfinite(action).all())
        except (TypeError, ValueError):  # not numbers, or ragged
            is_action = False
        if not is_action:
            raise InputError(f"to_action must return finite numbers of shape {space.shape}, not {brief(action)}")
        # An environment may clip actions a little outside of its space, but then it does not follow the command.
        with np.errstate(over="ignore", invalid="ignore"):
            beyond = np.maximum(space.low - action, action - space.high) / (space.high - space.low)
        if (beyond > FAR_OUTSIDE).any():
            raise InputError(
                f"to_action returned {brief(action)}, and the environment's actions are from {brief(space.low)} to "
                f"{brief(space.high)}: check the units of to_action, the demonstrations and the constraints"
            )

    def _measured(self) -> np.ndarray:
        measured = as_numbers(self._pose(self.env, self._observation), "the measured pose")
        if measured.shape != (self.guide.num_outputs,) or not np.isfinite(measured).all():
            raise InputError(f"pose must return {self.guide.num_outputs} finite numbers, not {brief(measured)}")
        return measured

    def _extended_space(self, space: gymnasium.Space[Any]) -> gymnasium.Space[Any]:
        sizes = {"phase": 1, "command": self.guide.num_outputs}
        extra = {name: Box(-np.inf, np.inf, (sizes[name],), np.float32) for name in self._observe}
        if not extra:
            return space
        if isinstance(space, Box) and len(space.shape) == 1:
            low = np.concatenate([space.low, *(box.low for box in extra.values())])
            high = np.concatenate([space.high, *(box.high for box in extra.values())])
            return Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
        if isinstance(space, Dict):
            if taken := sorted(extra.keys() & space.spaces.keys()):
                raise InputError(
                    f"the environment's observation has an entry {taken[0]!r} already: rename it, or leave {taken[0]} "
                    "out of observe"
                )
            return Dict({**space.spaces, **extra})
        return Dict({"observation": space, **extra})

    def _extended(self) -> Any:
        values = {"phase": lambda: [2.0 * self.guide.phase - 1.0], "command": self.guide.scaled_command}
        extra = {name: np.asarray(values[name](), dtype=np.float32) for name in self._observe}
        if not extra:
            return self._observation
        space = self.env.observation_space
        if isinstance(space, Box) and len(space.shape) == 1:
            return np.concatenate([self._observation, *extra.values()]).astype(np.float32)
        if isinstance(space, Dict):
            return {**self._observation, **extra}
        return {"observation": self._observation, **extra}


def _refuse_unused(user: str, arguments: Mapping[str, Any]) -> None:
    """Raise an InputError if an argument is given that the guidance does not use."""
    if superfluous := [name for name, value in arguments.items() if value is not None]:
        raise InputError(f"{user} does not use {superfluous[0]}: leave it out")


def _segments(demonstrations: Any, constraints: Any, frame: Any) -> list[Segment]:
    """Return the segments of a motion; a motion without segments becomes a single one."""
    if demonstrations is None:
        raise InputError("guidance by demonstrations needs demonstrations=")
    if isinstance(demonstrations, Demonstrations | str | Path):
        return [Segment(demonstrations, frame=frame, constraints=constraints)]
    if constraints is not None or frame is not None:
        raise InputError("give constraints and frame to each Segment")
    return list(demonstrations)


class GuidedVectorEnv(SyncVectorEnv):
    """Vector environment of `GuidedEnv`s that share fitted primitives; each behaves like a single `GuidedEnv`.

    The primitives are fitted once. `LcNsKmp.predict_batch` computes the predictions of all environments in each step.
    An environment is reset in the step after the end of its episode (`AutoresetMode.NEXT_STEP`).

    Args:
        env_fns: Functions that return the environments to wrap, at least one.
        **keywords: Keywords of `GuidedEnv`.

    Raises:
        InputError: As `GuidedEnv`, or if two functions return the same environment.
    """

    def __init__(self, env_fns: Sequence[Callable[[], gymnasium.Env[Any, Any]]], **keywords: Any):
        env_fns = list(env_fns)
        first = GuidedEnv(env_fns[0](), **keywords)
        own = {  # arguments that are not part of the shared guide
            name: keywords[name]
            for name in ("pose", "to_action", "action_repeat", "observe", "check_env")
            if name in keywords
        }

        def wrap(make: Callable[[], gymnasium.Env[Any, Any]]) -> Callable[[], gymnasium.Env[Any, Any]]:
            return lambda: GuidedEnv(make(), guidance=first.guide.copy(), **own)

        super().__init__([lambda: first, *map(wrap, env_fns[1:])], autoreset_mode=AutoresetMode.NEXT_STEP)
        if len({id(env.unwrapped) for env in self.envs}) < len(self.envs):
            raise InputError("each of env_fns must return an environment of its own: two of them return the same one")

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Apply actions (B, A); return observations, rewards (B,), terminations (B,), truncations (B,) and infos.

        Raises:
            InputError: If the actions are not (B, A) finite numbers, in which case no environment is stepped, or a
                measured pose is not (O,) finite numbers.
            ResetNeeded: If no episode has begun.
        """
        actions = as_numbers(actions, "actions")
        if actions.shape != self.action_space.shape:
            raise InputError(f"actions must be of shape {self.action_space.shape}, not {actions.shape}")
        if not np.isfinite(actions).all():
            raise InputError(f"actions must be finite, not {brief(actions)}")
        stepped = [i for i in range(self.num_envs) if not self._autoreset_envs[i]]
        guided: list[Any] = [self.envs[i] for i in stepped]
        for env, i in zip(guided, stepped, strict=True):
            env.begin_action(actions[i])
        while active := [env for env in guided if not env.is_action_complete]:
            for env, output in zip(active, _predict_batch([env.request() for env in active]), strict=True):
                env.advance(output)
        results = {i: env.end_action() for env, i in zip(guided, stepped, strict=True)}
        infos: dict[str, Any] = {}
        for i, env in enumerate(self.envs):
            if i in results:
                self._env_obs[i], self._rewards[i], self._terminations[i], self._truncations[i], info = results[i]
            else:
                self._env_obs[i], info = env.reset()
                self._rewards[i], self._terminations[i], self._truncations[i] = 0.0, False, False
            infos = self._add_info(infos, info, i)
        self._observations = gymnasium.vector.utils.concatenate(
            self.single_observation_space, self._env_obs, self._observations
        )
        self._autoreset_envs = np.logical_or(self._terminations, self._truncations)
        observations = deepcopy(self._observations) if self.copy else self._observations
        return observations, np.copy(self._rewards), np.copy(self._terminations), np.copy(self._truncations), infos


def _predict_batch(requests: list[Any]) -> list[np.ndarray | None]:
    """Compute requested predictions, batched by primitive; an output is None without a request or a solution."""
    groups: dict[int, list[int]] = defaultdict(list)
    outputs: list[np.ndarray | None] = [None] * len(requests)
    for i, request in enumerate(requests):
        if request is not None:
            groups[id(request[0])].append(i)
    for rows in groups.values():
        if len(rows) == 1:
            outputs[rows[0]] = predict_request(requests[rows[0]])
            continue
        primitive, _, _, history = requests[rows[0]]
        _, steps, raw, histories = zip(*(requests[i] for i in rows), strict=True)
        batch = primitive.predict_batch(steps, np.array(raw), None if history is None else np.array(histories))
        for i, output, is_solved in zip(rows, batch.outputs, batch.is_solved, strict=True):
            outputs[i] = output if is_solved else None
    return outputs
