"""Tries to make the pouring template fail: careless, random and malicious inputs, contacts checked at every plant step.

    python -m guiderail.tools.stress.pouring --steps 100000

A step is one control step (10 ms) of the arm. Exits with 1 if anything touched what it must not, if a commanded pose
was outside of the active constraints, if the thermos was commanded to tilt before that is allowed, or if the
simulation failed.
"""

import argparse
import json
import sys
import time
from collections import Counter
from typing import Any

import numpy as np

from guiderail.diagrams.env import GuidedEnv
from guiderail.diagrams.tasks.pouring import MAX_MUG_OFFSET, make_env
from guiderail.diagrams.tasks.pouring_inputs import ADVERSARIES
from guiderail.models.pose_coordinates import pose_to_transform
from guiderail.tools.learning.progress import TOLERANCE
from guiderail.tools.stress.campaign import Witness, episode


def stress(steps: int, seed: int = 0, progress: bool = False, input_speed: float = 1.0) -> dict[str, Any]:
    """Runs whole episodes, the adversaries in turn, until they took so many control steps.

    Returns:
        What was found: control steps, episodes by how they ended, collisions, the worst commanded and measured
        violation, and the greatest tilt [rad] that was commanded in the upright state.
    """
    env = make_env(mug_offset=MAX_MUG_OFFSET, input_speed=input_speed)
    rng = np.random.default_rng(seed)
    found: dict[str, Any] = {"steps": 0, "collisions": 0, "commanded": 0.0, "measured": 0.0, "early_tilt": 0.0}
    endings: Counter[str] = Counter()
    began = time.perf_counter()
    while found["steps"] < steps:
        name = list(ADVERSARIES)[sum(endings.values()) % len(ADVERSARIES)]
        inputs = ADVERSARIES[name](rng)
        row = episode(env, inputs, int(rng.integers(2**31)), witness=EarlyTilt)
        found["steps"] += row["steps"]
        found["collisions"] += row["collisions"]
        found["commanded"] = max(found["commanded"], row["worst_violation"])
        found["measured"] = max(found["measured"], row["worst_measured_violation"])
        found["early_tilt"] = max(found["early_tilt"], row["early_tilt"])
        endings[f"{name}: {row['termination']}"] += 1
        if progress:
            print(f"{found['steps']:7d} steps, {time.perf_counter() - began:5.0f} s, {dict(endings)}", file=sys.stderr)
    return {**found, "endings": dict(endings)}


class EarlyTilt(Witness):
    """The greatest tilt [rad] that is commanded while the template is in its first state, where it is upright."""

    def __init__(self, env: GuidedEnv):
        """
        Args:
            env: just reset.
        """
        self._diagram, self._context, self._worst = env.task.diagram, env.simulator.get_context(), 0.0

    def look(self) -> None:
        """Measures, unless the template is in another state."""
        if self._diagram.GetOutputPort("state").Eval(self._context)[0] != 0:
            return
        X = pose_to_transform(self._diagram.GetOutputPort("desired_pose").Eval(self._context))
        R = X.rotation().matrix()
        self._worst = max(self._worst, float(np.arctan2(np.hypot(R[0, 2], R[1, 2]), R[2, 2])))

    def report(self) -> dict[str, float]:
        """`early_tilt` [rad]."""
        return {"early_tilt": self._worst}


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--steps", type=int, default=100_000, help="control steps in all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--input-speed", type=float, default=1.0, help="how much faster than meant the inputs are")
    arguments = parser.parse_args()
    found = stress(arguments.steps, arguments.seed, progress=True, input_speed=arguments.input_speed)
    print(json.dumps(found, indent=2))
    failed = found["collisions"] > 0 or found["commanded"] > TOLERANCE or found["early_tilt"] > TOLERANCE
    failed |= any(ending.endswith("simulation_failure") for ending in found["endings"])
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
