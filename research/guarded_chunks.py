"""Guard of chunks around a base policy: guarded and unguarded rollouts on the same held-out episodes of the connector.

Finite differences of the recorded commands are compared with the limits, independently of the code of the guard.

Run it with `python -m research.guarded_chunks --out runs/guarded_chunks`.
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import research.base_policies  # noqa: F401 (registers the base policy)
from guiderail.models.common.errors import InputError
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.evaluate import evaluate_policies
from guiderail.tools.evaluation.evaluation import policy_digest
from guiderail.tools.tables import write_table
from research.command import Parser, print_rows, run_program
from research.distillation import evaluate_in_blocks

TASK, BASE_POLICY = "BncConnector", "connector_slow_search"
GUARDS = ("none", "projection", "slowdown")
MAX_SPEED, MAX_JERK = (0.03, 1.0), (5.0, 200.0)  # of the position [m/s, m/s³] and the angles [rad/s, rad/s³]
ROUNDING = 1e-9  # relative tolerance of a limit, because stored numbers are rounded
EXCESSES = ("bound_excess", "speed_ratio", "jerk_ratio")


def check_commands(
    commands: np.ndarray, lower: np.ndarray, upper: np.ndarray, speed: np.ndarray, jerk: np.ndarray, period: float
) -> dict[str, float]:
    """Measure commands against their limits, without the code of the guard.

    Args:
        commands: Commanded poses (n, O), n at least 4.
        lower: Lower bounds (O,), −inf for none.
        upper: Upper bounds (O,), inf for none.
        speed: Largest speeds (O,) [unit/s].
        jerk: Largest jerks (O,) [unit/s³].
        period: Time between commands [s].

    Returns:
        The largest distance beyond a bound [unit], negative inside; the largest speed and the largest jerk relative to
        their limits; and for each kind of limit the number of violations.
    """
    beyond = np.maximum(lower - commands, commands - upper).max(axis=1)
    fast = (np.abs(commands[1:] - commands[:-1]) / (speed * period)).max(axis=1)
    third = commands[3:] - 3.0 * commands[2:-1] + 3.0 * commands[1:-2] - commands[:-3]
    jerky = (np.abs(third) / (jerk * period**3)).max(axis=1)
    return {
        "bound_excess": float(beyond.max()),
        "speed_ratio": float(fast.max()),
        "jerk_ratio": float(jerky.max()),
        # Negated, so that NaN counts as a violation.
        "bound_violations": int((~(beyond <= 0.0)).sum()),
        "speed_violations": int((~(fast <= 1.0 + ROUNDING)).sum()),
        "jerk_violations": int((~(jerky <= 1.0 + ROUNDING)).sum()),
    }


def evaluate_guard(guard: str, base_policy: str, episodes: int, seed: int) -> pd.DataFrame:
    """Return the rows of held-out episodes with a guard, with the results of `check_commands` as columns.

    Args:
        guard: Value of the option `guard`.
        base_policy: Value of the option `base_policy`.
        episodes: Number of episodes.
        seed: Seed of the first episode.
    """
    options = {"guidance": "base_policy", "difficulty": "hard", "base_policy": base_policy, "base_policy.guard": guard}
    limits = {} if guard == "none" else {"max_speed": MAX_SPEED, "base_policy.max_jerk": MAX_JERK}
    env: Any = make_environment(TASK, {**options, "horizon": 15, **limits})
    try:
        bound = env.unwrapped.diagram.task.bound
        size, period = env.action_space.shape, env.unwrapped.diagram.control_period
        limits = [np.repeat(pair, 3) for pair in (MAX_SPEED, MAX_JERK)]
        upper = np.array([bound, bound, np.inf, np.inf, np.inf, np.inf])

        def collect(env: Any, row: Any) -> dict[str, float]:
            return check_commands(env.unwrapped.trace.commanded, -upper, upper, *limits, period)

        ((_, rows, checks),) = evaluate_policies(
            env, {guard: lambda observation: np.zeros(size)}, episodes=episodes, seed=seed, collect=collect
        )
        return pd.concat([rows, pd.DataFrame(checks)], axis=1)
    finally:
        env.close()


def compare_guards(out: Path, *, base_policy: str = BASE_POLICY, episodes: int = 100) -> list[dict[str, Any]]:
    """Evaluate the base policy with and without the guard; write `guarded_chunks.csv` and `.md`; return the rows.

    Args:
        out: Folder; blocks of episodes that are already evaluated in it are not evaluated again, unless the policy of a
            run has changed.
        base_policy: Registered base policy, or folder of a run with the learner `chunk`.
        episodes: Number of episodes of each guard.

    Raises:
        InputError: If `episodes` is below 1, or there is no such base policy.
    """
    if episodes < 1:
        raise InputError(f"give at least one episode, not {episodes}")
    rows, name = [], Path(base_policy).name
    if (Path(base_policy) / "policy.safetensors").is_file():
        name += f"-{policy_digest(Path(base_policy))}"
    tables = {
        guard: evaluate_in_blocks(
            out / "episodes" / f"{name}-{guard}", partial(evaluate_guard, guard, base_policy), episodes
        )
        for guard in GUARDS
    }
    unguarded = tables["none"]["success"].to_numpy()
    for guard, table in tables.items():
        success = table["success"].to_numpy()
        rows.append(
            {
                "guard": guard,
                "episodes": len(table),
                "success_rate": float(success.mean()),
                "only_with_guard": int(((success == 1) & (unguarded == 0)).sum()),
                "only_without": int(((success == 0) & (unguarded == 1)).sum()),
                **{name: int(table[name].sum()) for name in table if name.endswith("_violations")},
                **{name: float(table[name].max()) for name in EXCESSES},
                "fallback_steps": int(table["fallback_steps"].sum()),
                "commands": int(table["steps"].sum()),
                "peak_force": float(table["peak_force"].max()),
            }
        )
    write_table(out / "guarded_chunks", rows)
    return rows


def main(arguments: list[str]) -> None:
    """Run the program with command-line arguments."""
    parser = Parser("guarded_chunks", "Compare guarded and unguarded chunks of a base policy.", "--episodes 100")
    parser.add_out("runs/guarded_chunks")
    parser.add_argument("--episodes", type=int, default=100, help="held-out episodes of each guard (default: 100)")
    parser.add_argument(
        "--base-policy", default=BASE_POLICY, help=f"registered name, or folder of a run (default: {BASE_POLICY})"
    )
    parser.add_json()
    options = parser.parse_args(arguments)
    rows = compare_guards(options.out, base_policy=options.base_policy, episodes=options.episodes)
    print_rows(options.out / "guarded_chunks.md", rows, as_json=options.json)


if __name__ == "__main__":
    run_program(main)
