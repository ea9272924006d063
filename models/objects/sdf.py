"""Model files of objects: triangle meshes in Wavefront OBJ files, and SDF files of models with one link."""

import itertools
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np


def cylindrical(radius: np.ndarray | float, angle: np.ndarray | float, height: np.ndarray | float) -> np.ndarray:
    """Return points (N, 3) [m] from cylindrical coordinates about z, or one point (3,) from three numbers.

    Radius [m], angle [rad] and height [m] are (N,) or numbers; they are broadcast.
    """
    radius, angle, height = np.broadcast_arrays(radius, angle, height)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=-1)


def equal_area_radius(radius: float, num_sides: int) -> float:
    """Return the circumradius [m] of the regular polygon that has the area of a circle of `radius` [m]."""
    turn = 2.0 * np.pi / num_sides
    return radius * float(np.sqrt(turn / np.sin(turn)))


def strip(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return quads (N-1, 4, 3) between two polylines (N, 3), counter-clockwise if `second` is right of `first`."""
    return np.stack([first[:-1], second[:-1], second[1:], first[1:]], axis=1)


def area_vectors(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the normals (T, 3) of triangles; the length of a normal is twice the area of its triangle [m²]."""
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    return np.cross(b - a, c - a)


@dataclass(frozen=True)
class TriangleMesh:
    """Triangle mesh: vertices (V, 3) [m] and triangles (T, 3), counter-clockwise as seen from outside."""

    vertices: np.ndarray
    triangles: np.ndarray

    @staticmethod
    def from_quads(quads: np.ndarray) -> "TriangleMesh":
        """Split counter-clockwise quads (Q, 4, 3) into triangles; merge equal corners and drop degenerate triangles."""
        corners = np.round(np.asarray(quads, dtype=float), 9).reshape(-1, 3) + 0.0  # -0.0 becomes 0.0
        vertices, numbers = np.unique(corners, axis=0, return_inverse=True)
        a, b, c, d = numbers.reshape(-1, 4).T
        triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
        has_area = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
        return TriangleMesh(vertices, triangles[has_area])

    def normals(self) -> np.ndarray:
        """Return the unit normals (T, 3) of the triangles."""
        normal = area_vectors(self.vertices, self.triangles)
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)

    def to_obj(self) -> str:
        """Return an OBJ file's text: vertices rounded to 1 nm, and one normal per triangle, as renderers require."""
        lines = [f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in self.vertices]
        lines += [f"vn {x:.4f} {y:.4f} {z:.4f}" for x, y, z in np.round(self.normals(), 4) + 0.0]
        for number, corners in enumerate(self.triangles + 1, start=1):
            lines.append("f " + " ".join(f"{corner}//{number}" for corner in corners))
        return "\n".join(lines) + "\n"


def lathe(profile: Sequence[tuple[float, float]], num_sides: int) -> TriangleMesh:
    """Return a surface of revolution about z, whose circles are approximated by regular polygons.

    The middle of one side of each polygon lies on the x axis.

    Args:
        profile: (radius, height) [m] of each circle. Along the profile, with the radius plotted to the right and the
            height up, the outside is on the left: a bore's wall is listed upwards, a shaft's wall downwards.
        num_sides: Number of sides of the polygons.
    """
    angles = 2.0 * np.pi * (np.arange(num_sides + 1) + 0.5) / num_sides
    circles = [cylindrical(radius, angles, height) for radius, height in profile]
    return TriangleMesh.from_quads(
        np.concatenate([strip(first, second) for first, second in itertools.pairwise(circles)])
    )


# These references prevent the deletion of the folders: a simulator may read a mesh long after the SDF file.
_FOLDERS: list[TemporaryDirectory[str]] = []


@cache
def generate_assets(files: Callable[..., dict[str, str]], *dimensions: Hashable) -> Path:
    """Return a temporary folder with the files `files(*dimensions)`, a mapping from file name to content."""
    folder = TemporaryDirectory(prefix="guiderail-")
    _FOLDERS.append(folder)
    for name, content in files(*dimensions).items():
        Path(folder.name, name).write_text(content)
    return Path(folder.name)


@dataclass(frozen=True)
class ContactMaterial:
    """Parameters of the hydroelastic contact model of a surface; they are not properties of a real material."""

    friction: float  # coefficient of static and dynamic friction
    modulus: float | None = None  # hydroelastic modulus [Pa]; None for a rigid surface
    resolution: float | None = None  # resolution hint: edge length of a curved primitive's mesh [m]
    dissipation: float = 1.0  # Hunt-Crossley dissipation [s/m]
    # Distance from a compliant surface at which contact begins [m]; it limits the penetration within a time step.
    margin: float | None = None


def _proximity(material: ContactMaterial) -> str:
    if material.modulus is None:
        compliance = "<drake:rigid_hydroelastic/>"
    else:
        modulus = f"<drake:hydroelastic_modulus>{material.modulus:g}</drake:hydroelastic_modulus>"
        compliance = f"<drake:compliant_hydroelastic/>{modulus}"
    if material.margin is not None:
        compliance += f"<drake:hydroelastic_margin>{material.margin:g}</drake:hydroelastic_margin>"
    if material.resolution is not None:
        compliance += f"<drake:mesh_resolution_hint>{material.resolution:g}</drake:mesh_resolution_hint>"
    return f"""<drake:proximity_properties>
          {compliance}
          <drake:hunt_crossley_dissipation>{material.dissipation:g}</drake:hunt_crossley_dissipation>
          <drake:mu_dynamic>{material.friction:g}</drake:mu_dynamic>
          <drake:mu_static>{material.friction:g}</drake:mu_static>
        </drake:proximity_properties>"""


def cylinder(radius: float, length: float) -> str:
    """Return the SDF geometry of a cylinder about z; radius and length in [m]."""
    return f"<cylinder><radius>{radius:g}</radius><length>{length:g}</length></cylinder>"


def box(x: float, y: float, z: float) -> str:
    """Return the SDF geometry of a box with the given sizes [m]."""
    return f"<box><size>{x:g} {y:g} {z:g}</size></box>"


def mesh(file: str) -> str:
    """Return the SDF geometry of a mesh from an OBJ or VTK file in the folder of the SDF file."""
    return f"<mesh><uri>{file}</uri></mesh>"


def convex_mesh(file: str) -> str:
    """Return the SDF geometry of a convex solid, compliant or not, from an OBJ file in the folder of the SDF file."""
    return f"<mesh><uri>{file}</uri><drake:declare_convex/></mesh>"


def at(x: float = 0.0, y: float = 0.0, z: float = 0.0, pitch: float = 0.0) -> str:
    """Return the SDF text of a pose in the link: position [m], and rotation about y by `pitch` [rad]."""
    return f"{x:g} {y:g} {z:g} 0 {pitch:.6g} 0"


def collision(name: str, pose: str, geometry: str, material: ContactMaterial) -> str:
    """Return the SDF element of a collision geometry."""
    return f"""
      <collision name="{name}">
        <pose>{pose}</pose>
        <geometry>{geometry}</geometry>
        {_proximity(material)}
      </collision>"""


def visual(name: str, pose: str, geometry: str, color: str) -> str:
    """Return the SDF element of a visual geometry; `color` is "r g b a"."""
    return f"""
      <visual name="{name}">
        <pose>{pose}</pose>
        <geometry>{geometry}</geometry>
        <material><diffuse>{color}</diffuse></material>
      </visual>"""


def model(
    name: str,
    mass: float,
    center: Sequence[float],
    radius_of_gyration: float,
    contents: str,
    source: str = "guiderail.models.objects",
) -> str:
    """Return an SDF file with one model of one link.

    Args:
        name: Name of the model and the link.
        mass: Mass [kg].
        center: Center of mass (3,) [m].
        radius_of_gyration: Radius of gyration [m].
        contents: SDF elements of the collision and visual geometry.
        source: Module or file that the dimensions come from, named in a comment.
    """
    inertia = mass * radius_of_gyration**2
    return f"""<?xml version="1.0"?>
<!-- Written by {source}; change the dimensions there. -->
<sdf version="1.9" xmlns:drake="drake.mit.edu">
  <model name="{name}">
    <link name="{name}">
      <inertial>
        <pose>{at(*center)}</pose>
        <mass>{mass:g}</mass>
        <inertia><ixx>{inertia:.4g}</ixx><iyy>{inertia:.4g}</iyy><izz>{inertia:.4g}</izz>
          <ixy>0</ixy><ixz>0</ixz><iyz>0</iyz></inertia>
      </inertial>{contents}
    </link>
  </model>
</sdf>
"""
