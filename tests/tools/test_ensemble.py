"""Ensembles: mean action of several networks, and their disagreement."""

import json

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.policy import Ensemble, Policy


def policy(seed, size=3, **description):
    rng = np.random.default_rng(seed)
    shapes = (5, size), (2, 5)
    layers = [
        (rng.normal(size=shape).astype(np.float32), rng.normal(size=shape[0]).astype(np.float32)) for shape in shapes
    ]
    about = {"observation_shape": [size], "action_low": [-1.0, -1.0], "action_high": [1.0, 1.0], **description}
    return Policy(layers, about)


def test_ensemble_acts_with_the_mean_and_is_stored(tmp_path):
    members = [policy(0), policy(1, activation="tanh"), policy(2)]
    Ensemble(members).save(tmp_path)
    loaded = Policy.load(tmp_path)
    assert isinstance(loaded, Ensemble)
    observation = np.array([0.1, -0.2, 0.3], np.float32)
    actions = np.stack([member(observation) for member in members])
    np.testing.assert_array_equal(loaded(observation), actions.mean(axis=0))
    assert loaded.disagreement(observation) == pytest.approx(np.std(actions, axis=0).mean())
    assert Ensemble([members[0]] * 2).disagreement(observation) == 0.0
    with pytest.raises(InputError, match="several networks"):
        _ = loaded.layers


def test_damaged_ensembles_are_refused(tmp_path):
    Ensemble([policy(0), policy(1)]).save(tmp_path)
    file = tmp_path / "policy.json"
    values = json.loads(file.read_text())
    for changed in ([], values["members"][:1], [*values["members"], values["members"][0]], 3):
        file.write_text(json.dumps(values | {"members": changed}))
        with pytest.raises(InputError, match="is damaged"):
            Policy.load(tmp_path)


SEARCH = {"time": 0, "height": 2, "above": -0.1, "after": 0.25, "amplitude": 1.5, "cycles": [4.0, 3.0]}


def test_search_moves_a_workpiece_that_stays_on_the_rim(tmp_path):
    members = [policy(0), policy(1)]
    Ensemble(members, {**members[0].description, "search": SEARCH}).save(tmp_path)
    loaded, mean = Policy.load(tmp_path), Ensemble(members)
    for time, height, searches in ((-0.6, 0.3, False), (0.1, -0.2, False), (0.1, 0.3, True)):
        observation = np.array([time, 0.0, height], np.float32)
        angles = np.pi * (np.float64(np.float32(time)) + 1.0) * np.array([4.0, 3.0])
        moved = 1.5 * np.array([np.sin(angles[0]), np.cos(angles[1])]) * searches
        np.testing.assert_allclose(loaded(observation), np.clip(mean(observation) + moved, -1.0, 1.0), atol=1e-6)


@pytest.mark.parametrize(
    "changed",
    [
        {"time": 3}, {"height": -1}, {"time": 0.0}, {"amplitude": float("nan")}, {"cycles": [1.0]}, {"unknown": 1},
        {"after": "0.3"},
    ],
)  # fmt: skip
def test_searches_that_do_not_fit_are_refused(tmp_path, changed):
    members = [policy(0), policy(1)]
    with pytest.raises((ValueError, TypeError)):
        Ensemble(members, {**members[0].description, "search": {**SEARCH, **changed}})
