"""Train TQC with and without guidance in an environment of another package, and evaluate it on held-out episodes.

    python -m research.outside_envs.learn peg --method kgrl --seeds 0 1 2 3 4 --out DIR
    python -m research.outside_envs.learn peg --method baselines --out DIR
    python -m research.outside_envs.learn table --out DIR

`make outside` creates the Python environment with metaworld, robosuite and their version of MuJoCo. A result that
exists in DIR is not computed again.
"""

import argparse
import csv
import json
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from scipy import stats

from guiderail.tools.files import write_atomically
from guiderail.tools.guided.guide import Guide
from research.outside_envs.task import LearnerSettings, OutsideTask

TASKS = ("peg", "assembly", "nut")
METHODS = ("kgrl", "skgrl", "residual", "clipped_residual", "tqc", "rlpd")  # the last two are without guidance
TOLERANCE = 1e-9  # largest violation of a constraint that is not counted [unit of the output]
HELD_OUT_SEED = 10_000
SELECTION_SEED = 5_000  # seed of the episodes that select the best constant action
NUM_DEMONSTRATIONS = 10
LEARNING_RATE, LAST_LEARNING_RATE = 5e-4, 1e-4  # initial and final value; it falls in the second half of the training
ENTROPY_FALL = (0.4, 0.9)  # fractions of the training between which the target entropy falls
# Columns of the table of results.
COLUMNS = (
    "task", "method", "seed", "training_episodes", "held_out_episodes", "success_rate", "success_low", "success_high",
    "success_left", "success_right", "violated_episodes", "max_commanded_violation", "peak_force", "cpu_seconds",
)  # fmt: skip
Row = dict[str, Any]
PolicyFn = Callable[[Any, dict[str, Any]], np.ndarray]
"""(observation, info of the last step) → action (A,)."""


class WithHidden(gymnasium.ObservationWrapper):
    """Environment whose observation ends with the environment's `hidden` values, for a privileged critic."""

    def __init__(self, env: gymnasium.Env):
        super().__init__(env)
        size = env.observation_space.shape[0] + len(env.get_wrapper_attr("hidden"))
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)

    def observation(self, observation: np.ndarray) -> np.ndarray:
        """Return the observation of the critic."""
        return np.concatenate([observation, self.env.get_wrapper_attr("hidden")]).astype(np.float32)


def run_episode(env: Any, policy: PolicyFn, seed: int, side: float) -> Row:
    """Run an episode; return its success, side, largest violation and force."""
    observation, info = env.reset(seed=seed, options={"side": side})
    row: Row = {}
    done = False
    while not done:
        observation, _, terminated, truncated, info = env.step(policy(observation, info))
        row, done = add_step(row, info), terminated or truncated
    return row


def add_step(row: Row, info: dict[str, Any]) -> Row:
    """Return the row of an episode, updated with the `info` of a step; an empty row is initialized."""
    row = row or {"success": False, "violation": -np.inf, "force": 0.0, "fallbacks": 0, "decisions": 0}
    return {
        "success": row["success"] or bool(info["is_success"]),
        "violation": float(np.maximum(row["violation"], info["constraint_violation"])),  # NaN if one is NaN
        "force": max(row["force"], float(info.get("peak_force", 0.0))),
        "fallbacks": row["fallbacks"] + int(info["fallback"]),
        "decisions": row["decisions"] + 1,
        "side": info["side"],
    }


def evaluate(env: Any, policy: PolicyFn, episodes: int, seed: int = HELD_OUT_SEED) -> dict[str, Any]:
    """Return the summary of held-out episodes, in which the assumed goal is alternately on the left and right."""
    return summarize([run_episode(env, policy, seed + i, (-1.0) ** i) for i in range(episodes)])


def summarize(rows: list[Row]) -> dict[str, Any]:
    """Return the numbers of successes and episodes, in all and by side, and the largest violation and forces."""
    sides = [[row["success"] for row in rows if row["side"] == side] for side in (-1.0, 1.0)]
    return {
        "episodes": len(rows),
        "successes": sum(row["success"] for row in rows),
        "by_side": [[sum(side), len(side)] for side in sides],
        "violated_episodes": sum(not row["violation"] <= TOLERANCE for row in rows),  # NaN counts as a violation
        "max_violation": float(np.max([row["violation"] for row in rows])),
        "fallbacks": sum(row["fallbacks"] for row in rows),
        "median_force": float(np.median([row["force"] for row in rows])),
        "max_force": max(row["force"] for row in rows),
    }


def train(
    env: Any,
    episodes: int,
    seed: int,
    settings: LearnerSettings,
    demonstrated: list[tuple[Any, ...]] | None = None,
) -> tuple[Any, list[Row]]:
    """Train TQC; return the model, with the averaged actor, and the row of every episode.

    The critics also observe the hidden values (asymmetric actor-critic); the actor does not.

    Args:
        env: Environment with `hidden` values.
        episodes: Number of training episodes.
        seed: Seed of the learner.
        settings: Settings of the learner.
        demonstrated: Transitions of `WithHidden` that are half of every batch (RLPD), as arguments of a replay
            buffer's `add`.
    """
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.logger import configure
    from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

    from guiderail.tools.learning.fast_sb3 import FastTqc
    from guiderail.tools.learning.networks import DemonstrationReplayBuffer, NormalizedReLU, asymmetric_policy

    rows: list[Row] = []
    first, last = settings.entropy_per_action

    class Recorder(BaseCallback):
        row: Row
        average: AveragedModel

        def _on_training_start(self) -> None:
            self.row = {}
            self.average = AveragedModel(self.model.actor, multi_avg_fn=get_ema_multi_avg_fn(settings.average_decay))

        def _on_step(self) -> bool:
            self.average.update_parameters(self.model.actor)
            self.row = add_step(self.row, self.locals["infos"][0])
            if self.locals["dones"][0]:
                rows.append(self.row)
                self.row = {}
                if len(rows) % 20 == 0:
                    print(f"episode {len(rows)}: {sum(row['success'] for row in rows[-20:])} of 20", flush=True)
            fraction = (len(rows) / episodes - ENTROPY_FALL[0]) / (ENTROPY_FALL[1] - ENTROPY_FALL[0])
            entropy = first + np.clip(fraction, 0.0, 1.0) * (last - first)
            self.model.target_entropy = entropy * env.action_space.shape[0]
            return len(rows) < episodes

    def learning_rate(_: float) -> float:
        remaining = 1.0 - len(rows) / episodes
        return max(LEARNING_RATE * min(1.0, 2.0 * remaining), LAST_LEARNING_RATE)

    policy = asymmetric_policy(FastTqc.policy_aliases["MlpPolicy"], env.observation_space.shape[0])
    model = FastTqc(
        policy, WithHidden(env), seed=seed, learning_rate=learning_rate, gamma=0.98, batch_size=64,
        learning_starts=settings.learning_starts, train_freq=1, gradient_steps=settings.gradient_steps,
        n_steps=settings.return_steps, target_entropy=first * env.action_space.shape[0],
        top_quantiles_to_drop_per_net=2, tau=0.01, buffer_size=100_000, device="cpu",
        policy_kwargs={
            "net_arch": [128, 128], "n_critics": 2, "n_quantiles": 15, "activation_fn": NormalizedReLU,
            "share_features_extractor": False,
        },
    )  # fmt: skip
    if demonstrated:
        model.replay_buffer = buffer = DemonstrationReplayBuffer(
            model.buffer_size,
            model.observation_space,
            model.action_space,
            device="cpu",
            gamma=model.gamma,
            n_steps=settings.return_steps,
        )
        for transition in demonstrated:
            buffer.add(*transition)
        buffer.num_demonstrated = len(demonstrated)
    model.set_logger(configure(None, []))
    callback = Recorder()
    model.learn(10**9, callback=callback)
    model.actor.load_state_dict(callback.average.module.state_dict())
    return model, rows


def policy_of(model: Any) -> PolicyFn:
    """Return the deterministic policy of a trained model; zeros replace the hidden values, which the actor ignores."""

    def policy(observation: np.ndarray, _: dict[str, Any]) -> np.ndarray:
        unknown = np.zeros(model.observation_space.shape[0] - len(observation), np.float32)
        action, _ = model.predict(np.concatenate([observation, unknown]), deterministic=True)
        return np.asarray(action)

    return policy


def demonstrate_transitions(task: OutsideTask, env: Any, count: int, seed: int = 1000) -> list[tuple[Any, ...]]:
    """Return the transitions of `count` successful episodes of the scripted policy, without guidance."""
    transitions: list[tuple[Any, ...]] = []
    successes, env = 0, WithHidden(env)
    for attempt in range(10 * count):
        observation, info = env.reset(seed=seed + attempt, options={"side": (-1.0) ** successes})
        episode, done = [], False
        while not done:
            action = task.scripted(env.env.env)
            following, reward, terminated, truncated, info = env.step(action)
            done = terminated or truncated
            infos = [{"TimeLimit.truncated": truncated and not terminated}]
            row = (observation[None], following[None], action[None], np.array([reward]), np.array([done]), infos)
            episode.append(row)
            observation = following
        if info["is_success"]:
            transitions += episode
            successes += 1
        if successes == count:
            return transitions
    raise RuntimeError(f"the scripted policy succeeded in {successes} of {10 * count} episodes")


def evaluate_baselines(task: OutsideTask, env: Any, episodes: int) -> dict[str, Any]:
    """Return the summaries of policies that learn nothing, by name.

    The constant action is the best of all actions with −0.7, 0 or 0.7 in each of the first three entries and 0 in the
    others. It is selected on other episodes.
    """
    size = env.action_space.shape[0]
    rng = np.random.default_rng(0)
    result = {
        "zero": evaluate(env, lambda *_: np.zeros(size), episodes),
        "uniform_random": evaluate(env, lambda *_: rng.uniform(-1.0, 1.0, size), episodes),
    }
    grid = np.array(np.meshgrid(*[[-0.7, 0.0, 0.7]] * min(size, 3))).reshape(min(size, 3), -1).T
    actions = [np.concatenate([row, np.zeros(size - len(row))]) for row in grid]
    wins = [evaluate(env, lambda *_, a=a: a, 4, SELECTION_SEED)["successes"] for a in actions]
    finalists = [actions[i] for i in np.argsort(wins)[::-1][:3]]
    wins = [evaluate(env, lambda *_, a=a: a, 10, SELECTION_SEED + 100)["successes"] for a in finalists]
    best = finalists[int(np.argmax(wins))]
    result[f"constant {best.tolist()}"] = evaluate(env, lambda *_: best, episodes)
    if task.schedule and env.has_wrapper_attr("guide"):
        result["schedule"] = evaluate(env, lambda _, info: task.schedule[info["segment"]], episodes)
    for name, row in result.items():
        print(name, row["by_side"], flush=True)
    return result


def read_rows(folder: Path) -> list[dict[str, Any]]:
    """Return a row for each policy of the results in a folder."""
    rows = []
    for path in sorted(folder.glob("*.json")):
        result = json.loads(path.read_text())
        training = result.get("training")
        for name, held_out in result["held_out"].items():
            parts = [held_out, training] if training else [held_out]
            won, episodes = held_out["successes"], held_out["episodes"]
            interval = stats.binomtest(won, episodes).proportion_ci(method="wilson")
            left, right = (side[0] / max(side[1], 1) for side in held_out["by_side"])
            method = result["method"] if name == "learned" else f"{result['method']}: {name}"
            worst = float(np.max([0.0, *(part["max_violation"] for part in parts)]))  # NaN if one is NaN
            values = (
                result["task"], method, result["seed"], len(result.get("curve", [])), episodes, won / episodes,
                round(interval.low, 3), round(interval.high, 3), left, right,
                sum(part["violated_episodes"] for part in parts), worst,
                round(max(part["max_force"] for part in parts), 1), round(result["cpu_s"]),
            )  # fmt: skip
            rows.append(dict(zip(COLUMNS, values, strict=True)))
    return rows


def print_table(folder: Path) -> None:
    """Print the results of a folder as a Markdown table, and write them to `outside_envs.csv` in it.

    Violations and forces are those of the training and of the held-out episodes together.
    """
    rows = read_rows(folder)
    with (folder / "outside_envs.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    print("| task | method | seed | episodes | held out (95 %) | left, right | violated, worst [mm] | force [N] |")
    print("|---|---|---|---|---|---|---|---|")
    for row in rows:
        rate, low, high = (f"{row[f'success_{name}']:.0%}" for name in ("rate", "low", "high"))
        left, right = (f"{row[f'success_{name}']:.0%}" for name in ("left", "right"))
        violation = f"{row['violated_episodes']}, {1e3 * row['max_commanded_violation']:.1f}"
        print(
            f"| {row['task']} | {row['method']} | {row['seed']} | {row['training_episodes']} | "
            f"{rate} of {row['held_out_episodes']} ({low} to {high}) | {left}, {right} | {violation} | "
            f"{row['peak_force']:.0f} |"
        )


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", choices=(*TASKS, "table"))
    parser.add_argument("--method", default="kgrl", choices=(*METHODS, "baselines"))
    parser.add_argument("--guidance", default="kgrl", choices=METHODS[:4], help="guidance of the baselines")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--episodes", type=int, default=300)
    parser.add_argument("--held-out", type=int, default=50)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    if args.task == "table":
        print_table(args.out)
        return
    if args.task == "nut" and args.method == "rlpd":
        parser.error("rlpd needs a scripted policy whose actions can be repeated: choose peg or assembly")
    import torch

    torch.set_num_threads(1)
    args.out.mkdir(parents=True, exist_ok=True)
    is_baselines = args.method == "baselines"
    label = f"baselines_{args.guidance}" if is_baselines else args.method
    paths = {seed: args.out / f"{args.task}_{label}_{seed}.json" for seed in args.seeds}
    if is_baselines:
        paths = {0: args.out / f"{args.task}_{label}.json"}
    paths = {seed: path for seed, path in paths.items() if not path.exists()}
    if not paths:
        return
    task: OutsideTask = import_module(f"research.outside_envs.{args.task}").TASK
    guidance: str | Guide = args.guidance if is_baselines else {"tqc": "none", "rlpd": "none"}.get(label, label)
    segments = task.make_segments(NUM_DEMONSTRATIONS)
    for seed, path in paths.items():
        begin = time.process_time()
        env = task.make(guidance, seed, segments)
        if env.has_wrapper_attr("guide"):
            guidance = env.get_wrapper_attr("guide")  # fitted once
        result: dict[str, Any] = {"task": args.task, "method": label, "seed": seed}
        if is_baselines:
            result["held_out"] = evaluate_baselines(task, env, args.held_out)
        else:
            settings = task.settings if env.has_wrapper_attr("guide") else LearnerSettings()
            demonstrated = demonstrate_transitions(task, env, NUM_DEMONSTRATIONS) if label == "rlpd" else None
            model, rows = train(env, args.episodes, seed, settings, demonstrated)
            result |= {"training": summarize(rows), "curve": [int(row["success"]) for row in rows]}
            result["held_out"] = {"learned": evaluate(env, policy_of(model), args.held_out)}
            print(label, seed, result["held_out"]["learned"], flush=True)
        result["cpu_s"] = time.process_time() - begin
        write_atomically(path, json.dumps(result, indent=1).encode())  # a file that exists counts as finished


if __name__ == "__main__":
    main()
