"""Where a contact pushes, told from what it pushes with."""

from pydrake.systems.framework import BasicVector, Context, InputPort, LeafSystem, OutputPort

from guiderail.models.common.errors import InputError
from guiderail.models.common.poses import WRENCH_SIZE
from guiderail.models.control.wrench import center_of_pressure


class CenterOfPressure(LeafSystem):
    """Measures the lever of a force along z about a tool centre.

        lever = (−τ_y, τ_x) / f_z where f_z ≥ least_force, and 0 elsewhere

    A single point that pushes along z at p has τ = p × f, so that the lever is p: it leads from the tool centre to the
    point, however hard that pushes.

    .. pydrake_system::

        name: CenterOfPressure
        input_ports:
        - wrench
        output_ports:
        - center_of_pressure

    ``wrench`` (6,) is force and torque about the tool centre [N, Nm]; ``center_of_pressure`` is (2,) [m].
    """

    def __init__(self, least_force: float):
        """
        Args:
            least_force: [N] below which the plug touches nothing, positive.

        Raises:
            InputError: if it is not.
        """
        super().__init__()
        if not least_force > 0.0:
            raise InputError(f"the lever of a force needs a least force, positive, not {least_force} N")
        self._least_force = least_force
        self._wrench_port = self.DeclareVectorInputPort("wrench", WRENCH_SIZE)
        self._center_of_pressure_port = self.DeclareVectorOutputPort(
            "center_of_pressure", 2, self._calc_center_of_pressure, prerequisites_of_calc={self._wrench_port.ticket()}
        )

    def get_wrench_input_port(self) -> InputPort:
        """Force and torque about the tool centre, (6,) [N, Nm]."""
        return self._wrench_port

    def get_center_of_pressure_output_port(self) -> OutputPort:
        """From the tool centre to where it pushes, (2,) [m]."""
        return self._center_of_pressure_port

    def _calc_center_of_pressure(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(center_of_pressure(self._wrench_port.Eval(context), self._least_force))
