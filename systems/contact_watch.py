"""Whether two sets of bodies have touched, asked at every step of the plant."""

from collections.abc import Sequence

from pydrake.common.value import Value
from pydrake.multibody.plant import ContactResults, MultibodyPlant
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import (
    Context,
    DiscreteValues,
    EventStatus,
    InputPort,
    LeafSystem,
    OutputPort,
)


class ContactWatch(LeafSystem):
    """Says whether any body of one set has touched any body of another since the episode began.

    The plant's contact results are looked at in every plant step: a collision that is shorter than a control step
    counts. What was seen is state: whoever reads a port between two plant steps sees the last of them, and costs the
    plant nothing.

    .. pydrake_system::

        name: ContactWatch
        input_ports:
        - contact_results
        output_ports:
        - collision
        - touched
        - contact_force

    ``contact_results`` is the plant's. ``collision`` is (1,): 1 while they touch; ``touched`` is (1,): 1 from the first
    touch on; ``contact_force`` is (1,), the norm [N] of the largest force between the sets. Point contact
    and hydroelastic contact both count.
    """

    def __init__(self, plant: MultibodyPlant, ones: Sequence[RigidBody], others: Sequence[RigidBody], period: float):
        """
        Args:
            plant: finalized.
            ones: bodies that must not touch `others`.
            others: bodies that must not be touched; no body may be in both.
            period: seconds of a plant step, positive.

        Raises:
            ValueError: if the period is not positive, or the sets overlap.
        """
        super().__init__()
        if not period > 0:
            raise ValueError(f"the plant's period must be positive, not {period} s")
        self._ones = {int(body.index()) for body in ones}
        self._others = {int(body.index()) for body in others}
        if self._ones & self._others:
            raise ValueError("a body can't collide with itself: the two sets overlap")
        self._body_of = {
            geometry: int(body.index())
            for body in (*ones, *others)
            for geometry in plant.GetCollisionGeometriesForBody(body)
        }
        self._results_port = self.DeclareAbstractInputPort("contact_results", Value(ContactResults()))
        self._collision, self._touched, self._largest_force = (self.DeclareDiscreteState(1) for _ in range(3))
        self._collision_port = self.DeclareStateOutputPort("collision", self._collision)
        self._touched_port = self.DeclareStateOutputPort("touched", self._touched)
        self._force_port = self.DeclareStateOutputPort("contact_force", self._largest_force)
        self.DeclareInitializationDiscreteUpdateEvent(self._start)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def get_contact_results_input_port(self) -> InputPort:
        """The plant's contact results."""
        return self._results_port

    def get_collision_output_port(self) -> OutputPort:
        """1 while they touch, (1,)."""
        return self._collision_port

    def get_touched_output_port(self) -> OutputPort:
        """1 from the first touch of the episode on, (1,)."""
        return self._touched_port

    def get_contact_force_output_port(self) -> OutputPort:
        """The largest force between the two sets, (1,) [N]."""
        return self._force_port

    def _force(self, context: Context) -> float | None:
        """The largest force [N] between the sets; None where they don't touch."""
        results: ContactResults = self._results_port.Eval(context)
        largest: float | None = None
        for i in range(results.num_point_pair_contacts()):
            pair = results.point_pair_contact_info(i)
            if self._forbidden(int(pair.bodyA_index()), int(pair.bodyB_index())):
                f = pair.contact_force()
                largest = max(largest or 0.0, float(f @ f) ** 0.5)
        for i in range(results.num_hydroelastic_contacts()):
            info = results.hydroelastic_contact_info(i)
            surface = info.contact_surface()
            bodies = [self._body_of.get(geometry, -1) for geometry in (surface.id_M(), surface.id_N())]
            if self._forbidden(*bodies):
                f = info.F_Ac_W().translational()
                largest = max(largest or 0.0, float(f @ f) ** 0.5)
        return largest

    def _forbidden(self, a: int, b: int) -> bool:
        return (a in self._ones and b in self._others) or (b in self._ones and a in self._others)

    def _start(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        for index in (self._collision, self._touched, self._largest_force):
            discrete_state.set_value(index, [0.0])
        return EventStatus.Succeeded()

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        force = self._force(context)
        discrete_state.set_value(self._collision, [float(force is not None)])
        discrete_state.set_value(self._largest_force, [force or 0.0])
        if force is not None:
            discrete_state.set_value(self._touched, [1.0])
        return EventStatus.Succeeded()
