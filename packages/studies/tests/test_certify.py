import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.tasks.narrow_passage import NarrowPassage, reference_trajectory
from guiderail.models.common.errors import InputError
from guiderail_studies.certificate.adversary import Adversary
from guiderail_studies.certify import _declared_start, _find_subject, certify_skill, verify_certificate

COARSE = {"control_period": 0.16}  # 50 steps instead of 400, because the time of a certificate grows with them


@pytest.fixture
def unchecked(monkeypatch):
    """Leave out the checker, a process that takes a second, where another test has its verdict."""
    monkeypatch.setattr("guiderail_studies.certify._run_checker", lambda *_: "yes")


def test_certify_skill_writes_an_accepted_certificate(tmp_path):
    result = certify_skill("NarrowPassage", COARSE | {"guidance": "kgrl"}, out=tmp_path, attack=2000)
    assert result["checker"] == "yes"
    assert result["always_upper"][0] <= result["while_free_upper"][0]
    assert result["steps"] >= result["constrained_steps"]
    assert json.loads((tmp_path / "certificate.json").read_text())["assumes"]
    rows = result["attack"]
    assert result["attack_steps"] >= 2000
    assert {row["quantity"] for row in rows} == {"pose", "speed", "acceleration"}
    assert all(row["violations"] == 0 for row in rows)
    assert all(row["ratio"] < 1.2 for row in rows if row["constraint"] == "never active")
    assert (tmp_path / "attack.csv").exists()


def test_verification_compares_a_certificate_with_its_skill(tmp_path, monkeypatch):
    monkeypatch.setattr("guiderail_studies.certify.SEARCH_STEPS", 800)
    key = tmp_path / "key"
    key.write_bytes(bytes(range(32)))
    environment, folder = COARSE | {"guidance": "skgrl"}, tmp_path / "certificate"
    assert certify_skill("NarrowPassage", environment, out=folder, key=key)["checker"] == "yes"
    assert verify_certificate("NarrowPassage", environment, folder, key=key)["checker"] == "yes"
    key.write_bytes(bytes(32))
    assert "signature is missing" in verify_certificate("NarrowPassage", environment, folder, key=key)["checker"]
    monkeypatch.setattr("guiderail_studies.certify._run_checker", lambda *_: "yes")  # the checker takes seconds
    for name, value in {"action_scale": 2.0, "guidance": "kgrl"}.items():
        verdict = verify_certificate("NarrowPassage", environment | {name: value}, folder)["checker"]
        assert verdict == f"no: the certificate's {name} is not that of NarrowPassage"
    assert "'s start_within" in verify_certificate("NarrowPassage", environment, folder, start_within=0.5)["checker"]
    for excess in (9.0, np.nan):
        needed = SimpleNamespace(excess=np.full((2, 2), excess), residue=np.zeros((2, 2)))
        monkeypatch.setattr("guiderail_studies.certify._search_budget", lambda loop, needed=needed: needed)
        assert "'s budget of excess" in verify_certificate("NarrowPassage", environment, folder)["checker"]
    with pytest.raises(InputError, match="name the folder of a certificate"):
        verify_certificate("NarrowPassage", environment, tmp_path)
    key.write_bytes(b"short")
    with pytest.raises(InputError, match="at least 16 bytes"):
        certify_skill("NarrowPassage", environment, out=folder, key=key)
    with pytest.raises(InputError, match="can't be read"):
        certify_skill("NarrowPassage", environment, out=folder, key=tmp_path / "none")


def test_certify_skill_accepts_demonstrations_alone(tmp_path, monkeypatch):
    """A NaN in the command of an attack violates a bound."""
    attack = Adversary.attack

    def attack_with_nan(adversary, steps):
        result = attack(adversary, steps)
        result.largest["pose"][3, 0] = np.nan
        return result

    monkeypatch.setattr(Adversary, "attack", attack_with_nan)
    result = certify_skill("NarrowPassage", COARSE | {"guidance": "kmp"}, out=tmp_path, attack=200)
    assert (result["checker"], result["constrained_steps"]) == ("yes", 0)
    assert sum(row["violations"] for row in result["attack"]) == 1


@pytest.mark.parametrize(
    ("subject", "environment", "message"),
    [
        ("NarrowPassage", {"guidance": "residual"}, "cannot be certified"),
        ("NarrowPassage", {"guidance": "skgrl", "history.adaptive": True}, "of fixed length"),
        ("Pouring", {}, "cannot be certified"),
        ("nowhere", {}, "no task"),
    ],
)
def test_certify_skill_refuses_other_guidance(tmp_path, subject, environment, message):
    with pytest.raises(InputError, match=message):
        certify_skill(subject, environment, out=tmp_path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [({"start_within": -1.0}, "not negative"), ({"attack": -1}, "number of steps"), ({"out": None}, "--out")],
)
def test_certify_skill_refuses_invalid_arguments(arguments, message, tmp_path):
    with pytest.raises(InputError, match=message):
        certify_skill("NarrowPassage", {"guidance": "kgrl"}, **{"out": tmp_path, **arguments})


def test_held_out_episodes_stay_in_the_bounds(tmp_path, monkeypatch):
    """Robot and history of sKGRL begin with an offset from the demonstrations."""
    monkeypatch.setattr("guiderail_studies.certify.SEARCH_STEPS", 3_000)
    environment = COARSE | {"guidance": "skgrl", "difficulty": "hard"}
    result = certify_skill("NarrowPassage", environment, out=tmp_path)
    assert result["checker"] == "yes"
    assert result["start_within"] == pytest.approx([0.12, 0.12])
    certificate = json.loads((tmp_path / "certificate.json").read_text())
    env = make_env("NarrowPassage", **environment)
    for seed in (1352, 8387, *range(1_000_000, 1_000_004)):  # the first two start offsets are clipped to their limit
        env.reset(seed=seed, options={"held_out": True})
        while not any(env.step(np.zeros(2))[2:4]):
            pass
        y, period = env.trace.commanded, env.diagram.control_period
        for regime in ("free", "budgeted"):
            bounds = {name: np.array(certificate[regime][name])[: len(y)] for name in ("lower", "upper", "speed")}
            assert (y >= bounds["lower"] - 1e-7).all()
            assert (y <= bounds["upper"] + 1e-7).all()
            assert (np.abs(np.diff(y, axis=0)) / period <= bounds["speed"][1:] + 1e-6).all()
    env.close()


def declared_start(task, **environment):
    """Return the start offset of a certificate for a task."""
    config = EnvConfig.resolve(task, environment)
    return _declared_start(config, config.reference().num_outputs)


def test_declared_start_adds_pose_bias_and_start_offset():
    assert not declared_start("BncConnector").any()
    np.testing.assert_allclose(declared_start("NarrowPassage", guidance="skgrl"), [0.04, 0.04])
    np.testing.assert_allclose(declared_start("BncConnector", start_offset_max=0.002), np.full(6, 0.002))
    np.testing.assert_allclose(
        declared_start("BncConnector", sensing={"pose_bias": 0.001}), [1e-3, 1e-3, 1e-3, 0.0, 0.0, 0.0]
    )
    combined = declared_start("BncConnector", sensing={"pose_bias": 0.001}, start_offset_max=0.002)
    np.testing.assert_allclose(combined, [3e-3, 3e-3, 3e-3, 2e-3, 2e-3, 2e-3])


@pytest.mark.parametrize(
    "options",
    [{"sensing.pose_bias": 1e-3}, {"start_offset_max": 1e-3}, {"sensing.pose_bias": 5e-4, "start_offset_max": 1e-3}],
)
def test_history_begins_within_the_declared_offset(options):
    env = make_env("BncConnector", guidance="skgrl", **options)
    within = declared_start("BncConnector", **options)
    declared = env.diagram.task
    start = declared.constraints().nearest(declared.reference().means[0])
    farthest = np.zeros(6)
    for seed in range(20):
        env.reset(seed=seed, options={"held_out": True})
        history = env.diagram.diagram.GetSubsystemByName("guidance").GetSubsystemByName("history")
        context = history.GetMyContextFromRoot(env.simulator.get_context())
        offset = history.get_history_output_port().Eval(context).reshape(-1, 6) - start
        farthest = np.maximum(farthest, np.abs(offset).max(axis=0))
    env.close()
    assert (farthest <= within + 1e-9).all()
    assert (farthest[:2] > 0.5 * within[:2]).all()


def test_declared_start_refuses_the_wrong_number_of_outputs(monkeypatch, tmp_path):
    prior = NarrowPassage.prior
    monkeypatch.setattr(NarrowPassage, "prior", lambda self: replace(prior(self), start_within=[0.1, 0.1, 0.1]))
    with pytest.raises(InputError, match="start_within of NarrowPassage must return a number or 2 numbers"):
        certify_skill("NarrowPassage", {"guidance": "kgrl"}, out=tmp_path)


def test_via_points_move_the_motion_but_not_its_start(tmp_path, unchecked):
    """A reset starts at the demonstrations, not at a via-point of the first step."""
    via = [0.0, 0.36, 0.1]
    certify_skill("NarrowPassage", COARSE | {"guidance": "kgrl", "via_points": via}, out=tmp_path)
    with np.load(tmp_path / "primitive.npz") as primitive:
        assert np.abs(primitive["means"][0] - via[1:]).max() < 0.01
        np.testing.assert_array_equal(primitive["start"], reference_trajectory().means[0])


def test_pretrained_policy_is_certified_like_a_run():
    task, environment, about = _find_subject("pretrained:passage", {})
    assert (task, environment["guidance"], set(about)) == ("NarrowPassage", "skgrl", {"task", "config.yaml"})
    with pytest.raises(InputError, match="or of pretrained:NAME needs a folder"):
        certify_skill("pretrained:passage", {})
