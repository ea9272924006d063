"""Change the reward of a task: override `rewards` in a subclass. Each term is a column of the results."""

import numpy as np

import guiderail as gr
from guiderail.diagrams.tasks.grid_clamp import GridClamp


@gr.register_task("examples/TimeCost")
class TimeCost(GridClamp):
    """Grid clamp with a cost of time and a cost of jumps of the command."""

    def rewards(self):
        def jump(desired_pose, last_desired_pose):
            return -10.0 * float(np.linalg.norm(desired_pose - last_desired_pose))

        return {**super().rewards(), "time_cost": lambda: -0.01, "jump_cost": jump}


env = gr.make_env("examples/TimeCost", guidance="sct", action_repeat=10)
env.reset(seed=0)
sums = dict.fromkeys(("time_cost", "jump_cost"), 0.0)
for _ in range(10):
    info = env.step(np.array([0.0, 0.0, -1.0]))[-1]
    sums = {name: value + info[name] for name, value in sums.items()}
print("sums of the added terms:", {name: round(value, 3) for name, value in sums.items()})
print("costs in info:", sorted(name for name in info if "_cost" in name))
