"""Reference of a robot's own spring and damper that makes them exert the wrench of the station's controller."""

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, LeafSystem
from scipy.spatial.transform import Rotation

from guiderail.diagrams.stations.station import ControllerPlant
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail.systems.support.drake_multibody import transform_to_pose
from guiderail_hardware.models.robot_impedance import RobotImpedance


class SpringReference(LeafSystem):
    """Convert a wrench into the reference with which a robot's own spring and damper exert it.

        x_r = x + K⁻¹ (w + D V)

    x and V are the measured pose and velocity of the tool center, and w is the wrench. The wrench K (x_r − x) − D V of
    the robot is then w. With the wrench of a bounded impedance, the robot's force and approach speed are bounded as
    well. While no limit is active, x_r is the desired pose of this impedance. Between two periods, the robot's spring
    and damper act around a constant x_r.

    .. pydrake_system::

        name: SpringReference
        input_ports:
        - estimated_state
        - impedance_wrench
        output_ports:
        - reference_pose

    ``estimated_state`` is (2n,), joint positions and velocities [rad, rad/s]. ``impedance_wrench`` is (6,), force first
    [N, Nm], along and about the axes of the target frame T, which are those of the robot's base. ``reference_pose`` is
    (6,), [x y z Rz Ry Rx] in meters and radians.

    Args:
        model: Model of the arm, with the target frame and the tool center.
        impedance: Stiffness and damping of the robot's controller.
    """

    def __init__(self, model: ControllerPlant, impedance: RobotImpedance):
        super().__init__()
        self._model, self._impedance = model, impedance
        self._state_port = self.DeclareVectorInputPort("estimated_state", 2 * model.plant.num_positions())
        self._wrench_port = self.DeclareVectorInputPort("impedance_wrench", 6)
        self._plant_context = declare.plant_context(self, model.plant, self._state_port.Eval, [self._state_port])
        declare.output(self, "reference_pose", 6, self._reference_pose, [self._state_port, self._wrench_port])

    get_estimated_state_input_port = input_getter("estimated_state", "joint state, (2n,) [rad, rad/s]")
    get_impedance_wrench_input_port = input_getter("impedance_wrench", "wrench to exert, (6,), force first")
    get_reference_pose_output_port = output_getter("reference_pose", "reference of the spring, (6,)")

    def _reference_pose(self, context: Context) -> np.ndarray:
        model, plant_context = self._model, self._plant_context.Eval(context)
        target, tool_center = model.target, model.tool_center
        V = tool_center.CalcSpatialVelocity(plant_context, target, target)
        damping = self._impedance.damping @ np.concatenate([V.translational(), V.rotational()])
        deflection = np.linalg.solve(self._impedance.stiffness, self._wrench_port.Eval(context) + damping)
        X_TP = tool_center.CalcPose(plant_context, target)
        turn = RotationMatrix(Rotation.from_rotvec(deflection[3:]).as_matrix())
        return transform_to_pose(RigidTransform(turn @ X_TP.rotation(), X_TP.translation() + deflection[:3]))
