import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from guiderail.models.common.errors import InputError
from guiderail_studies.engines.engine import make_engine

needs_ray = pytest.mark.skipif(find_spec("ray") is None, reason="Ray is an extra: pip install 'guiderail[ray]'")


def test_ray_engine_names_the_missing_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r'pip install "guiderail\[ray\]"'):
        make_engine("ray")


@needs_ray
def test_ray_cluster_refuses_a_number_of_processes():
    with pytest.raises(InputError, match="leave --processes out"):
        make_engine("ray", 2, "127.0.0.1:6379")


@needs_ray
def test_ray_engine_reports_an_unreachable_address():
    with (
        pytest.raises(InputError, match=r"there is no Ray at 127.0.0.1:9 \(.*refused\)"),
        make_engine("ray", None, "127.0.0.1:9"),
    ):
        pass


@needs_ray
def test_ray_cluster_completes_the_same_study_after_losses(tmp_path):
    script = Path(__file__).with_name("ray_study.py")
    result = subprocess.run([sys.executable, script, "--bead", "--out", tmp_path], capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
