"""The wrench on a tool whose pose is a plant's coordinates, from their generalized forces."""

from pydrake.systems.framework import BasicVector, Context, InputPort, LeafSystem, OutputPort

from guiderail.models.common.poses import POSE_SIZE, WRENCH_SIZE, wrench_of_generalized_force


class PoseWrench(LeafSystem):
    """Turns generalized forces along a pose's coordinates into the wrench at the tool centre.

        f = τ_xyz,  [ez, Rz(a) ey, Rz(a) Ry(b) ex]ᵀ t = τ_abc

    (`wrench_of_generalized_force`). For a tool on rails, whose joints' positions are its pose: the plant's generalized
    contact forces are then what the surroundings do to it, without its own weight and inertia.

    .. pydrake_system::

        name: PoseWrench
        input_ports:
        - pose
        - generalized_force
        output_ports:
        - wrench

    ``pose`` is X_TP as (6,) [x y z a b c] in metres and radians, ``generalized_force`` (6,) [N, Nm] along and about
    these. ``wrench`` is (6,), [fx fy fz tx ty tz] at P in the axes of T.
    """

    def __init__(self) -> None:
        super().__init__()
        self._pose_port = self.DeclareVectorInputPort("pose", POSE_SIZE)
        self._generalized_force_port = self.DeclareVectorInputPort("generalized_force", POSE_SIZE)
        inputs = {self._pose_port.ticket(), self._generalized_force_port.ticket()}
        self._wrench_port = self.DeclareVectorOutputPort(
            "wrench", WRENCH_SIZE, self._calc_wrench, prerequisites_of_calc=inputs
        )

    def get_pose_input_port(self) -> InputPort:
        """X_TP, (6,)."""
        return self._pose_port

    def get_generalized_force_input_port(self) -> InputPort:
        """Along and about the pose's coordinates, (6,)."""
        return self._generalized_force_port

    def get_wrench_output_port(self) -> OutputPort:
        """At P in the axes of T, (6,), force first."""
        return self._wrench_port

    def _calc_wrench(self, context: Context, output: BasicVector) -> None:
        pose, force = self._pose_port.Eval(context), self._generalized_force_port.Eval(context)
        output.SetFromVector(wrench_of_generalized_force(pose, force))
