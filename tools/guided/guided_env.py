"""Wrapper that adds guidance to any Gymnasium environment: the action moves a demonstrated motion in constraints."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from numbers import Real
from pathlib import Path
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict

from guiderail.models.common.arrays import as_numbers, as_whole
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
        action_repeat = as_whole(action_repeat, "action_repeat", 1)
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

        Entries of the action outside [−1, 1] are clipped. After an error in `to_action`, the next step repeats the
        command and ignores the action.

        Raises:
            InputError: If the action is not (A,) finite numbers, in which case the environment is not stepped, or the
                measured pose is not (O,) finite numbers. If `to_action` returns an invalid action, in which case the
                environment is not stepped, or the environment's step breaks Gymnasium's contract
                (`check_step_result`). After an error of the environment's step, the episode cannot be continued.
            ResetNeeded: If no episode has begun, or the episode has ended.
        """
        if not self._has_begun:
            raise gymnasium.error.ResetNeeded("no episode has begun: call reset() first")
        if self._terminated or self._truncated:
            raise gymnasium.error.ResetNeeded("the episode has ended: call reset() first")
        action = as_numbers(action, "an action")
        if action.shape != (self.guide.num_actions,) or not np.isfinite(action).all():
            raise InputError(f"an action must be {self.guide.num_actions} finite numbers, not {brief(action)}")
        reward, violation, fallbacks, info = 0.0, -np.inf, 0, {}
        successes: dict[str, Any] = {}
        for _ in range(self.action_repeat):
            command = self._next_command(action)
            own_action = self._to_action(self.env, self._observation, command.pose, self._extra)
            self._check_action(own_action)
            if self._is_checked:
                check_values(self.env, self._observation, own_action)
            self._has_begun = self._is_pending = False  # after an error below, the episode cannot be continued
            with naming_wrong_counts():
                result: Any = self.env.step(own_action)
            result = check_step_result(self.env, result)
            self._observation, step_reward, self._terminated, self._truncated, info = result
            if self._is_checked:
                check_values(self.env, self._observation)
            self._has_begun = True
            reward += step_reward
            violation = float(np.maximum(violation, command.violation))  # NaN if one is NaN
            fallbacks += command.fallback
            successes |= {name: info[name] for name in SUCCESSES if np.any(info.get(name, False))}
            self._num_steps += 1
            self._truncated = bool(self._truncated) or (self.guide.is_finished and not self._terminated)
            if self._terminated or self._truncated:
                break
        info = {
            "control_steps": self._num_steps,
            **info,
            **successes,
            "constraint_violation": violation,
            "fallback": fallbacks,
            "phase": self.guide.phase,
            "command": command.pose.copy(),
            "segment": self.guide.segment_name,
        }
        return self._extended(), reward, bool(self._terminated), bool(self._truncated), info

    def _next_command(self, action: np.ndarray) -> Command:
        """Return the command of the next step, or again the last one if an error prevented its step."""
        measured = self._measured()
        if self._command is None or not self._is_pending:
            self._command, self._extra = self.guide.command(self.env, self._observation, action, measured)
        self._is_pending = True
        return self._command

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
