"""How many inputs property tests try: a few each time, many by `--hypothesis-profile=long`. What tests share."""

import gc

import pytest
from hypothesis import HealthCheck, settings
from served import Forks, begin_forkserver

CALM = {"deadline": None, "database": None, "suppress_health_check": list(HealthCheck)}

settings.register_profile("quick", max_examples=30, derandomize=True, **CALM)
settings.register_profile("long", max_examples=2500, **CALM)
settings.load_profile("quick")


# What hears a robot's bus from Python while a simulator reads it, which a Drake of nanobind's bindings can not.
ON_A_BUS = (
    "hardware/test_station.py", "hardware/test_injections.py", "hardware/test_clock.py",
    "hardware/test_part_randomization.py", "hardware/test_connection.py", "hardware/test_executor.py",
    "hardware/test_train.py", "benchmarks/test_loop.py",
)  # fmt: skip


def pytest_collection_modifyitems(items):
    """Where a handler would end the process, the tests that need one are skipped, and say so."""
    from guiderail.diagrams.hardware.lcm.driver import handlers_are_safe

    if not handlers_are_safe():
        for item in items:
            if item.path.as_posix().endswith(ON_A_BUS):
                item.add_marker(pytest.mark.skip(reason="this Drake calls handlers without the interpreter's lock"))


FORKS = pytest.StashKey[Forks]()


def pytest_collection_finish(session):
    """Before the first test this process has imported everything, and made nothing."""
    gc.freeze()  # collections of garbage look only through what comes after: a fifteenth of the whole run
    used = {name for item in session.items for name in getattr(item, "fixturenames", ())}
    # In this order: a server that is begun later holds what the earlier one is asked by, and ends first.
    if "forkserver" in used:
        begin_forkserver()
    if "forks" in used:
        session.config.stash[FORKS] = Forks()


def pytest_unconfigure(config):
    if FORKS in config.stash:
        config.stash[FORKS].close()


@pytest.fixture(scope="session")
def forks(request):
    """Runs programs in forks of this process as it was then: importing costs more than most of them."""
    return request.config.stash[FORKS]


@pytest.fixture
def forkserver():
    """Processes of multiprocessing's "forkserver" are forks of this process as it was then, too."""
