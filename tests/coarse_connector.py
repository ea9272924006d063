"""Fixture for tests whose subject is not the contact of the connector: they simulate it with longer steps."""

import pytest


@pytest.fixture(autouse=True, scope="module")
def coarse_connector():
    """Double the time step of the connector's plant; a module has diagrams of its own, because the key has no step."""
    from guiderail.diagrams.envs import make
    from guiderail.diagrams.tasks.bnc_connector import BncWorkcell

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(BncWorkcell, "time_step", 2.0 * BncWorkcell.time_step)
        patch.setattr(make, "_POOL", make.DiagramPool())
        yield
