"""The systems of this distribution satisfy the rules of the core's systems."""

from pathlib import Path

import numpy as np
import pytest

import guiderail_lerobot
from guiderail.models.primitives import LinearConstraints, ReferenceTrajectory
from guiderail_lerobot.chunk_guard import ChunkGuard
from guiderail_lerobot.chunk_reference import ChunkReference
from guiderail_lerobot.chunk_safety_limiter import ChunkSafetyLimiter
from oracles.systems import check_source, check_system, system_names

PERIOD = 0.125
FILES = [path for path in sorted(Path(guiderail_lerobot.__file__).parent.glob("*.py")) if system_names(path)]


def chunk_reference():
    times = PERIOD * np.arange(20)
    reference = ReferenceTrajectory(times, np.column_stack([times, times]), np.tile(0.01 * np.eye(2), (20, 1, 1)))
    policy, options = (lambda observation: observation), {"horizon": 1, "replan_steps": 1, "covariance_floor": 1.0}
    return ChunkReference(policy, 2, reference, period=PERIOD, **options)


def chunk_safety_limiter():
    box = LinearConstraints.box([-1.0, -1.0], [1.0, 1.0])
    return ChunkSafetyLimiter(ChunkGuard(box, np.ones(2), np.ones(2), period=PERIOD, start=np.zeros(2)), 4, 2, PERIOD)


SYSTEMS = {"ChunkReference": chunk_reference, "ChunkSafetyLimiter": chunk_safety_limiter}


def test_these_tests_cover_every_system():
    assert sorted(name for path in FILES for name in system_names(path)) == sorted(SYSTEMS)


@pytest.mark.parametrize("name", SYSTEMS)
def test_system_declares_and_documents_ports_and_prerequisites(name):
    check_system(SYSTEMS[name]())


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_source_gives_prerequisites_and_raises_input_errors(path):
    check_source(path)
