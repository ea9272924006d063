"""Constructors of systems refuse arguments of the wrong type with one sentence."""

import pytest

from guiderail.models.common.errors import InputError
from guiderail_hardware import systems


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: systems.PoseRateLimiter(period=None), "a system's period must be a number, not None"),
    ],
)
def test_systems_refuse_wrong_arguments(build, message):
    with pytest.raises(InputError, match=message):
        build()
