"""Wrist force/torque sensor with compensation of the tool's weight and inertia."""

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RotationMatrix
from pydrake.multibody.math import SpatialAcceleration, SpatialForce, SpatialVelocity
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, Frame, Joint, RigidBody, WeldJoint
from pydrake.systems.framework import Context, DiagramBuilder, DiscreteValues, LeafSystem

from guiderail.models.common.errors import InputError
from guiderail.models.control.wrench import external_wrench
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail.systems.support.drake_multibody import check_bodies, check_plant


class WrenchSensor(LeafSystem):
    """Measure the wrench of the environment on a tool at the center of compliance, low-pass filtered.

        F = M A + bias(V) − M [0, g] − F_wrist,  τ y' = F − y

    F is the `external_wrench` on a tool with spatial inertia M, velocity V and acceleration A. F_wrist is the reaction
    of the wrist, a joint. The tool consists of the child body of the wrist and all bodies welded to it. F is
    transformed to the center of compliance P and expressed in axes that are fixed in the world. y is the output.

    The inputs are the plant's outputs of the same names. ``wrench`` is (6,), [fx fy fz tx ty tz] in N and Nm. It is a
    discrete state without direct feedthrough, delayed by one sample, and zero after an initialization.

    Args:
        plant: Finalized plant, connected to this system.
        wrist: Joint whose reaction is measured; its child is the first body of `tool`.
        tool: Bodies on the child side of the wrist: the child of the wrist first, then all bodies welded to it.
        center: Center of compliance P, fixed to a body of `tool`.
        R_WAxes: Orientation in the world of the axes in which the wrench is expressed.
        period: Sampling period [s], positive; ideally the plant's time step.
        time_constant: Time constant τ of the filter [s], not negative; 0 disables it.

    Raises:
        InputError: If the time constant is out of range, a body is of another plant, the first body of `tool` is not
            the child of the wrist, `center` is not fixed to a body of `tool`, or a body welded to the tool is missing
            in `tool`.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        wrist: Joint,
        tool: list[RigidBody],
        center: Frame,
        R_WAxes: RotationMatrix,
        period: float,
        time_constant: float,
    ):
        super().__init__()
        if not 0.0 <= time_constant < np.inf:
            raise InputError(f"a wrench sensor's time constant must be finite and not negative, not {time_constant} s")
        check_bodies(plant, "tool", tool)
        check_plant(plant, center=center)
        if wrist.child_body().index() != tool[0].index():
            raise InputError(f"the first body of a wrench sensor's tool must be the child of {wrist.name()}")
        indices = {int(body.index()) for body in tool}
        if int(center.body().index()) not in indices:
            raise InputError(f"the center {center.name()} must be fixed to a body of a wrench sensor's tool")
        missing = _tool_indices(plant, wrist) - indices
        if missing:
            names = ", ".join(plant.get_body(BodyIndex(index)).name() for index in sorted(missing))
            raise InputError(f"a wrench sensor's tool must contain all bodies that are welded to it: add {names}")
        nominal = plant.CreateDefaultContext()
        self._wrist = int(wrist.index())
        self._tool = int(tool[0].index())
        X_ToolWrist = wrist.frame_on_child().CalcPose(nominal, tool[0].body_frame())
        X_ToolP = center.CalcPose(nominal, tool[0].body_frame())
        # The inertia and the two wrench transforms are constant in the frame of the tool.
        self._M_Tool = plant.CalcSpatialInertia(
            nominal, tool[0].body_frame(), [body.index() for body in tool]
        ).CopyToFullMatrix6()
        self._wrist_to_tool = _wrench_transform(X_ToolWrist.rotation().matrix(), X_ToolWrist.translation())
        self._tool_to_center = _wrench_transform(np.eye(3), -X_ToolP.translation())
        self._R_AxesW = R_WAxes.inverse().matrix()
        has_weight = plant.is_gravity_enabled(tool[0].model_instance())
        self._gravity_W = plant.gravity_field().gravity_vector() if has_weight else np.zeros(3)
        self._decay = float(np.exp(-period / time_constant)) if time_constant > 0.0 else 0.0

        self._reaction_forces_port = self.DeclareAbstractInputPort("reaction_forces", Value([SpatialForce()]))
        self._body_poses_port = self.DeclareAbstractInputPort(
            "body_poses", plant.get_body_poses_output_port().Allocate()
        )
        self._body_spatial_velocities_port = self.DeclareAbstractInputPort(
            "body_spatial_velocities", Value([SpatialVelocity()])
        )
        self._body_spatial_accelerations_port = self.DeclareAbstractInputPort(
            "body_spatial_accelerations", Value([SpatialAcceleration()])
        )
        self._state = self.DeclareDiscreteState(6)
        self.DeclareStateOutputPort("wrench", self._state)
        declare.update(self, period, self._sample, declare.reset_to_default(self))

    def connect(self, builder: DiagramBuilder, plant: MultibodyPlant) -> None:
        """Connect all inputs to the output ports of the plant."""
        builder.Connect(plant.get_reaction_forces_output_port(), self._reaction_forces_port)
        builder.Connect(plant.get_body_poses_output_port(), self._body_poses_port)
        builder.Connect(plant.get_body_spatial_velocities_output_port(), self._body_spatial_velocities_port)
        builder.Connect(plant.get_body_spatial_accelerations_output_port(), self._body_spatial_accelerations_port)

    get_reaction_forces_input_port = input_getter("reaction_forces", "plant's joint reaction forces")
    get_body_poses_input_port = input_getter("body_poses", "plant's body poses")
    get_body_spatial_velocities_input_port = input_getter("body_spatial_velocities", "plant's body velocities")
    get_body_spatial_accelerations_input_port = input_getter("body_spatial_accelerations", "plant's body accelerations")
    get_wrench_output_port = output_getter("wrench", "filtered wrench on the tool, (6,), force first")

    def _sample(self, context: Context, discrete_state: DiscreteValues) -> None:
        newest = self._measure(context)
        last = context.get_discrete_state().value(self._state)
        discrete_state.set_value(newest + self._decay * (last - newest))

    def _measure(self, context: Context) -> np.ndarray:
        F_reaction = self._wrist_to_tool @ self._reaction_forces_port.Eval(context)[self._wrist].get_coeffs()
        R_WTool = self._body_poses_port.Eval(context)[self._tool].rotation().matrix()
        V_W = self._body_spatial_velocities_port.Eval(context)[self._tool].get_coeffs()
        A_W = self._body_spatial_accelerations_port.Eval(context)[self._tool].get_coeffs()
        torque_force = external_wrench(
            F_reaction,
            self._M_Tool,
            (V_W.reshape(2, 3) @ R_WTool).ravel(),
            (A_W.reshape(2, 3) @ R_WTool).ravel(),
            self._gravity_W @ R_WTool,
        )
        at_center = (self._tool_to_center @ torque_force).reshape(2, 3)
        return (at_center[::-1] @ (self._R_AxesW @ R_WTool).T).ravel()


def _tool_indices(plant: MultibodyPlant, wrist: Joint) -> set[int]:
    """Return the indices of the child of the wrist and of all bodies welded to it, apart from the wrist itself."""
    joints = [plant.get_joint(index) for index in plant.GetJointIndices() if index != wrist.index()]
    welds = [
        {int(joint.parent_body().index()), int(joint.child_body().index())}
        for joint in joints
        if isinstance(joint, WeldJoint)
    ]
    found = {int(wrist.child_body().index())}
    while added := set().union(*(weld for weld in welds if weld & found)) - found:
        found |= added
    return found


def _wrench_transform(R: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return the (6, 6) matrix that transforms a wrench [torque, force] from frame B to frame A; X_AB = (R, p)."""
    p_cross = np.array([[0.0, -p[2], p[1]], [p[2], 0.0, -p[0]], [-p[1], p[0], 0.0]])
    return np.block([[R, p_cross @ R], [np.zeros((3, 3)), R]])
