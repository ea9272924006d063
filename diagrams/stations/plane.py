"""A plane with walls and a robot that is commanded by position."""

from dataclasses import dataclass

import numpy as np
from pydrake.geometry import Box, Cylinder, GeometryInstance, MakePhongIllustrationProperties, ProximityProperties
from pydrake.geometry import SceneGraph, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import ModelInstanceIndex, PrismaticJoint, SpatialInertia
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import Adder, Gain, LinearSystem, Saturation

from guiderail.diagrams.task import exact_period
from guiderail.models.objects.narrow_passage import NarrowPassage
from guiderail.systems.mean_force import MeanForce


@dataclass(frozen=True)
class PlaneConfig:
    """The robot and its clocks.

    The robot is a light ball on two rails that move it like strong, well damped drives: a proportional force, limited,
    against viscous friction that the plant integrates implicitly. Where it saturates it goes at `max_speed`, which
    keeps what it covers in a plant step (20 mm) well below a wall's thickness: nothing tunnels. Below that it is
    critically damped, so that it arrives within a control step and never overshoots a command.

    Attributes:
        plant_period: s, seconds of a plant step.
        substeps: plant steps in a control step.
        mass: kg, of the robot.
        max_force: N, on each rail.
        max_speed: m/s, on each rail.
        friction: between robot and walls; high, so that a robot pressed against a wall doesn't slide along it.
        stiffness: N/m, of the contact.
    """

    plant_period: float = exact_period(0.002)
    substeps: int = 10
    mass: float = 0.001
    max_force: float = 50.0
    max_speed: float = 10.0
    friction: float = 10.0
    stiffness: float = 1e6

    @property
    def control_period(self) -> float:
        """Seconds of a control step."""
        return self.substeps * self.plant_period

    @property
    def damping(self) -> float:
        """N s/m, with which full force means full speed."""
        return self.max_force / self.max_speed

    @property
    def position_gain(self) -> float:
        """N/m, for critical damping of the discrete loop.

        With a = m/(m + d h) and b = k h²/(m + d h) the loop's characteristic polynomial is z² − (1 + a − b) z + a;
        both roots are √a where b = (1 − √a)².
        """
        inertia = self.mass + self.damping * self.plant_period
        return (1 - np.sqrt(self.mass / inertia)) ** 2 * inertia / self.plant_period**2
