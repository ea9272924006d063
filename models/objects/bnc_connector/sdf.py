"""SDF and OBJ files of the BNC jack and plug."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from guiderail.models.common.transforms import MM
from guiderail.models.objects.bnc_connector.geometry import FOLDER, BncDimensions, bore_mesh, ring_mesh, slot_mesh
from guiderail.models.objects.sdf import (
    ContactMaterial,
    at,
    box,
    collision,
    cylinder,
    equal_area_radius,
    generate_assets,
    mesh,
    model,
    visual,
)

BRASS, NICKEL, RUBBER = "0.85 0.65 0.25 1", "0.62 0.64 0.68 1", "0.75 0.20 0.20 1"

FRICTION = 0.2  # metal on metal
# Without a margin the plug penetrates by its motion in a step of 10 ms, and the next step ejects it. With a margin,
# fast sliding is decelerated by more than friction, depending on the step (`python -m research.benchmarks engines`).
MARGIN = 0.1 * MM
# Stiffness of brass. A softer barrel distributes the load of a rim, which results in a torque on a misaligned plug that
# metal parts do not have (docs/experiments.md, "Center of pressure on the rim").
BARREL = ContactMaterial(friction=FRICTION, modulus=1e11, resolution=1.5 * MM, margin=MARGIN)
LUG = ContactMaterial(friction=FRICTION, modulus=5e9, resolution=0.8 * MM, margin=MARGIN)
PAD = ContactMaterial(friction=0.05, modulus=1e7, resolution=6.0 * MM)  # the gasket: a spring with little friction
RING = ContactMaterial(friction=FRICTION)
SEAT = ContactMaterial(friction=0.05)

PLUG_MASS = 0.03  # [kg]


def barrel_sides(dimensions: BncDimensions) -> int:
    """Return the number of sides of Drake's polygon of the barrel: each is at most as long as the resolution hint."""
    assert BARREL.resolution is not None
    return int(np.ceil(2.0 * np.pi * dimensions.barrel_radius / BARREL.resolution))


def jack_sdf(
    dimensions: BncDimensions, friction: float = FRICTION, margin: float = MARGIN, equal_area: bool = False
) -> str:
    """Return the jack's model: link `jack` is frame J, with geometry `barrel`, `pad`, `lug_0` and `lug_1`.

    The collision geometry of the barrel is an inscribed polygon, or with `equal_area` a polygon of the same area.
    """
    d = dimensions
    barrel_material, lug_material = (replace(metal, friction=friction, margin=margin) for metal in (BARREL, LUG))
    center = at(z=d.barrel_height / 2)
    radius = equal_area_radius(d.barrel_radius, barrel_sides(d)) if equal_area else d.barrel_radius
    pad = (at(z=d.barrel_height + d.pad_height - d.pad_thickness / 2), cylinder(d.pad_radius, d.pad_thickness))
    lug_length = d.lug_tip_radius - d.lug_root_radius
    lug_center = 0.5 * (d.lug_tip_radius + d.lug_root_radius)
    contents = collision("barrel", center, cylinder(radius, d.barrel_height), barrel_material)
    contents += visual("barrel_visual", center, cylinder(d.barrel_radius, d.barrel_height), NICKEL)
    contents += collision("pad", *pad, PAD) + visual("pad_visual", *pad, RUBBER)
    for number, side in enumerate((1.0, -1.0)):
        lug = (at(x=side * lug_center, z=d.lug_height, pitch=np.pi / 2), cylinder(d.lug_radius, lug_length))
        contents += collision(f"lug_{number}", *lug, lug_material) + visual(f"lug_{number}_visual", *lug, BRASS)
    return model("jack", 0.05, (0.0, 0.0, d.barrel_height / 2), 5.0 * MM, contents)


def plug_sdf(dimensions: BncDimensions, friction: float = FRICTION) -> str:
    """Return the plug's model: link `plug` is frame P, with geometry `bore`, `slots` and `seat`."""
    d, ring = dimensions, replace(RING, friction=friction)
    seat = (at(z=d.seat_height + d.seat_thickness / 2), box(d.seat_width, d.seat_width, d.seat_thickness))
    shell = (at(z=d.ring_length + d.shell_length / 2), cylinder(d.shell_radius, d.shell_length))
    contents = collision("bore", at(), mesh("bnc_bore.obj"), ring)
    contents += collision("slots", at(), mesh("bnc_slots.obj"), ring)
    contents += collision("seat", *seat, SEAT)
    contents += visual("ring_visual", at(), mesh("bnc_ring.obj"), NICKEL)
    contents += visual("shell_visual", *shell, BRASS)
    return model("plug", PLUG_MASS, (0.0, 0.0, d.ring_length), 8.0 * MM, contents)


def files(
    dimensions: BncDimensions, friction: float = FRICTION, margin: float = MARGIN, equal_area: bool = False
) -> dict[str, str]:
    """Return the content of each file by name."""
    return {
        "bnc_bore.obj": bore_mesh(dimensions, equal_area=equal_area).to_obj(),
        "bnc_slots.obj": slot_mesh(dimensions).to_obj(),
        "bnc_ring.obj": ring_mesh(dimensions).to_obj(),
        "bnc_jack.sdf": jack_sdf(dimensions, friction, margin, equal_area),
        "bnc_plug.sdf": plug_sdf(dimensions, friction),
    }


def folder_of(
    dimensions: BncDimensions, friction: float = FRICTION, margin: float = MARGIN, equal_area: bool = False
) -> Path:
    """Return the folder with a connector's files: that of this module, or a temporary one for other dimensions."""
    if (dimensions, friction, margin, equal_area) == (BncDimensions(), FRICTION, MARGIN, False):
        return FOLDER
    return generate_assets(files, dimensions, friction, margin, equal_area)


def main(folder: Path = FOLDER) -> None:
    """Write all files of the standard connector."""
    for name, content in files(BncDimensions()).items():
        (folder / name).write_text(content)


if __name__ == "__main__":
    main()
