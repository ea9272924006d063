"""Simulation error and CPU time for different time steps of the plant: `python -m research.benchmarks time_step`.

Three scripted motions on the gantry are compared with the same motions at the finest time step: a connector that locks,
a connector that starts 1.2 mm off the jack's axis and slips off its rim, and a clamp that is dragged into its holes.
The integration is of first order: errors are proportional to the time step, except that a coarse step overstates the
peak force of an impact.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.math import RigidTransform

from guiderail.diagrams.envs.recording import DrivenStation, linear_motion
from guiderail.diagrams.stations.gantry import GantryStation
from guiderail.diagrams.stations.station import CONTROL_PERIOD, PLANT_PERIOD
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.transforms import MM
from guiderail.tools.visualization.figures import new_figure, save_figure
from research.benchmarks import with_progress
from research.benchmarks.simulation import scripted_motion

HALVINGS = (0, 1, 2, 3, 4)  # halvings of the control period that give the time steps; the last one is the reference
MOTIONS = {
    "connector, no offset": ("BncConnector", (0.0, 0.0, 0.0)),
    "connector, slips off the rim": ("BncConnector", (0.8 * MM, -0.9 * MM, 0.0)),
    "clamp": ("GridClamp", (0.0, 0.0, 0.0)),
}
"""Task and jack offset [m] of each motion."""


def simulate(motion: str, time_step: float) -> tuple[dict[str, np.ndarray], float]:
    """Simulate a motion with a time step [s]; return the recorded signals and the CPU time [s]."""
    task, offset = MOTIONS[motion]
    workcell, times, poses, _ = scripted_motion(task)
    station = GantryStation(workcell, time_step=time_step)
    driven = DrivenStation(station, linear_motion(times, poses), num_samples=round(times[-1] / CONTROL_PERIOD))
    if isinstance(workcell, BncWorkcell):
        workcell.set_fixture_offset(station.plant, driven.plant_context, RigidTransform(np.array(offset)))
    driven.start(poses[0])
    start = time.process_time()
    signals = driven.run().signals
    return signals, time.process_time() - start


def measure() -> dict[str, Any]:
    """Run the benchmark; return rows of each motion and time step, the finest first."""
    rows = []
    for motion in with_progress(MOTIONS, "time step"):
        finest: dict[str, np.ndarray] = {}
        for halvings in reversed(HALVINGS):
            time_step = CONTROL_PERIOD / 2**halvings
            signals, seconds = simulate(motion, time_step)
            finest = finest or signals
            rows.append({"motion": motion, "time_step": time_step, "seconds": seconds, **_errors(signals, finest)})
    return {"rows": rows, "default": PLANT_PERIOD}


def _errors(signals: dict[str, np.ndarray], finest: dict[str, np.ndarray]) -> dict[str, float]:
    difference = {name: signals[name] - finest[name] for name in ("pose", "wrench")}
    return {
        "position_rms": _rms(difference["pose"][:, :3]),
        "angle_rms": _rms(difference["pose"][:, 3:]),
        "force_rms": _rms(difference["wrench"][:, :3]),
        "torque_rms": _rms(difference["wrench"][:, 3:]),
        "peak_impedance_force": float(signals["impedance_force"].max()),
        "end_distance": float(np.linalg.norm(difference["pose"][-1, :3])),
    }


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).sum(1).mean()))


def show(results: dict[str, Any]) -> None:
    """Print the results."""
    print("time step  CPU    position  angle    force   torque    peak    end")
    motion = None
    for row in results["rows"]:
        if row["motion"] != motion:
            motion = row["motion"]
            print(motion)
        print(
            f"{1e3 * row['time_step']:6.2f} ms  {row['seconds']:4.2f} s {1e3 * row['position_rms']:6.3f} mm "
            f"{np.rad2deg(row['angle_rms']):5.2f}°  {row['force_rms']:5.2f} N {1e3 * row['torque_rms']:5.1f} mNm "
            f"{row['peak_impedance_force']:5.1f} N {1e3 * row['end_distance']:5.3f} mm"
        )
    print(f"errors are RMS against the finest; the default is {1e3 * results['default']:.0f} ms")


def draw(results: dict[str, Any], path: Path) -> Path:
    """Draw error and peak force over CPU time: a curve per motion, a dot per time step, filled for the default step."""
    figure, axes = new_figure(1, 2, (10.0, 4.0))
    columns = (("force_rms", "force, RMS error [N]"), ("peak_impedance_force", "peak force of the impedance [N]"))
    for axis, (column, label) in zip(axes.flat, columns, strict=True):
        for motion in MOTIONS:
            rows = [row for row in results["rows"] if row["motion"] == motion]
            (line,) = axis.plot(
                [row["seconds"] for row in rows], [row[column] for row in rows], "o-", mfc="white", label=motion
            )
            for row in rows:
                point, offset = (row["seconds"], row[column]), {"xytext": (3, 5), "textcoords": "offset points"}
                axis.annotate(f"{1e3 * row['time_step']:g} ms", point, fontsize=7, **offset)
                if row["time_step"] == results["default"]:
                    axis.plot(row["seconds"], row[column], "o", color=line.get_color())
        axis.set(xlabel="CPU time of the motion [s]", ylabel=label, xscale="log", xticks=[0.5, 1.0, 2.0, 5.0])
        axis.minorticks_off()
        axis.xaxis.set_major_formatter("{x:g}")
    axes.flat[0].legend(frameon=False)
    return save_figure(figure, path)
