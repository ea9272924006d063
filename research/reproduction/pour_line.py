"""Map of pouring at difficulty hard: the positions of the thermos's tip from which both balls fall into the mug.

    python -m research.reproduction.pour_line

The scripted policy brings the tip to a position relative to the mug, keeps it there and tilts. The table
`pour_line.csv` has a row for each episode. The shield of the template `pouring_shielded` is derived from it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from guiderail.diagrams.tasks.pouring import AIM, POSITION_SCALE, STATE, scripted_pour_aimed
from guiderail.tools.environments import make_environment
from guiderail.tools.files import write_atomically
from guiderail.tools.tables import table_text
from research.command import Parser, run_program
from research.reproduction.tables import TABLES

X = np.arange(-30, 31, 10)  # positions of the tip relative to `AIM` along x [mm]
Y = np.arange(-30, 41, 10)  # and along y [mm]
REACHED = 0.004  # distance from the position at which tilting begins [m]
SOFTNESS = 0.02  # distance below which the inputs are proportional to it [m]


class PourFrom:
    """Policy that moves the tip to a position in the mug's frame, and then only tilts."""

    def __init__(self, position: np.ndarray):
        """Construct the policy for a position (2,) [m]."""
        self._position = position
        self.height: float | None = None  # height of the tip when tilting began [m]

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the inputs (3,)."""
        if observation[STATE] < 0.5:
            return scripted_pour_aimed(observation)
        tip = observation[:3] / POSITION_SCALE
        missing = self._position - tip[:2]
        if self.height is None and np.linalg.norm(missing) >= REACHED:
            return np.array([*np.clip(missing / SOFTNESS, -1.0, 1.0), 0.0])
        self.height = float(tip[2]) if self.height is None else self.height
        return np.array([0.0, 0.0, 1.0])


def measure(episodes: int = 2) -> list[dict[str, Any]]:
    """Return a row for each episode, `episodes` at each position."""
    env: Any = make_environment("Pouring", {"difficulty": "hard", "guidance": "sct", "shield": False})
    rows: list[dict[str, Any]] = []
    for x in X.tolist():
        for y in Y.tolist():
            for episode in range(episodes):
                policy = PourFrom(AIM + 1e-3 * np.array([x, y]))
                observation, _ = env.reset(seed=100 * episode + len(rows))
                is_over = False
                while not is_over:
                    observation, _, terminated, truncated, info = env.step(policy(observation).astype(np.float32))
                    is_over = terminated or truncated
                position = 1e3 * AIM + [x, y]
                rows.append(
                    {
                        "x_mm": float(position[0]),
                        "y_mm": float(position[1]),
                        "height_mm": None if policy.height is None else round(1e3 * policy.height, 1),
                        "ending": info["termination"],
                    }
                )
    env.close()
    return rows


def main(arguments: list[str]) -> None:
    """Run the program."""
    parser = Parser("reproduction.pour_line", "Measure from where both balls fall into the mug.", "--episodes 2")
    parser.add_argument("--episodes", type=int, default=2, help="episodes at each position (default: 2)")
    parser.add_argument("--out", type=Path, default=TABLES, help="folder of the table")
    args = parser.parse_args(arguments)
    write_atomically(args.out / "pour_line.csv", table_text(measure(args.episodes)).encode())
    print(args.out / "pour_line.csv")


if __name__ == "__main__":
    run_program(main)
