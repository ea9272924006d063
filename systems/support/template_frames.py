"""Poses of a template's objects as numeric parameters of a system, or from an input port."""

from collections.abc import Mapping

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, DependencyTicket, LeafSystem

from guiderail.models.common.arrays import is_finite
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import POSE_SIZE, pose_to_transform, transform_to_pose
from guiderail.models.templates.template import SharedControlTemplate, check_template
from guiderail.systems.support import declarations as declare


class TemplateFrames:
    """Poses of a template's object frames, declared as numeric parameters of a LeafSystem and as an optional port.

    Poses that are constant during an episode are parameters: a guidance diagram needs no additional port, and a reset
    moves an object with `set`. For objects that move, the input port ``frame_poses`` (6·k,) has the poses of all k
    frames in the order of `names`, [x y z Rz Ry Rx] each; while it is connected, it replaces the parameters. One source
    of it, such as a `MeasuredPose` of a fixture, serves all systems of the template. A template without frames has no
    such port.

    Args:
        system: System under construction; outputs that use the frames must depend on `ticket`.
        template: Template that uses the frames.
        frames: Default poses in the world by frame name.

    Attributes:
        names: Names of the frames.

    Raises:
        InputError: If a frame is missing, a pose is not finite, or a pose of the world is given.
    """

    def __init__(self, system: LeafSystem, template: SharedControlTemplate, frames: Mapping[str, RigidTransform]):
        check_template(template, frames)
        missing = [name for name in template.frames if name not in frames]
        if missing:
            raise InputError(f"the template {template.name} needs the frame {missing[0]}: give its pose")
        self._system, self.names = system, template.frames
        self._indices = [
            system.DeclareNumericParameter(BasicVector(_checked_pose(name, frames[name]))) for name in template.frames
        ]
        sources: list[declare.Source] = [system.all_parameters_ticket()]
        self._port = None
        if self.names:
            self._port = system.DeclareVectorInputPort("frame_poses", POSE_SIZE * len(self.names))
            sources.append(self._port)
        self._cache = declare.cache(system, "template_frames", self._calc, sources)

    @property
    def ticket(self) -> DependencyTicket:
        """Dependency ticket of values that are computed from the frames."""
        return self._cache.ticket()

    def eval(self, context: Context) -> dict[str, RigidTransform]:
        """Return the poses by name; `context` is the context of the system."""
        return self._cache.Eval(context)

    def set(self, context: Context, frames: Mapping[str, RigidTransform]) -> None:
        """Set the poses of frames by name in the context of the system; other frames do not move.

        Raises:
            InputError: If the context is another system's, the template has no such frame, or a pose is not finite.
        """
        declare.check_own_context(self._system, context)
        if unknown := [name for name in frames if name not in self.names]:
            raise InputError(f"the template has no frame {unknown[0]}, only {', '.join(self.names)}")
        poses = {name: _checked_pose(name, X_WF) for name, X_WF in frames.items()}
        for name, pose in poses.items():
            index = self._indices[self.names.index(name)]
            context.get_mutable_numeric_parameter(index).SetFromVector(pose)

    def _calc(self, context: Context) -> dict[str, RigidTransform]:
        if self._port is not None and self._port.HasValue(context):
            poses = list(self._port.Eval(context).reshape(-1, POSE_SIZE))
            for name, pose in zip(self.names, poses, strict=True):
                if not is_finite(pose):
                    raise InputError(f"the frame {name} must be at a finite pose, not at {pose}")
        else:
            poses = [np.asarray(context.get_numeric_parameter(index).CopyToVector()) for index in self._indices]
        return {name: pose_to_transform(pose) for name, pose in zip(self.names, poses, strict=True)}


def _checked_pose(name: str, X_WF: RigidTransform) -> np.ndarray:
    pose = transform_to_pose(X_WF)
    if not np.isfinite(pose).all():
        raise InputError(f"the frame {name} must be at a finite pose, not at {X_WF.translation()}")
    return pose
