"""Table of the results in environments of other packages."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

COLUMNS = (
    "task", "method", "seed", "training_episodes", "held_out_episodes", "success_rate", "success_low", "success_high",
    "success_left", "success_right", "violated_episodes", "max_commanded_violation", "peak_force", "cpu_seconds",
)  # fmt: skip


def read_rows(folder: Path) -> list[dict[str, Any]]:
    """Return a row for each policy of the results in a folder."""
    rows = []
    for path in sorted(folder.glob("*.json")):
        result = json.loads(path.read_text())
        training = result.get("training")
        for name, held_out in result["held_out"].items():
            of = [held_out, training] if training else [held_out]
            won, episodes = held_out["successes"], held_out["episodes"]
            interval = stats.binomtest(won, episodes).proportion_ci(method="wilson")
            left, right = (side[0] / max(side[1], 1) for side in held_out["by_side"])
            method = result["method"] if name == "learned" else f"{result['method']}: {name}"
            worst = float(np.max([0.0, *(one["max_violation"] for one in of)]))  # NaN if one is NaN
            values = (
                result["task"], method, result["seed"], len(result.get("curve", [])), episodes, won / episodes,
                round(interval.low, 3), round(interval.high, 3), left, right,
                sum(one["violated_episodes"] for one in of), worst,
                round(max(one["max_force"] for one in of), 1), round(result["cpu_s"]),
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
