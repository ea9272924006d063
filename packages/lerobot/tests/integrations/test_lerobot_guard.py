"""Guard of chunks as a step of LeRobot's processors, tested with a double of LeRobot's interface.

`make lerobot` tests the guard with the real library.
"""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

FILE = Path(__file__).parents[2] / "src/lerobot_robot_guiderail/guard.py"
PERIOD, VELOCITY, JERK, BOUND = 0.1, 0.5, 5.0, 0.2  # [s], [unit/s], [unit/s³], [unit]
NAMES = ["a.pos", "b.pos"]


@pytest.fixture(scope="module")
def guard():
    """Return the guard module, imported with a double of `lerobot.processor`."""
    registry = {}

    def register(name):
        return lambda kind: registry.setdefault(name, kind)

    processor = ModuleType("lerobot.processor")
    processor.ProcessorStep = type("ProcessorStep", (), {})
    processor.ProcessorStepRegistry = SimpleNamespace(register=register)
    processor.TransitionKey = SimpleNamespace(ACTION="action", OBSERVATION="observation")
    doubles = {"lerobot": ModuleType("lerobot"), "lerobot.processor": processor}
    spec = importlib.util.spec_from_file_location("guiderail_lerobot_guard", FILE)
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        for name, double in doubles.items():
            patch.setitem(sys.modules, name, double)
        patch.setitem(sys.modules, spec.name, module)
        spec.loader.exec_module(module)
    assert registry == {"guiderail_chunk_guard": module.ChunkGuardProcessorStep}
    return module


def make(guard, **changes):
    """Return the processor step for two joints, of which only the first has bounds of its position."""
    limits = {"lower": [-BOUND, None], "upper": [BOUND, None], "velocity": [VELOCITY] * 2, "jerk": [JERK] * 2}
    return guard.ChunkGuardProcessorStep(**limits | {"period": PERIOD, "start": [0.0, 0.0], "names": NAMES} | changes)


def send(step, action, observation=None):
    """Return the action that the processor step outputs."""
    return step({"action": action, "observation": observation})["action"]


def assert_motion_is_within_limits(motion):
    """Assert that a motion (n, 2) is within the limits of velocity and jerk."""
    assert np.abs(np.diff(motion, axis=0)).max() <= VELOCITY * PERIOD * (1 + 1e-9)
    assert np.abs(np.diff(motion, n=3, axis=0)).max() <= JERK * PERIOD**3 * (1 + 1e-9)


@pytest.mark.parametrize("mode", ["projection", "slowdown"])
@pytest.mark.parametrize("shape", [(2,), (1, 2), (1, 3, 2), (1, 8, 2)])
def test_actions_are_within_the_limits(guard, shape, mode):
    step, random = make(guard, mode=mode), np.random.default_rng(1)
    sent = [send(step, torch.from_numpy(random.uniform(-0.5, 0.5, shape))) for _ in range(30)]
    assert all(action.shape == shape for action in sent)
    motion = np.concatenate([np.zeros((3, 2)), torch.cat([action.reshape(-1, 2) for action in sent]).numpy()])
    assert_motion_is_within_limits(motion)
    assert np.abs(motion[:, 0]).max() <= BOUND
    assert np.ptp(motion, axis=0).max() > 0.005


def test_motion_reaches_a_constant_action(guard):
    step = make(guard)
    sent = [send(step, torch.tensor([[0.15, -0.3]], dtype=torch.float64)) for _ in range(40)]
    np.testing.assert_allclose(sent[-1][0], [0.15, -0.3], atol=1e-3)


def test_actions_by_name_start_at_the_observed_position(guard):
    step, observed = make(guard, start=None), dict(zip(NAMES, (0.1, 2.0), strict=True))
    assert send(step, observed, observed) == pytest.approx(observed, abs=1e-4)
    first = send(step, dict.fromkeys(NAMES, 0.15), observed)
    assert 0.1 < first["a.pos"] < 0.12
    step.reset()
    assert send(step, observed, observed) == pytest.approx(observed, abs=1e-4)


@pytest.mark.parametrize("mode", ["projection", "slowdown"])
@pytest.mark.parametrize("position", [-0.3, 0.0, 0.3])
def test_commands_are_within_limits_when_the_start_is_outside(guard, mode, position):
    step = make(guard, start=None, mode=mode)
    for excess in (1e-4, 0.001, 0.0024):
        step.reset()
        observed = {"a.pos": BOUND + excess, "b.pos": 2.0}
        sent = [send(step, {"a.pos": position, "b.pos": 2.0 + position}, observed) for _ in range(10)]
        motion = np.array([[observed["a.pos"], 2.0]] * 3 + [list(action.values()) for action in sent])
        assert_motion_is_within_limits(motion)
        assert motion[3:, 0].max() <= BOUND + 1e-9


def test_start_is_refused_when_a_step_cannot_reach_the_bounds(guard):
    outside = dict.fromkeys(NAMES, 0.3)
    with pytest.raises(ValueError, match=r"number 0 of .* start is 0\.1 outside of the bounds.*move the robot"):
        send(make(guard, start=None), outside, outside)
    with pytest.raises(ValueError, match="finite"):
        send(make(guard, start=None), outside, dict.fromkeys(NAMES, float("nan")))


@pytest.mark.parametrize(
    ("action", "words"),
    [
        (torch.full((1, 2), float("nan")), "finite"),
        (torch.zeros(1, 3), "shape"),
        (torch.zeros(2, 2), "shape"),
        (torch.zeros(1, 0, 2), "shape"),
        ({"a.pos": 0.0}, "b.pos"),
        ({"a.pos": 0.0, "b.pos": 0.0, "gripper.pos": 1.0}, "drop.*gripper.pos"),
    ],
)
def test_action_is_refused_when_values_shape_or_names_are_wrong(guard, action, words):
    with pytest.raises(ValueError, match=words):
        send(make(guard), action)


def test_guard_refuses_invalid_start_and_limits(guard):
    with pytest.raises(ValueError, match="give start"):
        send(make(guard, start=None), torch.zeros(1, 2))
    with pytest.raises(ValueError, match="one entry"):
        make(guard, velocity=[1.0])
    with pytest.raises(ValueError, match="positive"):
        make(guard, jerk=[1.0, 0.0])
    with pytest.raises(ValueError, match="inside"):
        send(make(guard, start=[0.21, 0.0]), torch.zeros(1, 2))


def test_step_from_a_configuration_outputs_the_same_action(guard):
    step = make(guard)
    second = guard.ChunkGuardProcessorStep(**step.get_config())
    action = torch.tensor([[0.3, 0.4]])
    assert (send(step, action) == send(second, action)).all()
