"""How many inputs property tests try: a few each time, many by `--hypothesis-profile=long`."""

import gc

from hypothesis import HealthCheck, settings

CALM = {"deadline": None, "database": None, "suppress_health_check": list(HealthCheck)}

settings.register_profile("quick", max_examples=30, derandomize=True, **CALM)
settings.register_profile("long", max_examples=2500, **CALM)
settings.load_profile("quick")


def pytest_collection_finish():
    """What all tests import stays: no collection of garbage looks through it again, a tenth of the suite's time."""
    gc.collect()
    gc.freeze()
