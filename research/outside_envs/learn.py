"""Train TQC with and without guidance in an environment of another package, and evaluate it on held-out episodes.

    python -m research.outside_envs.learn peg --guidance kgrl --seed 0 --episodes 300 --out DIR
    python -m research.outside_envs.learn peg --guidance kgrl --baselines --out DIR
    python -m research.outside_envs.learn table --out DIR

`make outside` makes the environment with metaworld and its version of MuJoCo.
"""

import argparse
import json
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

TASKS = ("peg", "assembly")
TOLERANCE = 1e-9  # of a constraint [unit of the output]
HELD_OUT_SEED = 10_000


def run_episode(env: Any, policy: Callable[[Any], np.ndarray], seed: int | None = None) -> dict[str, Any]:
    """Run an episode; return its success, side, largest violation and force."""
    observation, _ = env.reset(seed=seed)
    row: dict[str, Any] = {}
    done = False
    while not done:
        observation, _, terminated, truncated, info = env.step(policy(observation))
        row, done = add(row, info), terminated or truncated
    return row


def add(row: dict[str, Any], info: dict[str, Any]) -> dict[str, Any]:
    """Return the row of an episode after one more step."""
    row = row or {"success": False, "violation": -np.inf, "force": 0.0, "fallbacks": 0, "decisions": 0}
    return {
        "success": row["success"] or bool(info["is_success"]),
        "violation": max(row["violation"], float(info["constraint_violation"])),
        "force": max(row["force"], float(info.get("peak_force", 0.0))),
        "fallbacks": row["fallbacks"] + int(info["fallback"]),
        "decisions": row["decisions"] + 1,
        "side": info.get("side"),
    }


def summarize(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return success rates, by side too, and the worst violation of some episodes."""
    sides = sorted({row["side"] for row in rows if row["side"] is not None})
    return {
        "episodes": len(rows),
        "success": float(np.mean([row["success"] for row in rows])),
        "by_side": [float(np.mean([row["success"] for row in rows if row["side"] == side])) for side in sides],
        "violated": float(np.mean([row["violation"] > TOLERANCE for row in rows])),
        "max_violation": max(row["violation"] for row in rows),
        "fallbacks": sum(row["fallbacks"] for row in rows),
        "median_force": float(np.median([row["force"] for row in rows])),
        "max_force": max(row["force"] for row in rows),
    }


def train(env: Any, episodes: int, seed: int) -> tuple[Any, list[dict[str, Any]]]:
    """Train TQC; return the model and the row of every episode."""
    from sb3_contrib import TQC
    from stable_baselines3.common.callbacks import BaseCallback

    class Rows(BaseCallback):
        rows: list[dict[str, Any]]
        row: dict[str, Any]

        def _on_training_start(self) -> None:
            self.rows, self.row = [], {}

        def _on_step(self) -> bool:
            self.row = add(self.row, self.locals["infos"][0])
            if self.locals["dones"][0]:
                self.rows.append(self.row)
                self.row = {}
                if len(self.rows) % 25 == 0:
                    print(len(self.rows), summarize(self.rows[-25:])["success"], flush=True)
            return len(self.rows) < episodes

    model = TQC(
        "MlpPolicy", env, seed=seed, learning_rate=1e-3, gamma=0.98, batch_size=128, learning_starts=200, train_freq=1,
        gradient_steps=2, top_quantiles_to_drop_per_net=2, tau=0.01, device="cpu",
        policy_kwargs={"net_arch": [128, 128], "n_critics": 2, "n_quantiles": 15},
    )  # fmt: skip
    callback = Rows()
    model.learn(10**9, callback=callback)
    return model, callback.rows


def baseline_policies(size: int, seed: int) -> dict[str, Callable[[Any], np.ndarray]]:
    """Return policies that learn nothing, by name."""
    rng = np.random.default_rng(seed)
    policies: dict[str, Callable[[Any], np.ndarray]] = {
        "zero": lambda _: np.zeros(size),
        "uniform_random": lambda _: rng.uniform(-1.0, 1.0, size),
    }
    for axis in range(min(size, 3)):
        for sign in (-1.0, 1.0):
            policies[f"constant {sign * (axis + 1):+.0f}"] = lambda _, a=axis, s=sign: s * np.eye(size)[a]
    return policies


def print_table(folder: Path) -> None:
    """Print the results of a folder as a Markdown table."""
    print("| task | guidance | policy | held out | by side | episodes outside | worst [mm] | largest force [N] |")
    print("|---|---|---|---|---|---|---|---|")
    for path in sorted(folder.glob("*.json")):
        result = json.loads(path.read_text())
        for name, row in result["held_out"].items():
            sides = " / ".join(f"{share:.0%}" for share in row["by_side"])
            training = result.get("training")
            outside = max(row["violated"], training["violated"] if training else 0.0)
            worst = max(row["max_violation"], training["max_violation"] if training else -np.inf)
            force = max(row["max_force"], training["max_force"] if training else 0.0)
            print(
                f"| {result['task']} | {result['guidance']} | {name} | {row['success']:.0%} of {row['episodes']} | "
                f"{sides} | {outside:.0%} | {1e3 * max(worst, 0.0):.1f} | {force:.0f} |"
            )


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", choices=(*TASKS, "table"))
    parser.add_argument("--guidance", default="kgrl")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", type=int, default=300)
    parser.add_argument("--held-out", type=int, default=50)
    parser.add_argument("--baselines", action="store_true", help="evaluate policies that learn nothing instead")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    if given.task == "table":
        print_table(given.out)
        return
    module = import_module(f"research.outside_envs.{given.task}")
    begin = time.process_time()
    env = module.make(given.guidance, given.seed, module.make_segments())
    result: dict[str, Any] = {"task": given.task, "guidance": given.guidance, "seed": given.seed, "held_out": {}}
    if given.baselines:
        policies = baseline_policies(env.action_space.shape[0], given.seed)
        name = f"{given.task}_{given.guidance}_baselines.json"
    else:
        model, rows = train(env, given.episodes, given.seed)
        result |= {"training": summarize(rows), "curve": [row["success"] for row in rows]}
        policies = {
            f"TQC, {given.episodes} episodes, seed {given.seed}": lambda o: model.predict(o, deterministic=True)[0]
        }
        name = f"{given.task}_{given.guidance}_{given.seed}.json"
    for label, policy in policies.items():
        held_out = [run_episode(env, policy, HELD_OUT_SEED + i) for i in range(given.held_out)]
        result["held_out"][label] = summarize(held_out)
        print(given.guidance, label, result["held_out"][label], flush=True)
    result["cpu_s"] = time.process_time() - begin
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / name).write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
