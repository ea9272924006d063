"""Writes the BNC connector's files beside this one: `python -m guiderail.models.objects.write_bnc`."""

from __future__ import annotations

from pathlib import Path

from guiderail.models.objects.bnc_connector import FOLDER, BncDimensions, bore_mesh, ring_mesh, slot_mesh
from guiderail.models.objects.bnc_sdf import jack_sdf, plug_sdf


def files(dimensions: BncDimensions) -> dict[str, str]:
    """What each file holds, by name."""
    return {
        "bnc_bore.obj": bore_mesh(dimensions).to_obj(),
        "bnc_slots.obj": slot_mesh(dimensions).to_obj(),
        "bnc_ring.obj": ring_mesh(dimensions).to_obj(),
        "bnc_jack.sdf": jack_sdf(dimensions),
        "bnc_plug.sdf": plug_sdf(dimensions),
    }


def main(folder: Path = FOLDER) -> None:
    """Writes every file."""
    for name, content in files(BncDimensions()).items():
        (folder / name).write_text(content)


if __name__ == "__main__":
    main()
