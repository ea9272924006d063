"""Export of a guiderail policy as a LeRobot policy: `python -m lerobot_robot_guiderail.export RUN OUT [USER/NAME]`.

With a third argument the folder is uploaded to the Hugging Face Hub.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import torch
from huggingface_hub import HfApi
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.utils.constants import ACTION, OBS_STATE
from safetensors.torch import load_file

from lerobot_robot_guiderail.card import write_card, write_environment
from lerobot_robot_guiderail.configuration_guiderail import GuiderailConfig
from lerobot_robot_guiderail.modeling_guiderail import GuiderailPolicy
from lerobot_robot_guiderail.processor_guiderail import make_guiderail_pre_post_processors

FORMAT = "guiderail policy 2"


def export(run: Path | str, out: Path | str) -> GuiderailPolicy:
    """Write the policy of a run as a folder that LeRobot loads, with a model card and its environment for EnvHub.

    Args:
        run: Folder with guiderail's `policy.json` and `policy.safetensors`. With `config.yaml`, `env.py` is written as
            well; `evaluation.json`, the output of `guiderail evaluate RUN --json`, is summarized in the card.
        out: Folder to write.

    Returns:
        The policy.

    Raises:
        ValueError: If the files are of another format, or the policy observes images.
    """
    run, out = Path(run), Path(out)
    description, weights = json.loads((run / "policy.json").read_text()), load_file(run / "policy.safetensors")
    if description.get("format") != FORMAT:
        raise ValueError(f"{run} has no policy of the format {FORMAT!r}")
    if len(description["observation_shape"]) != 1 or description.get("image_shape") is not None:
        raise ValueError("a policy that observes images cannot be exported")
    number = len(weights) // 2
    sizes = [weights["layers.0.weight"].shape[1], *(len(weights[f"layers.{i}.bias"]) for i in range(number))]
    config = GuiderailConfig(
        layers=sizes,
        activation=description.get("activation", "relu"),
        squash=description.get("squash", "tanh"),
        action_low=description["action_low"],
        action_high=description["action_high"],
        device="cpu",
        push_to_hub=False,
        input_features={OBS_STATE: PolicyFeature(type=FeatureType.STATE, shape=(sizes[0],))},
        output_features={ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(sizes[-1],))},
    )
    policy = GuiderailPolicy(config)
    policy.load_state_dict({name: torch.as_tensor(value) for name, value in weights.items()})
    policy.eval()
    policy.save_pretrained(out)
    for processor in make_guiderail_pre_post_processors(config):
        processor.save_pretrained(out)
    write_card(run, out)
    write_environment(run, out)
    return policy


def push_to_hub(folder: Path | str, repo_id: str, *, private: bool = False) -> str:
    """Upload an exported folder to the Hugging Face Hub; `GuiderailPolicy.from_pretrained(repo_id)` loads it.

    Args:
        folder: Folder that `export` wrote.
        repo_id: USER/NAME of the repository, which is created if it does not exist.
        private: If True, a new repository is private.

    Returns:
        URL of the commit.
    """
    api = HfApi()
    api.create_repo(repo_id, private=private, exist_ok=True)
    return str(api.upload_folder(repo_id=repo_id, folder_path=folder, commit_message="Upload a guiderail policy"))


if __name__ == "__main__":
    if not 3 <= len(sys.argv) <= 4:
        sys.exit("python -m lerobot_robot_guiderail.export RUN OUT [USER/NAME]")
    export(*sys.argv[1:3])
    print(f"{sys.argv[2]}: use it by lerobot-rollout --policy.path={sys.argv[2]}")
    if len(sys.argv) == 4:
        print(push_to_hub(*sys.argv[2:]))
