"""Drake's own Gymnasium environment around a diagram with guidance."""

import gymnasium
import numpy as np
import pytest
from pydrake.gym import DrakeGymEnv
from pydrake.systems.analysis import Simulator

from guiderail import drake_gym_reset, make_env
from guiderail.models.common.errors import InputError


@pytest.fixture(scope="module")
def env():
    env = make_env("NarrowPassage", guidance="skgrl")
    env.reset(seed=0)
    yield env
    env.close()


def drake_env(env, reset_handler):
    """Return Drake's environment around the diagram of `env`."""
    task = env.unwrapped.diagram
    simulator, port = Simulator(task.diagram), task.diagram.GetInputPort("action")
    port.FixValue(simulator.get_mutable_context(), np.zeros(port.size()))
    spaces = gymnasium.spaces.Box(-1.0, 1.0, (port.size(),)), task.observation_space
    return DrakeGymEnv(
        simulator,
        task.control_period,
        *spaces,
        reward="reward",
        action_port_id="action",
        observation_port_id="observation",
        reset_handler=reset_handler,
    )


def first_command(env):
    return env.unwrapped.diagram.diagram.GetOutputPort("desired_pose").Eval(env.unwrapped.simulator.get_context())


def test_first_command_is_that_of_diagram_env(env):
    """Both environments wrap the same diagram and begin in the same state."""
    task = env.unwrapped.diagram

    def set_start(simulator, context, seed):
        task.randomize(context, np.random.default_rng(seed), {})

    drake = drake_env(env, drake_gym_reset(set_start))
    for seed in range(3):
        env.reset(seed=seed)
        drake.reset(seed=seed)
        command = task.diagram.GetOutputPort("desired_pose").Eval(drake.simulator.get_context())
        assert np.abs(command).max() > 1e-3
        np.testing.assert_array_equal(command, first_command(env))


def test_step_without_initialization_is_refused(env):
    drake = drake_env(env, lambda simulator, context, seed: None)
    drake.reset(seed=0)  # does not evaluate the command
    with pytest.raises(InputError, match=r"call Simulator\.Initialize\(\)"):
        drake.step(np.zeros(drake.action_space.shape))
