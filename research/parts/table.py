"""Results of the benchmark: one row per pair, and a summary."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

MEASURED = (
    "clearance_mm",
    "shrink_mm",
    "deviation_mm",
    "triangles",
    "compliant",
    "pieces",
    "preparation_s",
    "inserted_s",
    "real_time_factor",
    "penetration_mm",
    "penetration_pushed_on_the_rim_mm",
    "force",
    "inserted",
)
LEARNED = (
    "demonstrations_seated",
    "total_s",
    "calibration",
    "success_rate",
    "uniform_random_success_rate",
    "scripted_success_rate",
    "demonstration_success_rate",
    "episodes_to_convergence",
    "training_episodes",
    "training_minutes",
    "peak_force",
    "max_commanded_violation",
)


def to_table(rows: Mapping[str, Mapping[str, Any]]) -> pd.DataFrame:
    """Return one row per pair; the results of training have the difficulty and the seed in their names."""
    lines = []
    for name, row in sorted(rows.items()):
        line: dict[str, Any] = {"part": name, **{key: row.get(key) for key in MEASURED}}
        for key, result in row.items():
            if isinstance(result, dict):
                line |= {f"{key} {column}": result.get(column) for column in LEARNED}
                line[f"{key} reason"] = result.get("error")
        lines.append({**line, "reason": row.get("error")})
    return pd.DataFrame(lines)


def summarize(rows: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return counts and percentiles over all pairs."""
    prepared = [row for row in rows.values() if "error" not in row]
    inserted = [row for row in prepared if row["inserted"]]
    summary: dict[str, Any] = {"pairs": len(rows), "prepared": len(prepared), "inserted": len(inserted)}
    for key in ("preparation_s", "inserted_s", "real_time_factor"):
        values = [row[key] for row in prepared]
        if values:
            summary[f"{key} 50, 95 %"] = np.round(np.percentile(values, [50, 95]), 2).tolist()
    deep = [
        row
        for row in prepared
        if row["clearance_mm"] and row["penetration_pushed_on_the_rim_mm"] > 0.5 * row["clearance_mm"]
    ]
    summary["deeper than half the clearance"] = len(deep)
    summary["reasons"] = {name: row["error"] for name, row in sorted(rows.items()) if "error" in row}
    return summary
