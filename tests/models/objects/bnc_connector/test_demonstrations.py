"""Demonstrations of the BNC connector: shipped files, their covariances, and recording again."""

import numpy as np
import pytest

from guiderail.diagrams.tasks.bnc_connector import reference_trajectory
from guiderail.models.common.transforms import MM
from guiderail.models.objects.bnc_connector import demonstrations
from guiderail.models.objects.bnc_connector.demonstrations import NUM_DEMONSTRATIONS, NUM_STEPS
from research.generate import bnc_connector as generator
from research.generate.bnc_connector import TIMES as TIMES_RECORDED
from research.generate.bnc_connector import record_one

TIMES = 0.02 * np.arange(NUM_STEPS)


@pytest.mark.parametrize("path", [demonstrations.PATH, demonstrations.SEARCH_PATH], ids=["insertion", "search"])
def test_demonstrations_end_locked(path):
    measured = np.load(path)["measured"]
    assert measured.shape == (NUM_DEMONSTRATIONS, NUM_STEPS, 6)
    assert np.abs(measured[:, -1, 2]).max() < 0.6 * MM
    assert np.abs(np.rad2deg(measured[:, -1, 3])).max() < 4.0


def test_stiffness_times_pose_error_is_the_measured_force():
    """While the plug turns, the force along z is the stiffness times the difference of measured and commanded pose."""
    arrays = np.load(demonstrations.PATH)
    turning = slice(260, 320)
    command, measured = arrays["outputs"][:, turning, 2], arrays["measured"][:, turning, 2]
    force = arrays["stiffness"][2] * (measured - command)
    assert force.mean() > 8.0  # [N]
    np.testing.assert_allclose(force.mean(), arrays["wrench"][:, turning, 2].mean(), rtol=0.1)


def test_motions_differ_and_repeat_with_a_seed():
    motions, again, different = (generator.demonstrator_motions(seed, TIMES) for seed in (0, 0, 1))
    np.testing.assert_array_equal(motions, again)
    assert np.abs(motions[0] - motions[1])[:, :2].max() > 0.5 * MM
    assert np.abs(motions[0] - different[0])[:, :2].max() > 0.5 * MM


SEARCHING = slice(0, round(demonstrations.SEARCH[1] / 0.02))  # steps until the end of the search


def test_covariance_is_isotropic_until_the_plug_drops_in():
    reference = reference_trajectory("search")
    deviations = reference.standard_deviations[SEARCHING, :2]
    assert deviations.max() < 1.15 * deviations.min()
    correlation = reference.covariances[SEARCHING, 0, 1] / deviations.prod(axis=1)
    assert np.abs(correlation).max() < 0.15
    assert np.abs(reference.means[SEARCHING, :2]).max() < 0.4 * MM


def test_firm_search_commands_a_deeper_pose_than_a_light_search():
    searching = slice(round(demonstrations.SEARCH[0] / 0.02), SEARCHING.stop)
    light, firm = (reference_trajectory(name).means[searching, 2] for name in ("search", "firm_search"))
    assert np.abs(light - firm).mean() == pytest.approx(generator.FIRM_PUSH - generator.LIGHT_PUSH, abs=0.7 * MM)
    with np.load(demonstrations.FIRM_SEARCH_PATH, allow_pickle=False) as file:
        assert file["contact_force"].max() < 15.0  # [N], the force bound of the task


def test_record_one_reproduces_the_shipped_file():
    """The tolerance of the last pose is larger, because contact amplifies rounding, which differs between machines."""
    session = generator.INSERT_SESSION
    with np.load(session.path, allow_pickle=False) as file:
        arrays = dict(file)
    recording, is_locked = record_one(session.motions(int(arrays["seed"]), TIMES_RECORDED)[0], session.station)
    assert is_locked
    np.testing.assert_allclose(recording["desired_pose"], arrays["outputs"][0], atol=1e-9)
    np.testing.assert_allclose(recording["pose"][:60], arrays["measured"][0, :60], atol=1e-6)
    np.testing.assert_allclose(recording["pose"][-1, :3], arrays["measured"][0, -1, :3], atol=0.1 * MM)
