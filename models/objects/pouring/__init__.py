"""Objects of the pouring task: a thermos, a mug and table-tennis balls.

A vessel's frame, the tip, is at the center of its opening with z out of the opening. Its wall is a ring of boxes,
because point contact replaces a hollow mesh by its convex hull.
"""

from dataclasses import dataclass

import numpy as np
from pydrake.geometry import AddContactMaterial, Box, Cylinder, ProximityProperties, Shape, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import RigidBody, SpatialInertia, UnitInertia

from guiderail.models.common.errors import InputError

WALL_BOXES = 16  # number of boxes of a vessel's wall
FRICTION = 0.4  # friction coefficient of vessels and balls


@dataclass(frozen=True)
class Vessel:
    """Cylindrical vessel, open at the top.

    Raises:
        InputError: If a dimension or the mass is not positive and finite.
    """

    inner_diameter: float  # [m]
    depth: float  # inner depth [m]
    wall: float = 0.004  # thickness of the wall [m]
    bottom: float = 0.006  # thickness of the bottom [m]
    mass: float = 0.3  # [kg]

    def __post_init__(self) -> None:
        for name in ("inner_diameter", "depth", "wall", "bottom", "mass"):
            if not 0 < getattr(self, name) < np.inf:
                raise InputError(f"a vessel's {name} must be positive and finite, not {getattr(self, name)}")

    @property
    def outer_radius(self) -> float:
        """Radius of the outer corners of the boxes [m]."""
        return (self.inner_diameter / 2 + self.wall) / np.cos(np.pi / WALL_BOXES)

    @property
    def height(self) -> float:
        """Outer height [m]."""
        return self.depth + self.bottom

    @property
    def inertia(self) -> SpatialInertia:
        """Spatial inertia of a solid cylinder of the vessel's size about the tip."""
        center = np.array([0.0, 0.0, -self.height / 2])
        solid = UnitInertia.SolidCylinder(self.outer_radius, self.height, np.array([0.0, 0.0, 1.0]))
        return SpatialInertia(self.mass, center, solid.ShiftFromCenterOfMass(-center))

    def boxes(self) -> list[tuple[RigidTransform, Box]]:
        """Return the boxes of the wall in the tip frame; adjacent boxes share an outer edge, so the ring is closed."""
        radius = self.inner_diameter / 2
        width = 2 * (radius + self.wall) * np.tan(np.pi / WALL_BOXES)
        boxes = []
        for angle in 2 * np.pi * np.arange(WALL_BOXES) / WALL_BOXES:
            R = RotationMatrix.MakeZRotation(angle)
            center = R @ np.array([radius + self.wall / 2, 0.0, -self.height / 2])
            boxes.append((RigidTransform(R, center), Box(self.wall, width, self.height)))
        return boxes

    def contains(self, p_TP: np.ndarray, margin: float = 0.0) -> bool:
        """Return True if a point (3,) [m] in the tip frame is inside the vessel enlarged by `margin` [m]."""
        radius = np.hypot(p_TP[0], p_TP[1])
        return bool(radius <= self.inner_diameter / 2 + margin and -self.depth - margin <= p_TP[2] <= margin)


THERMOS = Vessel(inner_diameter=0.050, depth=0.120, mass=0.5)
MUG = Vessel(inner_diameter=0.080, depth=0.095)


@dataclass(frozen=True)
class Ball:
    """Table-tennis ball."""

    diameter: float = 0.040  # [m]
    mass: float = 0.0027  # [kg]
    # A stiffer ball needs a shorter plant step. With this stiffness and the default step of 5 ms, no ball passes
    # through a wall: the scripted policy that observes the mug succeeds in 200 of 200 episodes.
    stiffness: float = 1e3  # [N/m]
    dissipation: float = 0.5  # [s/m]


def contact(stiffness: float | None = None, dissipation: float | None = None) -> ProximityProperties:
    """Return contact properties with a stiffness [N/m] and a dissipation [s/m]; None: the plant's default."""
    properties = ProximityProperties()
    AddContactMaterial(
        properties=properties,
        dissipation=dissipation,
        point_stiffness=stiffness,
        friction=CoulombFriction(FRICTION, FRICTION),
    )
    return properties


def add_shape(
    body: RigidBody,
    name: str,
    X_BG: RigidTransform,
    shape: Shape,
    color: tuple[float, ...],
    properties: ProximityProperties | None = None,
) -> None:
    """Add a shape as collision and visual geometry; do nothing if the plant has no scene graph."""
    plant = body.GetParentPlant()
    if plant.geometry_source_is_registered():
        plant.RegisterCollisionGeometry(body, X_BG, shape, name, properties or contact())
        plant.RegisterVisualGeometry(body, X_BG, shape, f"{name}_visual", np.array(color))


def add_vessel(plant: MultibodyPlant, name: str, vessel: Vessel, color: tuple[float, ...]) -> RigidBody:
    """Add a vessel as a model instance; the frame of its body is the tip."""
    body = plant.AddRigidBody(name, plant.AddModelInstance(name), vessel.inertia)
    parts = [(f"wall_{i}", X, box) for i, (X, box) in enumerate(vessel.boxes())]
    bottom = Cylinder(vessel.inner_diameter / 2 + vessel.wall / 2, vessel.bottom)
    parts.append(("bottom", RigidTransform([0.0, 0.0, -vessel.depth - vessel.bottom / 2]), bottom))
    for part, X_TG, shape in parts:
        add_shape(body, part, X_TG, shape, color)
    return body


def add_ball(plant: MultibodyPlant, name: str, ball: Ball, color: tuple[float, ...]) -> RigidBody:
    """Add a free ball as a model instance."""
    inertia = SpatialInertia.HollowSphereWithMass(ball.mass, ball.diameter / 2)
    body = plant.AddRigidBody(name, plant.AddModelInstance(name), inertia)
    shape = Sphere(ball.diameter / 2)
    add_shape(body, "ball", RigidTransform(), shape, color, contact(ball.stiffness, ball.dissipation))
    return body
