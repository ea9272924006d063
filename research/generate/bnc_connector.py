"""Recording of the connector's demonstrations in simulation: insertion and search."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from guiderail.diagrams.envs.recording import drive_along
from guiderail.diagrams.stations.arm import ArmStation
from guiderail.diagrams.stations.gantry import GantryStation
from guiderail.diagrams.stations.station import CONTROL_PERIOD, Impedance, Station
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import POSE_NAMES
from guiderail.models.objects.bnc_connector import demonstrations as bnc_connector
from guiderail.models.objects.bnc_connector.demonstrations import NUM_STEPS
from guiderail.systems.recorder import Recording
from guiderail.tools.files import write_atomically

TIMES = CONTROL_PERIOD * np.arange(NUM_STEPS + 1)
TIME_STEP = CONTROL_PERIOD / 4  # time step of the shipped demonstrations [s]


@dataclass(frozen=True)
class Session:
    """Set of demonstrated motions.

    Attributes:
        motions: Function of a seed and times (N,) that returns the motions (M, N, 6).
        path: File of the shipped recording.
        station: Constructor of the station.
        source: Description of the recording.
        first_seed: Seed that is tried first.
    """

    motions: Callable[[int, np.ndarray], np.ndarray]
    path: Path
    station: Callable[..., Station] = GantryStation
    source: str = "scripted motion on the gantry station, through its impedance; outputs are commands"
    first_seed: int = 0


# Seed 0 did not lock in an earlier contact geometry; policies and results use the motions of seed 1.
INSERT_SESSION = Session(bnc_connector.demonstrator_motions, bnc_connector.PATH, first_seed=1)
SEARCH_SESSION = Session(bnc_connector.search_motions, bnc_connector.SEARCH_PATH)
FIRM_SEARCH_SESSION = Session(
    partial(bnc_connector.search_motions, push=bnc_connector.FIRM_PUSH),
    bnc_connector.FIRM_SEARCH_PATH,
    ArmStation,
    "scripted motion on the arm station, through its impedance; outputs are commands",
)


def record_one(motion: np.ndarray, station: Callable[..., Station] = GantryStation) -> tuple[Recording, bool]:
    """Command a motion (N, 6) on a station; return the recording, and True if the plug ends locked."""
    workcell = BncWorkcell()
    driven, recording = drive_along(station(workcell, time_step=TIME_STEP), TIMES, motion)
    return recording, workcell.is_locked(workcell.workpiece_in_target(driven.station.plant, driven.plant_context))


def record_session(session: Session, seed: int) -> list[Recording] | None:
    """Record all demonstrations of a session; return None if one of them does not end locked."""
    recorded = [record_one(motion, session.station) for motion in session.motions(seed, TIMES)]
    return [recording for recording, _ in recorded] if all(is_locked for _, is_locked in recorded) else None


def record(session: Session, seeds: range) -> dict[str, np.ndarray]:
    """Return the arrays of a session, recorded with the first seed for which every demonstration ends locked."""
    for seed in seeds:
        if (recordings := record_session(session, seed)) is not None:
            break
    else:
        raise InputError(f"some demonstration does not end locked, for each of {len(seeds)} seeds: try other seeds")

    def stacked(name: str) -> np.ndarray:
        return np.stack([recording[name] for recording in recordings])

    return {
        "times": recordings[0].times,
        "outputs": stacked("desired_pose"),
        "names": np.array(POSE_NAMES),
        # Measured values are stored in single precision, which resolves nanometers.
        "measured": stacked("pose").astype(np.float32),
        "wrench": stacked("wrench").astype(np.float32),
        "contact_force": stacked("contact_force")[..., 0].astype(np.float32),
        "seed": np.array(seed),
        "stiffness": np.array(Impedance().stiffness),
        "frame": np.array("T: the locked plug on the nominal jack; [x y z Rz Ry Rx], R = Rz Ry Rx"),
        "source": np.array(session.source),
    }


def main(folder: Path | None = None, session: Session = INSERT_SESSION) -> None:
    """Write the file of a session into `folder`, by default the folder of the shipped recording."""
    arrays: dict[str, Any] = record(session, range(session.first_seed, session.first_seed + 100))
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_atomically((folder or session.path.parent) / session.path.name, buffer.getvalue())
