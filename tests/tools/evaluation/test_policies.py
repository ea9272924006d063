"""Policies of other packages: Stable-Baselines3, ONNX, TorchScript, functions and objects with `predict`."""

import math
import threading
import zipfile
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from onnx_file import linear_policy
from sb3_contrib import TQC, TRPO, CrossQ, RecurrentPPO
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3

from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.evaluate import evaluate
from guiderail.tools.evaluation.policies import as_policy, check_compatible, is_policy_file, load_policy
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.evaluation.subject import EpisodeSpec
from guiderail.tools.pretrained import find_run

OBSERVATION = np.array([0.1, -0.2, 0.3], np.float32)


@pytest.fixture(scope="module")
def env():
    return make_environment("Bead", {})


@pytest.mark.parametrize("kind", [SAC, TD3, DDPG, PPO, A2C, TQC, TRPO, CrossQ])
def test_zip_of_stable_baselines3_acts_as_the_model(kind, env, tmp_path):
    networks = {"net_arch": [8]}
    model = kind("MlpPolicy", env, policy_kwargs=networks, seed=1, device="cpu")
    model.save(tmp_path / "model")
    act = check_compatible(load_policy(tmp_path / "model.zip", trust_policy=True), env)
    np.testing.assert_array_equal(act(OBSERVATION), model.predict(OBSERVATION, deterministic=True)[0])


def test_zip_is_read_only_with_trust(env, tmp_path, monkeypatch):
    SAC("MlpPolicy", env, policy_kwargs={"net_arch": [4]}, device="cpu").save(tmp_path / "model")
    monkeypatch.setattr(SAC, "load", lambda *_, **options: pytest.fail("the pickle was read"))
    with pytest.raises(InputError, match=r"model.zip is a pickle, .* give --trust-policy if you trust its origin"):
        load_policy(tmp_path / "model.zip")


@pytest.mark.parametrize(
    ("name", "message"),
    [("none.zip", "there is no file"), ("text.zip", "no model of Stable-B"), ("text.pt", "is no TorchScript file"),
     ("text.onnx", "is no ONNX file")],
)  # fmt: skip
def test_damaged_files_are_refused(name, message, tmp_path):
    (tmp_path / f"text{Path(name).suffix}").write_text("text")
    with pytest.raises(InputError, match=message):
        load_policy(tmp_path / name, trust_policy=True)


class Script(torch.nn.Module):
    """Network that doubles the first two entries of the observation."""

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return 2 * observation[:, :2]


def test_torchscript_is_loaded_only_with_trust(env, tmp_path):
    file = tmp_path / "policy.pt"
    torch.jit.trace(Script(), torch.zeros(1, 3)).save(file)
    with pytest.raises(InputError, match="is a program: give --trust-policy"):
        load_policy(file)
    act = load_policy(file, trust_policy=True)
    np.testing.assert_allclose(check_compatible(act, env)(OBSERVATION), [0.2, -0.4])


class Pair(torch.nn.Module):
    """Network that returns two tensors."""

    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return observation, observation


def test_torchscript_that_returns_no_tensor_is_named(tmp_path):
    file = tmp_path / "pair.pt"
    torch.jit.trace(Pair(), torch.zeros(1, 3)).save(file)
    with pytest.raises(InputError, match=r"pair\.pt returns .* instead of a tensor"):
        load_policy(file, trust_policy=True)(OBSERVATION)


def test_damaged_model_of_sb3_is_named(tmp_path):
    file = tmp_path / "damaged.zip"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("data", "x" * 5000)
    content = bytearray(file.read_bytes())
    content[40:50] = bytes(10)
    file.write_bytes(content)
    with pytest.raises(InputError, match="is no model of Stable-Baselines3"):
        load_policy(file, trust_policy=True)


@pytest.mark.parametrize("batch", [1, "batch", None])
def test_onnx_acts_as_its_network(batch, env, tmp_path):
    weight, bias = np.array([[1.0, 2.0], [0.0, 1.0], [-1.0, 0.5]], np.float32), np.array([0.1, -0.1], np.float32)
    file = tmp_path / "policy.onnx"
    file.write_bytes(linear_policy(weight, bias, batch))
    act = check_compatible(load_policy(file), env)
    np.testing.assert_allclose(act(OBSERVATION), np.tanh(OBSERVATION @ weight + bias), rtol=1e-6)
    single, double = (evaluate(file, "Bead", 3, baselines=(), processes=processes) for processes in (1, 2))
    assert single == double


def test_function_of_a_file_is_a_policy(env, tmp_path):
    file = tmp_path / "own_policies.py"
    file.write_text(
        "import numpy as np\n"
        "def act(observation):\n    return -observation[:2]\n"
        "class Model:\n    def predict(self, observation):\n        return np.full(2, 0.5)\n"
        "number = 3\n"
    )
    np.testing.assert_array_equal(load_policy(f"{file}:act")(OBSERVATION), -OBSERVATION[:2])
    np.testing.assert_array_equal(load_policy(f"{file}:Model")(OBSERVATION), [0.5, 0.5])
    for name, message in (("acts", "has no 'acts': did you mean act"), ("number", "3 is no policy")):
        with pytest.raises(InputError, match=message):
            load_policy(f"{file}:{name}")
    with pytest.raises(InputError, match="no module, file"):
        load_policy("no_such_module:act")
    assert evaluate(f"{file}:act", "Bead", 2, baselines=())["episodes"] == 2


@pytest.mark.parametrize(
    ("source", "expected"),
    [("model.zip", True), ("lab.policies:act", True), ("runs/a.py:act", True), ("runs/connector", False),
     ("scripted", False), ("pretrained:connector", False), ("lab/Peg", False)],
)  # fmt: skip
def test_is_policy_file_is_true_for_files_only(source, expected):
    assert is_policy_file(source) is expected


class RecurrentCounter:
    """Recurrent policy that returns the number of its actions in the episode."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        assert deterministic
        count = 0 if episode_start[0] else state + 1
        return np.full(2, count / 100), count


def test_state_of_a_recurrent_policy_is_reset_with_the_episode(env):
    act = as_policy(RecurrentCounter())
    episodes = []
    for _ in range(2):
        steps = rollout(env, act, seed=0)["steps"]
        episodes.append((steps, act._state))
    assert episodes[0] == episodes[1]
    assert episodes[0][1] == math.ceil(episodes[0][0] / env.unwrapped.action_repeat) - 1


def test_recurrent_model_of_sb3_contrib_is_a_policy(env, tmp_path):
    networks = {"net_arch": [4], "lstm_hidden_size": 4}
    RecurrentPPO("MlpLstmPolicy", env, policy_kwargs=networks, seed=0, device="cpu").save(tmp_path / "recurrent")
    act = load_policy(tmp_path / "recurrent.zip", trust_policy=True)
    first = act(OBSERVATION)
    assert not np.array_equal(act(OBSERVATION), first)  # in another state
    act.on_episode_start()
    np.testing.assert_array_equal(act(OBSERVATION), first)


def test_python_model_is_evaluated_in_a_task(env):
    model = SAC("MlpPolicy", env, policy_kwargs={"net_arch": [4]}, seed=0, device="cpu")
    functions = (model, lambda observation: model.predict(observation, deterministic=True)[0])
    first, second = (evaluate(policy, "Bead", 2, baselines=())["mean_return"] for policy in functions)
    assert first == second
    with pytest.raises(InputError, match="is no policy: give the folder of a run"):
        evaluate(3, "Bead", 2)
    with pytest.raises(InputError, match=r"acts in a task: name the task \(--task\)"):
        evaluate(model)


def test_model_with_other_action_bounds_is_refused(env, tmp_path):
    rescaled = gymnasium.wrappers.RescaleAction(env, np.float32(-2.0), np.float32(2.0))
    SAC("MlpPolicy", rescaled, policy_kwargs={"net_arch": [4]}, device="cpu").save(tmp_path / "rescaled")
    message = "actions from -2 to 2, and those of this environment are from -1 to 1: evaluate it through its wrapper"
    with pytest.raises(InputError, match=message):
        check_compatible(load_policy(tmp_path / "rescaled.zip", trust_policy=True), env)


@pytest.mark.parametrize("shape", [(), (3,), (2, 1)])
def test_mismatch_of_the_action_names_the_shape_to_return(shape, env):
    with pytest.raises(InputError, match=r"takes observations \(3,\) .*: it must return an action \(2,\)$"):
        check_compatible(lambda observation: np.zeros(shape), env)


def fail(observation):
    raise ValueError("wrong value")


def fail_in_episode(observation):
    if observation[0] > 0.0:
        raise RuntimeError("wrong state")
    return np.zeros(2)


def exit_program(observation):
    raise SystemExit


class FailingModel:
    """Model whose code has an error."""

    def predict(self, observation):
        raise KeyError("x")


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (fail, r"^the policy fail raised ValueError: wrong value"),
        (fail_in_episode, r"^the policy fail_in_episode raised RuntimeError: wrong state"),
        (exit_program, r"^the policy exit_program raised SystemExit"),
        (lambda: np.zeros(2), r"^the policy raised TypeError: .*takes 0 positional arguments"),
        (FailingModel(), r"^the policy FailingModel raised KeyError: 'x'"),
    ],
)
def test_exception_of_a_policy_is_named(policy, message, env):
    with pytest.raises(InputError, match=message):
        check_compatible(policy, env)
    with pytest.raises(InputError, match=message):
        evaluate(policy, "Bead", 2, baselines=(), processes=2)


class FailingNetwork(torch.nn.Module):
    """Network whose assertion fails for every observation."""

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        assert bool(observation.sum() > 1e9), "too small"
        return observation


@pytest.mark.parametrize(
    ("module", "message"),
    [
        (FailingNetwork(), "RuntimeError: AssertionError: too small"),
        (torch.nn.Linear(3, 2).double(), ".*Float and Double"),
    ],
)
def test_exception_of_torchscript_is_named(module, message, env, tmp_path):
    torch.jit.script(module).save(tmp_path / "policy.pt")
    with pytest.raises(InputError, match=rf"^the policy policy\.pt raised {message}"):
        check_compatible(load_policy(tmp_path / "policy.pt", trust_policy=True), env)


def test_class_of_a_file_that_cannot_be_constructed_is_named(tmp_path):
    (tmp_path / "lab_model.py").write_text("class Model:\n    def __init__(self):\n        raise OSError('no disk')\n")
    with pytest.raises(InputError, match=r"lab_model\.py:Model cannot be constructed: it raised OSError: no disk"):
        load_policy(f"{tmp_path}/lab_model.py:Model")


def test_message_has_a_hint_when_a_function_returns_a_pair(env):
    message = "only a predict method returns an action and a state: return the action alone"
    with pytest.raises(InputError, match=message):
        check_compatible(lambda observation: (np.zeros(2), None), env)


@pytest.mark.parametrize("task", ["Bead", None])
def test_function_may_return_a_batch_of_one_action(task):
    policies = (lambda observation: -observation[:2], lambda observation: -observation[None, :2])
    single, batch = (evaluate(policy, task or PointToOrigin(), 2, baselines=())["mean_return"] for policy in policies)
    assert single == batch


class PointToOrigin(gymnasium.Env):
    """Environment of another package: actions are displacements of a point, which is to reach the origin."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        assert not options
        self.point, self.num_steps = self.np_random.uniform(-1, 1, 2), 0
        return self.point.astype(np.float32), {}

    def step(self, action):
        self.point, self.num_steps = self.point + 0.3 * np.clip(action, -1, 1), self.num_steps + 1
        distance = float(np.linalg.norm(self.point))
        info = {"success": distance < 0.1, "constraint_violation": distance - 3.0}
        return self.point.astype(np.float32), -distance, distance < 0.1, self.num_steps == 10, info


def test_environment_of_another_package_is_evaluated():
    result = evaluate(lambda point: -3.0 * point, PointToOrigin(), 6, processes=2)
    assert result["success_rate"] == 1.0
    assert result["baselines"] == ["zero", "uniform_random", "constant"]
    assert -3.0 < result["max_commanded_violation"] < 0.0
    assert result["peak_force"] is None
    assert result["p"] < 0.05
    assert "better than the best baseline" in result.sentence
    assert result == evaluate(lambda point: -3.0 * point, PointToOrigin(), 6, processes=1)
    assert evaluate("constant", PointToOrigin(), 2, baselines=["zero"])["baselines"] == ["zero"]
    with pytest.raises(InputError, match="no baseline policy 'scripted'"):
        evaluate("zero", PointToOrigin(), 2, baselines=["scripted"])
    with pytest.raises(InputError, match="given as an object"):
        evaluate("zero", PointToOrigin(), 2, environment={"station": "arm"})


class WithoutSuccess(gymnasium.Wrapper):
    """Environment that reports no success."""

    def step(self, action):
        return *self.env.step(action)[:4], {}


@pytest.mark.parametrize("episodes", [1, 3])
def test_environment_without_success_has_no_success_rate(episodes):
    result = evaluate(lambda point: -3.0 * point, WithoutSuccess(PointToOrigin()), episodes)
    mean = result["mean_return"]
    assert result.sentence == (
        f"The environment reports no success; the policy's mean return of {episodes} episodes is {mean:.4g}."
    )
    assert {result[name] for name in ("success_rate", "success_low", "success_high", "zero_success_rate")} == {None}
    assert result.comparison is None
    assert "success_rate" not in result.table


def test_sentence_has_no_held_out_episodes_for_an_environment():
    result = evaluate(lambda point: -3.0 * point, PointToOrigin(), 4)
    assert "succeeds in 4 of 4 episodes (95 % interval" in result.sentence
    assert "succeeds in 0 of 4 episodes" in evaluate(lambda point: 3.0 * point, PointToOrigin(), 4).sentence


class CallCounter:
    """Policy that counts its calls."""

    calls = 0

    def predict(self, observation):
        self.calls += 1
        return 0, None


@pytest.mark.parametrize("is_declared", [False, True])
def test_policy_is_called_in_the_episodes_only(is_declared):
    policy, env = CallCounter(), gymnasium.make("CartPole-v1")
    if is_declared:
        policy.observation_space, policy.action_space = env.observation_space, env.action_space
        policy.lock = threading.Lock()  # a lock cannot be copied
    result = evaluate(policy, env, 2, baselines=(), processes=1)
    assert policy.calls == result["mean_steps"] * 2


def test_registered_environment_is_evaluated_by_its_id():
    result = evaluate(lambda observation: 0, "CartPole-v1", 2)
    assert dict(result) == dict(evaluate(lambda observation: 0, gymnasium.make("CartPole-v1"), 2))
    short = {"control_period": 0.16}  # an eighth of the steps
    by_id, by_name = (
        evaluate("zero", name, 1, baselines=(), environment=short)
        for name in ("guiderail/NarrowPassage-v0", "NarrowPassage")
    )
    assert dict(by_id) == dict(by_name)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((PointToOrigin(), lambda point: point), "needs a policy and then the name of a task, .*, not <function"),
        (("NarrowPassage", lambda point: point), "needs a policy and then the name of a task"),
        (("zero", "CartPole-v99"), "no environment 'CartPole-v99' is registered with Gymnasium: check the id"),
        (("zero", "NarowPassage"), "did you mean NarrowPassage"),
    ],
)
def test_evaluation_in_an_invalid_environment_is_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        evaluate(*arguments, episodes=1)


def test_name_of_a_pretrained_policy_loads_it():
    folder = find_run("pretrained:connector")
    named, loaded = load_policy("pretrained:connector"), Policy.load(folder)
    observation = np.full(loaded.description["observation_shape"], 0.1, np.float32)
    np.testing.assert_array_equal(named(observation), loaded(observation))


def test_evaluation_of_a_pretrained_policy_writes_no_file(bead_run, tmp_path, monkeypatch):
    folder = tmp_path / "package" / "bead"
    folder.mkdir(parents=True)
    for name in ("config.yaml", "policy.json", "policy.safetensors"):
        (folder / name).write_bytes((bead_run / name).read_bytes())
    monkeypatch.setattr("guiderail.tools.pretrained.PRETRAINED_FOLDER", folder.parent)
    result = evaluate("pretrained:bead", episodes=2, baselines=["constant"])
    assert result["mean_return"] == evaluate(bead_run, episodes=2, baselines=())["mean_return"]
    assert result["trained_episodes"] is None
    assert EpisodeSpec.of_policy("pretrained:bead").run is None
    assert len(list(folder.iterdir())) == 3


def test_policy_folder_is_loaded_without_code(tmp_path):
    description = {"observation_shape": [3], "action_low": [-1, -1], "action_high": [1, 1]}
    Policy([(np.zeros((2, 3), np.float32), np.zeros(2, np.float32))], description).save(tmp_path)
    np.testing.assert_array_equal(load_policy(tmp_path)(OBSERVATION), [0, 0])


class StatefulFunction:
    """Object that acts in its first three calls; a call after a `reset` is the first again."""

    def __init__(self, kind):
        self.calls, self.kind = 0, kind
        if kind == "predict":
            self.predict = self.act

    def reset(self):
        self.calls = 0

    def act(self, observation):
        self.calls += 1
        return np.ones(2) * (self.calls <= 3)

    def __call__(self, observation):
        return self.act(observation)


class Steps(gymnasium.Env):
    """Environment of five steps, whose return is the number of steps with actions of one."""

    observation_space, action_space = gymnasium.spaces.Box(-1, 1, (3,)), gymnasium.spaces.Box(-1, 1, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return np.zeros(3, np.float32), {}

    def step(self, action):
        self.count += 1
        return np.zeros(3, np.float32), float(np.sum(action) / 2), False, self.count == 5, {}


@pytest.mark.parametrize("kind", ["call", "predict"])
def test_stateful_policy_starts_every_episode_in_its_first_state(kind):
    policy = check_compatible(StatefulFunction(kind), Steps())
    for processes in (1, 2):
        assert evaluate(policy, Steps(), 5, baselines=(), processes=processes)["mean_return"] == 3.0
    policy = check_compatible(StatefulFunction(kind), Steps())  # the check does not use up the state
    assert [policy(np.zeros(3, np.float32))[0] for _ in range(4)] == [1.0, 1.0, 1.0, 0.0]
