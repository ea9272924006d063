"""From which sides two parts look the same: quarter turns about the axis, and mirrors.

What was learned on one side is then learned for the others. On the rim, where nothing but the outlines of tip and mouth
is felt, parts often look the same from more sides than when they are assembled.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from guiderail.models.parts.assembly_check import Motion, solids, turned
from guiderail.models.parts.mesh_file import Part, need

#: How each side moves (x, y); in the order of `diagrams.tasks.bnc_observation.sides_of_the_rim`.
SIDES = {
    "quarter turn": np.array([[0, -1], [1, 0]]),
    "half turn": np.array([[-1, 0], [0, -1]]),
    "three quarters of a turn": np.array([[0, 1], [-1, 0]]),
    "mirrored across x": np.array([[1, 0], [0, -1]]),
    "mirrored across the diagonal": np.array([[0, 1], [1, 0]]),
    "mirrored across y": np.array([[-1, 0], [0, 1]]),
    "mirrored across the other diagonal": np.array([[0, -1], [-1, 0]]),
}
SAME, NEARLY = 0.99, 0.8  # of two outlines' areas, common by joint
BELOW = 0.8e-3  # below tip and mouth, past their lead-ins, where the rim is looked at [m]
_SECTIONS = 12
_AROUND = 1.15  # of the plug's radius: how far around the axis a socket is looked at


def sides(plug: Part, socket: Part, motion: Motion) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The names of those from which both parts look the same, and of further ones from which the rim nearly does.

    Args:
        plug, socket: assembled, in the target frame.
        motion: how the plug comes in; on the rim it is turned back.
    """
    low, rim = float(plug.bounds[0, 2]), motion.rim + float(plug.bounds[0, 2])
    shown, held = solids(socket), [turned(one, 0.0, -motion.turn) for one in solids(plug)]
    radius = _AROUND * 1e3 * float(np.hypot(*np.concatenate([v for v, _ in plug.bodies])[:, :2].T).max())
    heights = np.linspace(low, rim, _SECTIONS + 2)[1:-1]
    entering = [_outline(held, height) for height in heights]
    holes = [_hole(shown, height, radius) for height in heights]
    tip, mouth = _outline(held, low + BELOW), _hole(shown, rim - BELOW, radius)
    same, near = [], []
    for name, move in SIDES.items():
        if motion.turn == 0.0 and min(_alike(one, move) for one in (*entering, *holes)) >= SAME:
            same.append(name)
        elif min(_alike(tip, move), _alike(mouth, move)) >= NEARLY:
            near.append(name)
    return tuple(same), tuple(near)


def _outline(bodies: Sequence[Any], height: float) -> Any:
    """The section of a part at a height [m], in millimetres."""
    sections = [body.slice(1e3 * height) for body in bodies]
    return need("manifold3d").CrossSection.batch_boolean(sections, need("manifold3d").OpType.Add)


def _hole(bodies: Sequence[Any], height: float, radius: float) -> Any:
    """What a part leaves open around the axis at a height [m]."""
    return need("manifold3d").CrossSection.circle(radius, 64) - _outline(bodies, height)


def _alike(outline: Any, move: np.ndarray) -> float:
    """The common area of an outline and the same from another side, by their joint area; 1 where there is none."""
    other = outline.transform(np.column_stack([move, [0, 0]]).astype(float))
    joint = (outline + other).area()
    return (outline ^ other).area() / joint if joint > 1e-6 else 1.0
