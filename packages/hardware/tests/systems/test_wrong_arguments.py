"""Constructors of systems refuse arguments of the wrong type or plant with one sentence."""

import pytest
from pydrake.multibody.plant import MultibodyPlant

from guiderail.models.common.errors import InputError
from guiderail_hardware import systems
from guiderail_hardware.models.joint_status import StatusLimits

PERIOD = 0.02
ONES = (1.0,) * 6
SAFETY = systems.SafetyLimits(ONES, ONES, ONES, decay_time=1.0)
DRAFT = MultibodyPlant(0.0)  # a plant that is not finalized


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: systems.StatusWatchdog(DRAFT, StatusLimits(ONES), ONES, period=PERIOD), "must be finalized"),
        (lambda: systems.TorqueSafetyLimiter(DRAFT, SAFETY, period=PERIOD), "must be finalized"),
        (lambda: systems.PoseRateLimiter(period=None), "a system's period must be a number, not None"),
    ],
)
def test_systems_refuse_wrong_arguments(build, message):
    with pytest.raises(InputError, match=message):
        build()
