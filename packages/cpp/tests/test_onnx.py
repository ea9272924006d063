"""Export of skills: the ONNX file computes the policy's actions, and a loop without an environment its commands."""

import importlib.util
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import onnxruntime
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from guiderail.models.common.errors import InputError
from guiderail.models.laws import load_law
from guiderail.models.policy import Policy
from guiderail.tools.cli.main import main
from guiderail.tools.environments import make_environment
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.pretrained import find_run
from guiderail_cpp.onnx import export_onnx, policy_to_onnx
from guiderail_cpp.recording import COMPUTED, record_skill


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


@pytest.fixture(scope="module", params=["connector", "passage"])
def exported(request, tmp_path_factory):
    """Return the name of a pretrained policy, the folder of its export, and the exported loop as a module."""
    folder = tmp_path_factory.mktemp("export") / request.param
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(record_skill, "__defaults__", (2, 0))  # two recorded episodes
        export_onnx(f"pretrained:{request.param}", folder)
    spec = importlib.util.spec_from_file_location("exported_loop", folder / "loop.py")
    loop = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loop)
    return request.param, folder, loop


def test_exported_loop_replays_the_recording(exported):
    _, folder, _ = exported
    result = subprocess.run([sys.executable, folder / "loop.py"], capture_output=True, text=True, check=True)
    assert float(result.stdout.partition(": ")[2].split()[0]) < 1e-6


@pytest.mark.parametrize("exported", ["passage"], indirect=True)
def test_exported_loop_names_the_missing_extra(exported):
    _, folder, _ = exported
    loop = str(folder / "loop.py")
    code = f"import sys, runpy; sys.modules['onnxruntime'] = None; runpy.run_path({loop!r}, run_name='__main__')"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert "guiderail[onnx]" in result.stderr


def test_exported_loop_refuses_measurements_that_are_not_finite(exported):
    _, folder, loop = exported
    skill = loop.Skill()
    skill.start(np.load(folder / "recording.npz")["pose"][0])
    with pytest.raises(ValueError, match="pose and wrench must be finite"):
        skill.step([np.nan] * skill.law.num_outputs, ())


def test_exported_loop_commands_what_the_environment_commands(exported):
    name, _, loop = exported
    config = RunFolder(find_run(f"pretrained:{name}")).config()
    env, policy, skill = (
        make_environment(config.task, config.environment),
        Policy.load(find_run(f"pretrained:{name}")),
        loop.Skill(),
    )
    observation, _ = env.reset(seed=1_000_000)
    simulator = env.unwrapped.simulator
    station = simulator.get_system().GetSubsystemByName("station")
    context = station.GetMyContextFromRoot(simulator.get_context())
    pose = station.GetOutputPort("pose").Eval(context)
    skill.start(pose)
    wrench = np.zeros(6 if name == "connector" else 0)
    for _ in range(3):
        signals = measured_signals(skill, observation)
        observation, _, terminated, truncated, _ = env.step(policy(observation))
        assert (terminated, truncated) == (False, False)
        trace, last = env.unwrapped.trace, -config.action_repeat
        wrenches = trace.signals["wrench"] if len(wrench) else np.zeros((len(trace), 0))
        after = list(zip(trace.measured[last:], wrenches[last:], strict=True))
        commands = [skill.step(*each, **signals) for each in [(pose, wrench), *after[:-1]]]
        np.testing.assert_allclose(commands, trace.commanded[last:], atol=1e-6)
        pose, wrench = after[-1]
    env.close()


def measured_signals(skill, observation):
    """Return the signals of an observation that do not follow from pose, wrench and commands, such as obstacles."""
    signals = {}
    for entry, value in zip(skill.entries, observation, strict=True):
        if entry["signal"] not in (*COMPUTED, "wrench"):
            signals.setdefault(entry["signal"], {})[entry["index"]] = value * entry["scale"] + entry["center"]
    return signals


def test_export_is_refused_in_one_sentence(tmp_path, capsys, monkeypatch):
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
    for image in ({"observation_shape": [8, 8, 3]}, {"observation_shape": [9], "image_shape": [2, 2, 1]}):
        policy = SimpleNamespace(description=image)
        monkeypatch.setattr("guiderail_cpp.skill.Policy.load", lambda _, policy=policy: policy)
        with pytest.raises(InputError, match="observes images"):
            export_onnx("pretrained:passage", tmp_path / "new")


@pytest.mark.parametrize(
    ("option", "value"), [("kernel", "matern52"), ("history.source", "measured"), ("history.adaptive", True)]
)
def test_export_refuses_options_that_its_loop_lacks(option, value, tmp_path, monkeypatch):
    config = RunFolder(find_run("pretrained:passage")).config()
    config = replace(config, environment={**config.environment, option: value})
    monkeypatch.setattr(RunFolder, "config", lambda self: config)
    with pytest.raises(InputError, match=f"{option}={value} cannot be exported"):
        export_onnx("pretrained:passage", tmp_path / "out")


@pytest.mark.parametrize("content", [None, "{", "{}"])
def test_law_is_refused_without_an_exported_skill(content, tmp_path):
    if content is not None:
        (tmp_path / "skill.json").write_text(content)
    with pytest.raises(InputError, match="is no exported skill"):
        load_law(tmp_path)
