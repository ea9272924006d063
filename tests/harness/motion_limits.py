"""Adversarial commands against the limits of velocity, acceleration and jerk of `PoseMotionLimiter`.

The largest values are computed from finite differences of the emitted poses, independently of the trajectory generator.
The n-th difference divided by the n-th power of the period is an average of the n-th derivative, and cannot exceed the
maximum of the derivative. The exit code is 1 if a limit is exceeded.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from pydrake.systems.analysis import Simulator
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[1]))  # this file runs as a script

from guiderail_hardware.drivers.fci import FciDriver
from guiderail_hardware.drivers.rtde import UR_MOTION_LIMITS
from guiderail_hardware.models.motion_limits import MotionLimits
from guiderail_hardware.systems.pose_motion_limiter import PoseMotionLimiter
from oracles.franka import FRANKA_LIMITS

START = np.array([0.5, 0.0, 0.5, 0.3, 0.1, 3.0])
CHUNK = 5000  # number of commands between two checks
TOLERANCE = 1e-6  # relative tolerance of the finite differences
Policy = Callable[[np.random.Generator], Iterator[np.ndarray]]


def jumps(rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Yield poses that jump at random instants by micrometers to meters."""
    desired = START
    while True:
        if rng.random() < 0.1:
            desired = START + rng.uniform(-1, 1, 6) * rng.choice([1e-6, 1e-4, 1e-2, 0.3, 2.0])
        yield desired


def white_noise(rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Yield a new random pose in every period."""
    scale = 0.3
    while True:
        if rng.random() < 0.002:
            scale = rng.choice([1e-5, 1e-3, 0.05, 0.3, 1.5])
        yield START + scale * rng.standard_normal(6)


def reversals(rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Yield alternating distant poses, with random half periods of 1 to 199 commands."""
    while True:
        half, corner = int(rng.integers(1, 200)), rng.choice([-1.0, 1.0], 6) * [0.5, 0.5, 0.5, 1.0, 0.5, 1.0]
        for k in range(10 * half):
            yield START + (corner if k // half % 2 else -corner)


def invalid(rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Yield poses that jump, mixed with non-finite values, huge angles and half turns."""
    for desired in jumps(rng):
        if rng.random() < 0.3:
            desired = desired.copy()
            values = [np.nan, np.inf, -np.inf, 1e300, np.pi, -np.pi, 1e6]
            desired[rng.integers(6)] += rng.choice(values)
            if abs(desired[0]) > 1e3 or abs(desired[1]) > 1e3 or abs(desired[2]) > 1e3:
                desired[:3] = np.nan  # otherwise the limiter would approach the distant position
        yield desired


def oscillations(rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Yield sinusoids of all frequencies up to half the command rate."""
    while True:
        frequency, phase = rng.uniform(0.01, np.pi, 6), rng.uniform(0, 2 * np.pi, 6)
        amplitude = rng.choice([1e-4, 1e-2, 0.2]) * rng.uniform(0, 1, 6)
        for k in range(int(rng.integers(50, 2000))):
            yield START + amplitude * np.sin(frequency * k + phase)


POLICIES: dict[str, Policy] = {
    policy.__name__: policy for policy in (jumps, white_noise, reversals, invalid, oscillations)
}
LIMITS = {"franka": FRANKA_LIMITS, "fci": FciDriver.motion_limits, "ur": UR_MOTION_LIMITS}


def largest_derivatives(poses: np.ndarray, period: float) -> np.ndarray:
    """Return the largest velocity, acceleration and jerk of poses (N, 6), (2, 3), linear part first."""
    turns = Rotation.from_euler("xyz", poses[:, [5, 4, 3]])
    rates = (np.diff(poses[:, :3], axis=0) / period, (turns[1:] * turns[:-1].inv()).as_rotvec() / period)
    return np.array(
        [[np.linalg.norm(np.diff(rate, n, axis=0), axis=1).max() / period**n for n in range(3)] for rate in rates]
    )


def attack(policy: Policy, limits: MotionLimits, period: float, commands: int, seed: int) -> np.ndarray:
    """Return the largest derivatives of the emitted poses relative to their limits, (2, 3)."""
    system = PoseMotionLimiter(limits, period=period)
    context = system.CreateDefaultContext()
    desired_port = system.get_desired_pose_input_port()
    desired_port.FixValue(context, START)
    system.get_pose_input_port().FixValue(context, START)
    system.get_blend_factor_input_port().FixValue(context, [1.0])
    simulator = Simulator(system, context)
    simulator.Initialize()
    output, source = system.get_limited_pose_output_port(), policy(np.random.default_rng(seed))
    bounds, worst, poses = np.array([limits.linear, limits.angular]), np.zeros((2, 3)), [START] * 4
    for k in range(1, commands + 1):
        desired_port.FixValue(context, next(source))
        poses.append(output.Eval(context).copy())
        simulator.AdvanceTo(k * period)
        if k % CHUNK == 0 or k == commands:
            worst = np.maximum(worst, largest_derivatives(np.array(poses), period) / bounds)
            poses = poses[-4:]
    return worst


def main() -> int:
    """Run all policies against all limits; return 1 if a limit was exceeded, otherwise 0."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--commands", type=int, default=1_000_000, help="total number of commands")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    runs = [(policy, name, period) for period in (0.005, 0.001) for name in LIMITS for policy in POLICIES]
    number, total, num_failed, start = arguments.commands // len(runs) + 1, 0, 0, time.monotonic()
    for seed, (policy, name, period) in enumerate(runs, arguments.seed):
        ratios = attack(POLICIES[policy], LIMITS[name], period, number, seed)
        is_within = bool((ratios <= 1.0 + TOLERANCE).all())
        total, num_failed = total + number, num_failed + (not is_within)
        largest = " ".join(f"{ratio:7.4f}" for ratio in ratios.ravel())
        print(
            f"{'ok  ' if is_within else 'FAIL'} {policy:<13}{name:<19}{1e3 * period:2.0f} ms  relative to the limits "
            f"{largest}  {total} commands, {time.monotonic() - start:.0f} s",
            flush=True,
        )
    print(f"{total} commands, {num_failed} runs with an exceeded limit")
    return int(num_failed > 0)


if __name__ == "__main__":
    sys.exit(main())
