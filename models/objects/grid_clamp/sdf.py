"""SDF and OBJ files of the grid clamp and its table."""

from dataclasses import replace
from pathlib import Path

from guiderail.models.common.transforms import MM
from guiderail.models.objects.grid_clamp.geometry import (
    CLAMP_SDF,
    FOLDER,
    TABLE_SDF,
    GridClampDimensions,
    bead_mesh,
    hole_mesh,
    lip_mesh,
    peg_mesh,
    slab_mesh,
)
from guiderail.models.objects.sdf import (
    ContactMaterial,
    at,
    box,
    collision,
    convex_mesh,
    cylinder,
    generate_assets,
    mesh,
    model,
    visual,
)

STEEL, ALUMINIUM, ANODIZED = "0.62 0.64 0.68 1", "0.80 0.81 0.82 1", "0.20 0.35 0.60 1"
GLASS = "0.20 0.35 0.60 0.3"  # transparent body, so that pegs and holes are visible

FRICTION = 0.2  # friction coefficient of pegs, holes and the table's face
PEG = ContactMaterial(friction=FRICTION, modulus=5e8)
BEAD = ContactMaterial(friction=0.1, modulus=2e7)
PAD = ContactMaterial(friction=FRICTION, modulus=1e6)
HOLE = ContactMaterial(friction=FRICTION)
LIP = ContactMaterial(friction=0.1)
SLAB = ContactMaterial(friction=FRICTION)

CLAMP_MASS = 0.15  # [kg]
STEM_RADIUS, STEM_LENGTH = 6.0 * MM, 6.0 * MM  # stem by which the clamp is held


def clamp_sdf(dimensions: GridClampDimensions, friction: float = FRICTION) -> str:
    """Return the clamp's model: link `clamp` is frame C, with geometry `peg_0` (middle) to `peg_4`, `bead`, `pad`."""
    d, peg_material, pad = dimensions, *(replace(surface, friction=friction) for surface in (PEG, PAD))
    contents = ""
    for number, (x, y) in enumerate(d.peg_positions):
        contents += collision(f"peg_{number}", at(x, y), convex_mesh("grid_clamp_peg.obj"), peg_material)
        shaft = (at(x, y, d.peg_length / 2), cylinder(d.peg_radius, d.peg_length))
        contents += visual(f"peg_{number}_visual", *shaft, STEEL)
    crest = at(z=d.peg_length - d.bead_depth)
    contents += collision("bead", crest, convex_mesh("grid_clamp_bead.obj"), BEAD)
    contents += visual("bead_visual", crest, mesh("grid_clamp_bead.obj"), ANODIZED)
    top = d.peg_length + d.body_height
    body = (at(z=d.peg_length + d.body_height / 2), box(d.shoulder_width, d.shoulder_width, d.body_height))
    contents += collision("pad", *body, pad)
    contents += visual("body_visual", *body, GLASS)
    contents += visual("stem_visual", at(z=top + STEM_LENGTH / 2), cylinder(STEM_RADIUS, STEM_LENGTH), STEEL)
    return model("clamp", CLAMP_MASS, (0.0, 0.0, d.peg_length), 20.0 * MM, contents)


def table_sdf(dimensions: GridClampDimensions, friction: float = FRICTION) -> str:
    """Return the table's model: link `table` is frame G, with geometry `hole_0` (middle) to `hole_4`, `lip`, `slab`."""
    d, hole, face = dimensions, *(replace(surface, friction=friction) for surface in (HOLE, SLAB))
    contents = ""
    for number, (x, y) in enumerate(d.peg_positions):
        contents += collision(f"hole_{number}", at(x, y), mesh("grid_clamp_hole.obj"), hole)
    contents += collision("lip", at(), mesh("grid_clamp_lip.obj"), LIP)
    contents += visual("lip_visual", at(), mesh("grid_clamp_lip.obj"), STEEL)
    slab = at(z=-d.table_thickness / 2)
    contents += collision("slab", slab, box(d.table_width, d.table_width, d.table_thickness), face)
    contents += visual("slab_visual", at(), mesh("grid_clamp_slab.obj"), ALUMINIUM)
    return model("table", 1.0, (0.0, 0.0, -d.table_thickness / 2), 30.0 * MM, contents)


def files(dimensions: GridClampDimensions, friction: float = FRICTION) -> dict[str, str]:
    """Return the content of each file by name."""
    return {
        "grid_clamp_peg.obj": peg_mesh(dimensions).to_obj(),
        "grid_clamp_bead.obj": bead_mesh(dimensions).to_obj(),
        "grid_clamp_hole.obj": hole_mesh(dimensions).to_obj(),
        "grid_clamp_lip.obj": lip_mesh(dimensions).to_obj(),
        "grid_clamp_slab.obj": slab_mesh(dimensions).to_obj(),
        CLAMP_SDF.name: clamp_sdf(dimensions, friction),
        TABLE_SDF.name: table_sdf(dimensions, friction),
    }


def folder_of(dimensions: GridClampDimensions, friction: float = FRICTION) -> Path:
    """Return the folder with the files of clamp and table: that of this module, or a temporary one."""
    if (dimensions, friction) == (GridClampDimensions(), FRICTION):
        return FOLDER
    return generate_assets(files, dimensions, friction)


def main(folder: Path = FOLDER) -> None:
    """Write all files of the standard clamp and table."""
    for name, content in files(GridClampDimensions()).items():
        (folder / name).write_text(content)


if __name__ == "__main__":
    main()
