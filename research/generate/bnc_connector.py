"""Scripted demonstrator of the connector, and recording of its demonstrations in simulation: insertion and search."""

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
from guiderail.models.common.transforms import DEGREE, MM, POSE_NAMES
from guiderail.models.objects.bnc_connector import demonstrations as bnc_connector
from guiderail.models.objects.bnc_connector.demonstrations import (
    HOLD_UNTIL,
    NUM_DEMONSTRATIONS,
    NUM_STEPS,
    QUARTER_TURN,
    RIM,
    SEARCH,
    SEAT_COMMAND,
    WAYPOINTS,
    insert_and_lock,
)
from guiderail.systems.recorder import Recording
from guiderail.tools.files import write_atomically
from guiderail_parts.geometry.demonstrator import correlated, random_curves

TIMES = CONTROL_PERIOD * np.arange(NUM_STEPS + 1)
TIME_STEP = CONTROL_PERIOD / 4  # time step of the shipped demonstrations [s]


# Standard deviations of the hand's pose at eight times of the motion: above the jack, at the rim, at begin and end of
# the search on the rim, dropping in, seated, turned and locked.
_TIMES = [0.0, 1.2, 1.6, 3.4, 4.1, 4.8, 7.0, 8.0]  # [s]
_DEVIATIONS = {
    "x": np.array([1.0, 1.2, 1.2, 1.2, 0.35, 0.15, 0.15, 0.10]) * MM,
    "y": np.array([1.0, 1.2, 1.2, 1.2, 0.35, 0.15, 0.15, 0.10]) * MM,
    "z": np.array([1.0, 0.9, 0.5, 0.5, 0.7, 0.5, 0.5, 0.3]) * MM,
    "Rz": np.array([2.0, 1.5, 1.0, 1.0, 1.0, 1.5, 1.5, 0.7]) * DEGREE,
    "Ry": np.array([1.2, 1.2, 1.2, 1.2, 0.5, 0.2, 0.2, 0.15]) * DEGREE,
    "Rx": np.array([1.2, 1.2, 1.2, 1.2, 0.5, 0.2, 0.2, 0.15]) * DEGREE,
}
_CORRELATION = {"x": 0.22, "y": 0.22, "z": 0.35, "Rz": 0.5, "Ry": 0.3, "Rx": 0.3}  # correlation times [s]
_CENTERING = 0.9  # fraction of the mean of the five random curves that is subtracted from each curve
_TEMPO_DEVIATION, _TEMPO_CORRELATION = 0.05, 1.5  # standard deviation and correlation time of the time shift [s]


def demonstrator_motions(seed: int, times: np.ndarray) -> np.ndarray:
    """Return the desired poses (M, N, 6) of the M demonstrated insertions at `times` (N,) [s], in the locked frame."""
    rng = np.random.default_rng(seed)
    script_times, script = insert_and_lock()
    scripted, curves = [], []
    for _ in range(NUM_DEMONSTRATIONS):
        time_shift = _TEMPO_DEVIATION * correlated(rng, times, _TEMPO_CORRELATION) * np.sin(np.pi * times / times[-1])
        script_time = np.clip(times + time_shift, 0.0, script_times[-1])
        scripted.append(np.stack([np.interp(script_time, script_times, column) for column in script.T], axis=1))
        curves.append(np.stack([correlated(rng, times, _CORRELATION[name]) for name in _DEVIATIONS], axis=1))
    wander = np.stack(curves) - _CENTERING * np.mean(curves, axis=0)
    return np.stack(scripted) + _interpolate(times, _TIMES, _DEVIATIONS) * wander


def _interpolate(times: np.ndarray, at: list[float], deviations: dict[str, np.ndarray]) -> np.ndarray:
    """Interpolate the standard deviations of each coordinate, given at the times `at` [s]; return (N, 6)."""
    return np.stack([np.interp(times, at, deviation) for deviation in deviations.values()], axis=1)


RADIUS = 2.5 * MM  # radius of the circle
TURN = 0.3  # duration of one circle [s], much shorter than the search
LIGHT_PUSH = 1.5 * MM  # distance of the command below the rim, which causes a force of about two newtons
FIRM_PUSH = 6.0 * MM  # distance of the command below the rim, which causes a force of about nine newtons
IN_BY = 4.1  # time when the circle has vanished [s]

# Waypoints of the plug: time [s], z [m], Rz [rad].
SEARCH_WAYPOINTS = np.array(
    [
        *WAYPOINTS[:2],
        [SEARCH[0], RIM - LIGHT_PUSH, QUARTER_TURN],
        [SEARCH[1], RIM - LIGHT_PUSH - 0.3 * MM, QUARTER_TURN],
        [SEARCH[1] + 0.8, SEAT_COMMAND, QUARTER_TURN],
        [4.6, SEAT_COMMAND, QUARTER_TURN],
        *WAYPOINTS[-4:],
    ]
)
# Standard deviations of the hand's pose in addition to the circle, at five times of the motion: at the start, when the
# circle begins to shrink, inserted, turned and locked.
_SEARCH_TIMES = [0.0, HOLD_UNTIL, IN_BY, 7.0, 8.0]  # [s]
_SEARCH_DEVIATIONS = {
    "x": np.array([0.05, 0.05, 0.15, 0.15, 0.10]) * MM,
    "y": np.array([0.05, 0.05, 0.15, 0.15, 0.10]) * MM,
    "z": np.array([0.9, 0.5, 0.5, 0.5, 0.3]) * MM,
    "Rz": np.array([1.5, 1.0, 1.0, 1.5, 0.7]) * DEGREE,
    "Ry": np.array([0.3, 0.3, 0.3, 0.2, 0.15]) * DEGREE,
    "Rx": np.array([0.3, 0.3, 0.3, 0.2, 0.15]) * DEGREE,
}
_SEARCH_CORRELATION = 0.3  # correlation time [s]


def search_motions(seed: int, times: np.ndarray, push: float = LIGHT_PUSH) -> np.ndarray:
    """Return the desired poses (M, N, 6) of the M demonstrated searches at `times` (N,) [s], in the locked frame.

    `push` is the distance of the command below the rim at the beginning of the search [m].
    """
    rng = np.random.default_rng(seed)
    script_times, z, yaw = SEARCH_WAYPOINTS.T
    searches = (script_times >= SEARCH[0]) & (script_times <= SEARCH[1])
    z = np.where(searches, z + LIGHT_PUSH - push, z)
    remaining = np.clip((IN_BY - times) / (IN_BY - HOLD_UNTIL), 0.0, 1.0)
    radius = RADIUS * remaining**2 * (3.0 - 2.0 * remaining)
    wander = random_curves(rng, times, [_SEARCH_CORRELATION] * len(_SEARCH_DEVIATIONS), NUM_DEMONSTRATIONS)
    motions = _interpolate(times, _SEARCH_TIMES, _SEARCH_DEVIATIONS) * (wander - wander.mean(axis=0))
    motions[..., 2] += np.interp(times, script_times, z)
    motions[..., 3] += np.interp(times, script_times, yaw)
    for number, motion in enumerate(motions):
        angle = 2.0 * np.pi * (times / TURN + number / NUM_DEMONSTRATIONS)
        motion[:, 0] += radius * np.cos(angle)
        motion[:, 1] += radius * np.sin(angle)
    return motions


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
INSERT_SESSION = Session(demonstrator_motions, bnc_connector.PATH, first_seed=1)
SEARCH_SESSION = Session(search_motions, bnc_connector.SEARCH_PATH)
FIRM_SEARCH_SESSION = Session(
    partial(search_motions, push=FIRM_PUSH),
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
