"""Contact between two sets of bodies, checked at every plant step."""

from collections.abc import Sequence

from pydrake.common.value import Value
from pydrake.multibody.plant import ContactResults, MultibodyPlant
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.errors import InputError
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter


class ContactDetector(LeafSystem):
    """Detect contact between bodies and obstacles, at the last plant step and since the episode started.

    The contact results are evaluated at every plant step, so collisions shorter than a control step count. All outputs
    are state: they are one plant step old, without direct feedthrough.

    .. pydrake_system::

        name: ContactDetector
        input_ports:
        - contact_results
        output_ports:
        - collision
        - has_collided
        - contact_force

    ``contact_results`` is the plant's output. ``collision`` (1,) is 1 while bodies and obstacles are in contact.
    ``has_collided`` (1,) is 1 from the first contact of the episode on. ``contact_force`` is (1,), the norm of the
    largest contact force between the two sets [N]. Point contact and hydroelastic contact both count.

    Args:
        plant: Finalized plant.
        bodies: Bodies that must not touch `obstacles`.
        obstacles: Obstacles; no body may be in both sets.
        period: Plant step [s], positive.

    Raises:
        InputError: If the period is not positive, or a body is in both sets.
    """

    def __init__(
        self, plant: MultibodyPlant, bodies: Sequence[RigidBody], obstacles: Sequence[RigidBody], period: float
    ):
        super().__init__()
        self._bodies = {int(body.index()) for body in bodies}
        self._obstacles = {int(body.index()) for body in obstacles}
        if self._bodies & self._obstacles:
            raise InputError("a body can't collide with itself: bodies and obstacles overlap")
        self._body_of = {
            geometry: int(body.index())
            for body in (*bodies, *obstacles)
            for geometry in plant.GetCollisionGeometriesForBody(body)
        }
        self._contact_results_port = self.DeclareAbstractInputPort("contact_results", Value(ContactResults()))
        self._collision, self._has_collided, self._contact_force = (self.DeclareDiscreteState(1) for _ in range(3))
        self._collision_port = self.DeclareStateOutputPort("collision", self._collision)
        self._has_collided_port = self.DeclareStateOutputPort("has_collided", self._has_collided)
        self._contact_force_port = self.DeclareStateOutputPort("contact_force", self._contact_force)
        declare.update(self, period, self._update, declare.reset_to_default(self))

    get_contact_results_input_port = input_getter("contact_results", "plant's contact results")
    get_collision_output_port = output_getter("collision", "flag of a contact at the last plant step, (1,)")
    get_has_collided_output_port = output_getter("has_collided", "flag of a contact in this episode, (1,)")
    get_contact_force_output_port = output_getter("contact_force", "largest contact force, (1,) [N]")

    def _largest_force(self, context: Context) -> float | None:
        """Return the largest force [N] between the two sets, or None without contact."""
        results: ContactResults = self._contact_results_port.Eval(context)
        largest: float | None = None
        for i in range(results.num_point_pair_contacts()):
            pair = results.point_pair_contact_info(i)
            if self._is_collision(int(pair.bodyA_index()), int(pair.bodyB_index())):
                f = pair.contact_force()
                largest = max(largest or 0.0, float(f @ f) ** 0.5)
        for i in range(results.num_hydroelastic_contacts()):
            info = results.hydroelastic_contact_info(i)
            surface = info.contact_surface()
            bodies = [self._body_of.get(geometry) for geometry in (surface.id_M(), surface.id_N())]
            if self._is_collision(*bodies):
                f = info.F_Ac_W().translational()
                largest = max(largest or 0.0, float(f @ f) ** 0.5)
        return largest

    def _is_collision(self, a: int | None, b: int | None) -> bool:
        return (a in self._bodies and b in self._obstacles) or (b in self._bodies and a in self._obstacles)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        force = self._largest_force(context)
        discrete_state.set_value(self._collision, [float(force is not None)])
        discrete_state.set_value(self._contact_force, [force or 0.0])
        if force is not None:
            discrete_state.set_value(self._has_collided, [1.0])
