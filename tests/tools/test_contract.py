"""Environments that break Gymnasium's contract: a table of faults, in evaluation and in `GuidedEnv`."""

import gymnasium
import numpy as np
import point_env
import pytest
from gymnasium import spaces
from point_env import PointEnv, guided

from guiderail.models.common.errors import InputError
from guiderail.tools.evaluation.evaluate import evaluate
from guiderail.tools.evaluation.rollout import rollout


def fail(error):
    raise error


def replace(index, value):
    return lambda result: (*result[:index], value, *result[index + 1 :])


# Faults of a step: function of its valid result, and the beginning of the message.
STEPS = {
    **{
        f"reward {value!r}": (replace(1, value), "the environment returned .* as reward")
        for value in (None, "1", np.array([0.0]), [0.0], True, 1j, float("nan"), float("inf"), {})
    },
    **{
        f"{name} {value!r}": (replace(index, value), f"the environment returned .* as {name}")
        for index, name in ((2, "terminated"), (3, "truncated"))
        for value in (None, "no", np.array([False, True]), 2.0, {})
    },
    **{f"info {value!r}": (replace(4, value), "returned .* as info") for value in (None, [], "", ())},
    **{
        f"observation {value!r}": (replace(0, value), "step returned the observation")
        for value in (None, "0", np.zeros(3), np.zeros((1, 6)), [np.zeros(2), 1.0], {"state": np.zeros(6)}, 0.0)
    },
    "observation with NaN": (replace(0, np.full(6, np.nan)), "contains NaN"),
    "four values": (lambda result: result[:3] + result[4:], "does not return five values|returned 4 values"),
    "six values": (lambda result: (*result, {}), "does not return five values|returned 6 values"),
    "nothing": (lambda result: None, "five values"),
    "exception": (lambda result: fail(KeyError("arm")), "KeyError"),
    "exit": (lambda result: fail(SystemExit(3)), "SystemExit"),
}
RESETS = {
    "observation alone": (lambda result: result[0], "reset returned .* two values"),
    "nothing": (lambda result: None, "reset returned None: it returns two values"),
    "info None": (replace(1, None), "reset returned None as info"),
    "observation None": (replace(0, None), "reset returned the observation None"),
    "observation of another shape": (replace(0, np.zeros(2)), r"shape \(2,\), and its observation space is \(6,\)"),
    "exception": (lambda result: fail(RuntimeError("no robot")), "RuntimeError: no robot"),
}


class Faulty(PointEnv):
    """Environment whose `method` has a fault in its n-th call."""

    def __init__(self, method, fault, number=1):
        super().__init__()
        self._method, self._fault, self._rest = method, fault, number

    def _result(self, method, result):
        self._rest -= method == self._method
        return self._fault(result) if method == self._method and self._rest == 0 else result

    def reset(self, **arguments):
        return self._result("reset", super().reset(**arguments))

    def step(self, action):
        return self._result("step", super().step(action))


FAULTS = [("step", name) for name in STEPS] + [("reset", name) for name in RESETS]


@pytest.mark.parametrize("number", [1, 2])
@pytest.mark.parametrize(("method", "name"), FAULTS)
def test_fault_is_named_in_an_episode(method, name, number):
    fault, message = {"step": STEPS, "reset": RESETS}[method][name]
    env = Faulty(method, fault, number)
    limited = gymnasium.wrappers.TimeLimit(env, 5)
    for _ in range(number if method == "reset" else 1):
        if method == "reset" and env._rest > 1:
            rollout(limited, lambda observation: np.zeros(4))
            continue
        with pytest.raises(InputError, match=message) as caught:
            rollout(limited, lambda observation: np.zeros(4))
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("method", "name"), FAULTS)
def test_guided_episode_ends_with_a_fault(method, name):
    fault, message = {"step": STEPS, "reset": RESETS}[method][name]
    env = guided(gymnasium.wrappers.TimeLimit(Faulty(method, fault), 50))
    expected = (KeyError, SystemExit, RuntimeError) if name in ("exception", "exit") else InputError

    def run():
        env.reset(seed=0)
        env.step(np.zeros(3))

    with pytest.raises(expected, match=None if name in ("exception", "exit") else message):
        run()
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(3))
    run()  # the fault is in one call only


def test_step_of_the_former_package_is_named():
    fault, _ = STEPS["four values"]
    with pytest.raises(InputError, match="returned 4 values, as in the former package gym"):
        rollout(Faulty("step", fault), lambda observation: np.zeros(4))


@pytest.mark.parametrize("arguments", [(), ("seed",), ("options",)])
def test_reset_without_the_arguments_is_named(arguments):
    class Old(gymnasium.Env):
        observation_space = action_space = spaces.Box(-1, 1, (2,))

    scope = {}
    exec(f"def reset(self, {', '.join(f'{name}=None' for name in arguments)}): return None, {{}}", scope)
    Old.reset = scope["reset"]
    with pytest.raises(InputError, match=r"reset lacks an argument .*declare it as reset\(self, \*, seed=None"):
        evaluate(lambda observation: np.zeros(2), Old(), 1, baselines=())


class Lax(PointEnv):
    """Environment with a value outside of its spaces from the first or the second episode on."""

    def __init__(self, wrong, first=0):
        super().__init__()
        self.observation_space = spaces.Box(-2.0, 2.0, (6,), np.float64)
        self._wrong, self._first, self._episode = wrong, first, -1

    def reset(self, **arguments):
        self._episode += 1
        return super().reset(**arguments)

    def _observe(self):
        observation = super()._observe()
        return self._wrong(observation) if self._episode >= self._first else observation


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda observation: observation + 5.0, "not in the environment's observation space"),
        (lambda observation: observation.astype(np.complex128), "of type complex128 is not in"),
    ],
)
def test_first_episode_is_checked_on_request(wrong, message):
    to_action = lambda env, observation, command, extra: point_env.to_action(env, observation, command, 0.0).astype(  # noqa: E731
        np.float32
    )
    guided(Lax(wrong), to_action=to_action).reset(seed=0)
    with pytest.raises(InputError, match=message):
        guided(Lax(wrong), check_env=True, to_action=to_action).reset(seed=0)
    env = guided(Lax(wrong, first=1), check_env=True, to_action=to_action)
    for _ in range(2):  # the second episode is not checked
        env.reset(seed=0)
        env.step(np.zeros(3))


def test_action_outside_of_its_space_is_named_on_request():
    env = guided(PointEnv(), check_env=True, to_action=lambda *_: np.full(4, 3.0, np.float32))
    env.reset(seed=0)
    with pytest.raises(InputError, match="not in the environment's action space"):
        env.step(np.zeros(3))
