"""Convex pieces of both parts for `station=mujoco`, offered if an aligned plug seats in that engine."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from guiderail.diagrams.envs.recording import drive_along
from guiderail.diagrams.stations.mujoco import MujocoStation
from guiderail.diagrams.tasks.part.file import PartModel, PartTaskFile
from guiderail.diagrams.tasks.part.task import write_workcell
from guiderail.models.common.isolation import IsolatedError, run_isolated
from guiderail.models.parts.demonstrator import plan_straight_insertion
from guiderail.models.parts.drake_check import piece_text
from guiderail.models.parts.preparation import CUT_SECONDS, ContactSurface, cut_bodies
from guiderail.tools.parts.trial import is_seated

CHECK_SECONDS = 30  # CPU time of the insertions in MuJoCo [s]
OFFSET = 3.5e-3  # offset of the socket at which it must block the plug [m]


def add_convex_pieces(
    folder: Path,
    file: PartTaskFile,
    surfaces: dict[str, ContactSurface],
    tolerance: float,
    say: Callable[[str], None],
) -> PartTaskFile:
    """Write convex pieces of both parts, and return the task file with their names; without them if they are no use.

    Args:
        folder: Folder of the task.
        file: Task file.
        surfaces: Contact surfaces of plug and socket.
        tolerance: Largest deviation of pieces [m].
        say: Called with a sentence on the result.
    """
    written: list[Path] = []
    changes: dict[str, PartModel] = {}
    try:
        for name, model in (("plug", file.plug), ("socket", file.socket)):
            names = [piece.file for piece in model.pieces if piece.modulus is not None and piece.file.endswith(".obj")]
            if len(names) < len(model.pieces):
                pieces = run_isolated(cut_bodies, surfaces[name], tolerance, cpu_seconds=CUT_SECONDS)
                if pieces is None:
                    raise IsolatedError(f"the {name} is too intricate for convex pieces")
                names = [f"{name}_convex_{number}.obj" for number in range(len(pieces))]
                for new, piece in zip(names, pieces, strict=True):
                    written.append(folder / new)
                    written[-1].write_text(piece_text(piece), encoding="utf-8")
            changes[name] = model.model_copy(update={"convex": tuple(names)})
        changed = file.model_copy(update=changes)
        aligned, blocked = run_isolated(_try_insertions, folder, changed, cpu_seconds=CHECK_SECONDS)
        if not aligned or blocked:
            raise IsolatedError("an aligned plug does not seat" if not aligned else "a misaligned plug is not blocked")
    except IsolatedError as error:
        say(f"station=mujoco is not offered: {error}")
        for path in written:
            path.unlink(missing_ok=True)
        return file
    say(f"station=mujoco: inserted ({' + '.join(str(len(model.convex)) for model in changes.values())} convex pieces)")
    return changed


def _try_insertions(folder: Path, file: PartTaskFile) -> tuple[bool, bool]:
    return insert_in_mujoco(folder, file), insert_in_mujoco(folder, file, OFFSET)


def insert_in_mujoco(folder: Path, file: PartTaskFile, offset: float = 0.0) -> bool:
    """Return True if a plug seats that moves straight in on `station=mujoco`.

    Args:
        folder: Folder of the task.
        file: Task file, which need not be written yet.
        offset: Offset of the motion along x [m].
    """
    numbers = file.motion
    times, poses = plan_straight_insertion(numbers.travel, numbers.rim, file.turn, numbers.push)
    poses[:, 0] += offset
    station = MujocoStation(write_workcell(folder, file), time_step=file.time_step)
    _, recording = drive_along(station, times, poses)
    pose = recording["pose"][-1]
    return is_seated(file, np.array([*pose[:3], *pose[:2:-1]]))
