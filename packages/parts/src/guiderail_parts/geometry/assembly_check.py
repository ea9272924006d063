"""Geometry of a plug and its socket: overlap and shrinking, clearance of walls, path to the target, symmetries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from guiderail.models.common.errors import InputError, import_extra
from guiderail.models.common.transforms import MM
from guiderail.models.objects.sdf import area_vectors
from guiderail_parts.geometry.demonstrator import TOUCH
from guiderail_parts.geometry.mesh_file import Part
from guiderail_parts.geometry.solids import SurfaceLocator, join_surfaces, sample_surface, to_arrays, to_manifold

MAX_WALL_SLOPE = 0.5  # largest component of a wall's normal along the axis
MAX_FLANK_SLOPE = 0.98  # largest component of a thread flank's normal along the axis
MAX_RESTING_OVERLAP = 2e-6  # largest overlap that counts as rounding of faces in contact [m]
_ROUNDING = 1e-6  # rounding of lengths in mesh files [m]
_SAMPLES = 12000  # number of points sampled on the walls of a part
_PATH_STEPS = 24  # number of poses on the straight part of a path
_SLIVER = 1e-13  # twice the area of a triangle below which its normal is a rounding error [m²]


@dataclass(frozen=True)
class InsertionMotion:
    """Motion of a plug along z to its target. It may end with a turn about z, during which a screw also advances."""

    travel: float  # height of the start above the target [m]
    rim: float  # height at which the plug's lowest point is level with the socket's highest [m]
    turn: float = 0.0  # angle of the turn, counter-clockwise as seen from above [rad]
    advance: float = 0.0  # height lost during the turn [m]

    @property
    def pitch(self) -> float:
        """Height lost per full turn [m]; only for a motion with a turn."""
        return self.advance * 2.0 * np.pi / abs(self.turn)

    def path(self) -> list[tuple[float, float]]:
        """Return heights [m] and angles [rad] from the rim to the target: straight down, then in the turn, if any."""
        down = [(float(z), -self.turn) for z in np.linspace(self.rim, self.advance, _PATH_STEPS)]
        if not self.turn:
            return down
        heights, angles = (np.linspace(start, 0.0, _PATH_STEPS)[1:] for start in (self.advance, -self.turn))
        return down + list(zip(heights.tolist(), angles.tolist(), strict=True))


def make_solids(part: Part) -> list[Any]:
    """Return the bodies of a part as `manifold3d` solids.

    Raises:
        InputError: If a body has faces that cross each other.
    """
    for solid in part.solids:
        if solid.is_empty():
            raise InputError(
                f"{part.path.name} has faces that cross each other (manifold3d: {solid.status()}): unite its bodies "
                "in the CAD model and export it again"
            )
    return part.solids


def move_solid(solid: Any, height: float, angle: float) -> Any:
    """Return a solid turned by `angle` [rad] about z and lifted by `height` [m]."""
    return solid.rotate((0.0, 0.0, float(np.rad2deg(angle)))).translate((0.0, 0.0, 1e3 * height))


def measure_overlap(first: Sequence[Any], second: Sequence[Any]) -> tuple[float, np.ndarray]:
    """Return the approximate thickness [m] and the position (3,) [m] of the thickest overlap of two parts.

    An overlap is treated as a thin sheet: its thickness is twice its volume divided by its surface area.
    """
    thickest, where = 0.0, np.zeros(3)
    for one in first:
        for other in second:
            for common in (one ^ other).decompose():
                area = common.surface_area()
                thickness = 2e-3 * common.volume() / area if area > 0.0 else 0.0
                if thickness > thickest:
                    thickest = thickness
                    where = to_arrays(common)[0].mean(axis=0)
    return thickest, where


def compute_center_of_mass(part: Part) -> np.ndarray:
    """Return the center of mass (3,) [m] of a part with uniform density."""
    return np.asarray(_join_bodies(part).center_mass)


def compute_radius_of_gyration(part: Part) -> float:
    """Return the radius of gyration [m] of a part with uniform density, sqrt(trace(I) / 3m) about its center of mass.

    An inertia of m k² about every axis then has the trace of the part's inertia.
    """
    mesh = _join_bodies(part)
    return float(np.sqrt(np.trace(mesh.moment_inertia) / (3.0 * mesh.volume)))


def _join_bodies(part: Part) -> Any:
    """Return all bodies of a part as one mesh of trimesh [m]."""
    return import_extra("trimesh").Trimesh(*join_surfaces(part.bodies), process=False)


def plan_motion(plug: Part, socket: Part, turn: float, clear: float = 3e-3, *, advance: float = 0.0) -> InsertionMotion:
    """Return the motion of a plug from `clear` [m] above the socket, with a `turn` [rad] and `advance` [m] at the end.

    Raises:
        InputError: If the plug at its target reaches at most `TOUCH` into the socket, or at most `TOUCH` deeper than
            the advance.
    """
    rim = float(socket.bounds[1, 2] - plug.bounds[0, 2])
    if rim <= TOUCH + _ROUNDING:
        raise InputError(
            f"the plug ends {1e3 * abs(rim):.1f} mm {'above' if rim < 0.0 else 'inside'} the socket at the target and "
            "is not inserted: draw them assembled, place the plug with --plug-pose, or give the direction in which it "
            f"comes out with --axis; it must enter more than {1e3 * TOUCH:g} mm"
        )
    if advance and advance >= rim - TOUCH - _ROUNDING:
        raise InputError(
            f"the plug advances by {1e3 * advance:.3g} mm during --turn, but enters only {1e3 * rim:.3g} mm: it must "
            f"enter more than {1e3 * TOUCH:g} mm more than it advances; give a smaller --turn or --pitch"
        )
    return InsertionMotion(travel=rim + clear, rim=rim, turn=turn, advance=advance)


def measure_side_clearance(plug: Part, socket: Part, max_slope: float = MAX_WALL_SLOPE) -> float:
    """Return the smallest distance [m] between facing walls of the parts at the target; infinite if there are none.

    `max_slope` is the largest component of a wall's normal along the axis.
    """
    walls = [_walls(part, max_slope) for part in (plug, socket)]
    least = np.inf
    for (vertices, triangles), other in (walls, walls[::-1]):
        if not len(triangles) or not len(other[1]):
            continue
        points, faces = sample_surface(vertices, triangles, _SAMPLES)
        nearest, distance, face = SurfaceLocator(*other).find_nearest(points)
        # Only walls that face each other count, not the distance to the back of a wall or past a corner.
        normals, other_normals = _normals(vertices, triangles)[faces], _normals(*other)[face]
        facing = np.einsum("ij,ij->i", normals, other_normals) < -0.7
        towards = np.einsum("ij,ij->i", normals, nearest - points) > -1e-9
        if (facing & towards).any():
            least = min(least, float(distance[facing & towards].min()))
    return least


def _walls(part: Part, max_slope: float) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) [m] and triangles (T, 3) of a part's walls: its faces along the axis."""
    vertices, triangles = join_surfaces(part.bodies)
    is_large = np.linalg.norm(area_vectors(vertices, triangles), axis=1) > _SLIVER
    is_wall = np.abs(_normals(vertices, triangles)[:, 2]) < max_slope
    return vertices, triangles[is_large & is_wall]


def _normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the unit normals (T, 3) of triangles; zero for triangles without area."""
    normals = area_vectors(vertices, triangles)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)


def find_obstructions(plug: Part, socket: Part, motion: InsertionMotion) -> list[tuple[float, float]]:
    """Return, for each body of the plug, the largest overlap with the socket on the path [m], and its height [m]."""
    fixed, obstructions = make_solids(socket), []
    for body in make_solids(plug):
        overlaps = [(measure_overlap([move_solid(body, z, a)], fixed)[0], z) for z, a in motion.path()]
        obstructions.append(max(overlaps, key=lambda overlap: overlap[0]))
    return obstructions


MAX_SHRINK = 0.5 * MM  # largest suggested `shrink` distance [m]; if more is needed, the parts are not drawn assembled
_SPARE = 0.01 * MM  # clearance left after shrinking by the suggested distance [m]
_VOLUME_SAMPLES = 1000  # number of points sampled on the surface of a common volume
_REGULARIZATION = 1e-3  # relative weight of the motion of a vertex in the least-squares problem


class OverlapError(InputError):
    """Error raised if the parts overlap at the target.

    Attributes:
        shrink: Distance by which the plug's surface would have to move inwards [m]; None if it exceeds `MAX_SHRINK`.
    """

    def __init__(self, message: str, shrink: float | None):
        """Construct the error; see the attributes."""
        super().__init__(message)
        self.shrink = shrink


def check_target(plug: Part, socket: Part) -> None:
    """Check that the parts do not overlap with the plug at its target.

    Raises:
        OverlapError: If they overlap, with the depth, the position, and the distance that `shrink` would need.
        InputError: As `make_solids`.
    """
    plug_solids, socket_solids = make_solids(plug), make_solids(socket)
    thickness, where = measure_overlap(plug_solids, socket_solids)
    if thickness <= MAX_RESTING_OVERLAP:
        return
    depth = measure_depth(plug_solids, socket_solids)
    needed = 1e-5 * np.ceil((depth + _SPARE) / 1e-5 - 1e-3)
    overlap = (
        f"overlap at the target by about {1e3 * depth:.2g} mm, around {np.round(1e3 * where, 1)} mm in the target frame"
    )
    if needed > MAX_SHRINK:
        raise OverlapError(
            f"the parts {overlap}: draw them assembled in one frame, or place the plug with --plug-pose", None
        )
    raise OverlapError(
        f"the parts {overlap}: --shrink {1e3 * needed:.2f} makes the plug smaller by that much; else correct the "
        "drawing, or place the plug with --plug-pose",
        float(needed),
    )


def measure_depth(first: Sequence[Any], second: Sequence[Any]) -> float:
    """Return the largest distance of a sampled point of the common volume from the surface of the second part [m]."""
    deepest = 0.0
    for one in first:
        for other in second:
            common = one ^ other
            if not common.is_empty():
                # Vertices on the intersection lie on both surfaces, so points between vertices are sampled, too.
                points, _ = sample_surface(*to_arrays(common), _VOLUME_SAMPLES)
                deepest = max(deepest, float(SurfaceLocator(*to_arrays(other)).find_nearest(points)[1].max()))
    return deepest


def shrink(part: Part, distance: float) -> Part:
    """Return a part whose faces are moved inwards by a distance [m].

    Each vertex moves so that the planes of its faces move by the distance, in the least-squares sense. The motion of a
    vertex is at most twice the distance.

    Raises:
        InputError: If a body would have no volume left.
    """
    bodies = []
    for vertices, triangles in part.bodies:
        smaller = vertices + _vertex_motion(vertices, triangles, distance)
        if to_manifold(smaller, triangles).volume() <= 0.0:
            raise InputError(f"{part.path.name} is too thin for --shrink {1e3 * distance:g}")
        bodies.append((smaller, triangles))
    return Part(part.path, tuple(bodies), part.repair)


def _vertex_motion(vertices: np.ndarray, triangles: np.ndarray, distance: float) -> np.ndarray:
    """Return the motion of each vertex (V, 3) [m] that moves the faces inwards by a distance [m]."""
    corners, normals = vertices[triangles], area_vectors(vertices, triangles)
    areas = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(areas > 1e-14, normals / np.maximum(areas, 1e-30), 0.0)
    matrices, sides = np.zeros((len(vertices), 3, 3)), np.zeros((len(vertices), 3))
    for i in range(3):
        one, two = corners[:, (i + 1) % 3] - corners[:, i], corners[:, (i + 2) % 3] - corners[:, i]
        lengths = np.linalg.norm(one, axis=1) * np.linalg.norm(two, axis=1)
        cosine = np.einsum("ij,ij->i", one, two) / np.maximum(lengths, 1e-30)
        angle = np.arccos(np.clip(cosine, -1.0, 1.0))  # faces weighted by angle: independent of triangulation
        np.add.at(matrices, triangles[:, i], angle[:, None, None] * normals[:, :, None] * normals[:, None, :])
        np.add.at(sides, triangles[:, i], angle[:, None] * normals)
    weight = _REGULARIZATION * np.trace(matrices, axis1=1, axis2=2)[:, None, None] + 1e-12
    motion = -distance * np.linalg.solve(matrices + weight * np.eye(3), sides[..., None])[..., 0]
    length = np.linalg.norm(motion, axis=1, keepdims=True)
    return motion * np.minimum(1.0, 2.0 * distance / np.maximum(length, 1e-30))


# A learner can augment its data by a symmetry under quarter turns about the axis and reflections. On the rim, where
# only the outlines of tip and mouth are in contact, parts often have more symmetries than when they are assembled.
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
BELOW = 0.8e-3  # distance of the compared sections from the plug's tip and the socket's mouth, past the lead-ins [m]
_SECTIONS = 12  # heights at which outlines are compared
_AROUND = 1.15  # radius around the axis in which a socket is compared, relative to the radius of the plug


def find_symmetries(
    plug: Part, socket: Part, motion: InsertionMotion, deviation: float = 0.0
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of the symmetries of both parts, and of further symmetries that nearly hold on the rim.

    A symmetry maps the outlines of both parts to themselves. It also maps the plug at its target to a plug that fits:
    the overlap of the mapped plug with the socket exceeds the overlap of the plug at most by rounding and `deviation`,
    the largest overlap caused by the decimation of both parts [m]. The parts are in the target frame, the plug at its
    target. On the rim, the plug is turned by minus `motion.turn`. With a turn, the first tuple is empty.
    """
    low, rim = float(plug.bounds[0, 2]), motion.rim + float(plug.bounds[0, 2])
    socket_solids, plug_solids = make_solids(socket), [move_solid(one, 0.0, -motion.turn) for one in make_solids(plug)]
    radius = _AROUND * 1e3 * float(np.hypot(*plug.corners[:, :2].T).max())
    heights = np.linspace(low, rim, _SECTIONS + 2)[1:-1]
    entering = [_outline(plug_solids, height) for height in heights]
    holes = [_hole(socket_solids, height, radius) for height in heights]
    tip, mouth = _outline(plug_solids, low + BELOW), _hole(socket_solids, rim - BELOW, radius)
    same, near = [], []
    largest = measure_overlap(plug_solids, socket_solids)[0] + MAX_RESTING_OVERLAP + deviation
    for name, move in SYMMETRIES.items():
        outlines_agree = min(_similarity(one, move) for one in (*entering, *holes)) >= SAME
        moved = [solid.transform(block_diag(move, np.eye(1, 2)).astype(float)) for solid in plug_solids]
        if motion.turn == 0.0 and outlines_agree and measure_overlap(moved, socket_solids)[0] <= largest:
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
    """Return the intersection over union of an outline and its image under a symmetry; 1 if both are empty."""
    other = outline.transform(np.column_stack([move, [0, 0]]).astype(float))
    joint = (outline + other).area()
    return (outline ^ other).area() / joint if joint > 1e-6 else 1.0
