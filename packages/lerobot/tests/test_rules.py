"""Rules of `oracles.system_rules` for the systems of chunks."""

from pathlib import Path

import numpy as np
import pytest

from guiderail.models.primitives import LinearConstraints, ReferenceTrajectory
from guiderail_lerobot import chunk_reference, chunk_safety_limiter
from guiderail_lerobot.chunk_guard import ChunkGuard
from oracles.system_rules import RULES, check_source

PERIOD = 0.125
BOX = LinearConstraints.box([-1.0, -1.0], [1.0, 1.0])


def reference():
    times = PERIOD * np.arange(20)
    return ReferenceTrajectory(times, np.column_stack([times, times]), np.tile(0.01 * np.eye(2), (20, 1, 1)))


def make_reference():
    arguments = {"horizon": 1, "replan_steps": 1, "covariance_floor": 1.0, "period": PERIOD}
    return chunk_reference.ChunkReference(lambda observation: observation, 2, reference(), **arguments)


def make_limiter():
    guard = ChunkGuard(BOX, np.ones(2), np.ones(2), period=PERIOD, start=np.zeros(2))
    return chunk_safety_limiter.ChunkSafetyLimiter(guard, 4, 2, PERIOD)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
@pytest.mark.parametrize("make", [make_reference, make_limiter])
def test_system_satisfies_the_rules(rule, make):
    rule(make())


@pytest.mark.parametrize("module", [chunk_reference, chunk_safety_limiter])
def test_source_raises_input_errors(module):
    check_source(Path(module.__file__))
