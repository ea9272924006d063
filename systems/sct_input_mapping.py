"""Input mapping of a shared control template (thesis, equations 2.19 and 2.20)."""

from collections.abc import Mapping

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, LeafSystem

from guiderail.models.laws.template_law import requested_pose
from guiderail.models.templates.template import SharedControlTemplate
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail.systems.support.template_frames import TemplateFrames


class SctInputMapping(LeafSystem):
    """Apply the input mapping of a template's current state to the inputs of a policy or a user.

        H^im = displace_q(H, map_q(u))    (equations 2.19 and 2.20)

    H is ``pose``, u is ``action`` clipped to [−1, 1] and constant for one period, and q is ``state``. If ``action`` is
    not finite, or ``state`` is not the number of a state, the requested pose is NaN, and an `ActiveConstraintProjector`
    repeats its last safe command.

    ``action`` is (n,), in [−1, 1]; ``pose`` and ``requested_pose`` are (6,), [x y z Rz Ry Rx] in meters and radians;
    ``state`` is (1,), the number of the template's state.

    Args:
        template: Shared control template.
        frames: Poses of the template's object frames by name, in the reference frame of the poses at the ports.
        period: Control period [s], positive.

    Raises:
        InputError: If the period is not positive, or a frame is missing or not finite.

    Attributes:
        frames: Poses of the template's object frames, parameters that a reset can set. While ``frame_poses`` (6·k,) is
            connected, the poses of the k frames that it has replace them, for objects that move (`TemplateFrames`).
    """

    def __init__(self, template: SharedControlTemplate, frames: Mapping[str, RigidTransform], period: float):
        super().__init__()
        declare.check_period(period)
        self._template, self._period = template, period
        self._action_port = self.DeclareVectorInputPort("action", template.inputs)
        self._pose_port = self.DeclareVectorInputPort("pose", 6)
        self._state_port = self.DeclareVectorInputPort("state", 1)
        self.frames = TemplateFrames(self, template, frames)
        sources = [self._action_port, self._pose_port, self._state_port, self.frames.ticket]
        declare.output(self, "requested_pose", 6, self._requested_pose, sources)

    get_action_input_port = input_getter("action", "inputs u of a policy or a user, (n,), in [−1, 1]")
    get_pose_input_port = input_getter("pose", "pose H to displace, (6,)")
    get_state_input_port = input_getter("state", "number of the template's state, (1,)")
    get_frame_poses_input_port = input_getter(
        "frame_poses", "poses of the template's frames, (6·k,), instead of the parameters; optional"
    )
    get_requested_pose_output_port = output_getter("requested_pose", "requested pose H^im, (6,), not constrained")

    def _requested_pose(self, context: Context) -> np.ndarray:
        state = declare.state_number(self._state_port, context, len(self._template.states))
        action, pose = self._action_port.Eval(context), self._pose_port.Eval(context)
        return requested_pose(self._template, state, action, pose, self.frames.eval(context), self._period)
