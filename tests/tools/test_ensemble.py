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
