"""Shared fixtures, and Hypothesis profiles: few examples by default, many with `--hypothesis-profile=long`."""

import gc
import os
from importlib.util import find_spec

import pytest
from fork_server import Forks, start_forkserver
from hypothesis import HealthCheck, settings

from guiderail.tools.evaluation import forks as evaluation_forks

COMMON = {"deadline": None, "database": None, "suppress_health_check": list(HealthCheck)}

settings.register_profile("quick", max_examples=30, derandomize=True, **COMMON)
settings.register_profile("long", max_examples=2500, **COMMON)
settings.load_profile("quick")


# Test files in which a simulator calls Python handlers of LCM messages, which ends the process in some Drake versions.
WITH_HANDLERS = (
    "drivers/test_station.py", "drivers/test_injections.py", "drivers/test_clock.py",
    "robot/test_sim_driver.py", "robot/test_connection.py", "robot/test_executor.py",
    "robot/test_train.py", "benchmarks/test_loop.py",
)  # fmt: skip


# Files that take longest. They run first, so that no worker begins one of them while the others have nothing left.
SLOW = (
    "parts/tests/test_create_task.py", "calibration/tests/test_calibrate.py", "docs/test_tutorials.py",
    "third_party/test_peglab.py", "cpp/tests/test_export.py", "robot/test_train.py",
    "robot/test_driver_failures.py", "certificate/test_certificate.py", "docs/test_notebooks.py",
)  # fmt: skip


def pytest_collection_modifyitems(items):
    """Order the files, and skip the tests with LCM handlers if a handler would end the process."""
    items.sort(key=lambda item: not item.path.as_posix().endswith(SLOW))
    if find_spec("guiderail_hardware") is None:  # the tests of another sibling, without this one
        return
    from guiderail_hardware.drivers.lcm import handlers_are_safe

    if not handlers_are_safe():
        for item in items:
            if item.path.as_posix().endswith(WITH_HANDLERS):
                reason = "this version of Drake calls LCM handlers without the interpreter's lock"
                item.add_marker(pytest.mark.skip(reason=reason))


def pytest_configure():
    """Skip waiting for the disk, which every written file of a run would do; no test ends the power."""
    os.fsync = lambda file: None


FORKS = pytest.StashKey[Forks]()


def pytest_collection(session):
    """Pause garbage collections, each of which would traverse all modules that are imported so far."""
    gc.disable()


def pytest_collection_finish(session):
    """Start the fork servers after the imports of all tests and before the first fixture.

    From then on, episodes are evaluated in this process unless a test gives a number of processes: a fork of a process
    that has imported everything takes longer than a short episode.
    """
    evaluation_forks.num_cores = lambda: 1
    gc.freeze()  # excludes imported objects from garbage collections, which saves a fifteenth of the run time
    gc.set_threshold(10_000)  # fewer collections, each of which traverses what the tests have left
    gc.enable()
    used = {name for item in session.items for name in getattr(item, "fixturenames", ())}
    # The server that starts later inherits the pipe of the earlier server and must end first.
    if "forkserver" in used:
        start_forkserver()
    if "forks" in used:
        session.config.stash[FORKS] = Forks()


def pytest_unconfigure(config):
    if FORKS in config.stash:
        config.stash[FORKS].close()


@pytest.fixture(scope="session")
def forks(request):
    """Return the server that runs programs in forks of this process, which saves seconds of imports."""
    return request.config.stash[FORKS]


@pytest.fixture
def forkserver():
    """Request that multiprocessing's start method "forkserver" forks this process, which saves seconds of imports."""
