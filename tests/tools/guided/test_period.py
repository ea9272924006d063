"""The number of control steps of a motion is limited."""

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import Demonstrations, ReferenceTrajectory
from guiderail.models.primitives.demonstrations import MAX_STEPS
from guiderail.tools.guided.segment import Segment

TIMES = np.linspace(0.0, 2.0, 30)
RECORDED = Demonstrations(TIMES, [np.column_stack([TIMES, TIMES**2])])


@pytest.mark.parametrize("period", [1e-9, 1e-300, 2.0 / MAX_STEPS])
def test_period_with_too_many_steps_is_refused(period):
    with pytest.raises(InputError, match=f"{MAX_STEPS} or more periods"):
        Segment(RECORDED).steps_of(period)
    reference = ReferenceTrajectory(TIMES, RECORDED.outputs[0], np.tile(np.eye(2), (30, 1, 1)))
    with pytest.raises(InputError, match=f"{MAX_STEPS} or more periods"):
        reference.resampled(period)


@pytest.mark.parametrize("number", [MAX_STEPS + 1, 10**12])
def test_number_of_steps_is_refused_when_too_large(number):
    with pytest.raises(InputError, match=f"{MAX_STEPS}"):
        Segment(RECORDED, num_steps=number)
    with pytest.raises(InputError, match=f"{MAX_STEPS}"):
        RECORDED.resampled(number)
    assert Segment(RECORDED).steps_of(2.1 / MAX_STEPS) <= MAX_STEPS
