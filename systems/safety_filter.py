"""Safety filter that projects commanded positions out of keep-out boxes and into linear constraints."""

import numpy as np
from pydrake.systems.framework import Context, LeafSystem

from guiderail.models.control.keep_out import KeepOut
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter


class SafetyFilter(LeafSystem):
    """Project commanded positions by active constraints (thesis, section 4.4.1).

        safe_pose = project(pose, desired_pose)

    `KeepOut.project` moves a command out of boxes and into linear constraints. The measured pose is sampled at control
    steps, so that the command is constant during a control step.

    .. pydrake_system::

        name: SafetyFilter
        input_ports:
        - desired_pose
        - pose
        output_ports:
        - safe_pose
        - intervention

    ``desired_pose``, ``pose`` (measured) and ``safe_pose`` are (O,). ``intervention`` (1,) is 1 if a box changed the
    command. It is 0 if only the linear constraints changed the command.

    Args:
        keep_out: Boxes and constraints.
        period: Control period [s], positive.

    Raises:
        InputError: If the period is not positive.
        UnsolvableError: At evaluation, if a pose is not finite.
    """

    def __init__(self, keep_out: KeepOut, period: float):
        super().__init__()
        self._keep_out = keep_out
        outputs = keep_out.num_outputs
        self._desired_pose_port = self.DeclareVectorInputPort("desired_pose", outputs)
        self._pose_port = self.DeclareVectorInputPort("pose", outputs)
        self._sampled_pose = declare.sample(self, self._pose_port, period)
        sources = [self._desired_pose_port, self._sampled_pose]
        self._projection = declare.cache(self, "projection", self._calc_projection, sources)
        declare.part_output(self, "safe_pose", self._projection, lambda projection: projection[:-1], outputs)
        declare.part_output(self, "intervention", self._projection, lambda projection: projection[-1])

    get_desired_pose_input_port = input_getter("desired_pose", "desired pose, (O,)")
    get_pose_input_port = input_getter("pose", "measured pose, (O,)")
    get_safe_pose_output_port = output_getter("safe_pose", "projected pose, (O,)")
    get_intervention_output_port = output_getter("intervention", "flag that a box changed the command, (1,)")

    def _calc_projection(self, context: Context) -> np.ndarray:
        """Return the safe pose and the intervention flag, (O + 1,)."""
        pose = context.get_discrete_state().value(self._sampled_pose)
        safe_pose, is_changed = self._keep_out.project(pose, self._desired_pose_port.Eval(context))
        return np.append(safe_pose, float(is_changed))
