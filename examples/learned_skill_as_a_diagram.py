"""Run a learned skill without Gymnasium: observation, policy, guidance and station are one Drake diagram.

The argument is the folder of a run with a policy. Without an argument, the action is zero.
"""

import sys
from pathlib import Path

import numpy as np
from pydrake.systems.analysis import Simulator

from guiderail import make_skill
from guiderail.models.policy import Policy

policy = Policy.load(Path(sys.argv[1])) if len(sys.argv) > 1 else lambda observation: np.zeros(2)
skill = make_skill("NarrowPassage", policy, guidance="skgrl")

simulator = Simulator(skill.diagram)
context = simulator.get_mutable_context()
skill.randomize(context, np.random.default_rng(0), {})
simulator.AdvanceTo(2.0)

print("measured  ", skill.diagram.GetOutputPort("pose").Eval(context).round(3))
print("commanded ", skill.diagram.GetOutputPort("desired_pose").Eval(context).round(3))
print("violation ", skill.diagram.GetOutputPort("constraint_violation").Eval(context)[0].round(3))
