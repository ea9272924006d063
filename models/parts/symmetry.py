"""Symmetry of two parts under quarter turns about the axis and reflections.

A learner can augment its data by a symmetry. On the rim, where only the outlines of tip and mouth are in contact, parts
often have more symmetries than when they are assembled.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from guiderail.models.common.errors import import_extra
from guiderail.models.parts.assembly_check import InsertionMotion, make_solids, move_solid
from guiderail.models.parts.mesh_file import Part

# Map of (x, y) of each candidate, in the order of `diagrams.tasks.insertion.sides_of_the_rim`.
SYMMETRIES = {
    "quarter turn": np.array([[0, -1], [1, 0]]),
    "half turn": np.array([[-1, 0], [0, -1]]),
    "three quarters of a turn": np.array([[0, 1], [-1, 0]]),
    "mirrored across x": np.array([[1, 0], [0, -1]]),
    "mirrored across the diagonal": np.array([[0, 1], [1, 0]]),
    "mirrored across y": np.array([[-1, 0], [0, 1]]),
    "mirrored across the other diagonal": np.array([[0, -1], [-1, 0]]),
}
SAME, NEARLY = 0.99, 0.8  # smallest intersection over union of two outlines that count as (nearly) the same
BELOW = 0.8e-3  # distance of the sections at the rim from the plug's tip or the socket's mouth, past the lead-ins [m]
_SECTIONS = 12  # heights at which outlines are compared
_AROUND = 1.15  # radius around the axis in which a socket is compared, in radii of the plug


def find_symmetries(plug: Part, socket: Part, motion: InsertionMotion) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of the symmetries of both parts, and of further ones that nearly hold on the rim.

    The parts are in the target frame, the plug at its target. On the rim, the plug is turned by minus `motion.turn`.
    """
    low, rim = float(plug.bounds[0, 2]), motion.rim + float(plug.bounds[0, 2])
    socket_solids, plug_solids = make_solids(socket), [move_solid(one, 0.0, -motion.turn) for one in make_solids(plug)]
    radius = _AROUND * 1e3 * float(np.hypot(*plug.corners[:, :2].T).max())
    heights = np.linspace(low, rim, _SECTIONS + 2)[1:-1]
    entering = [_outline(plug_solids, height) for height in heights]
    holes = [_hole(socket_solids, height, radius) for height in heights]
    tip, mouth = _outline(plug_solids, low + BELOW), _hole(socket_solids, rim - BELOW, radius)
    same, near = [], []
    for name, move in SYMMETRIES.items():
        if motion.turn == 0.0 and min(_similarity(one, move) for one in (*entering, *holes)) >= SAME:
            same.append(name)
        elif min(_similarity(tip, move), _similarity(mouth, move)) >= NEARLY:
            near.append(name)
    return tuple(same), tuple(near)


def _outline(bodies: Sequence[Any], height: float) -> Any:
    """Return the section of a part at a height [m], in millimeters."""
    sections = [body.slice(1e3 * height) for body in bodies]
    return import_extra("manifold3d").CrossSection.batch_boolean(sections, import_extra("manifold3d").OpType.Add)


def _hole(bodies: Sequence[Any], height: float, radius: float) -> Any:
    """Return the opening of a part around the axis at a height [m], in millimeters."""
    return import_extra("manifold3d").CrossSection.circle(radius, 64) - _outline(bodies, height)


def _similarity(outline: Any, move: np.ndarray) -> float:
    """Return the intersection over union of an outline and its image under a symmetry; 1 without an outline."""
    other = outline.transform(np.column_stack([move, [0, 0]]).astype(float))
    joint = (outline + other).area()
    return (outline ^ other).area() / joint if joint > 1e-6 else 1.0
