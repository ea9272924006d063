import pytest
from bead_runs import _bead_run, bead_config, bead_run  # noqa: F401


@pytest.fixture(autouse=True, scope="session")
def plain_pictures():
    """Skip the layout of labels, which takes half of the time of a picture; a training's page shows one episode."""
    from guiderail.tools.visualization import replay, style

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(style, "LAYOUT", None)
        patch.setattr(replay, "EPISODES", 1)
        yield
