"""Demonstrations of a scripted hand that searches the rim, recorded on rails."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from guiderail.diagrams.recording import drive_along
from guiderail.diagrams.stations.part_workcell import PLUG, SOCKET
from guiderail.diagrams.stations.rails import RailsStation
from guiderail.diagrams.stations.station import CONTROL_PERIOD
from guiderail.diagrams.tasks.part_file import PartTaskFile
from guiderail.diagrams.tasks.part_insertion import PartInsertion, workcell
from guiderail.models.demonstrations.bnc_connector import NAMES
from guiderail.models.parts.motion import NUM_DEMONSTRATIONS, demonstrator_motions, searching
from guiderail.models.primitives import Demonstrations

MOST_SESSIONS = 3  # of five attempts, until five have seated the plug


def demonstrate(folder: Path, file: PartTaskFile) -> int:
    """Writes the demonstrations' file; returns how many of them seat the plug."""
    numbers = file.motion
    script = searching(numbers.travel, numbers.rim, file.turn, numbers.push, numbers.press)
    times = CONTROL_PERIOD * np.arange(round(script[0][-1] / CONTROL_PERIOD) + 1)
    good: list[np.ndarray] = []
    bad: list[np.ndarray] = []
    for seed in range(MOST_SESSIONS):
        for motion in demonstrator_motions(seed, script, numbers.rim - numbers.press - 1e-3, times):
            if len(good) < NUM_DEMONSTRATIONS:
                (good if _seats(folder, file, times, motion) else bad).append(motion)
    shown = (good + bad)[:NUM_DEMONSTRATIONS]
    Demonstrations([times] * len(shown), shown, NAMES).save(folder / file.demonstrations.file)
    return len(good)


def _seats(folder: Path, file: PartTaskFile, times: np.ndarray, motion: np.ndarray) -> bool:
    driven, _ = drive_along(RailsStation(workcell(folder, file), time_step=file.time_step), times, motion)
    plant = driven.station.plant
    X = plant.GetFrameByName(PLUG).CalcPose(driven.plant_context, plant.GetFrameByName(SOCKET))
    turn = X.rotation().ToAngleAxis()
    judge: Any = type("Judge", (PartInsertion,), {"file": file})
    return judge.is_seated(np.concatenate([X.translation(), turn.angle() * turn.axis()]))
