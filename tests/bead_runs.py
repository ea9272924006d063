"""Fixtures with training runs on the bead task, for the tests of tools and research."""

import shutil
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent / "tools"))
import bead

bead.register()


@pytest.fixture(scope="session")
def bead_config():
    """Return the configuration of a run of about one second: small networks, updated from the second episode on."""
    from guiderail.tools.learning.run_folder import configure

    settings = {"net_arch": "16", "batch_size": 16, "learning_starts": 10, "gradient_steps": 4}
    return configure("Bead", {}, settings=settings, episodes=8, seed=5)


@pytest.fixture(scope="session")
def _bead_run(bead_config, tmp_path_factory):
    from guiderail.tools.learning.run_folder import RunFolder
    from guiderail.tools.learning.trainer import run_training

    run_training(RunFolder(folder := tmp_path_factory.mktemp("bead") / "run"), bead_config)
    return folder


@pytest.fixture
def bead_run(_bead_run, tmp_path):
    """Return a copy of the folder of a finished run."""
    return shutil.copytree(_bead_run, tmp_path / "run")


@pytest.fixture(autouse=True, scope="session")
def simplify_pictures():
    """Omit the layout of labels, half of the time of a picture, and show one episode on the page of a run."""
    from guiderail.tools.visualization import figures, replay

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "LAYOUT", None)
        patch.setattr(replay, "EPISODES", 1)
        yield
