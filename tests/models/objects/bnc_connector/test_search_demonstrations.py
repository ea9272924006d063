"""Demonstrations with a search."""

import numpy as np
import pytest

from guiderail.diagrams.tasks.bnc_connector.task import reference_trajectory
from guiderail.models.common.transforms import MM
from guiderail.models.objects.bnc_connector import search_demonstrations as bnc_search
from guiderail.models.objects.bnc_connector.demonstrations import NUM_DEMONSTRATIONS, NUM_STEPS
from research.generate.bnc_connector import FIRM_SEARCH_SESSION, SEARCH_SESSION, TIMES, record_one

SEARCHING = slice(0, round(bnc_search.SEARCH[1] / 0.02))


def test_load_returns_five_times_400_poses_that_end_locked():
    with np.load(bnc_search.PATH, allow_pickle=False) as file:
        measured = file["measured"]
    assert measured.shape == (NUM_DEMONSTRATIONS, NUM_STEPS, 6)
    assert np.abs(measured[:, -1, 2]).max() < 0.6 * MM
    assert np.abs(np.rad2deg(measured[:, -1, 3])).max() < 4.0


def test_covariance_is_isotropic_until_the_plug_drops_in():
    reference = reference_trajectory("search")
    deviations = reference.standard_deviations[SEARCHING, :2]
    assert deviations.max() < 1.15 * deviations.min()
    correlation = reference.covariances[SEARCHING, 0, 1] / deviations.prod(axis=1)
    assert np.abs(correlation).max() < 0.15
    assert np.abs(reference.means[SEARCHING, :2]).max() < 0.4 * MM


def test_deviations_are_small_after_the_insertion():
    reference = reference_trajectory("search")
    seated = slice(round((bnc_search.IN_BY + 0.4) / 0.02), NUM_STEPS)
    assert reference.standard_deviations[seated, :2].max() < 0.3 * MM


def test_firm_search_commands_four_times_the_depth():
    searching = slice(round(bnc_search.SEARCH[0] / 0.02), SEARCHING.stop)
    light, firm = (reference_trajectory(name).means[searching, 2] for name in ("search", "firm_search"))
    assert np.abs(light - firm).mean() == pytest.approx(bnc_search.FIRM_PUSH - bnc_search.SEARCH_PUSH, abs=0.7 * MM)
    with np.load(bnc_search.FIRM_PATH, allow_pickle=False) as file:
        assert file["contact_force"].max() < 15.0  # inside the force bound of the task


@pytest.mark.parametrize(
    ("path", "motions", "session"),
    [
        (bnc_search.PATH, bnc_search.demonstrator_motions, SEARCH_SESSION),
        (bnc_search.FIRM_PATH, bnc_search.firm_motions, FIRM_SEARCH_SESSION),
    ],
    ids=["gantry", "arm"],
)
def test_recording_again_reproduces_the_file(path, motions, session):
    with np.load(path, allow_pickle=False) as file:
        everything = dict(file)
    motion = motions(int(everything["seed"]), TIMES)[0]
    recording, is_locked = record_one(motion, session.station)
    assert is_locked
    np.testing.assert_allclose(recording["desired_pose"], everything["outputs"][0], atol=1e-9)
    assert recording["pose"][-1, :3] == pytest.approx(everything["measured"][0, -1, :3], abs=0.1 * MM)
