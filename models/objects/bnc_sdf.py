"""The SDF files of the BNC jack and plug, written from the drawing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from guiderail.models.objects.bnc_connector import MM, BncDimensions

DRAKE_NAMESPACE = 'xmlns:drake="drake.mit.edu"'
BRASS, NICKEL, RUBBER = "0.85 0.65 0.25 1", "0.62 0.64 0.68 1", "0.75 0.20 0.20 1"


@dataclass(frozen=True)
class ContactMaterial:
    """How a surface gives way; `modulus` None is rigid. Moduli are of the contact model, not of the metal."""

    friction: float
    modulus: float | None = None  # [Pa] pressure at full depth
    resolution: float | None = None  # [m] edge length of a curved primitive's mesh
    dissipation: float = 1.0  # [s/m]


# The lugs are stiffer than the barrel because they are small: the same force must not let one through a slot's wall.
BARREL = ContactMaterial(friction=0.2, modulus=1e9, resolution=1.5 * MM)
LUG = ContactMaterial(friction=0.2, modulus=5e9, resolution=0.8 * MM)
PAD = ContactMaterial(friction=0.05, modulus=1e7, resolution=6.0 * MM)  # the gasket is a spring that slips
RING = ContactMaterial(friction=0.2)
SEAT = ContactMaterial(friction=0.05)

PLUG_MASS = 0.03  # [kg]


def _proximity(material: ContactMaterial) -> str:
    if material.modulus is None:
        compliance = "<drake:rigid_hydroelastic/>"
    else:
        modulus = f"<drake:hydroelastic_modulus>{material.modulus:g}</drake:hydroelastic_modulus>"
        compliance = f"<drake:compliant_hydroelastic/>{modulus}"
    if material.resolution is not None:
        compliance += f"<drake:mesh_resolution_hint>{material.resolution:g}</drake:mesh_resolution_hint>"
    return f"""<drake:proximity_properties>
          {compliance}
          <drake:hunt_crossley_dissipation>{material.dissipation:g}</drake:hunt_crossley_dissipation>
          <drake:mu_dynamic>{material.friction:g}</drake:mu_dynamic>
          <drake:mu_static>{material.friction:g}</drake:mu_static>
        </drake:proximity_properties>"""


def _cylinder(radius: float, length: float) -> str:
    return f"<cylinder><radius>{radius:g}</radius><length>{length:g}</length></cylinder>"


def _mesh(file: str) -> str:
    return f"<mesh><uri>{file}</uri></mesh>"


def _collision(name: str, pose: str, geometry: str, material: ContactMaterial) -> str:
    return f"""
      <collision name="{name}">
        <pose>{pose}</pose>
        <geometry>{geometry}</geometry>
        {_proximity(material)}
      </collision>"""


def _visual(name: str, pose: str, geometry: str, color: str) -> str:
    return f"""
      <visual name="{name}">
        <pose>{pose}</pose>
        <geometry>{geometry}</geometry>
        <material><diffuse>{color}</diffuse></material>
      </visual>"""


def _at(x: float = 0.0, y: float = 0.0, z: float = 0.0, pitch: float = 0.0) -> str:
    return f"{x:g} {y:g} {z:g} 0 {pitch:.6g} 0"


def _model(name: str, mass: float, centre_height: float, radius_of_gyration: float, contents: str) -> str:
    inertia = mass * radius_of_gyration**2
    return f"""<?xml version="1.0"?>
<!-- Written by guiderail.models.objects; change the dimensions there. -->
<sdf version="1.9" {DRAKE_NAMESPACE}>
  <model name="{name}">
    <link name="{name}">
      <inertial>
        <pose>0 0 {centre_height:g} 0 0 0</pose>
        <mass>{mass:g}</mass>
        <inertia><ixx>{inertia:.4g}</ixx><iyy>{inertia:.4g}</iyy><izz>{inertia:.4g}</izz>
          <ixy>0</ixy><ixz>0</ixz><iyz>0</iyz></inertia>
      </inertial>{contents}
    </link>
  </model>
</sdf>
"""


def jack_sdf(dimensions: BncDimensions) -> str:
    """The jack: link `jack` is frame J. Geometry `barrel`, `pad`, `lug_0`, `lug_1`."""
    d = dimensions
    barrel = (_at(z=d.barrel_height / 2), _cylinder(d.barrel_radius, d.barrel_height))
    pad = (
        _at(z=d.barrel_height + d.pad_height - d.pad_thickness / 2),
        _cylinder(d.pad_radius, d.pad_thickness),
    )
    lug_length = d.lug_tip_radius - d.lug_root_radius
    lug_centre = 0.5 * (d.lug_tip_radius + d.lug_root_radius)
    contents = _collision("barrel", *barrel, BARREL) + _visual("barrel_visual", *barrel, NICKEL)
    contents += _collision("pad", *pad, PAD) + _visual("pad_visual", *pad, RUBBER)
    for number, side in enumerate((1.0, -1.0)):
        lug = (_at(x=side * lug_centre, z=d.lug_height, pitch=np.pi / 2), _cylinder(d.lug_radius, lug_length))
        contents += _collision(f"lug_{number}", *lug, LUG) + _visual(f"lug_{number}_visual", *lug, BRASS)
    return _model("jack", 0.05, d.barrel_height / 2, 5.0 * MM, contents)


def plug_sdf(dimensions: BncDimensions) -> str:
    """The plug: link `plug` is frame P. Geometry `bore`, `slots`, `seat`."""
    d = dimensions
    seat = (
        _at(z=d.seat_height + d.seat_thickness / 2),
        f"<box><size>{d.seat_width:g} {d.seat_width:g} {d.seat_thickness:g}</size></box>",
    )
    shell = (_at(z=d.ring_length + d.shell_length / 2), _cylinder(d.shell_radius, d.shell_length))
    contents = _collision("bore", _at(), _mesh("bnc_bore.obj"), RING)
    contents += _collision("slots", _at(), _mesh("bnc_slots.obj"), RING)
    contents += _collision("seat", *seat, SEAT)
    contents += _visual("ring_visual", _at(), _mesh("bnc_ring.obj"), NICKEL)
    contents += _visual("shell_visual", *shell, BRASS)
    return _model("plug", PLUG_MASS, d.ring_length, 8.0 * MM, contents)
