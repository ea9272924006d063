"""Convex solids of the core's workcells: Drake collides their meshes, whose convex hulls other engines collide."""

from typing import Any

from guiderail.diagrams.stations.workcell import ConvexWorkcell, Surface
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.diagrams.tasks.grid_clamp import GridClampWorkcell
from guiderail.models.common.errors import InputError
from guiderail_mujoco.clamp_surfaces import clamp_surfaces, table_surfaces
from guiderail_mujoco.connector_surfaces import jack_surfaces, plug_surfaces


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
