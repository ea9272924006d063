"""Reference governor of an impedance whose spring and damper belong to the plant."""

import numpy as np
from pydrake.systems.framework import Context, LeafSystem

from guiderail.models.common.arrays import as_number
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import POSE_SIZE
from guiderail.models.control.wrench import MAX_WRENCH_SIZE, WrenchBound, check_spring_damper, governed_error
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import check_period, input_getter, output_getter


class ReferenceGovernor(LeafSystem):
    """Move a desired pose towards the measured pose, so that the force of a spring and damper stays inside a bound.

        x_r = x + e_r,  K e_r inside the bound reduced by (K h + D) |v|

    x_r is the output, x and v are the measured pose and velocity, K and D the stiffness and damping of the six
    coordinates, and h is the time step. The spring accelerates the mass m to at most the speed F / (2 √(k m)), with the
    force bound F and the contact stiffness k (see `slow_down`). If no limit is active, the desired pose is output
    unchanged up to rounding.

    ``desired_pose`` and ``reference_pose`` are (6,), [x y z Rz Ry Rx] in meters and radians. ``state`` is (12,), the
    measured pose and its velocity [m/s, rad/s]. ``max_wrench`` is (8,), the limits of [fx fy fz tx ty tz], of the norm
    of the force and of the norm of the torque [N, Nm]; it can lower the bound but not raise it. NaN and negative
    numbers count as 0: the spring then exerts no force, and only the damper of the plant acts.

    Args:
        stiffness: Stiffness (6,) of each coordinate of the pose [N/m, Nm/rad], positive.
        damping: Damping (6,) of each coordinate [N s/m, Nm s/rad], not negative.
        mass: Moving mass [kg], positive.
        step: Time step of the plant [s], positive.
        bound: Bound of the wrench.

    Raises:
        InputError: If an argument is out of range.
    """

    def __init__(self, stiffness: np.ndarray, damping: np.ndarray, mass: float, step: float, bound: WrenchBound):
        super().__init__()
        check_period(step)
        self._stiffness, self._damping = check_spring_damper(stiffness, damping, "a reference governor")
        if not 0.0 < as_number(mass, "mass") < np.inf:
            raise InputError(f"the moving mass must be positive and finite, not {mass} kg")
        self._mass, self._step, self._bound = mass, step, bound
        self._desired_pose_port = self.DeclareVectorInputPort("desired_pose", POSE_SIZE)
        self._state_port = self.DeclareVectorInputPort("state", 2 * POSE_SIZE)
        self._max_wrench_port = self.DeclareVectorInputPort("max_wrench", MAX_WRENCH_SIZE)
        sources = [self._desired_pose_port, self._state_port, self._max_wrench_port]
        declare.output(self, "reference_pose", POSE_SIZE, self._reference_pose, sources)

    get_desired_pose_input_port = input_getter("desired_pose", "desired pose, (6,)")
    get_state_input_port = input_getter("state", "measured pose and its velocity, (12,)")
    get_max_wrench_input_port = input_getter("max_wrench", "limits per axis and of the norms, (8,) [N, Nm]; optional")
    get_reference_pose_output_port = output_getter("reference_pose", "reference of the spring, (6,)")

    def _reference_pose(self, context: Context) -> np.ndarray:
        state, bound = self._state_port.Eval(context), self._bound
        if self._max_wrench_port.HasValue(context):
            bound = bound.lowered_to(self._max_wrench_port.Eval(context))
        pose, velocity = state[:POSE_SIZE], state[POSE_SIZE:]
        error = governed_error(
            self._stiffness,
            self._damping,
            self._desired_pose_port.Eval(context) - pose,
            velocity,
            self._mass,
            self._step,
            bound.in_pose_order,
        )
        return pose + error
