"""Model card and EnvHub file of an exported policy."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from pprint import pformat
from typing import Any

import yaml

REQUIREMENTS = "guiderail[sim]\nguiderail-lerobot\n"
POLICIES = {  # prefixes of the numbers in `evaluation.json`, and what they describe
    "": "this policy",
    "demonstration_": "demonstration alone",
    "uniform_random_": "uniform random actions",
    "constant_": "random constant action",
    "scripted_": "scripted policy",
}


def write_card(run: Path, out: Path) -> None:
    """Write the model card `README.md` of a run's policy, with its evaluation if the run has one."""
    config, evaluation = _config(run), run / "evaluation.json"
    task, guidance = config.get("task", "unknown task"), config.get("environment", {}).get("guidance", "guidance")
    header = {
        "library_name": "lerobot",
        "pipeline_tag": "robotics",
        "tags": ["guiderail", "lerobot", "robotics", "reinforcement-learning"],
    }
    lines = ["---", yaml.safe_dump(header, sort_keys=False).rstrip(), "---", f"# {task}, {guidance}", ""]
    lines += [
        "Policy that guiderail trained in simulation. Its action is the input of the guidance, which turns it into a"
    ]
    lines += ["commanded pose inside the constraints. Without the guidance the policy guarantees no constraint.", ""]
    if evaluation.is_file():
        lines += _results(json.loads(evaluation.read_text("utf-8")))
    lines += ["```python", "from lerobot_robot_guiderail.modeling_guiderail import GuiderailPolicy", ""]
    lines += [f'policy = GuiderailPolicy.from_pretrained("USER/{out.name}")', "```", ""]
    (out / "README.md").write_text("\n".join(lines), encoding="utf-8")


def write_environment(run: Path, out: Path) -> None:
    """Write `env.py` and `requirements.txt`, from which LeRobot's `make_env` builds the environment of the run.

    Nothing is written for a run without `config.yaml`, for a task in a folder, or for one that a file of the user
    registers, because the repository would lack the task's files.
    """
    config = _config(run)
    if not config or config.get("imports") or Path(config["task"]).is_dir():
        return
    text = f'''"""Environment of this policy for LeRobot's EnvHub; requirements.txt lists the packages that it needs."""

from guiderail_lerobot.envhub import make_hub_env

TASK = {config["task"]!r}
OPTIONS = {pformat(config["environment"], sort_dicts=False, width=110)}


def make_env(n_envs=1, use_async_envs=False, cfg=None):
    """Return the environments that LeRobot runs."""
    return make_hub_env(TASK, OPTIONS, n_envs, use_async_envs)
'''
    (out / "env.py").write_text(text, encoding="utf-8")
    (out / "requirements.txt").write_text(REQUIREMENTS, encoding="utf-8")


def _config(run: Path) -> dict[str, Any]:
    file = run / "config.yaml"
    return dict(yaml.safe_load(file.read_text("utf-8"))) if file.is_file() else {}


def _results(evaluation: Mapping[str, Any]) -> list[str]:
    lines = [
        str(evaluation["sentence"]),
        "",
        "| | success [%] | 95 % interval | largest force [N] |",
        "|---|---|---|---|",
    ]
    for prefix, name in POLICIES.items():
        if (rate := evaluation.get(f"{prefix}success_rate")) is not None:
            low, high = (evaluation[f"{prefix}success_{end}"] for end in ("low", "high"))
            force = evaluation[f"{prefix}peak_force"]
            lines.append(f"| {name} | {100 * rate:.0f} | {100 * low:.0f} to {100 * high:.0f} | {force:.1f} |")
    return [*lines, ""]
