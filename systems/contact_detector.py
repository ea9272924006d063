"""Contact between two sets of bodies, checked at every plant step."""

from collections.abc import Sequence
from itertools import product

import numpy as np
from pydrake.common.value import Value
from pydrake.multibody.plant import ContactResults, MultibodyPlant
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail.systems.support.drake_multibody import check_bodies

ZERO, ONE = np.zeros(1), np.ones(1)  # values of flags, because converting a list takes longer than the contact check


class ContactDetector(LeafSystem):
    """Detect contact between bodies and obstacles at the last plant step and since the start of the episode.

    The contact results are evaluated at every plant step, so collisions that are shorter than a control step are
    detected. All outputs are state without direct feedthrough, delayed by one plant step.

    ``contact_results`` is the plant's output. ``collision`` (1,) is 1 while bodies and obstacles are in contact.
    ``has_collided`` (1,) is 1 from the first contact of the episode on. ``contact_force`` is (1,), the norm of the
    largest contact force between the two sets [N]. Point contact and hydroelastic contact both count.

    Args:
        plant: Finalized plant.
        bodies: Bodies of the plant that must not touch `obstacles`, at least one.
        obstacles: Obstacles, at least one, none in both sets.
        period: Plant step [s], positive.
    """

    def __init__(
        self, plant: MultibodyPlant, bodies: Sequence[RigidBody], obstacles: Sequence[RigidBody], period: float
    ):
        super().__init__()
        check_bodies(plant, "bodies", bodies)
        check_bodies(plant, "obstacles", obstacles)
        body_indices, obstacle_indices = ({int(body.index()) for body in group} for group in (bodies, obstacles))
        self._pairs = {*product(body_indices, obstacle_indices), *product(obstacle_indices, body_indices)}
        self._body_of = {
            geometry: int(body.index())
            for body in (*bodies, *obstacles)
            for geometry in plant.GetCollisionGeometriesForBody(body)
        }
        self._contact_results_port = self.DeclareAbstractInputPort("contact_results", Value(ContactResults()))
        self._collision, self._has_collided, self._contact_force = (self.DeclareDiscreteState(1) for _ in range(3))
        self.DeclareStateOutputPort("collision", self._collision)
        self.DeclareStateOutputPort("has_collided", self._has_collided)
        self.DeclareStateOutputPort("contact_force", self._contact_force)
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
            if (int(pair.bodyA_index()), int(pair.bodyB_index())) in self._pairs:
                f = pair.contact_force()
                largest = max(largest or 0.0, float(f @ f) ** 0.5)
        for i in range(results.num_hydroelastic_contacts()):
            info = results.hydroelastic_contact_info(i)
            surface = info.contact_surface()
            if (self._body_of.get(surface.id_M()), self._body_of.get(surface.id_N())) in self._pairs:
                f = info.F_Ac_W().translational()
                largest = max(largest or 0.0, float(f @ f) ** 0.5)
        return largest

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        force = self._largest_force(context)
        if force is None:
            discrete_state.set_value(self._collision, ZERO)
            discrete_state.set_value(self._contact_force, ZERO)
        else:
            discrete_state.set_value(self._collision, ONE)
            discrete_state.set_value(self._contact_force, [force])
            discrete_state.set_value(self._has_collided, ONE)
