"""`guiderail constraints`: bounds from demonstrations, drawn over them, as YAML that a task folder takes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from guiderail.diagrams.envs.options import validate_options
from guiderail.diagrams.tasks.part.file import Bounds, PartTaskFile, read_task_file, write_task_file
from guiderail.models.common.errors import InputError
from guiderail.models.primitives.bounds import DemonstratedBounds, demonstrated_bounds
from guiderail.tools.datasets.paths import check_new, is_there, load_demonstrations
from guiderail.tools.files import check_picture, check_writable, write_atomically


def constraints(
    file: Path,
    *,
    phases: int = 1,
    margin: float = 0.1,
    least: float = 0.0,
    outputs: list[int] | None = None,
    draw: Path | None = None,
    out: Path | None = None,
    into: Path | None = None,
) -> dict[str, Any]:
    """Finds bounds, draws and writes them.

    Args:
        file: demonstrations.
        phases, margin, least: see `demonstrated_bounds`.
        outputs: numbers of those that are bounded; all unless given.
        draw: a picture.
        out: a YAML file to write, which must not exist.
        into: a task folder whose bounds become these.

    Raises:
        InputError: if something of that makes no sense.
    """
    if draw is not None:
        check_picture(draw)
    if out is not None:
        if not is_there(out) and not out.parent.is_dir():
            raise InputError(f"there is no folder {out.parent}: make it first")
        check_new(out, "file")
        check_writable(out)
    demonstrations = load_demonstrations(file)
    found = demonstrated_bounds(demonstrations, phases, margin, least, outputs)
    values = as_values(found)
    # A picture can be drawn again, a task's bounds are what others rely on: they change last, and are sound by then.
    bounded = None if into is None else _with_bounds(into, values)
    if draw is not None:
        _draw(found, demonstrations, draw)
    if out is not None:
        text = yaml.safe_dump({"outputs": list(found.names), "bounds": values}, sort_keys=False, width=110)
        write_atomically(out, text.encode())
    if into is not None and bounded is not None:
        write_task_file(into, bounded)
    rows = {
        f"{name} in phase {k + 1}": f"{found.lower[k, o]:.4g} to {found.upper[k, o]:.4g}"
        for k in range(phases)
        for o, name in enumerate(found.names)
        if np.isfinite(found.lower[k, o])
    }
    fastest = [float(f"{one:.4g}") for one in found.fastest]
    written = {"written": str(out or into)} if out or into else {}
    return {"demonstrations": str(file), **rows, "fastest per second": fastest, **written}


def as_values(bounds: DemonstratedBounds) -> dict[str, Any]:
    """What a task folder's `bounds` holds; null where an output is free."""

    def plain(rows: np.ndarray) -> list[Any]:
        lists = [[float(f"{one:.9g}") if np.isfinite(one) else None for one in row] for row in rows]
        return lists if len(lists) > 1 else lists[0]

    values: dict[str, Any] = {"lower": plain(bounds.lower), "upper": plain(bounds.upper)}
    return values | ({"phases": bounds.phases.tolist()} if len(bounds.phases) > 1 else {})


def _with_bounds(folder: Path, values: dict[str, Any]) -> PartTaskFile:
    """A task folder's file with these bounds instead of its own."""
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
    axes[0, 0].set_title("demonstrations, and the bounds that they keep", fontsize=9)
    save_figure(figure, picture)
