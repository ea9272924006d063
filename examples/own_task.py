"""Define your own task, here a passage to a goal next to the demonstrations; an option is a field of the task."""

import guiderail as gr


@gr.register_task("examples/WideGap")
class WideGap(gr.Task):
    station, presets = gr.PlaneStation, {"hard": {"gap": 0.1}}
    gap: float = gr.Field(0.14, ge=0.05, le=0.3, description="width of the gap [m]")

    def workcell(self):
        return gr.PassageGeometry(goal=(0.42, 0.9), goal_radius=0.06, gap_x=(0.35 - self.gap / 2, 0.35 + self.gap / 2))

    def prior(self):
        path = gr.ReferenceTrajectory.straight([0.35, 0.1], [0.35, 0.9], std=0.04, num_steps=80, period=0.02)
        return gr.Prior(path, gr.LinearConstraints([[1.0, 0.0], [-1.0, 0.0]], [0.25, -0.45]))

    def done(self):
        return {"success": self.workcell().at_goal}


env = gr.make_env("examples/WideGap", guidance="skgrl", action_repeat=5)
print(gr.rollout(env, lambda observation: [0.8, 0.0], seed=1)["termination"])
