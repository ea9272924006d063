"""Environments with a kernel that is registered outside of the package."""

import numpy as np
import pytest

from guiderail import make_env, register_kernel
from guiderail.diagrams.envs.make import make_prior_knowledge
from guiderail.models.common.errors import InputError
from guiderail.models.primitives import SquaredExponential


class RationalQuadratic:
    """Rational quadratic kernel k(ζ, ζ') = (1 + ‖ζ − ζ'‖² / (2 a ℓ²))⁻ᵃ."""

    stationary = True

    def __init__(self, length_scale: float, mixture: float = 1.0):
        self.length_scale, self.mixture = length_scale, mixture

    def __call__(self, a, b):
        a, b = (np.reshape(x, (len(x), -1)) for x in (a, b))
        squared = ((a[:, None] - b[None]) ** 2).sum(axis=-1)
        return (1 + squared / (2 * self.mixture * self.length_scale**2)) ** -self.mixture


@pytest.fixture(scope="module", autouse=True)
def registration():
    """Register the kernel for the tests of this file."""
    register_kernel("lab_rational_quadratic", RationalQuadratic)


def primitive(**options):
    """Return the movement primitive of the narrow passage under KGRL with environment options."""
    return make_prior_knowledge("NarrowPassage", guidance="kgrl", **options).primitive.primitive(history=False)


def test_environment_uses_a_registered_kernel():
    options = {"kernel": "lab_rational_quadratic", "length_scale": 0.3, "kernel.parameters": {"mixture": 2.0}}
    kernel = primitive(**options).kernel
    assert type(kernel) is RationalQuadratic
    assert (kernel.length_scale, kernel.mixture) == (0.3, 2.0)
    assert primitive(**options) is primitive(**options)
    env = make_env("NarrowPassage", guidance="kgrl", **options)
    env.reset(seed=0)
    default_env = make_env("NarrowPassage", guidance="kgrl")
    default_env.reset(seed=0)
    action = np.ones(env.action_space.shape)
    assert env.step(action)[4]["constraint_violation"] != default_env.step(action)[4]["constraint_violation"]
    env.close()
    default_env.close()


def test_environment_uses_the_thesis_kernel_by_default():
    assert primitive().kernel == SquaredExponential(0.5)


def test_kernel_is_refused_when_it_is_a_function():
    register_kernel("lab_function", lambda a, b: np.subtract.outer(a, b))
    with pytest.raises(InputError, match=r"'lab_function' can't be made of length_scale.*: register a class"):
        primitive(kernel="lab_function")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kernel": "matern"}, "there is no kernel 'matern': did you mean matern52"),
        ({"kernel.parameters": {"mixture": 2.0}}, "'squared_exponential' has no parameter 'mixture'"),
        ({"kernel": "lab_rational_quadratic", "kernel.parameters": {"mix": 2.0}}, "did you mean mixture"),
        ({"kernel.parameters": {"mixture": "wide"}}, r"kernel\.parameters must be"),
        ({"length_scale": 0.0}, "length_scale must be more than 0"),
    ],
)
def test_environment_refuses_a_kernel_that_cannot_be_built(options, message):
    with pytest.raises(InputError, match=message):
        make_env("NarrowPassage", guidance="kgrl", **options)
