"""A page that shows the two parts, the pieces that touch, and the scripted insertion."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat, MeshcatAnimation, MeshcatParams, Rgba, SurfaceTriangle, TriangleSurfaceMesh
from pydrake.math import RigidTransform

from guiderail.diagrams.stations.station import CONTROL_PERIOD
from guiderail.diagrams.tasks.part_file import PartTaskFile
from guiderail.models.errors import InputError
from guiderail.models.pose_coordinates import pose_to_transform
from guiderail.tools.onboard.trial import Trial, triangles_of

_SOLID = {"plug": Rgba(0.85, 0.65, 0.25, 1.0), "socket": Rgba(0.62, 0.64, 0.68, 0.45)}
_SCALE = 10.0  # a part of two centimetres is too near for the page's camera


def write_preview(page: Path, folder: Path, file: PartTaskFile, trial: Trial) -> None:
    """Writes the page: parts in their colours, pieces that touch each in one of its own, hidden until asked for."""
    try:
        meshcat = Meshcat(MeshcatParams(host="localhost"))
    except RuntimeError as error:
        raise InputError(f"the preview can't be made ({error}): set DRAKE_ALLOW_NETWORK=meshcat") from error
    rng = np.random.default_rng(2)
    for name, part in (("plug", file.plug), ("socket", file.socket)):
        _show(meshcat, f"/{name}/seen", folder / part.visual, _SOLID[name])
        for piece in part.pieces:
            colour = Rgba(*rng.uniform(0.25, 0.95, 3), 1.0)
            _show(meshcat, f"/{name}/contact/{Path(piece.file).stem}", folder / piece.file, colour)
        meshcat.SetProperty(f"/{name}/contact", "visible", False)
    animation = MeshcatAnimation(frames_per_second=1.0 / CONTROL_PERIOD)
    poses: Any = trial.recording["pose"]
    for frame, pose in enumerate(poses):
        X = pose_to_transform(pose)
        animation.SetTransform(frame, "/plug", RigidTransform(X.rotation(), _SCALE * X.translation()))
    meshcat.SetAnimation(animation)
    size = _SCALE * file.motion.travel
    meshcat.SetCameraPose(np.array([3.0, -4.0, 3.5]) * size, np.array([0.0, 0.0, 0.5 * size]))
    page.write_text(meshcat.StaticHtml(), encoding="utf-8")


def _show(meshcat: Any, path: str, file: Path, colour: Any) -> None:
    corners = _SCALE * triangles_of(file).reshape(-1, 3)
    triangles = [SurfaceTriangle(3 * i, 3 * i + 1, 3 * i + 2) for i in range(len(corners) // 3)]
    meshcat.SetObject(path, TriangleSurfaceMesh(triangles, list(corners)), colour)
