"""What the studies of `hard` declare can be made."""

import numpy as np
import pytest

from guiderail.diagrams.tasks.pouring.options import MAX_MUG_ERROR
from guiderail.diagrams.tasks.pouring.scripted import scripted_pour_aimed, scripted_pour_blind
from guiderail.diagrams.tasks.pouring.task import POSITION_SCALE
from guiderail.tools.experiments.declaration import LEARNED, load_study
from guiderail.tools.experiments.study import Job
from research.studies import study_path

HARD = (
    "pouring_hard",
    "pouring_hard_baselines",
    "pouring_balls_baselines",
    "narrow_passage_hard",
    "narrow_passage_hard_baselines",
)
SWEEPS = ("connector_sweep", "grid_clamp_sweep", "pouring_sweep", "narrow_passage_sweep")
# Of what was learned at the hardest, by whose study a sweep finds it.
LEARNED_BY = {
    "connector_sweep": "connector_hard",
    "grid_clamp_sweep": "grid_clamp_hard",
    "pouring_sweep": "pouring_hard",
    "narrow_passage_sweep": "narrow_passage_hard",
}


@pytest.mark.parametrize("name", [*HARD, *SWEEPS])
def test_every_method_can_be_made(name, tmp_path):
    study = load_study(study_path(name))
    for method in study.methods:
        job = Job(study, method, study.seeds[0], tmp_path)
        assert job.config(job.after_episodes[-1]).environment["difficulty"] == "hard"


@pytest.mark.parametrize("name", LEARNED_BY)
def test_a_sweep_judges_what_another_study_learned(name, tmp_path):
    sweep, learned = load_study(study_path(name)), load_study(study_path(LEARNED_BY[name]))
    shared = [m for m, one in sweep.methods.items() if one.policy == LEARNED]
    assert shared
    for method in shared:
        for seed in sweep.methods[method].seeds or sweep.seeds:
            ours, theirs = (Job(study, method, seed, tmp_path) for study in (sweep, learned))
            assert seed in learned.seeds
            assert ours.folder.path == theirs.folder.path
            assert ours.config(ours.after_episodes[-1]) == theirs.config(theirs.after_episodes[-1])


@pytest.mark.parametrize("name", SWEEPS)
def test_a_sweep_goes_from_easy_to_hard_and(name):
    for sweep in load_study(study_path(name)).sweeps:
        values = list(sweep.at)
        assert values in (sorted(values), sorted(values, reverse=True))


def seen(tip, error=(0.0, 0.0), state=1.0, tilt=0.0):
    values = [*(POSITION_SCALE * np.array(tip)), -tilt, 0.0, 0.0, *(np.array(error) / MAX_MUG_ERROR), state]
    return np.array(values)


def test_who_looks_aims_before_it_pours():
    np.testing.assert_array_equal(scripted_pour_aimed(seen((0.05, -0.2, 0.06)))[[0, 2]], [-1.0, 0.0])
    assert scripted_pour_aimed(seen((0.0, -0.045, 0.06)))[2] == 1.0
    assert scripted_pour_aimed(seen((0.05, -0.2, 0.06), tilt=np.deg2rad(100)))[2] == 1.0  # no way back: the balls roll


def test_who_does_not_look_acts_as_if_the_mug_were_where_it_is_believed():
    """However far the two are apart, the same in the frame of where the mug is believed to be."""
    for state in (-1.0, 0.0, 1.0):
        there = scripted_pour_blind(seen((0.01 + 0.04, -0.1 - 0.02, 0.06), (0.04, -0.02), state))
        np.testing.assert_allclose(there, scripted_pour_aimed(seen((0.01, -0.1, 0.06), state=state)), atol=1e-9)
