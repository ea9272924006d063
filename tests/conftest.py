"""How many inputs property tests try: a few each time, many by `--hypothesis-profile=long`."""

from hypothesis import HealthCheck, settings

CALM = {"deadline": None, "database": None, "suppress_health_check": list(HealthCheck)}

settings.register_profile("quick", max_examples=30, derandomize=True, **CALM)
settings.register_profile("long", max_examples=2500, **CALM)
settings.load_profile("quick")
