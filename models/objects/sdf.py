"""The pieces of an object's SDF file: surfaces that touch, surfaces that are seen, and a model of one link."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

# A folder is removed when the last reference to it goes: a simulator may read a mesh long after it read the SDF file.
_FOLDERS: list[TemporaryDirectory[str]] = []


@cache
def generate_assets(files: Callable[..., dict[str, str]], *dimensions: Hashable) -> Path:
    """The folder that holds `files(*dimensions)`, which gives what each file holds by its name."""
    folder = TemporaryDirectory(prefix="guiderail-")
    _FOLDERS.append(folder)
    for name, content in files(*dimensions).items():
        Path(folder.name, name).write_text(content)
    return Path(folder.name)


DRAKE_NAMESPACE = 'xmlns:drake="drake.mit.edu"'


@dataclass(frozen=True)
class ContactMaterial:
    """How a surface gives way; `modulus` None is rigid. Moduli are of the contact model, not of the material."""

    friction: float
    modulus: float | None = None  # [Pa] pressure at full depth
    resolution: float | None = None  # [m] edge length of a curved primitive's mesh
    dissipation: float = 1.0  # [s/m]
    margin: float | None = None  # [m] by which a compliant surface is felt before it touches, so that no step leaps in


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
    """A cylinder [m] about z."""
    return f"<cylinder><radius>{radius:g}</radius><length>{length:g}</length></cylinder>"


def box(x: float, y: float, z: float) -> str:
    """A box by its sizes [m]."""
    return f"<box><size>{x:g} {y:g} {z:g}</size></box>"


def mesh(file: str) -> str:
    """A surface from an OBJ file beside the SDF file."""
    return f"<mesh><uri>{file}</uri></mesh>"


def convex_mesh(file: str) -> str:
    """A convex solid from an OBJ file beside the SDF file, which may be compliant."""
    return f"<mesh><uri>{file}</uri><drake:declare_convex/></mesh>"


def at(x: float = 0.0, y: float = 0.0, z: float = 0.0, pitch: float = 0.0) -> str:
    """A pose in the link [m, rad]."""
    return f"{x:g} {y:g} {z:g} 0 {pitch:.6g} 0"


def collision(name: str, pose: str, geometry: str, material: ContactMaterial) -> str:
    """A surface that touches."""
    return f"""
      <collision name="{name}">
        <pose>{pose}</pose>
        <geometry>{geometry}</geometry>
        {_proximity(material)}
      </collision>"""


def visual(name: str, pose: str, geometry: str, color: str) -> str:
    """A surface that is seen; `color` is "r g b a"."""
    return f"""
      <visual name="{name}">
        <pose>{pose}</pose>
        <geometry>{geometry}</geometry>
        <material><diffuse>{color}</diffuse></material>
      </visual>"""


def model(
    name: str,
    mass: float,
    centre: Sequence[float],
    radius_of_gyration: float,
    contents: str,
    source: str = "guiderail.models.objects",
) -> str:
    """A file with one model of one link, both called `name`; mass [kg], centre of mass (3,) and gyration [m].

    `source` is what the file is written from, for whoever would change a number in it.
    """
    inertia = mass * radius_of_gyration**2
    return f"""<?xml version="1.0"?>
<!-- Written by {source}; change the dimensions there. -->
<sdf version="1.9" {DRAKE_NAMESPACE}>
  <model name="{name}">
    <link name="{name}">
      <inertial>
        <pose>{at(*centre)}</pose>
        <mass>{mass:g}</mass>
        <inertia><ixx>{inertia:.4g}</ixx><iyy>{inertia:.4g}</iyy><izz>{inertia:.4g}</izz>
          <ixy>0</ixy><ixz>0</ixz><iyz>0</iyz></inertia>
      </inertial>{contents}
    </link>
  </model>
</sdf>
"""
