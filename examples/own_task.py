"""Define your own task, here a narrow passage with another gap and another goal."""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from pydrake.systems.framework import Context, Diagram

import guiderail as gr
from guiderail.models.objects.narrow_passage.geometry import PassageGeometry

WORLD = PassageGeometry(start=(0.35, 0.1), goal=(0.42, 0.9), goal_radius=0.06, gap_x=(0.28, 0.42))
STEPS, PERIOD = 80, 0.02


@gr.register_task("examples/WideGap")
class WideGap(gr.Task):
    """Pass a wide gap to a goal next to the demonstrations."""

    workcell_kind, num_steps, clip = "plane", STEPS, 1.0

    def workcell(self) -> PassageGeometry:
        return WORLD

    def reference(self) -> gr.ReferenceTrajectory:  # for kmp, residual, kgrl and skgrl
        means = np.column_stack([np.full(STEPS, 0.35), np.linspace(0.1, 0.9, STEPS)])
        return gr.ReferenceTrajectory(PERIOD * np.arange(STEPS), means, np.tile(0.04**2 * np.eye(2), (STEPS, 1, 1)))

    def constraints(self) -> gr.LinearConstraints:
        return gr.LinearConstraints.box([0.25, -np.inf], [0.45, np.inf])

    def observation_terms(self) -> Sequence[gr.ObservationTerm]:
        return (gr.ObservationTerm("phase"), gr.ObservationTerm("pose", center=0.5, scale=0.5))

    def reward_terms(self, num_actions: int) -> list[gr.RewardTerm]:
        return [
            gr.RewardTerm("nearness", {"pose": 2}, lambda pose: -float(np.linalg.norm(pose - np.array(WORLD.goal))))
        ]

    def termination_terms(self) -> list[gr.TerminationTerm]:
        return [gr.TerminationTerm("success", {"pose": 2}, WORLD.at_goal)]

    def reset(
        self, station: gr.Station, guidance: Diagram, context: Context, rng: np.random.Generator, options: Any
    ) -> dict[str, Any]:
        station.set_pose(context, start := np.array(WORLD.start) + 0.005 * rng.standard_normal(2))
        return {"start": start}


env = gymnasium.make("examples/WideGap-v0", guidance="skgrl", action_repeat=5)
print("start:", env.reset(seed=1)[1]["start"].round(3))
is_over = False
while not is_over:
    _, _, terminated, truncated, info = env.step(np.array([0.8, 0.0], np.float32))
    is_over = terminated or truncated
print(f"termination: {info['termination']}, largest commanded violation: {info['constraint_violation']:.3f} m")
