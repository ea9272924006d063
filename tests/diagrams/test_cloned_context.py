"""Simulation that continues from a cloned context."""

import numpy as np
from pydrake.systems.analysis import InitializeParams, Simulator

from guiderail import make_skill


def test_clone_continues_bit_for_bit_without_initialization():
    skill = make_skill("NarrowPassage", lambda observation: np.full(2, 0.5), guidance="skgrl", action_repeat=5)
    original = Simulator(skill.diagram)
    skill.randomize(original.get_mutable_context(), np.random.default_rng(0), {})
    original.AdvanceTo(0.3)
    copy = Simulator(skill.diagram, original.get_context().Clone())
    copy.Initialize(InitializeParams(suppress_initialization_events=True))
    poses = []
    for simulator in (original, copy):
        simulator.AdvanceTo(0.6)
        poses.append(skill.diagram.GetOutputPort("pose").Eval(simulator.get_context()))
    np.testing.assert_array_equal(*poses)
