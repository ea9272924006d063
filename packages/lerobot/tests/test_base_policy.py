"""Base policies: accepted results, the window of their chunks, and their sources."""

import numpy as np
import pytest
import torch
from onnx_file import linear_policy

from guiderail.models.common.errors import InputError
from guiderail.models.policy import FORMAT, Policy
from guiderail.tools.environments import check_environment, task_content
from guiderail.tools.imports import trust_imports
from guiderail_lerobot.base_policy import BASE_POLICIES, chunk_samples, find_base_policy, mean_and_variance


def make_chunk_policy(ensemble=2, points=3, outputs=2, seed=0):
    size, random = ensemble * points * outputs, np.random.default_rng(seed)
    layers = [(random.normal(size=(size, 4)).astype(np.float32), np.zeros(size, np.float32))]
    description = {"observation_shape": [4], "action_low": [-9.0] * size, "action_high": [9.0] * size}
    return Policy(layers, description | {"format": FORMAT, "squash": "clip", "chunk": [ensemble, points, outputs]})


def test_chunk_samples_accepts_arrays_with_and_without_batch():
    chunks = np.arange(12.0).reshape(2, 3, 2)
    for returned in (chunks, chunks[None], chunks.tolist()):
        assert (chunk_samples(lambda observation, returned=returned: returned, np.zeros(4), 2) == chunks).all()
    for returned in (chunks[0], chunks[0].ravel()):
        assert (chunk_samples(lambda observation, returned=returned: returned, np.zeros(4), 2) == chunks[:1]).all()


@pytest.mark.parametrize(
    "returned", [np.zeros((3, 3)), np.zeros(5), np.full((1, 3, 2), np.nan), np.zeros((0, 3, 2)), 1.0]
)
def test_chunk_samples_refuses_arrays_that_are_no_chunks(returned):
    with pytest.raises(ValueError, match="finite chunks"):
        chunk_samples(lambda observation: returned, np.zeros(4), 2)


def test_window_repeats_the_last_point_of_a_short_chunk():
    samples = np.arange(12.0).reshape(2, 3, 2)
    mean, variance = mean_and_variance(samples, 5)
    assert (mean == samples.mean(axis=0)[[0, 1, 2, 2, 2]]).all()
    assert np.allclose(variance, 18.0)  # the two samples differ by 6
    assert (mean_and_variance(samples[:1], 2)[1] == 0.0).all()


def test_find_base_policy_loads_the_folder_of_a_chunk_policy(tmp_path):
    policy, observation = make_chunk_policy(), np.ones(4, np.float32)
    policy.save(tmp_path)
    samples = chunk_samples(find_base_policy(str(tmp_path)), observation, 2)
    assert samples.shape == (2, 3, 2)
    assert (samples.ravel() == policy(observation)).all()


def test_find_base_policy_refuses_a_policy_without_chunks(tmp_path):
    policy = make_chunk_policy()
    del policy.description["chunk"]
    policy.save(tmp_path)
    with pytest.raises(InputError, match="predicts no chunks"):
        find_base_policy(str(tmp_path))
    with pytest.raises(InputError, match="no base policy"):
        find_base_policy("nothing")


def test_find_base_policy_returns_a_registered_function(monkeypatch):
    monkeypatch.setattr(BASE_POLICIES, "_entries", {})
    monkeypatch.setattr(BASE_POLICIES, "_origins", {})
    function = BASE_POLICIES.register("rest", lambda observation: np.zeros((1, 2, 6)))
    assert find_base_policy("rest") is function


class Script(torch.nn.Module):
    """Network that returns the first two entries of the observation."""

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return observation[:, :2]


@pytest.fixture
def base_policies(monkeypatch):
    monkeypatch.setattr(BASE_POLICIES, "_entries", {})
    monkeypatch.setattr(BASE_POLICIES, "_origins", {})
    return BASE_POLICIES


def test_base_policy_of_a_file_needs_trust_when_executable(tmp_path, monkeypatch, base_policies):
    (tmp_path / "policy.onnx").write_bytes(linear_policy(np.zeros((3, 4), np.float32), np.zeros(4, np.float32), 1))
    torch.jit.trace(Script(), torch.zeros(1, 3)).save(tmp_path / "policy.pt")
    (tmp_path / "lab_base.py").write_text("raise RuntimeError\n")
    monkeypatch.chdir(tmp_path)
    environment = {"guidance": "kgrl_base_policy", "base_policy": "policy.onnx"}
    resolved = check_environment("NarrowPassage", environment)["base_policy"]
    assert resolved == str(tmp_path / "policy.onnx")
    assert chunk_samples(find_base_policy(resolved), np.zeros(3, np.float32), 2).shape == (1, 2, 2)
    for source in ("policy.pt", "lab_base.py:chunk"):
        with pytest.raises(InputError, match="give --trust-imports"):
            check_environment("NarrowPassage", environment | {"base_policy": source})
    with trust_imports():
        check_environment("NarrowPassage", environment | {"base_policy": "policy.pt"})
    assert str(tmp_path / "policy.pt") in base_policies.names()


def test_base_policy_of_a_function_is_stored_with_path_and_code(tmp_path, monkeypatch, base_policies):
    file = tmp_path / "lab_chunk.py"
    file.write_text("import numpy as np\ndef chunk(observation):\n    return np.zeros((1, 2, 2))\n")
    monkeypatch.chdir(tmp_path)
    with trust_imports():
        environment = check_environment(
            "NarrowPassage", {"guidance": "kgrl_base_policy", "base_policy": "lab_chunk.py:chunk"}
        )
    assert environment["base_policy"] == f"{file}:chunk"
    before = task_content("NarrowPassage", environment, ())
    file.write_text(file.read_text().replace("zeros", "ones"))
    assert task_content("NarrowPassage", environment, ()) != before


def test_registration_refuses_an_object_that_is_not_callable():
    with pytest.raises(InputError, match="registered with a function or a class, not with 3"):
        BASE_POLICIES.register("lab", 3)
    assert "lab" not in BASE_POLICIES.names()
