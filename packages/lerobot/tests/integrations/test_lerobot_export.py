"""Export of a policy to LeRobot, tested with doubles of LeRobot's modules.

`make lerobot` tests the export with the real library.
"""

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType
from unittest.mock import MagicMock

import numpy as np
import pytest
from safetensors.numpy import save_file

FILE = Path(__file__).parents[2] / "src/lerobot_robot_guiderail/export.py"
DOUBLES = {
    "huggingface_hub": ("HfApi",),
    "lerobot_robot_guiderail.card": ("write_card", "write_environment"),
    "lerobot.configs": ("FeatureType", "PolicyFeature"),
    "lerobot.utils.constants": ("ACTION", "OBS_STATE"),
    "lerobot_robot_guiderail.configuration_guiderail": ("GuiderailConfig",),
    "lerobot_robot_guiderail.modeling_guiderail": ("GuiderailPolicy",),
    "lerobot_robot_guiderail.processor_guiderail": ("make_guiderail_pre_post_processors",),
}


@pytest.fixture
def module(monkeypatch):
    """Return the export module, imported with doubles of LeRobot's modules and of modules that import LeRobot."""
    for name in ("lerobot", "lerobot.utils", "lerobot_robot_guiderail"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    for name, members in DOUBLES.items():
        double = ModuleType(name)
        vars(double).update({member: MagicMock() for member in members})
        monkeypatch.setitem(sys.modules, name, double)
    spec = importlib.util.spec_from_file_location("guiderail_lerobot_export", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    "observation", [{"observation_shape": [8, 8, 3]}, {"observation_shape": [199], "image_shape": [8, 8, 3]}]
)
def test_policy_that_observes_images_is_refused(module, observation, tmp_path):
    weights = {"layers.0.weight": np.zeros((2, 19), np.float32), "layers.0.bias": np.zeros(2, np.float32)}
    save_file(weights, tmp_path / "policy.safetensors")
    description = {"format": module.FORMAT, "action_low": [-1.0] * 2, "action_high": [1.0] * 2, "pool": 4} | observation
    (tmp_path / "policy.json").write_text(json.dumps(description))
    with pytest.raises(ValueError, match="observes images"):
        module.export(tmp_path, tmp_path / "out")


def test_exported_folder_is_uploaded_to_a_repository(module, tmp_path):
    api = module.HfApi.return_value
    api.upload_folder.return_value = "https://huggingface.co/lab/connector/commit/1"
    assert module.push_to_hub(tmp_path, "lab/connector", private=True).endswith("/commit/1")
    api.create_repo.assert_called_once_with("lab/connector", private=True, exist_ok=True)
    assert api.upload_folder.call_args.kwargs["folder_path"] == tmp_path
