"""Define your own task, here a passage to another goal; an option is a field of the task."""

import numpy as np

import guiderail as gr
from guiderail.models.objects.narrow_passage import PassageGeometry

PATH = np.column_stack([np.full(80, 0.35), np.linspace(0.1, 0.9, 80)])


@gr.register_task("examples/WideGap")
class WideGap(gr.Task):
    """Pass a gap to a goal next to the demonstrations."""

    station, presets = gr.PlaneStation, {"hard": {"gap": 0.1}}
    gap: float = gr.Field(0.14, ge=0.05, le=0.3, description="width of the gap [m]")

    def workcell(self):
        return PassageGeometry(goal=(0.42, 0.9), goal_radius=0.06, gap_x=(0.35 - self.gap / 2, 0.35 + self.gap / 2))

    def prior(self):
        reference = gr.ReferenceTrajectory(0.02 * np.arange(80), PATH, np.tile(0.04**2 * np.eye(2), (80, 1, 1)))
        return gr.Prior(reference, gr.LinearConstraints.box([0.25, -np.inf], [0.45, np.inf]))

    def rewards(self):
        return {"nearness": lambda pose: -float(np.linalg.norm(pose - self.workcell().goal))}

    def done(self):
        return {"success": self.workcell().at_goal}


env = gr.make_env("examples/WideGap", guidance="skgrl", action_repeat=5)
print(gr.rollout(env, lambda observation: np.array([0.8, 0.0]), seed=1)["termination"])
