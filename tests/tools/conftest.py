"""Fixtures of the tests of tools."""

import pytest
from bead_runs import _bead_run, bead_config, bead_run, simplify_pictures  # noqa: F401


@pytest.fixture(autouse=True, scope="session")
def cached_fits():
    """Fit equal demonstrations of a `GuidedEnv` once, and compare few kernels, because fits take most of the time."""
    from guiderail.models.primitives import fit as selection
    from guiderail.tools.guided import guide

    original, cache = guide.fit, {}

    def fit(recorded, **options):
        key = (*(array.tobytes() for array in (*recorded.times, *recorded.outputs)), repr(options))
        if key not in cache:
            cache[key] = original(recorded, **options)
        return cache[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(guide, "fit", fit)
        patch.setattr(selection, "_LENGTHS", (0.2, 0.06))
        patch.setattr(selection, "_REGULARIZATIONS", (0.1, 0.01))
        yield
