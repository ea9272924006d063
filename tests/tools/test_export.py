"""Export of skills: the ONNX file computes the policy's actions, and a loop without an environment its commands."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import onnxruntime
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.models.primitives import (
    LcNsKmp,
    LinearConstraints,
    PrimitiveStepper,
    ReferenceTrajectory,
    SquaredExponential,
)
from guiderail.tools.cli.main import main
from guiderail.tools.environments import make_environment
from guiderail.tools.export import export_skill, policy_to_onnx
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.pretrained import find_run


@settings(deadline=None, max_examples=40)
@given(
    sizes=st.lists(st.integers(1, 9), min_size=2, max_size=5),
    activation=st.sampled_from(["relu", "normalized_relu", "tanh"]),
    squash=st.sampled_from(["tanh", "clip"]),
    seed=st.integers(0, 1000),
)
def test_onnx_computes_the_actions_of_the_policy(sizes, activation, squash, seed):
    rng = np.random.default_rng(seed)
    layers = [
        (rng.normal(size=(after, before)).astype(np.float32), rng.normal(size=after).astype(np.float32))
        for before, after in pairwise(sizes)
    ]
    low = rng.normal(size=sizes[-1])
    description = {
        "observation_shape": [sizes[0]], "activation": activation, "squash": squash,
        "action_low": low.tolist(), "action_high": (low + rng.uniform(0.5, 2.0, sizes[-1])).tolist(),
    }  # fmt: skip
    policy = Policy(layers, description)
    session = onnxruntime.InferenceSession(policy_to_onnx(policy), providers=["CPUExecutionProvider"])
    for observation in rng.normal(size=(3, sizes[0])).astype(np.float32):
        (action,) = session.run(None, {"observation": observation[None]})
        np.testing.assert_allclose(action[0], policy(observation), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", ["connector", "passage"])
def test_exported_skill_acts_as_in_its_environment(name, tmp_path):
    export_skill(f"pretrained:{name}", tmp_path / "skill")
    skill = json.loads((tmp_path / "skill/skill.json").read_text())
    config = RunFolder(find_run(f"pretrained:{name}")).config()
    env = make_environment(config.task, config.environment)
    session = onnxruntime.InferenceSession(tmp_path / "skill/policy.onnx", providers=["CPUExecutionProvider"])
    data, settings = np.load(tmp_path / "skill/primitive.npz"), skill["primitive"]
    primitive = LcNsKmp(
        ReferenceTrajectory(data["times"], data["means"], data["covariances"]),
        kernel=SquaredExponential(length_scale=settings["length_scale"]),
        constraints=LinearConstraints(data["G"], data["c"]),
        **{key: settings[key] for key in ("lambda_", "beta", "horizon", "history", "history_variance")},
    )
    policy = Policy.load(find_run(f"pretrained:{name}"))
    observation, _ = env.reset(seed=1_000_000)
    assert len(skill["observation"]) == len(observation)
    simulator = env.unwrapped.simulator
    station = simulator.get_system().GetSubsystemByName("station")
    pose = station.GetOutputPort("pose").Eval(station.GetMyContextFromRoot(simulator.get_context()))
    stepper = PrimitiveStepper(primitive, pose, data["gains"])
    outputs = [entry["output"] for entry in skill["action"]]
    for _ in range(3):
        (row,) = session.run(None, {"observation": observation[None].astype(np.float32)})
        np.testing.assert_allclose(row[0], policy(observation), rtol=1e-4, atol=1e-5)
        null_space_action = np.zeros(primitive.num_outputs)
        null_space_action[outputs] = row[0]
        commands = [stepper.step(null_space_action).output for _ in range(skill["action_repeat"])]
        observation, _, terminated, truncated, _ = env.step(row[0])
        assert (terminated, truncated) == (False, False)
        np.testing.assert_allclose(env.unwrapped.trace.commanded[-len(commands) :], commands, atol=1e-6)
    env.close()


def test_export_is_refused_in_one_sentence(tmp_path, capsys):
    (tmp_path / "full").mkdir()
    for arguments, message in (
        (["pretrained:passage", "--out", str(tmp_path / "full")], "already exists"),
        (["pretrained:passage", "--target", "onx", "--out", str(tmp_path / "new")], "did you mean onnx?"),
        (["pretrained:pouring", "--out", str(tmp_path / "new")], "the guidance of a run to export is kgrl or skgrl"),
    ):
        with pytest.raises(SystemExit) as end:
            main(["export", *arguments])
        assert end.value.code == 2
        assert message in capsys.readouterr().err
    image = Policy.__new__(Policy)
    image._layers, image.description = [], {"observation_shape": [8, 8, 3]}
    with pytest.raises(InputError, match="observes images"):
        policy_to_onnx(image)


@pytest.mark.parametrize(
    ("option", "value"), [("kernel", "matern52"), ("history_source", "measured"), ("adaptive_history", True)]
)
def test_export_refuses_options_that_its_loop_lacks(option, value, tmp_path, monkeypatch):
    config = RunFolder(find_run("pretrained:passage")).config()
    config = replace(config, environment={**config.environment, option: value})
    monkeypatch.setattr(RunFolder, "config", lambda self: config)
    with pytest.raises(InputError, match=f"{option}={value} cannot be exported"):
        export_skill("pretrained:passage", tmp_path / "out")


def test_target_of_missing_sibling_names_the_line_that_installs_it(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("guiderail.tools.cli.export.find_plugins", lambda kind: iter(()))
    with pytest.raises(SystemExit) as ended:
        main(["export", "pretrained:connector", "--target", "cpp", "--out", str(tmp_path / "skill")])
    line = 'guiderail export --target cpp needs guiderail-cpp, which is not installed: pip install "guiderail[cpp]"'
    assert (ended.value.code, capsys.readouterr().err) == (2, f"guiderail: {line}\n")
