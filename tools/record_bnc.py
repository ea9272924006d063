"""Records the BNC connector's demonstrations in simulation: `python -m guiderail.tools.record_bnc`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from guiderail.diagrams.recording import drive_along
from guiderail.diagrams.stations.bnc_workcell import BncWorkcell
from guiderail.diagrams.stations.rails import RailsStation
from guiderail.diagrams.stations.station import CONTROL_PERIOD, Impedance
from guiderail.models.demonstrations.bnc_connector import (
    NAMES,
    NUM_DEMONSTRATIONS,
    NUM_STEPS,
    PATH,
    demonstrator_motion,
)
from guiderail.models.errors import InputError
from guiderail.systems.recorder import Recording


def record_one(seed: int) -> tuple[Recording, bool]:
    """One demonstration through the rails' impedance, and whether the plug was locked in the end."""
    workcell = BncWorkcell()
    times = CONTROL_PERIOD * np.arange(NUM_STEPS + 1)
    motion = demonstrator_motion(seed, times)
    driven, recording = drive_along(RailsStation(workcell), times, motion)
    return recording, workcell.is_locked(workcell.plug_in_locked_frame(driven.station.plant, driven.plant_context))


def record(seeds: range) -> dict[str, np.ndarray]:
    """The arrays of the demonstrations' file: those of the first `NUM_DEMONSTRATIONS` seeds that lock."""
    successes = []
    for seed in seeds:
        recording, is_locked = record_one(seed)
        if is_locked:
            successes.append((seed, recording))
        if len(successes) == NUM_DEMONSTRATIONS:
            break
    else:
        raise InputError(f"only {len(successes)} of the seeds {seeds} lead to a locked connector: give more seeds")

    def stacked(name: str) -> np.ndarray:
        return np.stack([recording[name] for _, recording in successes])

    return {
        "times": successes[0][1].times,
        "outputs": stacked("desired_pose"),
        "names": np.array(NAMES),
        # What was measured is kept to single precision: a nanometre.
        "measured": stacked("pose").astype(np.float32),
        "wrench": stacked("wrench").astype(np.float32),
        "contact_force": stacked("contact_force")[..., 0].astype(np.float32),
        "seeds": np.array([seed for seed, _ in successes]),
        "stiffness": np.array(Impedance().stiffness),
        "frame": np.array("T: the locked plug on the nominal jack; [x y z Rz Ry Rx], R = Rz Ry Rx"),
        "source": np.array("scripted demonstrator on the rails station, through its impedance; outputs are commands"),
    }


def main(path: Path = PATH) -> None:
    """Writes the file."""
    arrays: dict[str, Any] = record(range(100))
    np.savez_compressed(path, **arrays)


if __name__ == "__main__":
    main()
