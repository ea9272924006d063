"""Writes the BNC connector's files beside this one: `python -m guiderail.models.objects.write_bnc`."""

from __future__ import annotations

from pathlib import Path

from guiderail.models.objects.bnc_connector import FOLDER, BncDimensions, bore_mesh, ring_mesh, slot_mesh
from guiderail.models.objects.bnc_sdf import FRICTION, MARGIN, jack_sdf, plug_sdf
from guiderail.models.objects.made import made


def files(
    dimensions: BncDimensions, friction: float = FRICTION, margin: float = MARGIN, equal_area: bool = False
) -> dict[str, str]:
    """What each file holds, by name."""
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
    """Where the files of a connector lie: beside this one, or made to measure."""
    if (dimensions, friction, margin, equal_area) == (BncDimensions(), FRICTION, MARGIN, False):
        return FOLDER
    return made(files, dimensions, friction, margin, equal_area)


def main(folder: Path = FOLDER) -> None:
    """Writes every file."""
    for name, content in files(BncDimensions()).items():
        (folder / name).write_text(content)


if __name__ == "__main__":
    main()
