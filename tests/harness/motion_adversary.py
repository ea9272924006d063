"""Adversarial actions against obstacles and motion limits: `python tests/harness/motion_adversary.py [STEPS [SEED]]`.

Spherical obstacles are placed at sampled positions in the narrow passage. Actions of full size push against the
obstacle, or change at random. No command, fallbacks included, and no straight line between two commands may enter an
obstacle. The check uses formulas that share no code with the constraints.
"""

import sys
import time
from dataclasses import dataclass

import numpy as np

from guiderail.diagrams.envs.make import make_prior_knowledge
from guiderail.models.common.transforms import RigidTransform
from guiderail.models.control.motion_constraints import MotionConstraintFilter, MotionConstraints
from guiderail.models.control.shapes import Sphere, linearize
from guiderail.models.laws import PrimitiveLaw, Stepper
from guiderail.models.primitives import LcNsKmp
from guiderail.models.templates.schema import parse_template

KINDS = ("reference", "command", "command, smooth", "speed", "speed and acceleration", "template")
LIMITS = {"speed": (0.3, np.inf), "speed and acceleration": (0.3, 2.0)}  # speed [m/s], acceleration [m/s²]
TEMPLATE = """
name: free
inputs: 3
frames: [ball]
max_speed_m_per_s: 1.0
max_speed_rad_per_s: 1.0
parameters: {radius_m: 0.05}
states:
  free:
    input_mapping: [{kind: translation, inputs: [0, 1, 2], speed_m_per_s: 0.8}]
    active_constraints:
      - {kind: box, lower_m: [0.0, 0.0, -0.2], upper_m: [0.6, 1.0, 0.2]}
      - {kind: outside_sphere, frame: ball, radius_m: radius_m}
    transition_distance: {kind: distance, frame: world}
    starts_at_m: 1.0
    ends_at_m: 0.0
"""
EPISODES = 5  # number of episodes with each obstacle


@dataclass
class Result:
    """Statistics of the executed steps.

    Attributes:
        steps: Number of executed steps.
        touching: Number of commands closer than 0.1 mm to the obstacle.
        fallbacks: Number of steps with a fallback.
        nearest: Smallest distance of a command from the obstacle [m].
        nearest_between: Smallest distance between the obstacle and a straight line from one command to the next [m].
        speed: Largest speed along an axis [m/s].
        acceleration: Largest acceleration along an axis [m/s²].
        outside: Largest violation of the linear constraints [m].
    """

    steps: int = 0
    touching: int = 0
    fallbacks: int = 0
    nearest: float = np.inf
    nearest_between: float = np.inf
    speed: float = 0.0
    acceleration: float = 0.0
    outside: float = -np.inf

    def add(self, commands: np.ndarray, center: np.ndarray, radius: float, period: float, outside: float) -> None:
        """Add the commands (N, D) of an episode; the first row is only the start of the first move."""
        moves = np.diff(commands, axis=0)
        fraction = ((center - commands[:-1]) * moves).sum(axis=1) / np.maximum((moves**2).sum(axis=1), 1e-300)
        between = commands[:-1] + np.clip(fraction, 0.0, 1.0)[:, None] * moves
        distances = np.linalg.norm(commands[1:] - center, axis=1) - radius
        self.steps += len(moves)
        self.touching += int((distances < 1e-4).sum())
        self.nearest = min(self.nearest, float(distances.min()))
        self.nearest_between = min(self.nearest_between, float(np.linalg.norm(between - center, axis=1).min()) - radius)
        self.speed = max(self.speed, float(np.abs(moves).max()) / period)
        self.acceleration = max(self.acceleration, float(np.abs(np.diff(moves, axis=0)).max()) / period**2)
        self.outside = max(self.outside, outside)


def pushing_action(
    rng: np.random.Generator, style: int, last: np.ndarray, center: np.ndarray, before: np.ndarray
) -> np.ndarray:
    """Return an action (D,) in [−1, 1]: towards or around the obstacle, random, or the previous action `before`."""
    towards = (center - last) / max(float(np.linalg.norm(center - last)), 1e-12)
    around = np.roll(towards, 1) * np.where(np.arange(len(towards)) % 2, 1.0, -1.0)
    choices = (towards, towards + around, np.sign(rng.uniform(-1.0, 1.0, len(last))), before, around)
    return np.clip(choices[style if rng.uniform() < 0.9 else int(rng.integers(5))] * 3.0, -1.0, 1.0)


def attack(steps: int, seed: int = 0) -> dict[str, Result]:
    """Execute at least `steps` steps; return the result for each kind of constraints."""
    rng, results, rounds = np.random.default_rng(seed), {kind: Result() for kind in KINDS}, 0
    config = make_prior_knowledge("NarrowPassage").primitive
    while sum(result.steps for result in results.values()) < steps:
        kind, radius = KINDS[rounds % len(KINDS)], float(rng.choice([0.01, 0.03, 0.08]))
        rounds += 1
        if kind == "template":
            attack_template(rng, radius, results[kind])
        else:
            attack_primitive(rng, config, kind, radius, results[kind])
    return results


def attack_primitive(rng: np.random.Generator, config: object, kind: str, radius: float, result: Result) -> None:
    """Execute episodes with an obstacle near the motion, with sKGRL if `kind` is smooth, otherwise with KGRL."""
    reference, history = config.reference, 4 if kind == "command, smooth" else 0
    step = int(rng.integers(30, reference.num_steps - 30))
    # The obstacle is next to the mean. If commands are constrained, its center may also be on the mean.
    aside = rng.choice([-1.0, 1.0], 2) * rng.uniform(0.5 if kind == "reference" else 0.0, 1.5, 2) * radius
    sphere = Sphere(reference.means[step] + aside, radius)
    if sphere.distance(reference.means[0]) < 0.1:
        return  # the sampled start could be inside the obstacle
    constraints, motion = config.constraints, None
    if kind == "reference":
        constraints = linearize([sphere], reference.means, constraints)
    else:
        speed, acceleration = LIMITS.get(kind, (np.inf, np.inf))
        limits = np.full(2, speed), np.full(2, acceleration)
        motion = MotionConstraintFilter(MotionConstraints(constraints, [sphere], *limits), config.control_period)
    primitive = LcNsKmp(reference, horizon=10, history=history, constraints=constraints)
    gain = config.null_space_gains(primitive) * rng.choice([1.0, 3.0, 30.0])
    for _ in range(EPISODES):
        style, action = int(rng.integers(5)), np.zeros(2)
        start = reference.means[0] + rng.normal(0.0, 0.02, 2)
        stepper = Stepper(PrimitiveLaw(primitive, gain, command_filter=motion), start)
        commands, outside = [start] if motion else [], -np.inf
        for n in range(reference.num_steps):
            if style == 0:  # action for which the unconstrained primitive commands the center of the obstacle
                _, effect, mean = primitive.linear_response(n)
                action = np.linalg.solve(effect, sphere.center - mean) / gain if not history else action
                action = np.clip(action + 0.1 * rng.standard_normal(2), -30.0, 30.0)
            if style or history:
                action = pushing_action(rng, style, commands[-1] if commands else start, sphere.center, action)
            command = stepper.step(action)
            commands.append(command.pose)
            result.fallbacks += command.fallback
            outside = max(outside, command.pose[0] - 0.6)
        result.add(np.array(commands), sphere.center, radius, config.control_period, outside)


def attack_template(rng: np.random.Generator, radius: float, result: Result, period: float = 0.02) -> None:
    """Execute episodes of a template with free motion in a box around an obstacle."""
    template = parse_template(TEMPLATE, radius_m=radius)
    center = np.append(
        rng.uniform([0.1, 0.15], [0.5, 0.9]), 0.0
    )  # the distance from the start exceeds the largest radius
    frames = {"ball": RigidTransform(center)}
    for _ in range(EPISODES):
        style, action, X = int(rng.integers(5)), np.zeros(3), RigidTransform([0.3, 0.05, 0.0])
        commands, outside = [X.translation()], -np.inf
        for _ in range(400):
            action = pushing_action(rng, style, commands[-1], center, action)
            request = template.displace(X, template.map(0, action, X, frames, period))
            command = template.command(0, X, request, frames, period)
            X = command.X_WE
            commands.append(X.translation())
            result.fallbacks += command.fraction == 0.0
            outside = max(outside, float((np.abs(commands[-1] - [0.3, 0.5, 0.0]) - [0.3, 0.5, 0.2]).max()))
        result.add(np.array(commands), center, radius, period, outside)


def is_violated(kind: str, result: Result) -> bool:
    """Return True if a command or a line between commands was inside the obstacle, or a limit was exceeded."""
    speed, acceleration = LIMITS.get(kind, (np.inf, np.inf))
    return (
        min(result.nearest, result.nearest_between) < 0.0
        or result.outside > 1e-9
        or result.speed > speed * (1.0 + 1e-9)
        or result.acceleration > acceleration * (1.0 + 1e-6)
    )


def main(steps: int = 1_000_000, seed: int = 0) -> int:
    start = time.perf_counter()
    results = attack(steps, seed)
    print("kind | steps | touching | fallbacks | nearest [m] | between [m] | speed [m/s] | acceleration [m/s²]")
    for kind, r in results.items():
        print(
            f"{kind} | {r.steps} | {r.touching} | {r.fallbacks} | {r.nearest:.1e} | {r.nearest_between:.1e} | "
            f"{r.speed:.3g} | {r.acceleration:.3g}"
        )
    print(f"{time.perf_counter() - start:.0f} s")
    return int(any(is_violated(kind, result) for kind, result in results.items()))


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:])))
