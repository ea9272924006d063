"""`DiagramEnv.save` and `restore` with MuJoCo as the engine."""

import numpy as np

from guiderail import make_env


def test_rest_of_an_episode_in_contact_is_equal_bit_for_bit_when_restored():
    env = make_env("BncConnector", guidance="kgrl", station="mujoco", action_repeat=5)
    env.reset(seed=3)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (43, *env.action_space.shape))

    def run(actions):
        rows = [env.step(action) for action in actions]
        return [(observation.tobytes(), reward, repr(info)) for observation, reward, _, _, info in rows]

    run(actions[:40])
    state = env.save()
    expected = run(actions[40:])
    env.reset()
    env.restore(state)
    assert run(actions[40:]) == expected
