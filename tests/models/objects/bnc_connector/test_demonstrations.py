import os
from dataclasses import replace

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import MM
from guiderail.models.objects.bnc_connector import demonstrations
from guiderail.models.objects.bnc_connector.demonstrations import NUM_DEMONSTRATIONS, NUM_STEPS, demonstrator_motions
from research.generate import bnc_connector as generator
from research.generate.bnc_connector import TIMES as TIMES_RECORDED
from research.generate.bnc_connector import record_one

TIMES = 0.02 * np.arange(NUM_STEPS)


def test_load_returns_five_times_400_poses():
    loaded = demonstrations.load()
    assert loaded.num_demonstrations == NUM_DEMONSTRATIONS
    assert all(output.shape == (NUM_STEPS, 6) for output in loaded.outputs)
    assert loaded.names == demonstrations.NAMES
    np.testing.assert_allclose(loaded.times[0], TIMES, atol=1e-9)


def test_file_holds_measured_poses_and_wrenches():
    everything = np.load(demonstrations.PATH)
    shape = (NUM_DEMONSTRATIONS, NUM_STEPS)
    assert everything["measured"].shape == everything["wrench"].shape == (*shape, 6)
    assert everything["contact_force"].shape == shape
    assert "locked plug" in str(everything["frame"])


def test_demonstrations_end_locked():
    """The measured poses end at the locked frame's origin."""
    final = np.load(demonstrations.PATH)["measured"][:, -1]
    assert np.abs(final[:, 2]).max() < 0.6 * MM
    assert np.abs(np.rad2deg(final[:, 3])).max() < 4.0


def test_push_is_the_difference_of_command_and_measurement():
    """While the plug is turned, the stiffness times commanded minus measured is the force along z."""
    everything = np.load(demonstrations.PATH)
    turning = slice(260, 320)
    command, measured = everything["outputs"][:, turning, 2], everything["measured"][:, turning, 2]
    push = everything["stiffness"][2] * (measured - command)
    assert push.mean() > 8.0
    np.testing.assert_allclose(push.mean(), everything["wrench"][:, turning, 2].mean(), rtol=0.1)


def test_deviations_are_wide_at_the_rim_and_small_when_seated():
    outputs = np.stack(demonstrations.load().outputs)
    spread = outputs.std(axis=0)[:, :2].mean(axis=1)
    assert spread[80:170].mean() > 4.0 * spread[240:].mean()


def test_motions_differ_and_repeat_with_a_seed():
    session, second, other = (demonstrator_motions(seed, TIMES) for seed in (0, 0, 1))
    np.testing.assert_array_equal(session, second)
    assert np.abs(session[0] - session[1])[:, :2].max() > 0.5 * MM
    assert np.abs(session[0] - other[0])[:, :2].max() > 0.5 * MM


def test_mean_of_the_motions_has_no_search_offset():
    """The mean of the demonstrations leads to the expected position of the jack without a search."""
    mean = np.mean(demonstrations.load().outputs, axis=0)
    assert np.abs(mean[:, :2]).max() < 0.3 * MM


def test_recording_again_reproduces_the_file():
    """Rounding may differ between machines, and contact amplifies it."""
    everything = np.load(demonstrations.PATH)
    recording, is_locked = record_one(demonstrator_motions(int(everything["seed"]), TIMES_RECORDED)[0])
    assert is_locked
    np.testing.assert_allclose(recording["desired_pose"], everything["outputs"][0], atol=1e-9)
    np.testing.assert_allclose(recording["pose"][:60], everything["measured"][0, :60], atol=1e-6)
    np.testing.assert_allclose(recording["pose"][-1, :3], everything["measured"][0, -1, :3], atol=0.1 * MM)


def test_shipped_file_is_kept_when_writing_is_interrupted(tmp_path, monkeypatch):
    def fail(*_):
        raise OSError(28, "No space left on device")

    session = replace(generator.INSERT_SESSION, path=tmp_path / "session.npz")
    monkeypatch.setattr(generator, "record", lambda *_: {"times": np.arange(3.0)})
    generator.main(session=session)
    monkeypatch.setattr(generator, "record", lambda *_: {"times": np.arange(9.0)})
    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(InputError, match="cannot be written"):
        generator.main(session=session)
    np.testing.assert_array_equal(np.load(session.path)["times"], np.arange(3.0))
