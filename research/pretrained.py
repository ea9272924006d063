"""Train and evaluate the policies that come with the package: `make pretrained`, an hour or two on two cores.

    python -m research.pretrained [NAME...] [--out runs/pretrained] [--episodes 40]

The policies of contact tasks are learned at `difficulty="hard"` on the arm: the clamp with the sensors of a robot, the
connector with a force-torque sensor at the wrist, because joint torques do not show the side of its rim. Every policy
and the baseline policies of its task are evaluated on 40 held-out episodes. The policy's configuration, weights and
evaluation are written to `tools/pretrained/NAME`. An interrupted training is resumed.

`tools/pretrained/insertion` is `general-mean` of `research.unseen_parts`, which needs meshes of others.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

import guiderail
from guiderail.tools.cli.app import to_json
from guiderail.tools.pretrained import PRETRAINED_FOLDER

ARM = {"station": "arm", "sensing": "robot", "difficulty": "hard", "reward": "aligned"}
POLICIES: dict[str, dict[str, Any]] = {
    "passage": {
        "task": "NarrowPassage", "guidance": "skgrl", "episodes": 120, "seed": 180, "difficulty": "hard",
        "reward": "shaped", "preset": "tqc_contact",
        "settings": {
            "demonstration_episodes": 10, "gamma": 0.998,
            "exploration": {
                "constant_episodes": 0, "greedy_episode_fraction": 0.5, "ez_greedy": 0.02, "ez_greedy_longest": 30
            },
        },
    },
    "connector": {
        "task": "BncConnector", "guidance": "kgrl", "episodes": 120, "seed": 3000001, **ARM, "sensing": "wrist",
        "disturbances.friction_factor": (0.5, 2.0), "settings": {"symmetry": "near", "privileged_critic": True},
    },
    "clamp": {
        "task": "GridClamp", "guidance": "sct", "episodes": 60, "seed": 2300001, **ARM, "difficulty": "hard_6s",
        "fixture_offset": "per_run", "algorithm": "sac", "preset": "sac_gridclamp",
        "settings": {"demonstration_episodes": 3},
    },
    "pouring": {
        "task": "Pouring", "guidance": "sct", "episodes": 150, "seed": 113, "difficulty": "hard", "shield": False,
        "reward": "shaped", "algorithm": "sac", "preset": "pouring", "settings": {"net_arch": "128,128"},
    },
}  # fmt: skip
"""Arguments of `guiderail.train` by the name of the policy: the first seeds of the studies narrow_passage_hard,
grid_clamp_robot_sensing and pouring_hard_shield, and of `research.engines`."""
FILES = ("config.yaml", "policy.json", "policy.safetensors", "evaluation.json")
MAX_SIZE = 200_000  # largest total size of the files of one policy [bytes]
EPISODES = 40  # held-out episodes of the policy and of each baseline policy


def make(name: str, out: Path, episodes: int = EPISODES) -> guiderail.Evaluation:
    """Train and evaluate a policy, and write its files into the package.

    Args:
        name: Key of `POLICIES`.
        out: Folder of the runs.
        episodes: Held-out episodes.
    """
    folder = out / name
    arguments = dict(POLICIES[name])
    if folder.exists():
        run = guiderail.train(arguments["task"], out=folder, resume=True)
    else:
        run = guiderail.train(arguments.pop("task"), out=folder, **arguments)
    evaluation = guiderail.evaluate(run, episodes=episodes)
    text = json.dumps(json.loads(to_json({"sentence": evaluation.sentence, **evaluation})), indent=1)
    (folder / "evaluation.json").write_text(text + "\n", encoding="utf-8")
    size = sum((folder / file).stat().st_size for file in FILES)
    if size > MAX_SIZE:
        raise SystemExit(f"{name} has {size} bytes, more than {MAX_SIZE}")
    (PRETRAINED_FOLDER / name).mkdir(exist_ok=True)
    for file in FILES:
        shutil.copyfile(folder / file, PRETRAINED_FOLDER / name / file)
    return evaluation


def main() -> None:
    """Train and store the policies that are named on the command line; all policies by default."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", choices=[*POLICIES, []], help="Policies; all by default.")
    parser.add_argument("--out", type=Path, default=Path("runs/pretrained"), help="Folder of the runs.")
    parser.add_argument("--episodes", type=int, default=EPISODES, help="Held-out episodes of each policy.")
    args = parser.parse_args()
    for name in args.names or POLICIES:
        print(f"{name}: {make(name, args.out, args.episodes).sentence}", flush=True)


if __name__ == "__main__":
    main()
