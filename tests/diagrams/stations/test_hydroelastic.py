"""Insertions have hydroelastic contact only, never Drake's point contact."""

import numpy as np
import pytest

from guiderail import make_env

DOWN = np.array([0.0, 0.0, -1.0])
# Task, options and action.
CASES = {
    "connector": ("BncConnector", {"guidance": "kmp"}, np.zeros(2)),
    "clamp": ("GridClamp", {}, DOWN),
    "clamp on an arm": ("GridClamp", {"station": "arm"}, DOWN),
}


@pytest.mark.parametrize("case", CASES)
def test_insertion_has_no_point_contact(case):
    task, options, action = CASES[case]
    env = make_env(task, fixture_offset="none", **options)
    env.reset(seed=0)
    plant = env.diagram.diagram.GetSubsystemByName("station").plant
    context = plant.GetMyContextFromRoot(env.simulator.get_context())
    surfaces, points, has_ended = 0, 0, False
    while not has_ended:
        *_, terminated, truncated, info = env.step(action)
        has_ended = terminated or truncated
        results = plant.get_contact_results_output_port().Eval(context)
        surfaces += results.num_hydroelastic_contacts()
        points += results.num_point_pair_contacts()
    assert points == 0
    assert surfaces > 0
    assert info["termination"] == "success"
