"""Comparison of the gantry's two impedances: `python -m research.benchmarks impedance`.

`joint` consists of springs and dampers in the gantry's joints, solved together with the contact. `cartesian` is the
Cartesian impedance controller of the arm, whose forces are constant during a plant step. Both have the same stiffness,
damping ratio and limits. A scripted insertion is simulated with several time steps, and compared with the finest one.
The demonstration alone and the scripted policy are evaluated in the same held-out episodes with each impedance.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.envs.recording import DrivenStation, linear_motion
from guiderail.diagrams.stations.gantry import GantryStation
from guiderail.diagrams.stations.station import CONTROL_PERIOD
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.transforms import MM, POSE_SIZE
from guiderail.models.objects.bnc_connector.demonstrations import insert_and_lock
from guiderail.tools.evaluation.baselines import make_baseline
from guiderail.tools.evaluation.evaluate import evaluate_policy
from guiderail.tools.evaluation.metrics import summary
from research.benchmarks import with_progress

CONTROLS = ("joint", "cartesian")
TIME_STEPS = {"joint": (1, 2, 4, 16), "cartesian": (4, 8, 16)}  # plant steps per control period; the last is the finest
DIFFICULTIES = ("standard", "hard")
POLICIES = {"demonstration": "zero", "scripted": "scripted"}
EPISODES = 10  # number of held-out episodes of each policy
RESPONSE = 15  # duration of a step response [control periods]
STEP = np.array([4.0 * MM, -3.0 * MM, 5.0 * MM, 0.05, -0.04, 0.03])  # step of the desired pose in free space [m, rad]
STATISTICS = (
    "success_rate",
    "success_low",
    "success_high",
    "mean_force",
    "peak_force",
    "mean_steps",
    "max_commanded_violation",
)


def measure() -> dict[str, Any]:
    """Run the benchmark; return lists of rows `motion`, `step` and `episodes`."""
    jobs = [(control, parts) for control in CONTROLS for parts in reversed(TIME_STEPS[control])]
    motions: list[dict[str, Any]] = []
    finest: dict[str, np.ndarray] = {}
    for control, parts in with_progress(jobs, "motion"):
        row, pose = insertion(control, CONTROL_PERIOD / parts)
        finest.setdefault(control, pose)
        motions.append(row | _difference(pose, finest[control], "own"))
    for row, (control, parts) in zip(motions, jobs, strict=True):
        if parts == TIME_STEPS[control][-1]:
            row |= _difference(finest[control], finest[CONTROLS[0]], "joint")
    cases = [(difficulty, name, control) for difficulty in DIFFICULTIES for name in POLICIES for control in CONTROLS]
    return {
        "motion": motions,
        "step": [step_response(control) for control in CONTROLS],
        "episodes": [_episodes(*case) for case in with_progress(cases, "episodes")],
    }


def insertion(control: str, time_step: float) -> tuple[dict[str, Any], np.ndarray]:
    """Simulate a scripted insertion with a time step [s]; return its row and the plug's poses, (n, 6)."""
    workcell, (times, poses) = BncWorkcell(), insert_and_lock()
    station = GantryStation(workcell, time_step=time_step, impedance_control=control)  # type: ignore[arg-type]
    driven = DrivenStation(station, linear_motion(times, poses), round(times[-1] / CONTROL_PERIOD))
    driven.start(poses[0])
    begin = time.process_time()
    recording = driven.run()
    row = {
        "control": control,
        "time_step": time_step,
        "seconds": time.process_time() - begin,
        "locks": workcell.is_locked(workcell.workpiece_in_target(station.plant, driven.plant_context)),
        "peak_force": float(recording["impedance_force"].max()),
    }
    return row, recording["pose"]


def step_response(control: str, time_step: float | None = None) -> dict[str, Any]:
    """Return a row whose `response` (n, 6) is the pose after a step of all coordinates, relative to the step."""
    station = GantryStation(BncWorkcell(), time_step=time_step, impedance_control=control)  # type: ignore[arg-type]
    start = np.array([0.0, 0.0, 50.0 * MM, 0.0, 0.0, 0.0])
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    station.get_desired_pose_input_port().FixValue(context, start + STEP)
    station.set_pose(context, start)
    simulator.Initialize()
    poses = []
    for n in range(1, RESPONSE + 1):
        simulator.AdvanceTo(n * CONTROL_PERIOD)
        poses.append(station.get_pose_output_port().Eval(context))
    return {"control": control, "response": ((np.array(poses) - start) / STEP).tolist()}


def _difference(poses: np.ndarray, others: np.ndarray, name: str) -> dict[str, float]:
    """Return the RMS distance [m] and the largest angle difference [rad] of two motions, as columns `name`_…."""
    away = np.linalg.norm((poses - others)[:, :3], axis=1)
    turned = np.abs((poses - others)[:, 3:])
    return {f"{name}_position_rms": float(np.sqrt((away**2).mean())), f"{name}_angle_most": float(turned.max())}


def _episodes(difficulty: str, name: str, control: str) -> dict[str, Any]:
    env = make_env("BncConnector", guidance="kgrl", difficulty=difficulty, impedance_control=control)
    env.reset(seed=0)
    act = make_baseline("BncConnector", POLICIES[name])(env)
    begin = time.process_time()
    rows = evaluate_policy(env, act, episodes=EPISODES, options={"new_run": True})
    spent = time.process_time() - begin
    env.close()
    labels = {"difficulty": difficulty, "policy": name, "control": control, "episodes": EPISODES}
    return labels | summary(rows, STATISTICS) | {"seconds_per_1000_steps": 1000.0 * spent / float(rows["steps"].sum())}


def show(results: dict[str, Any]) -> None:
    """Print the results."""
    print("scripted insertion   step     CPU    peak    locks  RMS error to the finest step")
    for row in results["motion"]:
        errors = f"{row['own_position_rms'] / MM:6.3f} mm"
        if row.get("joint_position_rms"):
            errors += f", {row['joint_position_rms'] / MM:.3f} mm to the joint impedance"
        print(
            f"  {row['control']:<17}{1e3 * row['time_step']:6.2f} ms {row['seconds']:5.2f} s "
            f"{row['peak_force']:5.1f} N  {'yes' if row['locks'] else 'no':<5} {errors}"
        )
    print("step response, relative to the step, after 1, 2, 3, 5, 10 control periods")
    for row in results["step"]:
        response = np.array(row["response"])
        for label, column in (("x, y, z", slice(0, 3)), ("angles", slice(3, POSE_SIZE))):
            means = response[[0, 1, 2, 4, 9], column].mean(axis=1)
            print(f"  {row['control']:<12}{label:<8}{'  '.join(f'{value:.3f}' for value in means)}")
    print("held-out episodes            success (95 %)       mean    peak    CPU of 1000 control steps")
    for row in results["episodes"]:
        label = f"{row['difficulty']}, {row['policy']}, {row['control']}"
        print(
            f"  {label:<37} {row['success_rate']:4.0%} ({row['success_low']:.0%}–{row['success_high']:.0%}) "
            f"{row['mean_force']:5.1f} N {row['peak_force']:5.1f} N {row['seconds_per_1000_steps']:6.1f} s"
        )
