"""Adversarial actions against the force limit: drops, random, held, extreme, bang-bang, and a search over episodes.

    python tests/harness/force_adversary.py --steps 100000 --out forces.csv  # ten minutes of one core
    python tests/harness/force_adversary.py --steps 5000 --bounded false --task BncConnector

A case is a task at difficulty=hard, on a station, with a contact of a given stiffness and a time step: the default, or
one that resolves impacts on soft contacts. Each round of a case draws a guidance, factors of friction and dissipation
and a range of force limits, on an arm also a payload and a friction of the joints that its controller does not model,
and on the gantry a factor of the moving mass. In two of three rounds the guidance is `Anywhere`, which commands what a
policy behind guidance cannot: any reference in a box around the target, to fall on the rim, or off it and into the
walls. Half of the episodes belong to an evolution strategy, which changes actions or conditions of the episode with the
largest transient force.

The table has a row for each case, with the largest forces and their bounds (docs/concepts/forces.md). Contact forces
are less what the joints' friction holds, relative to the limit of the episode plus the weight of the payload. The table
is printed, and written to `--out`, and the episode of each largest transient force to a file of the case beside it,
which `--replay` repeats. A run continues from that table; only the search starts again then. The exit code is 1 if an
episode ended by force, or if a force exceeded its bound.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import json
import math
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import ProximityProperties, Role, RoleAssign
from pydrake.multibody.plant import ContactResults
from pydrake.multibody.tree import BodyIndex, JacobianWrtVariable
from pydrake.systems.framework import Context, EventStatus
from scipy.integrate import solve_ivp

from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.guidance.registry import register_guidance
from guiderail.diagrams.stations.station import CONTACT_STIFFNESS, Impedance
from guiderail.models.control.wrench import FORCE_SHARES, PRESSED, approach_impedance, impact_ratio
from guiderail.models.laws.law import Command, Law
from guiderail_mujoco.station import MujocoContact

ANYWHERE = "anywhere"  # registered name of `Anywhere`
GUIDANCE = {"BncConnector": ("kgrl", "skgrl", "residual"), "GridClamp": ("sct", "residual")}
STATIONS = ("gantry", "arm", "mujoco")
# Largest stiffness of the contact with the rim [N/mm] that `--measure` prints, and the factor of the contact's modulus.
DRAKE = {
    "BncConnector": {15400: 1.0, 210: 5.8e-4, 105: 2.8e-4, 23: 6e-5},
    "GridClamp": {7800: 1.0, 233: 0.022, 132: 0.011, 29: 2.4e-3},
}
CONTACTS = {
    "gantry": DRAKE,
    "arm": DRAKE,
    "mujoco": {
        "BncConnector": {1180: 1.0, 171: 7.4e-4, 82: 3.3e-4},
        "GridClamp": {311000: 1.0, 188: 6e-4, 100: 3.2e-4},
    },
}
# Default time steps of the plant, and one that resolves impacts on soft contacts [ms].
STEPS = {"BncConnector": (5.0, 1.0), "GridClamp": (10.0, 1.0)}
ENGINE_STEPS = (1.0,)  # of MuJoCo
FINE_SHARE = 5  # a case with a finer step gets one in this number of control steps, because they take longer
RIM = {"BncConnector": 0.004, "GridClamp": 0.005}  # distance from the target at which the workpiece is on the rim [m]
FRICTION_FACTORS = (0.5, 1.0, 2.0)
REACH = np.array([0.008, 0.008, 0.025, 0.3, 0.1, 0.1])  # of `Anywhere` from the start [m], [rad]
ATTACKS = ("random", "constant", "extreme", "bang_bang", "drop")
DROP = 8  # number of actions down, and up again
LIMITS = (8.0, 25.0)  # range of sampled force limits [N]
PAYLOADS = (0.0, 0.25, 0.5)  # a weight of up to 5 N, the largest that is not refused before a motion [kg]
JOINT_FRICTIONS = (0.0, 0.3, 0.7)  # of each joint of the arm [Nm]
MASS_FACTORS = (0.8, 1.0, 1.2)
DISSIPATION_FACTORS = (0.0, 1.0)
GRAVITY = 9.81  # [m/s²]
MASS = {"gantry": 1.5, "arm": 1.4, "mujoco": 1.5}  # smallest moving mass in any direction [kg]
# Of the mass at the farthest contact on a gantry, 1 / (1 + l² m / I) for l = 14 and 44 mm; on an arm, I is not known.
MASS_SHARE = {"BncConnector": 0.87, "GridClamp": 0.39}
DISSIPATION = {"BncConnector": 100.0, "GridClamp": 1.0}  # largest one of a contact in Drake [s/m]
SEED = 2_100_000
ROUND = 2000  # control steps of a round


@dataclass
class Case:
    """Statistics of the attacks on a task.

    Contact forces are less what the joints' friction holds, relative to the limit of the episode plus the weight.
    """

    task: str
    station: str
    stiffness: int  # of the contact [N/mm]
    step_ms: float  # time step of the plant, or of MuJoCo
    rounds: int = 0
    episodes: int = 0
    control_steps: int = 0
    plant_steps: int = 0
    stops: int = 0  # episodes that ended by force
    tank_J: float = math.inf  # smallest content of the energy tank
    impedance: float = 0.0  # force of the impedance, relative to the limit
    filtered: float = 0.0  # contact force, filtered with 10 ms
    quasi_static: float = 0.0  # contact force that lasts 0.5 s
    quasi_static_bound: float = 0.0
    transient: float = 0.0  # contact force in a single plant step
    transient_bound: float = 0.0

    def __post_init__(self) -> None:
        self.quasi_static_bound = round(math.hypot(*FORCE_SHARES), 3)
        share = 1.0 if self.station == "arm" else MASS_SHARE[self.task]
        if self.station == "mujoco":
            bound = mujoco_bound(share, modulus=CONTACTS["mujoco"][self.task][self.stiffness])
        else:
            mass, heavier = MASS[self.station], 1.0 if self.station == "arm" else max(MASS_FACTORS)
            speed = max(LIMITS) / approach_impedance(CONTACT_STIFFNESS, mass)
            # The controller of an arm has the period of the plant; on the gantry it is solved with the contact.
            delay = 1e-3 * self.step_ms if self.station == "arm" else 0.0
            stiffness = 1e3 * self.stiffness
            bound = transient_bound(stiffness, mass, delay, share, heavier, DISSIPATION[self.task] * speed)
        self.transient_bound = round(bound, 2)

    @property
    def has_failed(self) -> bool:
        """True if an episode ended by force, or a force exceeded its bound."""
        return (
            self.stops > 0
            or self.quasi_static > self.quasi_static_bound + 1e-3
            or self.transient > self.transient_bound
        )


def transient_bound(
    stiffness: float, mass: float, delay: float, share: float, heavier: float = 1.0, damping: float = 0.0
) -> float:
    """Return the bound of a transient contact's force, relative to the limit.

    Args:
        stiffness: Stiffness of the contact [N/m].
        mass: Moving mass [kg] that the controller assumes.
        delay: Period of the controller, 0 if spring and damper are solved with the contact [s].
        share: Share of the mass at the farthest contact; see `impact_ratio`.
        heavier: Actual mass relative to the assumed one.
        damping: Dissipation of the contact times the largest approach speed; 0 for `impact_ratio`.
    """
    ratio = stiffness / CONTACT_STIFFNESS
    pressed = peak(ratio, heavier, 1.0, damping)
    turned = peak(ratio, heavier * share, (2.0 - PRESSED) * share, damping)
    return max(pressed, turned) + delay * math.sqrt(stiffness / mass)


def peak(ratio: float, mass: float, drive: float, damping: float) -> float:
    """Return the largest force of an impact on a spring with Hunt–Crossley damping, relative to the limit F.

    The force is r / 4 x (1 + δ x') for m x'' = f (1 − x') − r / 4 x (1 + δ x') with x'(0) = 1, in units in which F, c
    and the assumed mass are 1: r is the `ratio` of the stiffnesses, f the `drive`, and δ the `damping`.
    """

    def push(x: np.ndarray, speed: np.ndarray) -> np.ndarray:
        return 0.25 * ratio * x * (1.0 + damping * speed)

    def rate(_: float, state: np.ndarray) -> np.ndarray:
        x, speed = state
        return np.array([speed, (drive * (1.0 - speed) - push(x, speed)) / mass])

    def turns(_: float, state: np.ndarray) -> float:
        return float(state[1])

    turns.terminal = True  # type: ignore[attr-defined]
    longest = 0.1 * math.sqrt(mass / (1.0 + ratio))
    result = solve_ivp(rate, (0.0, 100.0), [0.0, 1.0], events=turns, max_step=longest, rtol=1e-8, atol=1e-10)
    return float(push(*result.y).max())


def mujoco_bound(
    share: float,
    mass: float = 1.65,
    contact: MujocoContact = MujocoContact(),  # noqa: B008
    modulus: float = 1.0,
) -> float:
    """Return the bound of a transient force in MuJoCo's contact, relative to the limit F; `mass` is the largest.

    This contact is a spring and a damper that act on the acceleration: damping b = 2 / (d τ) and stiffness 1 / (d τ²)
    of a unit mass. At the approach speed F / (2 √(k m)) its damper decides. A step h before, the depth is at most the
    speed times h. A factor of the modulus divides τ by its root.
    """
    contact = replace(contact, time_constant=contact.time_constant / math.sqrt(modulus))
    return impact_ratio(1.0, share) + mujoco_damping(contact) * 0.5 * math.sqrt(mass / CONTACT_STIFFNESS)


def mujoco_damping(contact: MujocoContact) -> float:
    """Return the force of an impact in MuJoCo's contact per mass and speed [1/s]; see `mujoco_bound`."""
    d, constant = contact.impedance, contact.time_constant
    return 2.0 / (d * constant) + contact.time_step / (d * constant**2)


class Anywhere(Law):
    """Law of a reference anywhere in the box `REACH` around the start; the state is the start."""

    def command(self, start: np.ndarray, action: np.ndarray, pose: np.ndarray, wrench: np.ndarray) -> np.ndarray:
        return start + REACH * action

    def next(self, start: np.ndarray, command: Command, pose: np.ndarray) -> np.ndarray:
        return start


def attack(kind: str, rng: np.random.Generator, size: int) -> Callable[[], np.ndarray]:
    """Return a function that returns the next action (size,) of an attack."""
    if kind == "drop":  # onto the rim, at a random place, upright (the stiffest contact) or with a small tilt
        angle, number = rng.uniform(0.0, 2.0 * np.pi), itertools.count()
        held = rng.uniform(-0.3, 0.3, size) * rng.choice([0.0, 1.0])
        held[:2] = 0.5 * np.cos(angle), 0.5 * np.sin(angle)
        return lambda: np.where(np.arange(size) == 2, 1.0 if next(number) // DROP % 2 else -1.0, held)
    constant = rng.uniform(-1.0, 1.0, size) if kind == "constant" else rng.choice([-1.0, 1.0], size)
    if kind in ("constant", "extreme"):
        return lambda: constant
    if kind == "random":
        return lambda: rng.uniform(-1.0, 1.0, size)
    return lambda: rng.choice([-1.0, 1.0], size)


@dataclass
class Search:
    """Evolution strategy over episodes: held actions of a sampled duration, and the seed of the conditions."""

    SEGMENTS, LONGEST = 40, 20  # number of held actions, their longest duration in actions

    seed: int = -1
    actions: np.ndarray | None = None  # (SEGMENTS, size)
    lengths: np.ndarray | None = None  # (SEGMENTS,)
    force: float = -1.0  # largest transient force of the best episode, relative to its limit

    def changed(self, rng: np.random.Generator, size: int, seed: int) -> Search:
        """Return a new candidate: changes of the best one, or random actions with the conditions of `seed`."""
        actions, lengths = rng.choice([-1.0, 0.0, 1.0], (self.SEGMENTS, size)), self._lengths(rng)
        if self.actions is None or rng.random() < 0.1:
            return Search(seed, actions, lengths)
        is_kept = rng.random(self.SEGMENTS) > rng.choice([0.05, 0.15, 0.4])
        actions = np.where(is_kept[:, None], self.actions, actions)
        lengths = np.where(rng.random(self.SEGMENTS) > 0.1, self.lengths, lengths)
        return Search(seed if rng.random() < 0.1 else self.seed, actions, lengths)

    def _lengths(self, rng: np.random.Generator) -> np.ndarray:
        return rng.integers(1, self.LONGEST, self.SEGMENTS)

    def act(self) -> Callable[[], np.ndarray]:
        """Return a function that returns the next action (size,)."""
        sequence = iter(np.repeat(self.actions, self.lengths, axis=0))
        return lambda: next(sequence, self.actions[-1])


@dataclass(frozen=True)
class Conditions:
    """Conditions of a round: factors of friction, mass and dissipation, joint friction [Nm], and payload [kg]."""

    task: str
    station: str
    stiffness: int  # of the contact [N/mm]
    step_ms: float
    guidance: str
    is_limit_sampled: bool
    is_bounded: bool
    friction: float
    mass: float
    joint_friction: float
    payload: float
    dissipation: float

    @classmethod
    def sample(cls, case: Case, rng: np.random.Generator, is_bounded: bool) -> Conditions:
        """Return random conditions of a round of a case."""
        arm, gantry = case.station == "arm", case.station == "gantry"
        return cls(
            case.task,
            case.station,
            case.stiffness,
            case.step_ms,
            guidance=ANYWHERE if case.rounds % 3 else str(rng.choice(GUIDANCE[case.task])),
            is_limit_sampled=bool(rng.random() < 0.5),
            is_bounded=is_bounded,
            payload=float(rng.choice(PAYLOADS)) if arm else 0.0,
            mass=float(rng.choice(MASS_FACTORS)) if gantry else 1.0,
            friction=float(rng.choice(FRICTION_FACTORS)),
            joint_friction=float(rng.choice(JOINT_FRICTIONS)) if arm else 0.0,
            dissipation=1.0 if case.station == "mujoco" else float(rng.choice(DISSIPATION_FACTORS)),
        )

    def make_env(self) -> Any:
        """Return the environment."""
        options: dict[str, Any] = {"force_limit_range": LIMITS} if self.is_limit_sampled else {}
        if self.station != "mujoco":
            options["time_step"] = 1e-3 * self.step_ms
        return make_env(
            self.task,
            guidance=self.guidance,
            station=self.station,
            difficulty="hard",
            action_repeat=5,
            bounded_force=self.is_bounded,
            disturbances={"payload": self.payload, "joint_friction": self.joint_friction},
            **options,
        )

    def run(self, env: Any, seed: int, act: Callable[[], np.ndarray]) -> Outcome:
        """Run an episode with a seed of the environment."""
        *_, info = env.reset(seed=seed, options={"new_run": True})
        context = env.simulator.get_mutable_context()
        station_of(env).set_contact(context, self.friction, CONTACTS[self.station][self.task][self.stiffness])
        if self.mass != 1.0:
            scale_mass(env, self.mass)
        if self.dissipation != 1.0:
            scale_dissipation(env, self.dissipation)
        limit = info.get("force_limit", env.diagram.task.collision.above)
        held, forces, actions = held_force(env, self.joint_friction), watch_contact(env), []
        terminated = truncated = False
        while not (terminated or truncated):
            actions.append(act())
            *_, terminated, truncated, info = env.step(actions[-1])
        return Outcome(info, limit, limit + GRAVITY * self.payload, held, np.array(forces), np.array(actions))


@dataclass
class Outcome:
    """An episode: its last `info`, limit, limit with weight and force that friction holds [N], contact forces [N]."""

    info: dict[str, Any]
    limit: float
    scale: float
    held: float
    forces: np.ndarray  # (plant steps,)
    actions: np.ndarray

    @property
    def transient(self) -> float:
        """Largest contact force, relative to the limit."""
        return float(self.forces.max() - self.held) / self.scale


def run_round(
    case: Case, searches: dict[str, Search], steps: int, is_bounded: bool, report: Callable[[str, str], None]
) -> None:
    """Run attacks for at least `steps` control steps and add them to a case; `searches` are by the guidance.

    Every new largest transient force is passed to `report` as name and JSON of its episode; see `replay`.
    """
    rng = np.random.default_rng([SEED, STATIONS.index(case.station), case.stiffness, round(case.step_ms), case.rounds])
    conditions = Conditions.sample(case, rng, is_bounded)
    env = conditions.make_env()
    size, best, done = env.action_space.shape[0], searches.setdefault(conditions.guidance, Search()), 0
    while done < steps:
        seed, candidate = SEED + case.episodes, None
        if case.episodes % 2:
            candidate = best.changed(rng, size, seed)
            seed, act = candidate.seed, candidate.act()
        else:
            act = attack(ATTACKS[case.episodes // 2 % len(ATTACKS)], rng, size)
        outcome = conditions.run(env, seed, act)
        transient, limit, control_steps = outcome.transient, outcome.limit, outcome.info["control_steps"]
        if candidate is not None and transient > best.force:
            candidate.force = transient
            searches[conditions.guidance] = best = candidate
        if round(transient, 3) > case.transient:
            episode = asdict(conditions) | {"seed": seed, "transient": transient, "actions": outcome.actions.tolist()}
            report(f"{case.task}-{case.station}-{case.stiffness}-{case.step_ms:g}", json.dumps(episode))
        held, scale = outcome.held, outcome.scale
        wrench, statistics = env.trace.signals["wrench"][:, :3], env.trace.statistics()
        case.episodes, case.control_steps = case.episodes + 1, case.control_steps + control_steps
        case.plant_steps += round(control_steps * env.diagram.control_period / station_of(env).time_step)
        case.stops += outcome.info["termination"] == "collision"
        case.impedance = max(case.impedance, round(float(env.trace.force.max()) / limit, 3))
        case.filtered = max(case.filtered, round(float(np.linalg.norm(wrench, axis=1).max() - held) / scale, 3))
        case.quasi_static = max(case.quasi_static, round((statistics["quasi_static_force"] - held) / scale, 3))
        case.transient = max(case.transient, round(transient, 3))
        case.tank_J = min(case.tank_J, round(tank_content(env), 2))
        done += control_steps
    case.rounds += 1
    env.close()


def replay(path: Path) -> float:
    """Repeat a stored episode, print its force, and return its largest transient force, relative to the limit."""
    episode = json.loads(path.read_text())
    seed, transient, actions = (episode.pop(name) for name in ("seed", "transient", "actions"))
    conditions, sequence = Conditions(**episode), iter(np.array(actions))
    env = conditions.make_env()
    outcome = conditions.run(env, seed, lambda: next(sequence))
    step = env.diagram.control_period * outcome.info["control_steps"] / (len(outcome.forces) - 1)
    time = outcome.forces.argmax() * step
    print(f"transient force {outcome.transient:.3f} F after {time:.4f} s, F = {outcome.limit:.2f} N")
    env.close()
    if abs(outcome.transient - transient) > 1e-9:
        print(f"the stored one is {transient:.3f} F")
    return outcome.transient


def station_of(env: Any) -> Any:
    """Return the station of an environment, without its disturbances."""
    station = env.diagram.diagram.GetSubsystemByName("station")
    return getattr(station, "_inner", station)


def held_force(env: Any, joint_friction: float) -> float:
    """Return the largest force at the tool center [N] against which an arm's joints at rest need no more than friction.

    See `friction_force`.
    """
    if joint_friction == 0.0:
        return 0.0
    station = station_of(env)
    plant, arm = station.plant, station.arm
    context = plant.GetMyContextFromRoot(env.simulator.get_context())
    world = plant.world_frame()
    jacobian = plant.CalcJacobianTranslationalVelocity(
        context, JacobianWrtVariable.kV, arm.tool_center, np.zeros(3), world, world
    )
    return friction_force(np.stack([plant.GetVelocitiesFromArray(arm.model, row) for row in jacobian]), joint_friction)


def friction_force(jacobian: np.ndarray, joint_friction: float) -> float:
    """Return the largest force at the tool center [N] that the friction of an arm's joints [Nm] holds.

    In the direction u, the joint with the largest lever arm slips first: min over joints of friction / |Jᵀ u|, with the
    Jacobian J (3, n) of the tool center's position.
    """
    directions = np.random.default_rng(0).standard_normal((4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return float((joint_friction / np.abs(directions @ jacobian).max(axis=1)).max())


def scale_mass(env: Any, factor: float) -> None:
    """Multiply the masses of all bodies by a factor."""
    plant = station_of(env).plant
    context = plant.GetMyMutableContextFromRoot(env.simulator.get_mutable_context())
    for number in range(1, plant.num_bodies()):  # number 0 is the world
        body = plant.get_body(BodyIndex(number))
        body.SetMass(context, factor * body.default_mass())


def scale_dissipation(env: Any, factor: float) -> None:
    """Multiply the dissipation of all contacts by a factor, until the next reset."""
    station = station_of(env)
    graph, source = station.scene_graph, station.plant.get_source_id()
    context = graph.GetMyMutableContextFromRoot(env.simulator.get_mutable_context())
    inspector = graph.get_query_output_port().Eval(graph.GetMyContextFromRoot(env.simulator.get_context())).inspector()
    for geometry in inspector.GetAllGeometryIds(Role.kProximity):
        properties = ProximityProperties(inspector.GetProximityProperties(geometry))
        if properties.HasProperty("material", "hunt_crossley_dissipation"):
            nominal = properties.GetProperty("material", "hunt_crossley_dissipation")
            properties.UpdateProperty("material", "hunt_crossley_dissipation", factor * nominal)
            graph.AssignRole(context, source, geometry, properties, RoleAssign.kReplace)


def largest_stiffness(task: str, modulus: float) -> float:
    """Return the largest stiffness of Drake's contact with the rim [N/mm] for forces up to three times the limit."""
    env = make_env(task, guidance=ANYWHERE, difficulty="hard", action_repeat=5, time_step=2e-4)
    env.reset(seed=SEED, options={"new_run": True})
    station, root = station_of(env), env.simulator.get_mutable_context()
    station.set_contact(root, 1.0, modulus)
    context = station.plant.GetMyMutableContextFromRoot(root)
    pose = station.GetOutputPort("pose").Eval(station.GetMyContextFromRoot(root))
    start = pose + RIM[task] * np.eye(6)[0]

    def force(depth: float) -> float:
        station.set_pose(root, start - [0.0, 0.0, depth, 0.0, 0.0, 0.0])
        station.plant.SetVelocities(context, np.zeros(station.plant.num_velocities()))
        return float(np.linalg.norm(contact_force(station.plant.get_contact_results_output_port().Eval(context))))

    free, touching = 0.0, next(depth for depth in np.arange(0.0, REACH[2], 2e-4) if force(depth) > 0.0)
    while touching - free > 1e-9:
        middle = 0.5 * (free + touching)
        free, touching = (middle, touching) if force(middle) == 0.0 else (free, middle)
    depths = np.geomspace(1e-7, 2e-3, 80)
    forces = np.array([force(free + depth) for depth in depths])
    env.close()
    return float((np.diff(forces) / np.diff(depths))[forces[1:] < 3 * max(LIMITS)].max()) * 1e-3


def pressed_stiffness(task: str, modulus: float) -> float:
    """Return the stiffness of MuJoCo's contact with the rim [N/mm] between pressures of 4.5 N and the largest one."""
    difficulty = "hard_6s" if task == "GridClamp" else "hard"
    env = make_env(task, guidance=ANYWHERE, station="mujoco", difficulty=difficulty, action_repeat=5)
    env.reset(seed=SEED, options={"new_run": True})
    station_of(env).set_contact(env.simulator.get_mutable_context(), 1.0, modulus)

    def press(height: float, num_actions: int) -> tuple[float, float]:
        """Command a height [m] relative to the start; return the measured height and the contact's force along z."""
        action = np.array([RIM[task], 0.0, height, 0.0, 0.0, 0.0]) / REACH
        for _ in range(num_actions):
            env.step(action)
        return float(env.trace.measured[-1, 2] - env.trace.measured[0, 2]), float(env.trace.signals["wrench"][-1, 2])

    press(0.0, 6)
    heights = iter(np.arange(0.0, REACH[2], 5e-4))
    while press(-next(heights), 1)[1] < 0.5:
        pass
    height, force = press(-next(heights), 1)
    points = []
    for pressure in (4.5, 9.0):
        for _ in range(2):
            height, force = press(height - pressure / Impedance().stiffness[2], 8)
        points.append((height, force))
    env.close()
    (first, low), (second, high) = points
    return 1e-3 * (high - low) / (first - second)


def watch_contact(env: Any) -> list[float]:
    """Return a list to which every step of the physics adds the norm of the contact forces [N]."""
    station, forces = station_of(env), [0.0]
    gantry, plant = getattr(station, "gantry", None), station.plant
    if station.plant.time_step() == 0.0:  # MuJoCo
        engine, inner = gantry.engine, type(gantry.engine).advance

        def advance(*given: Any) -> tuple[np.ndarray, np.ndarray, float]:
            state, wrenches, step = inner(engine, *given)
            forces.extend(np.linalg.norm(wrenches[:, :3], axis=1).tolist())
            return state, wrenches, step

        engine.advance = advance
        return forces
    contact = plant.get_contact_results_output_port()

    def add(root: Context) -> EventStatus:
        forces.append(float(np.linalg.norm(contact_force(contact.Eval(plant.GetMyContextFromRoot(root))))))
        return EventStatus.DidNothing()

    env.simulator.set_monitor(add)
    return forces


def contact_force(results: ContactResults) -> np.ndarray:
    """Return the sum of the contact forces of a plant (3,) [N]."""
    surfaces = map(results.hydroelastic_contact_info, range(results.num_hydroelastic_contacts()))
    points = map(results.point_pair_contact_info, range(results.num_point_pair_contacts()))
    pushes = [surface.F_Ac_W().translational() for surface in surfaces]
    pushes += [-point.contact_force() for point in points]
    return np.sum(pushes, axis=0) if pushes else np.zeros(3)


def tank_content(env: Any) -> float:
    """Return the energy in the station's tank [J], infinite without a tank."""
    station = station_of(env)
    if not station.HasSubsystemNamed("tank"):
        return math.inf
    tank = station.GetSubsystemByName("tank")
    return float(tank.get_energy_output_port().Eval(tank.GetMyContextFromRoot(env.simulator.get_context()))[0])


def read(path: Path | None) -> list[Case]:
    """Return the cases in a table, none without a table."""
    if path is None or not path.exists():
        return []
    types = {entry.name: {"str": str, "int": int, "float": float}[str(entry.type)] for entry in fields(Case)}
    with path.open(newline="") as file:
        return [Case(**{name: types[name](text) for name, text in row.items()}) for row in csv.DictReader(file)]


def write(cases: list[Case], path: Path) -> None:
    """Write a table."""
    temporary = path.with_suffix(".part")
    with temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, [entry.name for entry in fields(Case)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(map(asdict, cases))
    temporary.replace(path)


def main(arguments: list[str] | None = None) -> int:
    """Run the program; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=100_000, help="control steps of all cases together")
    parser.add_argument("--bounded", choices=("true", "false"), default="true", help="option bounded_force")
    parser.add_argument("--task", choices=sorted(GUIDANCE), help="one task; default: all")
    parser.add_argument("--station", choices=STATIONS, help="one station; default: all")
    parser.add_argument("--out", type=Path, help="CSV file of the table, from which a run continues")
    parser.add_argument("--replay", type=Path, help="file of an episode, which is repeated instead")
    parser.add_argument("--measure", action="store_true", help="print the stiffness of each contact instead")
    args = parser.parse_args(arguments)
    register_guidance(ANYWHERE)(Anywhere)
    if args.replay is not None:
        replay(args.replay)
        return 0
    if args.measure:
        for task, contacts in DRAKE.items():
            for modulus in contacts.values():
                print(f"{task}, Drake, factor {modulus:g} of the modulus: {largest_stiffness(task, modulus):.0f} N/mm")
        for task, contacts in CONTACTS["mujoco"].items():
            for modulus in contacts.values():
                print(f"{task}, MuJoCo, factor {modulus:g} of the modulus: {pressed_stiffness(task, modulus):.0f} N/mm")
        return 0
    cases = {(case.task, case.station, case.stiffness, case.step_ms): case for case in read(args.out)}
    for station in STATIONS:
        for task, contacts in CONTACTS[station].items():
            for stiffness, step in itertools.product(contacts, ENGINE_STEPS if station == "mujoco" else STEPS[task]):
                if args.task in (None, task) and args.station in (None, station):
                    cases.setdefault((task, station, stiffness, step), Case(task, station, stiffness, step))
    table = list(cases.values())

    def report(name: str, episode: str) -> None:
        if args.out is not None:
            args.out.with_name(f"{args.out.stem}-{name}.json").write_text(episode)

    searches: dict[int, dict[str, Search]] = {number: {} for number in range(len(table))}
    shares = [1 if case.station == "mujoco" or case.step_ms == STEPS[case.task][0] else FINE_SHARE for case in table]
    steps = min(ROUND, max(args.steps // len(table), 1))
    while (remaining := args.steps - sum(case.control_steps for case in table)) > 0:
        number = min(range(len(table)), key=lambda index: table[index].control_steps * shares[index])
        run_round(table[number], searches[number], min(steps, remaining), args.bounded == "true", report)
        if args.out is not None:
            write(table, args.out)
    for case in table:
        print(", ".join(f"{name} {value}" for name, value in asdict(case).items()))
    failed = sum(case.has_failed for case in table)
    print(f"{sum(case.control_steps for case in table)} control steps, {failed} of {len(table)} cases failed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
