"""Fixtures of the tests of research."""

import sys

import gymnasium
import pytest
from bead_runs import _bead_run, bead_config, bead_run  # noqa: F401

from guiderail.diagrams.tasks.registry import TASKS, environment_id


@pytest.fixture(scope="module")
def own_tasks():
    """Forget the tasks that a module's tests register, with the modules that register them, after these tests.

    Other tests check every registered task and import what a study names, in any order.
    """
    before = set(TASKS._entries)
    yield
    for name in set(TASKS._entries) - before:
        sys.modules.pop(TASKS._entries.pop(name).__module__)
        gymnasium.registry.pop(environment_id(name))
