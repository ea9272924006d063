"""Guides: compute commands from a policy's actions and demonstrations, or a shared control template."""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium
import numpy as np

from guiderail.models.common.arrays import as_whole
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import did_you_mean
from guiderail.models.common.transforms import POSE_SIZE, RigidTransform, pose_to_transform, transform_to_pose
from guiderail.models.control.motion_constraints import MotionConstraintFilter, MotionConstraints
from guiderail.models.laws.law import Command, Law, check_law, safe_command
from guiderail.models.laws.primitive import PrimitiveLaw
from guiderail.models.laws.template_law import TemplateLaw
from guiderail.models.primitives import LcNsKmp, LinearConstraints
from guiderail.models.primitives.demonstrations import DemonstratedBounds, phases_of_steps
from guiderail.models.primitives.fit import LONG, MIN_DEMONSTRATIONS, Selection, fit
from guiderail.models.primitives.gains import authority_gains, check_action_scale, deviation, residual_gains
from guiderail.models.primitives.lc_ns_kmp import HISTORY, HORIZON
from guiderail.models.primitives.poses import Orientation, check_orientation, orientation_of_names
from guiderail.models.templates import SharedControlTemplate
from guiderail.tools.guided.segment import Frame, Segment, as_bool

PRIMITIVE_GUIDANCE = ("kgrl", "skgrl", "kmp", "residual", "clipped_residual")
GUIDANCE = (*PRIMITIVE_GUIDANCE, "template")

# Ratio of two lengths above which a warning states that one of them may have another unit; and fraction of the
# demonstrations' range that the start of an episode is, in addition, at least away from their start.
FAR, FAR_FRACTION = 10.0, 0.1
# Scale of the observed command of a template [m, rad]; a template has no demonstrations that define a range.
_COMMAND_SCALE = np.array([0.2, 0.2, 0.2, np.pi, np.pi, np.pi])


class Guide(ABC):
    """Source of the commands of an episode, one per control step.

    Attributes:
        num_outputs: Number O of outputs of a command.
        num_actions: Number A of entries of an action.
    """

    num_outputs: int
    num_actions: int
    _law: Law
    _last: Command | None  # command of the last control step; None at the start of `_law`

    def copy(self) -> Guide:
        """Return a guide for another environment, which shares the fitted parts but not the episode."""
        return copy(self)

    @abstractmethod
    def reset(self, env: Any, observation: Any, pose: np.ndarray) -> None:
        """Begin an episode at a measured pose (O,)."""

    def _begin(self, law: Law, pose: np.ndarray) -> None:
        """Begin with the commands of a law at a measured pose (O,), or after the last outputs (n, O)."""
        self._law, self._state, self._last, self._start = law, law.start(pose), None, pose

    def command(self, env: Any, observation: Any, action: np.ndarray, pose: np.ndarray) -> tuple[Command, Any]:
        """Return the command of a control step, in the world, and the discrete output for `to_action`.

        After an error of a function of the user, a second call begins the same control step again.

        Args:
            env: Environment, for the callables of segments and templates.
            observation: Last observation of `env`.
            action: Policy's action (A,), finite; the guide clips it to [−1, 1].
            pose: Measured pose (O,).
        """
        last = self._last
        self._now = self._state if last is None else self._law.next(self._state, last, pose)
        extra = self._extra()  # may call a function of the user, whose error must not skip a command
        arguments = self._now, np.clip(action, -1.0, 1.0), pose, np.zeros(0)
        if isinstance(self._law, PrimitiveLaw):  # its commands are finite, in the segment's frame
            command = self._law.command(*arguments)
        else:
            command = safe_command(self._law.command(*arguments), pose if last is None else last.pose)
        self._state, self._last = self._now, command
        return command, extra

    def _extra(self) -> Any:
        """Return the discrete output of the control step, for `to_action`."""
        return None

    @property
    def is_finished(self) -> bool:
        """True after the last step of the motion."""
        return False

    @property
    def phase(self) -> float:
        """Phase of the motion, from 0 to 1."""
        return 0.0

    @property
    def segment_name(self) -> str:
        """Name of the current segment."""
        return "0"

    @abstractmethod
    def scaled_command(self) -> np.ndarray:
        """Return the last command (O,) in the segment's frame, scaled to about ±1."""


class _FittedSegment:
    """Segment with its reference, primitive and gains."""

    def __init__(self, segment: Segment, guidance: str, settings: GuideSettings, period: float | None):
        self.segment, self.guidance, self.settings = segment, guidance, settings
        self.num_steps = segment.steps_of(period)
        # A fit to long recordings takes seconds.
        say = partial(print, "guiderail:", file=sys.stderr, flush=True) if self.num_steps > LONG else None
        recorded = segment.recorded.resampled(self.num_steps)
        self.selection: Selection = fit(recorded, floor=segment.floor, horizon=settings.horizon, log=say)
        self.reference = self.selection.reference
        self.num_outputs = self.reference.num_outputs
        self.discrete = segment.discrete_values(self.num_steps)
        samples = np.concatenate(segment.recorded.outputs)
        self.center = 0.5 * (samples.max(axis=0) + samples.min(axis=0))
        self.half_range = np.maximum(0.5 * np.ptp(samples, axis=0), deviation(self.reference))
        self._primitive: LcNsKmp | None = None
        if not callable(segment.constraints):
            self.primitive_for(self.as_linear(segment.constraints))  # refuses invalid constraints before an episode

    def as_linear(self, constraints: Any) -> LinearConstraints:
        """Return the linear constraints of a segment; demonstrated bounds become a box for each step."""
        if constraints is None:
            return LinearConstraints.none(self.num_outputs)
        if isinstance(constraints, DemonstratedBounds):
            phase = phases_of_steps(constraints.phases, self.num_steps) if len(constraints.phases) > 1 else 0
            constraints = LinearConstraints.box(constraints.lower[phase], constraints.upper[phase])
        if isinstance(constraints, MotionConstraints):
            if "residual" in self.guidance:
                constraints.refuse_limits()
            constraints = constraints.linear
        constraints.check_sizes(self.num_outputs, self.num_steps)
        return constraints

    def primitive_for(self, constraints: LinearConstraints) -> tuple[LcNsKmp, np.ndarray]:
        """Return the primitive with these constraints, rebuilt only if the constraints change, and its gains (O,)."""
        current = self._primitive
        if current is None or not (
            np.array_equal(current.constraints.G, constraints.G)
            and np.array_equal(current.constraints.c, constraints.c)
        ):
            self._primitive = current = self.selection.primitive(
                horizon=self.settings.horizon,
                history=self.settings.history if self.guidance == "skgrl" else 0,
                history_variance=self.settings.history_variance,
                constraints=constraints,
            )
            self._gains = self._make_gains(current)
        return current, self._gains

    def _make_gains(self, primitive: LcNsKmp) -> np.ndarray:
        if self.guidance == "kmp":
            return np.zeros(self.num_outputs)
        dims = _checked_dims(self.settings.action_dims, self.num_outputs)
        if "residual" in self.guidance:
            groups = (range(3), range(3, 6)) if self.num_outputs == 6 else ()
            gains = residual_gains(self.reference, self.settings.action_scale, groups)
            return np.where(np.isin(np.arange(self.num_outputs), dims), gains, 0.0)
        return authority_gains(primitive, self.settings.action_scale, np.array(dims))


@dataclass(frozen=True)
class GuideSettings:
    """Settings of guidance by demonstrations."""

    # κ; a constant action of ±1 displaces the motion by about √3 κ standard deviations of the demonstrations.
    action_scale: float = 1.0
    action_dims: Sequence[int] | None = None  # outputs that an action moves, one entry each; all by default
    history: int = HISTORY  # P, number of past outputs that the motion of sKGRL passes through
    history_variance: float = 1e-6  # ρ, variance of the past outputs [output²]
    horizon: int = HORIZON  # H, number of future points at which the constraints are satisfied
    # Representation of the last three of six outputs; None: by the demonstrations' names, otherwise "rotation_vector".
    orientation: Orientation | None = None


class PrimitiveGuide(Guide):
    """Guide by movement primitives, one segment after another.

    Args:
        segments: Segments in their order.
        guidance: "kgrl", "skgrl", "kmp" (actions have no effect), "residual" (no constraints) or "clipped_residual"
            (moved to the nearest point within the linear constraints).
        settings: Settings.
        period: Control period [s]; required for `MotionConstraints`, and unless every segment has `num_steps`.
    """

    def __init__(
        self, segments: Sequence[Segment], guidance: str, settings: GuideSettings, period: float | None = None
    ):
        if guidance not in PRIMITIVE_GUIDANCE:
            raise InputError(f"there is no guidance {brief(guidance)}: {did_you_mean(guidance, GUIDANCE)}")
        if not segments:
            raise InputError("guidance by demonstrations needs at least one segment")
        as_whole(settings.history, "history", 1)
        for index, segment in enumerate(segments):
            if (number := segment.recorded.num_demonstrations) < MIN_DEMONSTRATIONS:
                raise InputError(
                    f"guidance by demonstrations needs at least {MIN_DEMONSTRATIONS} in each segment, and segment "
                    f"{segment.name or index} has {number}: record more, or give a PrimitiveLaw of your own "
                    "(ReferenceTrajectory.from_demonstrations takes two, or one with prior_std)"
                )
        sizes = {segment.recorded.num_outputs for segment in segments}
        if len(sizes) > 1:
            raise InputError(f"all segments need the same number of outputs, not {sorted(sizes)}")
        (self.num_outputs,) = sizes
        self._period = period
        self._orientation = _orientation_of(segments, settings.orientation)
        self.guidance, self.settings, self._has_begun = guidance, settings, False
        check_action_scale(settings.action_scale)
        self._dims = _checked_dims(settings.action_dims, self.num_outputs)
        self.num_actions = len(self._dims)
        self.segments = [_FittedSegment(segment, guidance, settings, period) for segment in segments]
        self.num_steps = sum(fitted.num_steps + fitted.segment.dwell for fitted in self.segments)

    def reset(self, env: Any, observation: Any, pose: np.ndarray) -> None:
        """Begin the first segment."""
        self._recent = [np.array(pose, dtype=float)]
        self._is_ended = False
        self._begin_segment(0, env, observation)
        if not self._has_begun:
            self._has_begun = True
            self._warn_of_units()

    def _warn_of_units(self) -> None:
        """Warn if pose, demonstrations and constraints are so far apart that one may have another unit or frame."""
        reference, warn = self.segments[0].reference, gymnasium.logger.warn
        start, deviation = reference.means[0], np.sqrt(np.diag(reference.covariances[0]))
        distance = float(np.linalg.norm(self._last_output - start))
        if distance > max(FAR * np.linalg.norm(deviation), FAR_FRACTION * np.ptp(reference.means, 0).max()):
            warn(
                f"the first episode begins at {_numbers(self._last_output)}, and the demonstrations at "
                f"{_numbers(start)} with standard deviations {_numbers(deviation)}: check units and frames of the "
                "measured pose and of the demonstrations"
            )
        nearest = np.array([self.constraints.nearest(mean, step) for step, mean in enumerate(reference.means)])
        outside, extent = np.median(np.linalg.norm(reference.means - nearest, axis=1)), np.ptp(nearest, 0).max()
        if outside > FAR * extent:
            warn(
                f"at half of the steps the demonstrations are outside of the constraints by {outside:.3g} or more, and "
                f"within the constraints the motion extends over {extent:.3g}: check the units of both"
            )
        extents = [np.ptp(outputs, 0).max() for outputs in self.segments[0].segment.recorded.outputs]
        if max(extents) > FAR * np.median(extents):
            warn(
                f"demonstration {np.argmax(extents)} extends over {max(extents):.3g}, and the median one over "
                f"{np.median(extents):.3g}: check its unit"
            )

    def _begin_segment(self, index: int, env: Any, observation: Any) -> None:
        self._index, self._step = index, 0
        fitted = self.segments[index]
        segment = fitted.segment
        frame = segment.frame(env, observation) if segment.frame is not None else np.zeros(0)
        self.frame = frame if isinstance(frame, Frame) else Frame(frame)
        constraints = segment.constraints
        constraints = constraints(env, observation) if callable(constraints) else constraints
        self.constraints = fitted.as_linear(constraints)
        is_enforced = "residual" not in self.guidance
        motion, motion_filter = constraints if isinstance(constraints, MotionConstraints) else None, None
        if motion is not None and is_enforced:
            if self._period is None:
                raise InputError("constraints of the motion need the period of the environment [s]")
            motion_filter = MotionConstraintFilter(motion, self._period)
        primitive, gains = fitted.primitive_for(
            self.constraints if is_enforced else LinearConstraints.none(self.num_outputs)
        )
        law = PrimitiveLaw(
            primitive,
            gains if is_enforced else np.zeros(self.num_outputs),
            residual=None if is_enforced else gains,
            outputs=self._dims,
            command_filter=motion_filter,
            checked=motion or self.constraints,
            clip=self.constraints if self.guidance == "clipped_residual" else None,
        )
        length = max(primitive.history, 1 if motion_filter is None else 2)  # a filter continues the last velocity
        recent = self._recent[-length:]
        past = [self.frame.to_frame(recent[-1], self._orientation, fitted.reference.means[0])]
        for output in recent[-2::-1]:  # each orientation is near the next, without jumps by a full turn
            past.insert(0, self.frame.to_frame(output, self._orientation, past[0]))
        past = [past[0]] * (length - len(past)) + past
        self._begin(law, past[-1] if primitive.history == 0 and motion_filter is None else np.array(past))
        self._last_output = past[-1]

    def command(self, env: Any, observation: Any, action: np.ndarray, pose: np.ndarray) -> tuple[Command, Any]:
        """Return the command of a control step; begin the next segment if the current one has ended."""
        fitted = self.segments[self._index]
        segment = fitted.segment
        is_over = self._step >= fitted.num_steps + segment.dwell
        if not is_over and segment.until is not None and self._step > 0:
            is_over = as_bool(segment.until(env, observation), "until of a segment")
        if is_over and self._index + 1 < len(self.segments):
            self._begin_segment(self._index + 1, env, observation)
        elif is_over:
            self._is_ended = True
        command, extra = super().command(env, observation, action, pose)
        self._last_output = command.pose
        world = self.frame.to_world(command.pose, self._orientation)
        self._recent = [*self._recent, world][-max(self.settings.history, 2) :]
        self._step += 1
        return command._replace(pose=world), extra

    def _extra(self) -> Any:
        fitted, step = self.segments[self._index], self._step
        if callable(fitted.segment.extra):
            last = fitted.num_steps - 1
            return fitted.segment.extra(min(step / last, 1.0), step > last)
        if fitted.discrete is not None:
            return fitted.discrete[min(step, fitted.num_steps - 1)]
        return fitted.segment.extra

    @property
    def is_finished(self) -> bool:
        """True after the last step of the last segment, or after that segment has ended early."""
        fitted = self.segments[self._index]
        is_last = self._index + 1 == len(self.segments)
        return self._is_ended or (is_last and self._step >= fitted.num_steps + fitted.segment.dwell)

    @property
    def phase(self) -> float:
        """Completed fraction of the steps of all segments; it jumps if a segment ends early."""
        before = sum(fitted.num_steps + fitted.segment.dwell for fitted in self.segments[: self._index])
        return (before + self._step) / self.num_steps

    @property
    def segment_name(self) -> str:
        """Name of the current segment, or its index if it has no name."""
        return self.segments[self._index].segment.name or str(self._index)

    def scaled_command(self) -> np.ndarray:
        """Return the last command (O,) in the segment's frame, scaled to ±1 over the range of its demonstrations."""
        fitted = self.segments[self._index]
        return (self._last_output - fitted.center) / fitted.half_range


def _checked_dims(action_dims: Sequence[int] | None, num_outputs: int) -> list[int]:
    """Return the indices of the outputs that an action moves; raise an InputError unless they are distinct indices."""
    if action_dims is None:
        return list(range(num_outputs))
    dims = [as_whole(o, "an output in action_dims", 0, num_outputs - 1) for o in action_dims]
    if len(set(dims)) < len(dims):
        raise InputError(f"action_dims names an output twice, {brief(action_dims)}: name each output once")
    return dims


def _orientation_of(segments: Sequence[Segment], given: Orientation | None) -> Orientation:
    """Return the orientation `given`, or that of the outputs' names; raise an InputError if both differ."""
    if given is not None:
        check_orientation(given)
        if (number := segments[0].recorded.num_outputs) != POSE_SIZE:
            raise InputError(f"orientation needs poses of 6 outputs, and there are {number}: leave it out")
    orientation = given
    for segment in segments:
        named = orientation_of_names(segment.recorded.names)
        if named is not None and orientation not in (None, named):
            source = f"orientation={given!r}" if given is not None else f"the {orientation} of another segment"
            raise InputError(
                f"the outputs {', '.join(segment.recorded.names[3:])} of the demonstrations are {named}, which "
                f"contradicts {source}: use one orientation, or rename the outputs"
            )
        orientation = orientation or named
    return orientation or "rotation_vector"


class TemplateGuide(Guide):
    """Guide by a shared control template; outputs are poses [x y z Rz Ry Rx] [m, rad].

    Args:
        template: Template.
        frames: (env, observation) → poses X_WF of the template's objects by name, called at reset; each is a
            `RigidTransform` of `guiderail.models.common.transforms` or of Drake.
        period: Control period [s], positive.
    """

    num_outputs = POSE_SIZE

    def __init__(
        self,
        template: SharedControlTemplate,
        frames: Callable[[Any, Any], Mapping[str, Any]],
        period: float | None,
    ):
        TemplateLaw(template, {}, period)  # refuses invalid arguments before an episode
        if template.limits_wrench:
            raise InputError(
                f"states of template {template.name!r} limit force or torque, and GuidedEnv has no controller that "
                "could follow the limit: remove max_force_n and max_torque_nm, and bound the force in the environment"
            )
        self.template, self._frames_of, self._period = template, frames, period
        self.num_actions = template.inputs

    def reset(self, env: Any, observation: Any, pose: np.ndarray) -> None:
        """Begin in the template's state for the measured pose."""
        frames = self._frames_of(env, observation)
        missing = [name for name in self.template.frames if name not in frames]
        if missing:
            raise InputError(f"the template {self.template.name} needs the frame {missing[0]}: give its pose")
        self._frames = {name: RigidTransform(X_WF) for name, X_WF in frames.items()}
        self._begin(TemplateLaw(self.template, self._frames, self._period), pose)
        self._now = self._state

    @property
    def phase(self) -> float:
        """Index of the current state, scaled to the range from 0 to 1."""
        return self._now.number / max(len(self.template.states) - 1, 1)

    @property
    def segment_name(self) -> str:
        """Name of the template's state."""
        return self.template.states[self._now.number].name

    def scaled_command(self) -> np.ndarray:
        """Return the last command (6,) in the template's first frame, in units of 0.2 m and π."""
        X_WF = self._frames[self.template.frames[0]] if self.template.frames else None
        X_WE = pose_to_transform(self._state.last if self._last is None else self._last.pose)
        X_FE = X_WE if X_WF is None else X_WF.inverse() @ X_WE
        return transform_to_pose(X_FE) / _COMMAND_SCALE


class LawGuide(Guide):
    """Guide by a law, whose commands are in the world.

    Args:
        law: Law.
    """

    def __init__(self, law: Law):
        check_law(law)
        self._law, self.num_outputs, self.num_actions = law, law.num_outputs, law.num_actions

    def reset(self, env: Any, observation: Any, pose: np.ndarray) -> None:
        """Begin an episode at a measured pose (O,)."""
        self._begin(self._law, pose)

    def scaled_command(self) -> np.ndarray:
        """Return the last command (O,), which has no range to be scaled to."""
        return self._start if self._last is None else self._last.pose


def _numbers(values: np.ndarray) -> str:
    """Return numbers with three digits for a message."""
    return np.array2string(values, precision=3, separator=", ", suppress_small=False)
