"""Export of skills: the ONNX file computes the policy's actions, and a loop without an environment its commands."""

import re
from dataclasses import replace
from itertools import count, pairwise
from pathlib import Path

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
def test_loop_of_the_docs_acts_as_the_environment(name, tmp_path, monkeypatch):
    """The loop without an environment in docs/use.md commands what the environment of the run commands."""
    page = (Path(__file__).parents[3] / "docs/use.md").read_text("utf-8").partition("\n## A skill without")[2]
    (code,) = re.findall(r"```python\n(.*?)```", page.partition("\n## ")[0], re.DOTALL)
    monkeypatch.chdir(tmp_path)
    export_onnx(f"pretrained:{name}", Path("connector"))
    loop: dict = {}
    exec(compile(code, "use.md", "exec"), loop)
    skill, config = loop["skill"], RunFolder(find_run(f"pretrained:{name}")).config()
    env, policy = make_environment(config.task, config.environment), Policy.load(find_run(f"pretrained:{name}"))
    observation, _ = env.reset(seed=1_000_000)
    assert len(skill["observation"]) == len(observation)
    simulator = env.unwrapped.simulator
    station = simulator.get_system().GetSubsystemByName("station")
    pose = station.GetOutputPort("pose").Eval(station.GetMyContextFromRoot(simulator.get_context()))
    commands: list[np.ndarray] = []
    reads = count()

    def read_signals():
        nonlocal observation
        if next(reads) == 0:
            return {"pose": pose}
        if commands:
            observation, _, terminated, truncated, _ = env.step(policy(observation))
            assert (terminated, truncated) == (False, False)
            recent = env.unwrapped.trace.commanded[-skill["action_repeat"] :]
            np.testing.assert_allclose(recent, commands[-skill["action_repeat"] :], atol=1e-6)
        if len(commands) == 3 * skill["action_repeat"]:
            raise KeyboardInterrupt
        signals: dict = {}
        for entry, value in zip(skill["observation"], observation, strict=True):
            signals.setdefault(entry["signal"], {})[entry["index"]] = value * entry["scale"] + entry["center"]
        return signals

    with pytest.raises(KeyboardInterrupt):
        loop["run"](read_signals, commands.append)
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
