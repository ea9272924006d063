import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
import bead

bead.register()


@pytest.fixture
def bead_config():
    """A run of a second: tiny networks that learn from the second episode on."""
    from guiderail.tools.learning.configure import configure

    settings = {"units": "16", "batch_size": 16, "learning_starts": 10, "gradient_steps": 4}
    return configure("Bead", {}, settings=settings, episodes=8, seed=5)
