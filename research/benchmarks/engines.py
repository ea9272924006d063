"""Drake compared with MuJoCo in scripted motions and contact on the rim: `python -m research.benchmarks engines`."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.math import RigidTransform

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.recording import DrivenStation, linear_motion
from guiderail.diagrams.stations.registry import STATIONS
from guiderail.diagrams.stations.station import CONTROL_PERIOD, PLANT_PERIOD
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.diagrams.tasks.contact_probe import SPEEDS
from guiderail.models.common.transforms import MM
from guiderail.models.control.wrench import center_of_pressure
from guiderail.models.objects.bnc_connector import FRICTION, BncDimensions
from guiderail.models.objects.bnc_connector.demonstrations import poses
from guiderail.systems.recorder import Recording
from guiderail.tools.visualization.figures import legend, new_figure, save_figure
from guiderail_studies.contact_probe import probe_contact
from research.benchmarks import with_progress
from research.benchmarks.simulation import scripted_motion

ENGINES = {"Drake": "gantry", "MuJoCo": "mujoco"}
COLORS = {"Drake": "#1f5fbf", "MuJoCo": "#c0504d"}
TASKS = ("BncConnector", "GridClamp")
OFFSETS = (0.8, 1.25, 2.0, 3.0)  # offsets of a plug on the rim [mm]
MODULI = (0.01, 0.1, 1.0, 10.0)  # factors of the contact modulus, in Drake
PRESSED = 7.8 * MM  # commanded height [m]: 2.7 mm below the rim, which presses with 4 N
MIN_CONTACT_FORCE = 0.5  # smallest force at which the center of pressure is used [N]
NARROW = EnvConfig.resolve("BncConnector", {"difficulty": "hard"}).declared
CONTACTS = {  # station and time step [s]
    "Drake, 5 ms": ("gantry", PLANT_PERIOD / 2),  # the default of the connector
    "Drake, 2.5 ms": ("gantry", PLANT_PERIOD / 4),
    "MuJoCo": ("mujoco", PLANT_PERIOD),
}


def measure() -> dict[str, Any]:
    """Measure force profiles, real-time factors (CPU time), centers of pressure, capture offsets and drag."""
    jobs = [(task, engine) for task in TASKS for engine in ENGINES]
    profiles = {f"{task} {engine}": _profile(task, ENGINES[engine]) for task, engine in with_progress(jobs, "motion")}
    pressed = [("Drake", modulus) for modulus in MODULI] + [("MuJoCo", 1.0)]
    levers = {
        f"{engine}, modulus × {modulus:g}" if engine == "Drake" else engine: [
            _lever(ENGINES[engine], offset * MM, modulus) / MM for offset in OFFSETS
        ]
        for engine, modulus in with_progress(pressed, "rim")
    }
    levers["two points, rigid"] = [rigid_lever(BncDimensions(), offset * MM) / MM for offset in OFFSETS]
    levers["even pressure"] = [even_lever(BncDimensions(), offset * MM) / MM for offset in OFFSETS]
    captures = {"as drawn": geometric_capture() / MM}
    drags = {}
    for contact, (station, time_step) in with_progress(CONTACTS.items(), "contact"):
        probe = probe_contact(NARROW, station, time_step=time_step)
        captures[contact], drags[contact] = probe.capture / MM, list(probe.drags)
    measured = {"levers_mm": levers, "captures_mm": captures, "drags": drags}
    return {"profiles": profiles, "offsets_mm": list(OFFSETS), **measured}


def geometric_capture() -> float:
    """Return the offset from which a plug drops in as drawn [m]."""
    dimensions = NARROW.workcell().dimensions
    return float(dimensions.bore_clearance + dimensions.mouth_chamfer)


def rigid_lever(d: BncDimensions, offset: float) -> float:
    """Return the distance between the plug's axis and the chord through the contact points of rigid bodies [m]."""
    mouth = d.bore_radius + d.mouth_chamfer
    return float((mouth**2 + offset**2 - d.barrel_radius**2) / (2.0 * offset))


def even_lever(d: BncDimensions, offset: float) -> float:
    """Return the distance between the plug's axis and the centroid of the overlap of mouth and barrel [m]."""
    x, y = np.meshgrid(*(np.linspace(-d.ring_radius, d.ring_radius, 1401),) * 2)
    inside = (np.hypot(x, y) > d.bore_radius + d.mouth_chamfer) & (np.hypot(x, y) < d.ring_radius)
    inside &= np.hypot(x - offset, y) < d.barrel_radius
    return float(x[inside].mean())


def _profile(task: str, station: str) -> dict[str, Any]:
    workcell, times, motion, _ = scripted_motion(task)
    driven = DrivenStation(
        STATIONS.get(station).build(workcell), linear_motion(times, motion), round(times[-1] / CONTROL_PERIOD)
    )
    driven.start(motion[0])
    begin = time.process_time()
    recording = driven.run()
    spent = time.process_time() - begin
    return {
        "real_time_factor": float(times[-1] / spent),
        "time": (CONTROL_PERIOD * np.arange(len(recording["pose"]))).tolist(),
        "height_mm": (recording["pose"][:, 2] / MM).tolist(),
        "push_n": recording["wrench"][:, 2].tolist(),
        "torque_nm": recording["wrench"][:, 5].tolist(),
        "peak_force_n": float(recording["impedance_force"].max()),
    }


def _lever(name: str, offset: float, modulus: float) -> float:
    """Return the distance between the plug's axis and the center of pressure, at rest on the rim [m]."""
    recording = _pressed(name, BncWorkcell(), offset, modulus)
    return float(np.linalg.norm(center_of_pressure(recording["wrench"][-10:].mean(axis=0), MIN_CONTACT_FORCE)))


def _pressed(name: str, workcell: BncWorkcell, offset: float, modulus: float = 1.0) -> Recording:
    """Record a plug that is pressed on a jack with an offset [m]."""
    motion = poses(np.array([11.0 * MM, PRESSED, PRESSED]), np.pi / 2)
    station = STATIONS.get(name).build(workcell)
    times = np.array([0.0, 0.6, 1.4])
    driven = DrivenStation(station, linear_motion(times, motion), round(times[-1] / CONTROL_PERIOD))
    workcell.set_fixture_offset(station.plant, driven.plant_context, RigidTransform([offset, 0.0, 0.0]))
    if modulus != 1.0:
        station.set_contact(driven.context, 1.0, modulus)
    driven.start(motion[0])
    return driven.run()


def show(results: dict[str, Any]) -> None:
    """Print a line for each motion and each measurement."""
    for name, profile in results["profiles"].items():
        factor, peak = profile["real_time_factor"], profile["peak_force_n"]
        print(f"{name}: {factor:.1f} times real time, {peak:.1f} N peak force")
    print(
        "center of pressure of a plug on the rim [mm], at",
        ", ".join(f"{offset:g}" for offset in results["offsets_mm"]),
        "mm offset",
    )
    for name, levers in results["levers_mm"].items():
        print(f"  {name}: {', '.join(f'{lever:.2f}' for lever in levers)}")
    print(
        "largest offset at which a plug drops in:",
        ", ".join(f"{mm:.2f} mm ({name})" for name, mm in results["captures_mm"].items()),
    )
    speeds = ", ".join(f"{1e3 * speed:g}" for speed in SPEEDS)
    print(f"drag over normal force on a sharp rim at {speeds} mm/s; the friction is {FRICTION:g}")
    for name, drags in results["drags"].items():
        print(f"  {name}: {', '.join(f'{share:.2f}' for share in drags)}")


def draw(results: dict[str, Any], path: Path) -> Path:
    """Draw height, normal force and torque of both engines, and the centers of pressure on the rim."""
    figure, axes = new_figure(2, 3, (11.0, 5.6))
    for row, task in enumerate(TASKS):
        for engine in ENGINES:
            profile = results["profiles"][f"{task} {engine}"]
            for axis, key in zip(axes[row], ("height_mm", "push_n", "torque_nm"), strict=True):
                axis.plot(profile["time"], profile[key], color=COLORS[engine], label=engine)
        for axis, label in zip(axes[row], ("height [mm]", "normal force [N]", "torque about z [Nm]"), strict=True):
            axis.set_ylabel(label)
            axis.set_xlabel(f"{task}: time [s]")
    legend(figure, axes[0, 0])
    lever = axes[1, 2]
    lever.clear()
    for name, levers in results["levers_mm"].items():
        nominal = name in ("MuJoCo", "Drake, modulus × 1")
        color = COLORS.get(name.split(",")[0], "0.6")
        lever.plot(results["offsets_mm"], levers, ".-", color=color, alpha=1.0 if nominal else 0.5)
        lever.annotate(name, (results["offsets_mm"][-1], levers[-1]), fontsize=6)
    lever.set_xlabel("plug on the rim: offset [mm]")
    lever.set_ylabel("center of pressure [mm]")
    return save_figure(figure, path)
