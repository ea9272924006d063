"""Convex solids of the core's workcells: Drake collides their meshes, whose convex hulls other engines collide."""

from typing import Any

import numpy as np

from guiderail.diagrams.stations.workcell import ConvexWorkcell, Cylinder, Surface
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.diagrams.tasks.grid_clamp import GridClampWorkcell
from guiderail.models.common.errors import InputError
from guiderail_mujoco.clamp_surfaces import clamp_surfaces, table_surfaces
from guiderail_mujoco.connector_surfaces import jack_surfaces, plug_surfaces

# A prism with this number of sides is 2 µm inside a barrel of 5 mm. PhysX has no cylinders, and MuJoCo's contacts
# between edges of cylinders and polyhedra can be 0.2 mm too shallow, or 1.5 mm too deep.
CYLINDER_SIDES = 120


def surfaces_of(workcell: Any) -> tuple[list[Surface], list[Surface]]:
    """Return the contact surfaces of a workcell's fixture and workpiece, each in the frame of its body.

    Raises:
        InputError: If the workcell has no convex solids.
    """
    if isinstance(workcell, ConvexWorkcell):
        return workcell.fixture_surfaces(), workcell.workpiece_surfaces()
    if isinstance(workcell, BncWorkcell):
        connector = workcell.dimensions, workcell.friction
        return jack_surfaces(*connector), plug_surfaces(*connector)
    if isinstance(workcell, GridClampWorkcell):
        table = workcell.dimensions, workcell.friction
        return table_surfaces(*table), clamp_surfaces(*table)
    raise InputError(
        f"this engine needs convex solids, which {type(workcell).__name__} does not provide: implement the methods of "
        "ConvexWorkcell"
    )


def prism(cylinder: Cylinder) -> np.ndarray:
    """Return the vertices (2 N, 3) [m] of a prism in place of a cylinder, with N = `CYLINDER_SIDES`."""
    angle, half = 2.0 * np.pi * np.arange(CYLINDER_SIDES) / CYLINDER_SIDES, np.full(CYLINDER_SIDES, cylinder.length / 2)
    x, y = cylinder.radius * np.cos(angle), cylinder.radius * np.sin(angle)
    return np.concatenate([np.column_stack([x, y, z]) for z in (-half, half)])
