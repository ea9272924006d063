"""Change the reward of a task: override `reward_terms` in a subclass. Each term is a column of the results."""

import numpy as np

import guiderail as gr
from guiderail.diagrams.tasks.grid_clamp.task import GridClamp


@gr.register_task("examples/TimeCost")
class TimeCost(GridClamp):
    """Grid clamp with a cost of time and a cost of jumps of the command."""

    def reward_terms(self, num_actions: int) -> list[gr.RewardTerm]:
        def jump(desired_pose: np.ndarray, last_desired_pose: np.ndarray) -> float:
            return -10.0 * float(np.linalg.norm(desired_pose - last_desired_pose))

        return [
            *super().reward_terms(num_actions),
            gr.RewardTerm("time_cost", {}, lambda: -0.01),
            gr.RewardTerm("jump_cost", {"desired_pose": 6, "last_desired_pose": 6}, jump),
        ]


env = gr.make_env("examples/TimeCost", guidance="sct", action_repeat=10)
env.reset(seed=0)
sums = dict.fromkeys(("time_cost", "jump_cost"), 0.0)
for _ in range(10):
    info = env.step(np.array([0.0, 0.0, -1.0]))[-1]
    sums = {name: value + info[name] for name, value in sums.items()}
print("sums of the added terms:", {name: round(value, 3) for name, value in sums.items()})
print("costs in info:", sorted(name for name in info if "_cost" in name))
