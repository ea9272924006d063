"""Studies of difficulty "hard", and the scripted policies for pouring."""

import numpy as np
import pytest

from guiderail.diagrams.tasks.pouring import MAX_MUG_ERROR, POSITION_SCALE, scripted_pour_aimed, scripted_pour_blind
from guiderail_studies.declaration import LEARNED, load_study
from guiderail_studies.job import Job
from research.studies import study_path

HARD = (
    "pouring_hard",
    "pouring_hard_shield",
    "pouring_balls_baselines",
    "narrow_passage_hard",
    "narrow_passage_hard_baselines",
    "connector_robot_sensing",
    "connector_robot_sensing_transfer",
    "grid_clamp_hard_3s",
)
HARD_6S = ("grid_clamp_hard", "peers_grid_clamp_hard", "grid_clamp_robot_sensing", "grid_clamp_sweep")
SWEEPS = ("connector_sweep", "grid_clamp_sweep", "pouring_sweep", "narrow_passage_sweep")
# The study whose policies each sweep evaluates.
TRAINED_BY = {
    "connector_sweep": "connector_hard",
    "grid_clamp_sweep": "grid_clamp_hard",
    "pouring_sweep": "pouring_hard",
    "narrow_passage_sweep": "narrow_passage_hard",
}


@pytest.mark.parametrize("name", dict.fromkeys([*HARD, *HARD_6S, *SWEEPS]))
def test_all_methods_of_a_study_can_be_configured(name, tmp_path):
    study = load_study(study_path(name))
    for method in study.methods:
        job = Job(study, method, study.seeds[0], tmp_path)
        difficulty = "hard_6s" if name in HARD_6S else "hard"
        assert job.config(job.after_episodes[-1]).environment["difficulty"] == difficulty


@pytest.mark.parametrize("name", TRAINED_BY)
def test_sweep_evaluates_the_policies_of_its_study(name, tmp_path):
    sweep, trained = load_study(study_path(name)), load_study(study_path(TRAINED_BY[name]))
    learned = [name for name, method in sweep.methods.items() if method.policy == LEARNED]
    assert learned
    for method in learned:
        for seed in sweep.methods[method].seeds or sweep.seeds:
            assert seed in trained.seeds
            jobs = [Job(study, method, seed, tmp_path) for study in (sweep, trained)]
            folders, configs = zip(
                *((job.folder.path, job.config(job.after_episodes[-1])) for job in jobs), strict=True
            )
            assert folders[0] == folders[1]
            assert configs[0] == configs[1]


@pytest.mark.parametrize("name", SWEEPS)
def test_sweep_is_monotonic(name):
    for sweep in load_study(study_path(name)).sweeps:
        values = list(sweep.at)
        assert values in (sorted(values), sorted(values, reverse=True))


def pouring_observation(tip, error=(0.0, 0.0), state=1.0, tilt=0.0):
    """Return an observation of the pouring task from positions [m] and a tilt [rad]."""
    values = [*(POSITION_SCALE * np.array(tip)), -tilt, 0.0, 0.0, *(np.array(error) / MAX_MUG_ERROR), state]
    return np.array(values)


def test_aimed_policy_aims_before_tilting():
    np.testing.assert_array_equal(scripted_pour_aimed(pouring_observation((0.05, -0.2, 0.06)))[[0, 2]], [-1.0, 0.0])
    assert scripted_pour_aimed(pouring_observation((0.0, -0.045, 0.06)))[2] == 1.0
    tilted = pouring_observation((0.05, -0.2, 0.06), tilt=np.deg2rad(100))
    assert scripted_pour_aimed(tilted)[2] == 1.0  # the balls already roll, so tilting back would not help


def test_blind_policy_ignores_the_displacement_of_the_mug():
    """The blind policy acts like the aimed policy for a mug at the estimated position."""
    for state in (-1.0, 0.0, 1.0):
        blind = scripted_pour_blind(pouring_observation((0.01 + 0.04, -0.1 - 0.02, 0.06), (0.04, -0.02), state))
        np.testing.assert_allclose(
            blind, scripted_pour_aimed(pouring_observation((0.01, -0.1, 0.06), state=state)), atol=1e-9
        )
