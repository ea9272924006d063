"""Shared fixtures, and Hypothesis profiles: few examples by default, many with `--hypothesis-profile=long`."""

import gc

import pytest
from hypothesis import HealthCheck, settings
from served import Forks, begin_forkserver

COMMON = {"deadline": None, "database": None, "suppress_health_check": list(HealthCheck)}

settings.register_profile("quick", max_examples=30, derandomize=True, **COMMON)
settings.register_profile("long", max_examples=2500, **COMMON)
settings.load_profile("quick")


# Tests with Python LCM handlers while a simulator handles subscriptions, which some versions of Drake do not support.
WITH_HANDLERS = (
    "hardware/test_station.py", "hardware/test_injections.py", "hardware/test_clock.py",
    "hardware/test_sim_driver.py", "hardware/test_connection.py", "hardware/test_executor.py",
    "hardware/test_train.py", "benchmarks/test_loop.py",
)  # fmt: skip


def pytest_collection_modifyitems(items):
    """Skip tests with LCM handlers if a handler would abort the process."""
    from guiderail.diagrams.hardware.lcm import handlers_are_safe

    if not handlers_are_safe():
        for item in items:
            if item.path.as_posix().endswith(WITH_HANDLERS):
                item.add_marker(pytest.mark.skip(reason="this Drake calls handlers without the interpreter's lock"))


FORKS = pytest.StashKey[Forks]()


def pytest_collection_finish(session):
    """Start the fork servers when everything is imported and nothing has been created."""
    gc.freeze()  # saves a fifteenth of the whole run in garbage collections
    used = {name for item in session.items for name in getattr(item, "fixturenames", ())}
    # In this order: the later server holds the pipe of the earlier one and must end first.
    if "forkserver" in used:
        begin_forkserver()
    if "forks" in used:
        session.config.stash[FORKS] = Forks()


def pytest_unconfigure(config):
    if FORKS in config.stash:
        config.stash[FORKS].close()


@pytest.fixture(scope="session")
def forks(request):
    """Return an interpreter that runs programs in forks of this process, because importing takes seconds."""
    return request.config.stash[FORKS]


@pytest.fixture
def forkserver():
    """Make processes of multiprocessing's "forkserver" forks of this process as well."""
