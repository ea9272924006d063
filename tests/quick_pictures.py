"""Fixture that draws pictures quickly."""

import pytest


@pytest.fixture(autouse=True, scope="session")
def simplify_pictures():
    """Omit the layout of labels, half of the time of a picture, and show one episode on the page of a run."""
    from guiderail.tools.visualization import replay, style

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(style, "LAYOUT", None)
        patch.setattr(replay, "EPISODES", 1)
        yield
