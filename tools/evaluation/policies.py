"""Policies of any origin: a run, a policy's folder, a file of another library, a function, or an object with `predict`.

Code in a file is executed only if the user allows it: a policy's folder and an ONNX file hold only numbers, but a zip
of Stable-Baselines3 is a pickle and a TorchScript file is a program. With `module:function`, the user names the code.
"""

from __future__ import annotations

import inspect
import json
import sys
import zipfile
import zlib
from collections.abc import Callable, Mapping
from copy import deepcopy
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from guiderail.models.common.errors import InputError, brief, naming_failures, require_extra
from guiderail.models.common.files import read_bytes
from guiderail.models.common.registry import did_you_mean
from guiderail.models.policy import MAX_WEIGHTS_SIZE, Policy
from guiderail.tools.evaluation.episode import Callback, PolicyFn, as_action
from guiderail.tools.imports import import_modules, module_name
from guiderail.tools.pretrained import PRETRAINED, find_run
from guiderail.tools.spaces import describe_space, from_tensors, has_layout, layout, probes, takes_observations

ENDINGS = (".zip", ".onnx", ".pt", ".ts", ".torchscript")
"""Endings of files of policies: Stable-Baselines3, ONNX and TorchScript."""

# Package and algorithm that read a zip of Stable-Baselines3, by the module of the policy's class, because the zip does
# not name its algorithm.
_SB3_ALGORITHMS = {
    "stable_baselines3.common.policies": ("stable_baselines3", "PPO"),  # A2C and TRPO have the same policy
    "stable_baselines3.sac.policies": ("stable_baselines3", "SAC"),
    "stable_baselines3.td3.policies": ("stable_baselines3", "TD3"),  # DDPG has the same policy
    "sb3_contrib.tqc.policies": ("sb3_contrib", "TQC"),
    "sb3_contrib.crossq.policies": ("sb3_contrib", "CrossQ"),
    "sb3_contrib.common.recurrent.policies": ("sb3_contrib", "RecurrentPPO"),
    "sb3_contrib.ars.policies": ("sb3_contrib", "ARS"),
}
# Replacements of entries that only training needs, so that a zip from another Python or NumPy version can be read.
_SB3_UNUSED: dict[str, Any] = {
    "learning_rate": 0.0,
    "lr_schedule": lambda remaining: 0.0,
    "clip_range": lambda remaining: 0.0,
    "buffer_size": 1,
}

_MAX_ERROR = 200  # largest number of characters of an exception's message that are quoted


class ForeignPolicy(Callback):
    """Policy of another library, as a function from an observation to an action.

    Attributes:
        observation_shape: Shape of the observation that the policy takes; None if unknown.
        action_shape: Shape of the action that the policy returns; None if unknown.
        observation_space: Observation space that a model declares, or None.
        action_space: Action space that a model declares, or None.
    """

    observation_space: Any = None
    action_space: Any = None

    def __init__(
        self,
        act: Callable[[np.ndarray], Any],
        *,
        observation_shape: tuple[int, ...] | None = None,
        action_shape: tuple[int, ...] | None = None,
        name: str = "",
    ):
        """Construct the policy from `act`, a function from an observation to an action.

        An action of shape (1, A) becomes (A,). A shape is None if it is unknown. `name` is for error messages.
        """
        self.observation_shape, self.action_shape = observation_shape, action_shape
        self._act, self._name = act, name

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the action for an observation."""
        if self.observation_shape is not None and self.observation_shape != np.shape(observation):
            raise InputError(f"the policy takes observations {self.observation_shape}, not {np.shape(observation)}")
        try:
            return self._converted(self._act(observation))
        except InputError:
            raise
        except (Exception, SystemExit) as error:  # code of others can raise any exception
            policy = f"the policy {self._name}".rstrip()
            raise InputError(f"{policy} raised {_describe_error(error)}") from error

    def copy(self) -> ForeignPolicy:
        """Return a policy whose calls do not change the internal state of this one; itself if it has no such state."""
        return self

    def _converted(self, action: Any) -> Any:
        action = from_tensors(action)
        if isinstance(action, Mapping | tuple | str):  # of a space that is no array
            return action
        array = np.asarray(action)
        return array[0] if array.ndim == 2 and len(array) == 1 and array.shape != self.action_shape else array


def _describe_error(error: BaseException) -> str:
    """Return the type of an exception and the beginning of its message, on one line."""
    text = " ".join(str(error).split())[:_MAX_ERROR].rstrip(": ")
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def _reset_state(policy: Any) -> None:
    """Call the method `reset` of a stateful policy, if it has one without arguments."""
    reset = getattr(policy, "reset", None)
    if not callable(reset):
        return
    try:
        inspect.signature(reset).bind()
    except (TypeError, ValueError):  # it has arguments, or no signature
        return
    with naming_failures(f"reset of the policy {type(policy).__name__}"):
        reset()


class FunctionPolicy(ForeignPolicy):
    """Policy of a function from an observation to an action; tensors become arrays.

    The method `reset` of an object that can be called is called at the start of every episode, if it has no arguments.
    """

    def __init__(self, function: Callable[[np.ndarray], Any]):
        """Construct the policy of `function`; error messages contain the name of the function."""
        name = getattr(function, "__name__", type(function).__name__)
        super().__init__(function, name="" if name == "<lambda>" else name)

    def copy(self) -> FunctionPolicy:
        """Return the policy of a deep copy of an object that can be called, or itself if it cannot be copied."""
        if inspect.isroutine(self._act):
            return self
        try:
            return FunctionPolicy(deepcopy(self._act))
        except Exception:  # code of others can raise any exception
            return self

    def on_episode_start(self) -> None:
        """Reset the internal state of an object that can be called."""
        if not inspect.isroutine(self._act):
            _reset_state(self._act)

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the function, such as `start_episode` of an object that can be called."""
        if name.startswith("_"):  # a copy does not have `_act` at first
            raise AttributeError(name)
        return getattr(self._act, name)

    def _converted(self, action: Any) -> Any:
        if isinstance(action, tuple) and len(action) == 2 and _is_pair(action):
            raise InputError(
                f"the policy returned {brief(action)}, and only a predict method returns an action and a state: return "
                "the action alone"
            )
        return from_tensors(action)


def _is_pair(returned: tuple[Any, Any]) -> bool:
    """Return True if a tuple is an action and a state, and False if it is an action of two numbers."""
    if returned[1] is None:
        return True
    try:
        np.shape(returned)
    except ValueError:  # ragged
        return True
    return False


class PredictPolicy(ForeignPolicy):
    """Policy with a `predict` method, such as a model of Stable-Baselines3.

    It acts deterministically if `predict` has a parameter `deterministic`. If `predict` has the parameters `state` and
    `episode_start`, the state is passed from call to call and reset at the start of an episode. Its method `reset` is
    called at the start of an episode, if it has no arguments.
    """

    def __init__(self, model: Any):
        """Construct the policy of `model`, whose `predict` returns an action, or an action and a state."""
        self.observation_space, self.action_space = (
            getattr(model, f"{kind}_space", None) for kind in ("observation", "action")
        )
        observation_shape, action_shape = (
            getattr(space, "shape", None) for space in (self.observation_space, self.action_space)
        )
        if observation_shape is not None and len(observation_shape) == 3:
            observation_shape = None  # `predict` converts images with the channels last
        name = type(model).__name__
        super().__init__(self._predict, observation_shape=observation_shape, action_shape=action_shape, name=name)
        self.model = model
        parameters = inspect.signature(model.predict).parameters
        self._options = {"deterministic": True} if "deterministic" in parameters else {}
        self._has_state = {"state", "episode_start"} <= parameters.keys()
        self._state: Any = None
        self._is_start = True

    def copy(self) -> PredictPolicy:
        """Return the policy of a deep copy of the model, or itself if the model cannot be copied."""
        try:
            return PredictPolicy(deepcopy(self.model))
        except Exception:  # code of others can raise any exception
            return self

    def on_episode_start(self) -> None:
        """Reset the internal state of a recurrent policy."""
        self._state = None
        self._is_start = True
        _reset_state(self.model)

    def _predict(self, observation: np.ndarray) -> Any:
        if not self._has_state:
            result = self.model.predict(observation, **self._options)
            return result[0] if isinstance(result, tuple) else result
        start = np.array([self._is_start])
        action, self._state = self.model.predict(observation, self._state, start, **self._options)
        self._is_start = False
        return action


def as_policy(given: Any) -> PolicyFn:
    """Convert a function or an object with a `predict` method to a policy whose errors name the policy.

    A policy of this package, or a callable `Callback`, is returned unchanged.
    """
    if isinstance(given, type) and (hasattr(given, "predict") or "__call__" in vars(given)):
        raise InputError(f"{given.__name__} is a class: give a policy, such as {given.__name__}()")
    if isinstance(given, Policy | Callback) and callable(given):
        return given
    if callable(getattr(given, "predict", None)):
        return PredictPolicy(given)
    if callable(given):
        return FunctionPolicy(given)
    raise InputError(
        f"{brief(given)} is no policy: give the folder of a run, a function from an observation to an action, or an "
        "object with a predict method"
    )


def is_policy_file(source: str | Path) -> bool:
    """Return True if a source has the ending of a policy's file, or is `module:function`."""
    return Path(source).suffix in ENDINGS or function_of(str(source)) is not None


def load_policy(source: str | Path, *, trust_policy: bool = False) -> PolicyFn:
    """Return the policy of a folder, a file or `module:function`.

    Args:
        source: Folder with `policy.safetensors`; `pretrained:NAME`; .zip of Stable-Baselines3; .onnx; TorchScript
            (.pt, .ts, .torchscript); or `module:function`, where `module` is a module's name or a file (.py), and
            `function` is any policy that `as_policy` takes, or a class of such policies.
        trust_policy: True to read files that can execute code: a zip of Stable-Baselines3 and TorchScript.
    """
    if (function := function_of(str(source))) is not None:
        return _load_function(*function)
    path = find_run(source)
    if path.suffix not in ENDINGS:
        return Policy.load(path)
    if not path.is_file():
        raise InputError(f"there is no file {path}: give the file of a policy")
    if path.suffix == ".onnx":
        return _load_onnx(path)
    if not trust_policy:
        kind = "is a pickle, which can execute code when it is read" if path.suffix == ".zip" else "is a program"
        raise InputError(f"{path} {kind}: give --trust-policy if you trust its origin")
    return _load_sb3(path) if path.suffix == ".zip" else _load_torchscript(path)


def function_of(source: str) -> tuple[str, str] | None:
    """Return the module and the function's name of `module:function`; None for another source."""
    module, separator, name = source.rpartition(":")
    is_name = bool(separator) and name.isidentifier() and bool(module) and not source.startswith(PRETRAINED)
    return (module, name) if is_name else None


def _load_function(module: str, name: str) -> PolicyFn:
    (imported,) = import_modules([module], f" for {module}:{name}: give MODULE:FUNCTION or FILE.py:FUNCTION")
    loaded = sys.modules.get(module_name(Path(imported)) if imported.endswith(".py") else imported)
    if not hasattr(loaded, name):
        names = [public for public in vars(loaded or object) if not public.startswith("_")]
        raise InputError(f"{module} has no {brief(name)}: {did_you_mean(name, names)}")
    result = getattr(loaded, name)
    try:
        policy = result() if inspect.isclass(result) else result
    except (Exception, SystemExit) as error:  # code of others can raise any exception
        raise InputError(f"{module}:{name} cannot be constructed: it raised {_describe_error(error)}") from error
    return as_policy(policy)


def _load_sb3(path: Path) -> PolicyFn:
    try:
        with zipfile.ZipFile(path) as archive:
            module = json.loads(archive.read("data"))["policy_class"]["__module__"]
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, RuntimeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is no model of Stable-Baselines3: give a file that model.save wrote") from error
    if module not in _SB3_ALGORITHMS:
        raise InputError(
            f"{path} has a policy of {brief(module)}: load it in a function of yours and give FILE.py:FUNCTION"
        )
    package, algorithm = _SB3_ALGORITHMS[module]
    require_extra(package)
    try:
        kind: Any = getattr(import_module(package), algorithm)
        model = kind.load(path, device="cpu", custom_objects=_SB3_UNUSED)
    except Exception as error:  # reading a pickle can raise any exception
        raise InputError(
            f"{path} cannot be read ({_describe_error(error)}): save it with the installed versions"
        ) from error
    return PredictPolicy(model)


def _load_torchscript(path: Path) -> PolicyFn:
    require_extra("torch")
    import torch

    try:
        module = torch.jit.load(path, map_location="cpu")
    except RuntimeError as error:
        raise InputError(f"{path} is no TorchScript file: write it with torch.jit.script(module).save(...)") from error
    return TorchScriptPolicy(module.eval(), path)


class TorchScriptPolicy(ForeignPolicy):
    """Policy of a TorchScript file; every episode begins with the state of the file.

    The exported method `reset` of the module is called too, if it has no arguments.
    """

    def __init__(self, module: Any, path: Path):
        """Construct the policy of a module that `path` contains, which must not have been called."""
        super().__init__(self._forward, name=path.name)
        self._stored, self._path = module, path
        self._module = deepcopy(module)

    def copy(self) -> TorchScriptPolicy:
        """Return the policy in the state of the file."""
        return TorchScriptPolicy(self._stored, self._path)

    def on_episode_start(self) -> None:
        """Restore the buffers and attributes of the file, and call the exported method `reset`."""
        self._module = deepcopy(self._stored)
        reset = getattr(self._module, "reset", None)
        if callable(reset) and len(reset.schema.arguments) == 1:  # only the module itself
            with naming_failures(f"reset of the policy {self._path.name}"):
                reset()

    def _forward(self, observation: np.ndarray) -> np.ndarray:
        import torch

        try:
            with torch.inference_mode():
                action = self._module(torch.as_tensor(observation, dtype=torch.float32)[None])
        except (RuntimeError, torch.jit.Error) as error:  # the lines before the last one are a traceback of TorchScript
            reason = ([line.strip() for line in str(error).splitlines() if line.strip()] or [""])[-1]
            raise RuntimeError(reason.removeprefix("RuntimeError: ")) from error
        if not isinstance(action, torch.Tensor):
            raise InputError(f"{self._path} returns {brief(action)} instead of a tensor of actions")
        return action.numpy()


def _load_onnx(path: Path) -> PolicyFn:
    require_extra("onnxruntime")
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # a fork does not have its parent's threads
    content = read_bytes(path, "policy", MAX_WEIGHTS_SIZE)
    try:
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime's exceptions have no common base class
        raise InputError(f"{path} is no ONNX file that can be read: export it again") from error
    inputs, outputs = session.get_inputs(), session.get_outputs()
    if len(inputs) != 1 or inputs[0].type != "tensor(float)":
        raise InputError(f"{path} has the inputs {[given.name for given in inputs]}: a policy has one, of float32")
    name, shape = inputs[0].name, inputs[0].shape
    is_batched = not (shape and isinstance(shape[0], int) and shape[0] > 1) and len(shape) > 1
    observation_shape = tuple(shape[1:] if is_batched else shape)

    def act(observation: np.ndarray) -> np.ndarray:
        values = np.asarray(observation, np.float32)
        return session.run([outputs[0].name], {name: values[None] if is_batched else values})[0]

    is_known = all(isinstance(size, int) for size in observation_shape)
    return ForeignPolicy(act, observation_shape=observation_shape if is_known else None, name=path.name)


_MAX_DIFFERENCES = 5  # largest number of options that a message names


def check_compatible(policy: PolicyFn, env: gymnasium.Env, learned_in: Mapping[str, Any] | None = None) -> PolicyFn:
    """Return `as_policy(policy)` if its observations and actions have the layout of an environment's.

    `learned_in` are the options of the environment in training; the error message names those that differ. A model's
    action space must also have the bounds of the environment's.
    """
    policy = as_policy(policy)
    taken, returned = _declared_layout(policy)
    try:
        if has_same_shapes(policy, env):
            _check_bounds(policy, env)
            return policy
    except (IndexError, TypeError, ValueError) as error:
        if taken in (None, describe_space(env.observation_space)):
            raise error if isinstance(error, InputError) else InputError(f"the policy failed: {error}") from error
    expected = describe_space(env.action_space)
    if taken in (None, describe_space(env.observation_space)):
        taken, hint = describe_space(env.observation_space), f": it must return an action {expected}"
    else:
        hint = ": give another policy"
    config = getattr(getattr(env.unwrapped, "diagram", None), "config", None)  # None for another origin
    options = {} if config is None else config.options
    changed = [
        f"{name}={brief(value)} instead of {brief(options[name])}"
        for name, value in (learned_in or {}).items()
        if name in options and options[name] != value
    ][:_MAX_DIFFERENCES]
    if changed:
        hint = f"; it learned with {', '.join(changed)}: change --env"
    raise InputError(
        f"the policy takes observations {taken} and returns actions {returned or 'of another shape'}, and this "
        f"environment has observations {describe_space(env.observation_space)} and actions {expected}{hint}"
    )


def _declared_layout(policy: PolicyFn) -> tuple[str | None, str | None]:
    """Return the observations and actions that a policy declares, as `describe_space`; None if unknown."""
    if isinstance(policy, Policy):
        size = len(policy.description["action_low"])
        return str(tuple(policy.description["observation_shape"])), str((size,))
    pairs = (
        (getattr(policy, f"{kind}_space", None), getattr(policy, f"{kind}_shape", None))
        for kind in ("observation", "action")
    )
    taken, returned = (
        (None if shape is None else str(tuple(shape))) if space is None else describe_space(space)
        for space, shape in pairs
    )
    return taken, returned


def _check_bounds(policy: PolicyFn, env: gymnasium.Env) -> None:
    """Raise an InputError if the action space that a model declares has other bounds than the environment's."""
    declared, space = getattr(getattr(policy, "model", None), "action_space", None), env.action_space
    if not isinstance(declared, gymnasium.spaces.Box) or not isinstance(space, gymnasium.spaces.Box):
        return
    if not (np.array_equal(declared.low, space.low) and np.array_equal(declared.high, space.high)):
        raise InputError(
            f"the policy was trained with actions from {declared.low.min():g} to {declared.high.max():g}, and those of "
            f"this environment are from {space.low.min():g} to {space.high.max():g}: evaluate it through its wrapper "
            "from Python"
        )


def is_compatible(make_policy: Callable[[gymnasium.Env], PolicyFn], env: gymnasium.Env) -> bool:
    """Return True if a policy's observations and actions have the layout of the environment's."""
    try:
        return has_same_shapes(make_policy(env), env)
    except (IndexError, TypeError, ValueError):
        return False


def has_same_shapes(act: PolicyFn, env: gymnasium.Env) -> bool:
    """Return True if the policy's actions for several observations have the shape of the environment's actions.

    The policy is called with the observations of `probes`. An object with `predict` is not called if it declares both
    spaces. Otherwise a copy of a policy of another library is called, if it can be copied, so that its internal state
    does not change. An exception of the policy is not caught.
    """
    if isinstance(act, ForeignPolicy):
        if act.observation_space is not None and act.action_space is not None:
            is_known = layout(act.action_space) == layout(env.action_space)
            return is_known and takes_observations(act.observation_space, env.observation_space)
        act = act.copy()
    return all(
        has_layout(as_action(act(observation), env), env.action_space) for observation in probes(env.observation_space)
    )
