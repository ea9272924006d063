"""Generated spaces of Gymnasium: policies for each are accepted, policies for another are refused."""

from copy import deepcopy

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from guiderail.models.common.errors import InputError
from guiderail.tools.evaluation.evaluate import evaluate
from guiderail.tools.evaluation.policies import as_policy, check_compatible
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.spaces import NUM_PROBES, from_tensors, has_layout, has_values, layout, probes

SHAPES = st.lists(st.integers(1, 3), max_size=2).map(tuple)
NAMES = st.sampled_from(["p", "goal", "achieved_goal", "image"])
LEAVES = st.one_of(
    SHAPES.map(lambda shape: spaces.Box(-1, 1, shape)),
    SHAPES.map(lambda shape: spaces.Box(0, 255, shape, np.uint8)),
    st.builds(spaces.Discrete, st.integers(1, 4), start=st.integers(-2, 2)),
    st.lists(st.integers(1, 4), min_size=1, max_size=3).map(spaces.MultiDiscrete),
    st.integers(1, 3).map(spaces.MultiBinary),
    st.integers(1, 4).map(spaces.Text),
)
SPACES = st.recursive(
    LEAVES,
    lambda parts: st.one_of(
        st.dictionaries(NAMES, parts, min_size=1, max_size=3).map(spaces.Dict),
        st.lists(parts, min_size=1, max_size=3).map(spaces.Tuple),
    ),
    max_leaves=4,
)


class RandomEnv(gymnasium.Env):
    """Environment of samples of its observation space, which ends after three steps."""

    def __init__(self, observation_space, action_space):
        self.observation_space, self.action_space = deepcopy(observation_space), deepcopy(action_space)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.count += 1
        return self.observation_space.sample(), 0.0, False, self.count == 3, {"is_success": True}


class Sampler:
    """Object with `predict` that samples actions; the observation must be of its space."""

    def __init__(self, observation_space, action_space, *, is_declared):
        self._observations, self._actions = deepcopy(observation_space), deepcopy(action_space)
        if is_declared:
            self.observation_space, self.action_space = self._observations, self._actions

    def predict(self, observation):
        assert has_layout(observation, self._observations)
        return self._actions.sample(), None


@settings(deadline=None, max_examples=60)
@given(observations=SPACES, actions=SPACES, is_declared=st.booleans(), is_wrapped=st.booleans())
def test_policy_is_accepted_in_every_space(observations, actions, is_declared, is_wrapped):
    env = RandomEnv(observations, actions)
    if is_wrapped:
        from stable_baselines3.common.monitor import Monitor

        env = Monitor(env)
    policy = check_compatible(Sampler(observations, actions, is_declared=is_declared), env)
    assert rollout(env, policy)["success"] == 1


@settings(deadline=None, max_examples=60)
@given(observations=SPACES, others=SPACES, actions=SPACES)
def test_policy_of_other_observations_is_refused(observations, others, actions):
    assume(layout(observations) != layout(others))
    env = RandomEnv(observations, actions)
    with pytest.raises(InputError, match="observations"):
        check_compatible(Sampler(others, actions, is_declared=True), env)


@settings(deadline=None, max_examples=60)
@given(space=SPACES)
def test_probes_are_values_of_the_space(space):
    before = deepcopy(space.np_random.bit_generator.state)
    values = list(probes(space))
    assert len(values) == NUM_PROBES
    assert all(has_layout(value, space) and has_values(value, space) for value in values)
    assert space.np_random.bit_generator.state == before


@settings(deadline=None, max_examples=60)
@given(space=SPACES, other=SPACES)
def test_action_of_another_layout_is_refused(space, other):
    env = RandomEnv(spaces.Discrete(2), space)
    action = other.sample()
    assume(not (has_layout(action, space) and has_values(action, space)))  # data type and bounds are the environment's
    with pytest.raises(InputError, match="the actions of this environment"):
        rollout(env, lambda observation: action)


@pytest.mark.parametrize("algorithm", ["PPO", "SAC", "HER"])
def test_model_with_dict_observations_is_evaluated(algorithm):
    import stable_baselines3
    from stable_baselines3.common.monitor import Monitor

    box = spaces.Box(-1, 1, (2,))
    names = ["observation", "achieved_goal", "desired_goal"]

    class GoalEnv(RandomEnv):
        def compute_reward(self, achieved, desired, info):
            return -np.linalg.norm(achieved - desired, axis=-1)

    env = Monitor(GoalEnv(spaces.Dict(dict.fromkeys(names, box)), box))
    more = {} if algorithm == "PPO" else {"buffer_size": 100}
    more |= {"replay_buffer_class": stable_baselines3.HerReplayBuffer} if algorithm == "HER" else {}
    kind = getattr(stable_baselines3, "SAC" if algorithm == "HER" else algorithm)
    model = kind("MultiInputPolicy", env, device="cpu", **more)
    assert evaluate(model, env, 2, baselines=())["success_rate"] == 1.0


def test_model_of_images_takes_channels_at_the_end():
    from stable_baselines3 import PPO

    env = RandomEnv(spaces.Box(0, 255, (36, 36, 3), np.uint8), spaces.Box(-1, 1, (2,)))
    model = PPO("CnnPolicy", env, n_steps=8, device="cpu")
    assert model.observation_space.shape == (3, 36, 36)
    assert evaluate(model, env, 1, baselines=())["success_rate"] == 1.0


VALUES = [0.25, [0.25, -0.5], [[0.25, -0.5]]]


@pytest.mark.parametrize("values", VALUES)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.float16, torch.bfloat16])
@pytest.mark.parametrize("kind", ["plain", "gradient", "parameter", "computed", "sparse", "conjugate", "list"])
def test_tensor_becomes_an_array(values, dtype, kind):
    tensor = torch.tensor(values, dtype=dtype)
    make = {
        "plain": lambda: tensor,
        "gradient": tensor.requires_grad_,
        "parameter": lambda: torch.nn.Parameter(tensor),
        "computed": lambda: tensor.requires_grad_() * 1.0,
        "sparse": lambda: tensor.to_sparse() if tensor.ndim else tensor,
        "conjugate": lambda: torch.complex(tensor.float(), tensor.float()).conj().real,
        "list": lambda: [*tensor.requires_grad_()] if tensor.ndim else [tensor.requires_grad_()],
    }
    array = np.asarray(from_tensors(make[kind]()))
    np.testing.assert_array_equal(array.reshape(np.shape(values)), values)


def test_tensor_without_values_is_refused_in_one_sentence():
    policy = as_policy(lambda observation: torch.zeros(2, device="meta"))
    with pytest.raises(InputError, match="cannot be converted to an array: return a NumPy array"):
        policy(np.zeros(1))
