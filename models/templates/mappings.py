"""Input mappings from the few inputs of a user or a policy to displacements (thesis, equations 2.19 and 2.20)."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from typing_extensions import override

from guiderail.models.common.transforms import RigidTransform, RotationMatrix, axis_angle_rotation
from guiderail.models.templates.parts import (
    INPUT_MAPPINGS,
    WORLD,
    Frames,
    StatePart,
    axes,
    bearing,
    position_in,
    register,
    require,
    require_three,
    tilt_axis,
)

TOOL = "tool"


class InputMapping(StatePart, ABC):
    """Displacement commanded by some of the inputs, a part of the mapping map_q of a state q (equation 2.19).

    A displacement ΔH is a RigidTransform. Its translation is added to p_WE. Its rotation, about the end effector's
    origin and expressed in the world, is applied to R_WE from the left.
    """

    inputs: tuple[int, ...]
    own_frames = (WORLD, TOOL)

    @abstractmethod
    def displacement(self, inputs: np.ndarray, X_WE: RigidTransform, frames: Frames, period_s: float) -> RigidTransform:
        """Return ΔH of one period `period_s` [s]; `inputs` (n,) are all inputs of the template, each in [−1, 1]."""

    @property
    def used_inputs(self) -> tuple[int, ...]:
        """Indices of the inputs that the mapping uses; by default the field `inputs`."""
        return self.inputs


def axes_in_world(frame: str, X_WE: RigidTransform, frames: Frames) -> np.ndarray:
    """Return R_WF (3, 3), whose columns are the axes of `frame`: `world`, `tool` or the frame of an object."""
    return X_WE.rotation().matrix() if frame == TOOL else axes(frame, frames)


def _require_axes(inputs: tuple[int, ...], axes: tuple[tuple[float, ...], ...]) -> None:
    require(len(inputs) == len(axes) > 0, f"give one axis per input, at least one, not {len(axes)} for {len(inputs)}.")
    for axis in axes:
        require_three(axis, "an axis")
        require(np.any(axis), "an axis must not be all zero.")


def _require_object(frame: str) -> None:
    require(frame != TOOL, f"frame must be the frame of an object or {WORLD}, not {TOOL}.")


@register(INPUT_MAPPINGS, "translation")
@dataclass(frozen=True)
class Translation(InputMapping):
    """Translation of the end effector along one axis of a frame for each input.

    An input of 1 commands the speed `speed_m_per_s` times the length of its axis.
    """

    inputs: tuple[int, ...]  # indices of the inputs, from 0
    speed_m_per_s: float  # speed at an input of 1
    frame: str = WORLD  # frame of the axes: `world`, `tool` or the frame of an object
    axes: tuple[tuple[float, ...], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))  # one axis for each input

    def __post_init__(self) -> None:
        _require_axes(self.inputs, self.axes)
        require(self.speed_m_per_s > 0, f"speed_m_per_s must be positive, not {self.speed_m_per_s}.")

    @override
    def displacement(self, inputs: np.ndarray, X_WE: RigidTransform, frames: Frames, period_s: float) -> RigidTransform:
        v_FE = self.speed_m_per_s * np.array(self.axes).T @ inputs[list(self.inputs)]
        return RigidTransform(RotationMatrix(), axes_in_world(self.frame, X_WE, frames) @ v_FE * period_s)


@register(INPUT_MAPPINGS, "rotation")
@dataclass(frozen=True)
class Rotation(InputMapping):
    """Rotation of the end effector about one axis of a frame for each input.

    An input of 1 commands the speed `speed_rad_per_s` times the length of its axis.
    """

    inputs: tuple[int, ...]  # indices of the inputs, from 0
    speed_rad_per_s: float  # speed at an input of 1
    frame: str = WORLD  # frame of the axes: `world`, `tool` or the frame of an object
    axes: tuple[tuple[float, ...], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))  # one axis for each input

    def __post_init__(self) -> None:
        _require_axes(self.inputs, self.axes)
        require(self.speed_rad_per_s > 0, f"speed_rad_per_s must be positive, not {self.speed_rad_per_s}.")

    @override
    def displacement(self, inputs: np.ndarray, X_WE: RigidTransform, frames: Frames, period_s: float) -> RigidTransform:
        w_FE = self.speed_rad_per_s * np.array(self.axes).T @ inputs[list(self.inputs)]
        turn = axes_in_world(self.frame, X_WE, frames) @ w_FE * period_s
        angle = float(np.linalg.norm(turn))
        return RigidTransform(RotationMatrix() if angle == 0 else axis_angle_rotation(turn / angle, angle), np.zeros(3))


@register(INPUT_MAPPINGS, "tilt_towards")
@dataclass(frozen=True)
class TiltTowards(InputMapping):
    """Tilt towards a frame.

    Two inputs form a horizontal vector in the frame. The component of this vector along the bearing of the end effector
    is the speed of the tilt, as a fraction of full speed.
    """

    inputs: tuple[int, ...]  # indices of two inputs, from 0
    speed_rad_per_s: float  # speed at an input of 1
    frame: str  # frame to tilt towards: frame of an object, or `world`

    def __post_init__(self) -> None:
        _require_object(self.frame)
        require(len(self.inputs) == 2, f"tilt_towards needs two inputs, x and y, not {len(self.inputs)}.")
        require(self.speed_rad_per_s > 0, f"speed_rad_per_s must be positive, not {self.speed_rad_per_s}.")

    @override
    def displacement(self, inputs: np.ndarray, X_WE: RigidTransform, frames: Frames, period_s: float) -> RigidTransform:
        p_FE = position_in(self.frame, X_WE, frames)
        along = float(np.clip(inputs[list(self.inputs)] @ bearing(p_FE)[:2], -1.0, 1.0))
        axis_W = axes_in_world(self.frame, X_WE, frames) @ tilt_axis(p_FE)
        return RigidTransform(axis_angle_rotation(axis_W, along * self.speed_rad_per_s * period_s), np.zeros(3))


@register(INPUT_MAPPINGS, "uneven")
@dataclass(frozen=True)
class Uneven(InputMapping):
    """Another mapping with different factors for positive and negative inputs.

    Random inputs move the end effector in the faster direction on average; a zero input commands no motion. With equal
    factors, random exploration would move away from a goal as often as towards it.
    """

    above: float  # factor of positive inputs, in (0, 1]
    below: float  # factor of negative inputs, in (0, 1]
    of: InputMapping  # mapping whose inputs are scaled, an entry with its own kind

    def __post_init__(self) -> None:
        require(0 < self.above <= 1 and 0 < self.below <= 1, "both factors must be above 0 and at most 1.")

    @property
    @override
    def used_inputs(self) -> tuple[int, ...]:
        return self.of.used_inputs

    @property
    @override
    def frame_names(self) -> tuple[str, ...]:
        return self.of.frame_names

    @override
    def displacement(self, inputs: np.ndarray, X_WE: RigidTransform, frames: Frames, period_s: float) -> RigidTransform:
        return self.of.displacement(np.where(inputs < 0.0, self.below, self.above) * inputs, X_WE, frames, period_s)
