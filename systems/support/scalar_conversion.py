"""Systems that Drake can convert to other scalar types."""

from typing import TYPE_CHECKING, Any

from pydrake.systems.framework import LeafSystem, LeafSystem_
from pydrake.systems.scalar_conversion import TemplateSystem

if TYPE_CHECKING:

    class ConvertibleSystem(LeafSystem):
        """System of floats that `ToAutoDiffXd` and `ToSymbolic` convert, alone or as a part of a diagram."""

        def declare_converted(self, system: Any, scalar: type) -> None:
            """Declare the ports, states and parameters of this system in `system`, whose numbers are of type `scalar`.

            Raises:
                InputError: If the system has no law for this type.
            """

else:

    @TemplateSystem.define("ConvertibleSystem_")
    def ConvertibleSystem_(T):
        """Return the class of numbers of type `T`."""

        class Impl(LeafSystem_[T]):
            """System of floats that `ToAutoDiffXd` and `ToSymbolic` convert, alone or as a part of a diagram."""

            def _construct(self, converter=None):
                super().__init__(converter)

            def _construct_copy(self, other, converter=None):
                super().__init__(converter)
                self._original = getattr(other, "_original", other)
                self._original.declare_converted(self, T)

        return Impl

    ConvertibleSystem = ConvertibleSystem_[float]
