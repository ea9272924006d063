"""Write guidance with memory, as a law whose state is restored by a reset.

This guidance adds each action to its last command, not to the measured pose. By default, the state of a law is its last
command, at first the measured pose. The same law runs in a diagram, in `GuidedEnv` and in a program of your own.
"""

import numpy as np

from guiderail import Law, Stepper, make_env, register_guidance


@register_guidance("integrator")
class Integrator(Law):
    """Law command[k] = command[k − 1] + 0.01 action[k], with the measured pose as the first command."""

    def command(self, last, action, pose, wrench):
        return last + 0.01 * action


env = make_env("NarrowPassage", guidance="integrator", action_repeat=5)
for episode in range(2):
    env.reset(seed=0)
    for _ in range(4):
        env.step(np.array([0.0, 0.5]))
    print("last command of episode", episode, env.trace.commanded[-1].round(3), "m")

stepper = Stepper(Integrator(2), pose=[0.0, 0.0])
commands = [stepper.step([0.0, 0.5], pose=[0.0, 0.0]).pose for _ in range(20)]
print("last command without a diagram", commands[-1].round(3), "m")
