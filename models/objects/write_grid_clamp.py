"""Writes the grid clamp's files beside this one: `python -m guiderail.models.objects.write_grid_clamp`."""

from __future__ import annotations

from pathlib import Path

from guiderail.models.objects.grid_clamp import (
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
from guiderail.models.objects.grid_clamp_sdf import FRICTION, clamp_sdf, table_sdf
from guiderail.models.objects.made import made


def files(dimensions: GridClampDimensions, friction: float = FRICTION) -> dict[str, str]:
    """What each file holds, by name."""
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
    """Where the files of a clamp and its table lie: beside this one, or made to measure."""
    if (dimensions, friction) == (GridClampDimensions(), FRICTION):
        return FOLDER
    return made(files, dimensions, friction)


def main(folder: Path = FOLDER) -> None:
    """Writes every file."""
    for name, content in files(GridClampDimensions()).items():
        (folder / name).write_text(content)


if __name__ == "__main__":
    main()
