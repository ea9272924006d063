"""Adversarial actions against the force limit: random, constant, extreme and bang-bang, for all stations and guidance.

    python tests/harness/force_adversary.py --steps 100000            # an hour on one core; 0 stops are expected
    python tests/harness/force_adversary.py --steps 5000 --bounded false --task BncConnector

A line of JSON is printed for each case: control steps, terminations, the smallest energy in the tank [J], and three
forces relative to the limit of the episode. These are the largest impedance force, the largest measured contact force,
and the largest unfiltered contact force of a plant step. The exit code is 1 if an episode ended by force.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from collections import Counter
from collections.abc import Callable

import numpy as np
from pydrake.systems.framework import Context, EventStatus

from guiderail.diagrams.envs.make import make_env

GUIDANCE = {"BncConnector": ("kgrl", "skgrl", "residual"), "GridClamp": ("sct", "residual")}
STATIONS = ("gantry", "arm", "mujoco")
ATTACKS = ("random", "constant", "extreme", "bang_bang")
SEED = 2_100_000


def attack(kind: str, rng: np.random.Generator, size: int) -> Callable[[], np.ndarray]:
    """Return a function that returns the next action (size,) of an attack."""
    constant = rng.uniform(-1.0, 1.0, size) if kind == "constant" else rng.choice([-1.0, 1.0], size)
    if kind in ("constant", "extreme"):
        return lambda: constant
    if kind == "random":
        return lambda: rng.uniform(-1.0, 1.0, size)
    return lambda: rng.choice([-1.0, 1.0], size)


def run_case(task: str, steps: int, **options: object) -> dict[str, object]:
    """Run attacks in an environment for at least `steps` control steps; return the statistics."""
    env = make_env(task, action_repeat=5, **options)
    done, terminations, force, contact, step_contact, energy = 0, Counter[str](), 0.0, 0.0, 0.0, np.inf
    for episode in itertools.count():
        rng = np.random.default_rng([SEED, episode])
        act = attack(ATTACKS[episode % len(ATTACKS)], rng, env.action_space.shape[0])
        *_, info = env.reset(seed=SEED + episode, options={"new_run": True})
        limit = info.get("force_limit", env.diagram.task.collision.above)
        terminated = truncated = False
        unfiltered = watch_contact(env)
        while not (terminated or truncated):
            *_, terminated, truncated, info = env.step(act())
        terminations[info["termination"]] += 1
        done += info["control_steps"]
        force = max(force, float(env.trace.force.max()) / limit)
        contact = max(contact, float(np.linalg.norm(env.trace.signals["wrench"][:, :3], axis=1).max()) / limit)
        step_contact = max(step_contact, max(unfiltered) / limit)
        energy = min(energy, tank_content(env))
        if done >= steps:
            break
    env.close()
    return {
        "steps": done,
        "terminations": dict(terminations),
        "force_per_limit": round(force, 3),
        "contact_per_limit": round(contact, 3),
        "step_contact_per_limit": round(step_contact, 3),
        "tank_J": round(energy, 2),
    }


def watch_contact(env: object) -> list[float]:
    """Return a list to which every step of Drake's plant adds the norm of the contact forces [N]; [0] in MuJoCo."""
    plant = env.diagram.diagram.GetSubsystemByName("station").plant
    contact, forces = plant.get_contact_results_output_port(), [0.0]

    def add(root: Context) -> EventStatus:
        results = contact.Eval(plant.GetMyContextFromRoot(root))
        surfaces = map(results.hydroelastic_contact_info, range(results.num_hydroelastic_contacts()))
        points = map(results.point_pair_contact_info, range(results.num_point_pair_contacts()))
        pushes = [surface.F_Ac_W().translational() for surface in surfaces]
        pushes += [-point.contact_force() for point in points]
        forces.append(float(np.linalg.norm(np.sum(pushes, axis=0))))
        return EventStatus.DidNothing()

    if plant.time_step() > 0.0:
        env.simulator.set_monitor(add)
    return forces


def tank_content(env: object) -> float:
    """Return the energy in the station's tank [J], infinite without a tank."""
    station = env.diagram.diagram.GetSubsystemByName("station")
    if not station.HasSubsystemNamed("tank"):
        return np.inf
    tank = station.GetSubsystemByName("tank")
    return float(tank.get_energy_output_port().Eval(tank.GetMyContextFromRoot(env.simulator.get_context()))[0])


def main(arguments: list[str] | None = None) -> int:
    """Run the program; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=100_000, help="control steps of all cases together")
    parser.add_argument("--bounded", choices=("true", "false"), default="true", help="option bounded_force")
    parser.add_argument("--task", choices=sorted(GUIDANCE), help="one task; default: all")
    parser.add_argument("--station", choices=STATIONS, help="one station; default: all")
    args = parser.parse_args(arguments)
    cases = [
        (task, {"guidance": guidance, "station": station, "difficulty": difficulty} | limits)
        for task in GUIDANCE
        for guidance in GUIDANCE[task]
        for station in STATIONS
        for difficulty in ("standard", "hard")
        for limits in ({}, {"force_limit_range": (8.0, 25.0)})
        if args.task in (None, task) and args.station in (None, station) and not (limits and difficulty == "standard")
    ]
    stops = total = 0
    for task, options in cases:
        result = run_case(task, max(args.steps // len(cases), 1), bounded_force=args.bounded == "true", **options)
        stops += result["terminations"].get("collision", 0)
        total += result["steps"]
        print(json.dumps({"task": task, **options, **result}), flush=True)
    print(json.dumps({"steps": total, "stops": stops}))
    return 1 if stops else 0


if __name__ == "__main__":
    sys.exit(main())
