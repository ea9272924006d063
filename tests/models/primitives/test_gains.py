import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import LcNsKmp, ReferenceTrajectory
from guiderail.models.primitives.gains import authority, authority_gains, exploration_rms, residual_gains, rms_gains


@pytest.fixture(scope="module", params=[0, 5])
def primitive(request):
    t = np.linspace(0, 3, 150)
    width = np.column_stack([0.01 + 0.1 * np.sin(t), 1e-3 * np.ones_like(t)])
    mix = np.array([[1, 0.3], [0.3, 1]])
    reference = ReferenceTrajectory(t, np.column_stack([t, t]), np.einsum("ni,ij,nj->nij", width, mix, width))
    return LcNsKmp(reference, history=request.param, history_variance=1e-6, horizon=20)


def rollout(primitive, actions):
    """Return the commands (N, O) of a closed loop, in which earlier commands are the history."""
    past = np.tile(primitive.reference.means[0], (primitive.history, 1))
    outputs = []
    for n, action in enumerate(actions):
        outputs.append(primitive.predict(n, action, past if primitive.history else None).output)
        past = np.vstack([past, outputs[-1]])[1:] if primitive.history else past
    return np.array(outputs)


def deviation_rms(primitive, actions):
    """Return the RMS (O,) of the displacement by actions, relative to the RMS standard deviation of the reference."""
    displacements = rollout(primitive, actions) - rollout(primitive, np.zeros_like(actions))
    return np.sqrt((displacements**2).mean(axis=0)) / np.sqrt((primitive.reference.standard_deviations**2).mean(axis=0))


def test_constant_actions_reach_the_authority(primitive):
    gains = authority_gains(primitive, action_scale=1.5)
    np.testing.assert_allclose(authority(primitive, gains), np.sqrt(3) * 1.5)
    for o in range(2):
        reached = deviation_rms(primitive, np.tile(gains * np.eye(2)[o], (150, 1)))[o]
        assert reached == pytest.approx(np.sqrt(3) * 1.5, rel=1e-6)


@pytest.mark.parametrize("action_repeat", [1, 5])
def test_white_actions_reach_the_exploration_rms(primitive, action_repeat):
    gains = rms_gains(primitive, action_scale=1.0, action_repeat=action_repeat)
    np.testing.assert_allclose(exploration_rms(primitive, gains, action_repeat), 1.0)
    rng = np.random.default_rng(0)
    samples = [
        deviation_rms(
            primitive, gains * np.repeat(rng.uniform(-1, 1, (150 // action_repeat, 2)), action_repeat, axis=0)
        )
        for _ in range(40)
    ]
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(samples), axis=0)), 1.0, rtol=0.15)


def test_gains_are_zero_for_unexplored_outputs(primitive):
    for gains in (authority_gains(primitive, outputs=[1]), rms_gains(primitive, outputs=[1])):
        assert gains[0] == 0
        assert gains[1] > 0
    masked = authority_gains(primitive, outputs=np.array([False, True]))
    np.testing.assert_array_equal(masked, authority_gains(primitive, outputs=[1]))


def test_gains_refuse_invalid_arguments(primitive):
    with pytest.raises(InputError, match="action_scale"):
        authority_gains(primitive, action_scale=0)
    for outputs in ([2], [0.5], [], [True], [True, False, True]):
        with pytest.raises(InputError, match="outputs"):
            rms_gains(primitive, outputs=outputs)
    for groups in ([[2]], [[-1]], [[0.5]], [[]]):
        with pytest.raises(InputError, match="a group of outputs must be indices among"):
            residual_gains(primitive.reference, 1.0, groups)
    with pytest.raises(InputError, match="action_scale"):
        residual_gains(primitive.reference, -1.0)
    without_null_space = LcNsKmp(primitive.reference, beta=0.0, lambda_=12.0, horizon=20)
    with pytest.raises(InputError, match="beta"):
        authority_gains(without_null_space)


def test_exploration_rms_accepts_lists_and_defaults_to_one_step(primitive):
    gains = [0.5, 2.0]
    np.testing.assert_array_equal(exploration_rms(primitive, gains), exploration_rms(primitive, np.array(gains), 1))
    np.testing.assert_array_equal(authority(primitive, tuple(gains)), authority(primitive, np.array(gains)))
