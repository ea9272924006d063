"""Bounds of commands, fitted to demonstrations, as a picture, as YAML and in a task folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from guiderail.diagrams.envs.options import validate_options
from guiderail.diagrams.tasks.part.file import Bounds, PartTaskFile, read_task_file, write_task_file
from guiderail.models.common.errors import InputError
from guiderail.models.primitives.bounds import DemonstratedBounds, compute_bounds
from guiderail.tools.datasets.paths import check_new, load_demonstrations, path_exists
from guiderail.tools.files import check_picture, check_writable, write_atomically


def fit_bounds(
    file: Path,
    *,
    phases: int = 1,
    margin: float = 0.1,
    min_margin: float = 0.0,
    outputs: list[int] | None = None,
    draw: Path | None = None,
    out: Path | None = None,
    task: Path | None = None,
) -> dict[str, Any]:
    """Fit bounds to demonstrations, draw and write them; return them as text.

    Args:
        file: Demonstrations.
        phases: Number of phases, each with its own bounds.
        margin: Margin beyond the demonstrations, as a fraction of their range.
        min_margin: Smallest margin, in the outputs' unit.
        outputs: Indices of the bounded outputs; all by default.
        draw: Picture to write.
        out: YAML file to write; it must not exist.
        task: Task folder; its bounds are replaced.

    Raises:
        InputError: If an argument is invalid.
    """
    if draw is not None:
        check_picture(draw)
    if out is not None:
        if not path_exists(out) and not out.parent.is_dir():
            raise InputError(f"there is no folder {out.parent}: make it first")
        check_new(out, "file")
        check_writable(out)
    demonstrations = load_demonstrations(file)
    bounds = compute_bounds(demonstrations, phases, margin, min_margin, outputs)
    values = as_values(bounds)
    # The task's bounds are written last, once they are valid: a picture can be drawn again.
    task_file = None if task is None else _with_bounds(task, values)
    if draw is not None:
        _draw(bounds, demonstrations, draw)
    if out is not None:
        text = yaml.safe_dump({"outputs": list(bounds.names), "bounds": values}, sort_keys=False, width=110)
        write_atomically(out, text.encode())
    if task is not None and task_file is not None:
        write_task_file(task, task_file)
    rows = {
        f"{name} in phase {k + 1}": f"{bounds.lower[k, o]:.4g} to {bounds.upper[k, o]:.4g}"
        for k in range(phases)
        for o, name in enumerate(bounds.names)
        if np.isfinite(bounds.lower[k, o])
    }
    fastest = [float(f"{speed:.4g}") for speed in bounds.max_rates]
    written = {"written": str(out or task)} if out or task else {}
    return {"demonstrations": str(file), **rows, "fastest per second": fastest, **written}


def as_values(bounds: DemonstratedBounds) -> dict[str, Any]:
    """Return the value of `bounds` in a task folder; an unbounded output is None."""

    def plain(rows: np.ndarray) -> list[Any]:
        lists = [[float(f"{value:.9g}") if np.isfinite(value) else None for value in row] for row in rows]
        return lists if len(lists) > 1 else lists[0]

    values: dict[str, Any] = {"lower": plain(bounds.lower), "upper": plain(bounds.upper)}
    return values | ({"phases": bounds.phases.tolist()} if len(bounds.phases) > 1 else {})


def _with_bounds(folder: Path, values: dict[str, Any]) -> PartTaskFile:
    """Return the task file of a folder with its bounds replaced."""
    return read_task_file(folder).model_copy(update={"bounds": validate_options(Bounds, values, str(folder))})


def _draw(bounds: DemonstratedBounds, demonstrations: Any, picture: Path) -> None:
    from guiderail.tools.visualization.style import new_figure, save_figure

    common = demonstrations.resampled()
    at = np.linspace(0.0, 1.0, len(common.times[0]))
    edges = np.append(bounds.phases, 1.0)
    figure, axes = new_figure(len(bounds.names), 1, (8.0, 2.0 * len(bounds.names)))
    for o, (axis, name) in enumerate(zip(axes[:, 0], bounds.names, strict=True)):
        axis.plot(at, np.stack(common.outputs)[..., o].T, color="0.6", linewidth=0.8)
        for bound in (bounds.lower[:, o], bounds.upper[:, o]):
            if np.isfinite(bound).all():
                axis.step(edges, np.append(bound, bound[-1]), where="post", color="firebrick", linewidth=1.0)
        axis.set(ylabel=name, xlabel="phase" if o + 1 == len(bounds.names) else "")
    axes[0, 0].set_title("demonstrations and fitted bounds", fontsize=9)
    save_figure(figure, picture)
