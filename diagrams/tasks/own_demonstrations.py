"""Demonstrations from a person's own file, as a task's reference on the control period's clock."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from guiderail.diagrams.stations.station import CONTROL_PERIOD
from guiderail.models.errors import InputError
from guiderail.models.pose_coordinates import POSE_SIZE
from guiderail.models.primitives import Demonstrations, ReferenceTrajectory


def reference_of_file(path: Path, components: int | None, floor: tuple[float, ...]) -> ReferenceTrajectory:
    """What a file's demonstrations have in common, as long as they last on average.

    Args:
        path: .npz or .csv, poses (N, 6) in the target frame.
        components: of their mixture; by information criterion unless given.
        floor: standard deviation (6,) that a hand has anyway.

    Raises:
        InputError: if there is no such file, or it holds no demonstrations of a pose.
    """
    if not path.is_file():
        raise InputError(f"there is no file {path}: name demonstrations, such as guiderail teach makes")
    return _fitted(path, path.stat().st_mtime_ns, components, floor)


@cache
def _fitted(path: Path, changed: int, components: int | None, floor: tuple[float, ...]) -> ReferenceTrajectory:
    """Fitted once a process and version."""
    demonstrations = Demonstrations.load(path)
    if demonstrations.num_outputs != POSE_SIZE:
        raise InputError(
            f"{path} has {demonstrations.num_outputs} outputs: an insertion needs the six of a pose, "
            "[x y z Rz Ry Rx] in the target frame"
        )
    duration = float(np.mean([t[-1] - t[0] for t in demonstrations.times]))
    num_steps = round(duration / CONTROL_PERIOD) + 1
    fitted = ReferenceTrajectory.from_demonstrations(
        demonstrations, components=components, num_steps=num_steps, floor=np.array(floor)
    )
    return ReferenceTrajectory(CONTROL_PERIOD * np.arange(num_steps), fitted.means, fitted.covariances)
