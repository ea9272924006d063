"""Whether two sets of bodies have touched, asked at every step of the plant."""

from collections.abc import Sequence

from pydrake.common.value import Value
from pydrake.multibody.plant import ContactResults, MultibodyPlant
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import (
    BasicVector,
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
    counts. They are best those of a plant without sampled output ports; then each step's are seen at its beginning.

    .. pydrake_system::

        name: ContactWatch
        input_ports:
        - contact_results
        output_ports:
        - collision
        - touched
        - contact_force

    ``contact_results`` is the plant's. ``collision`` is (1,): 1 while they touch; ``touched`` is (1,): 1 from the first
    touch on; ``contact_force`` is (1,), the norm [N] of the largest force between the sets in this step. Point contact
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
        self._state = self.DeclareDiscreteState(1)
        results = self._results_port.ticket()
        self._collision_port = self.DeclareVectorOutputPort(
            "collision",
            1,
            lambda context, output: output.SetAtIndex(0, float(self._force(context) is not None)),
            prerequisites_of_calc={results},
        )
        self._touched_port = self.DeclareVectorOutputPort(
            "touched", 1, self._calc_touched, prerequisites_of_calc={results, self.discrete_state_ticket(self._state)}
        )
        self._force_port = self.DeclareVectorOutputPort(
            "contact_force",
            1,
            lambda context, output: output.SetAtIndex(0, self._force(context) or 0.0),
            prerequisites_of_calc={results},
        )
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

    def _calc_touched(self, context: Context, output: BasicVector) -> None:
        touched = context.get_discrete_state(self._state).value()[0] > 0
        output.SetAtIndex(0, float(touched or self._force(context) is not None))

    def _start(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        discrete_state.set_value([0.0])
        return EventStatus.Succeeded()

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        if context.get_discrete_state(self._state).value()[0] == 0 and self._force(context) is not None:
            discrete_state.set_value([1.0])
        return EventStatus.Succeeded()
