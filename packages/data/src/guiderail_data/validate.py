"""Validation of demonstrations before they are used, and bounds fitted to demonstrations."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from guiderail.diagrams.envs.options import validate_options
from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import require_sibling
from guiderail.models.primitives import Demonstrations, ReferenceTrajectory, SquaredExponential
from guiderail.models.primitives.demonstrations import DemonstratedBounds, compute_bounds
from guiderail.models.primitives.fit import MIN_SHARE, share_within_spread
from guiderail.tools.files import (
    ENDINGS,
    check_new,
    check_picture,
    path_exists,
    write_atomically,
)
from guiderail_data.reading import load_demonstrations, visible_files

JUMP_RATIO = 150.0  # ratio of an output's largest to its median speed above which a jump is reported
GAP_RATIO = 10.0  # ratio of the longest to the median sampling period above which missing samples are reported
UNIT_RATIO = 20.0  # ratio of two motions' extents above which units are suspected to differ; m and mm differ by 1000


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
    """Fit bounds to demonstrations, and draw or write them; return a summary with the bounds as text.

    Args:
        file: File of demonstrations, or a folder of files.
        phases: Number of phases, each with its own bounds.
        margin: Margin on each side, as a fraction of the demonstrations' range in the phase.
        min_margin: Smallest margin on each side, in the outputs' unit.
        outputs: Indices of the bounded outputs; all by default.
        draw: Picture to write.
        out: YAML file to write; it must not exist.
        task: Task folder; the bounds in its `task.yaml` are replaced.

    Raises:
        InputError: If the demonstrations or another argument are invalid, or a file cannot be written.
    """
    if draw is not None:
        check_picture(draw)
    if out is not None:
        if not path_exists(out) and not out.parent.is_dir():
            raise InputError(f"there is no folder {out.parent}: make it first")
        check_new(out, "file")
    demonstrations = load_demonstrations(file)
    bounds = compute_bounds(demonstrations, phases, margin, min_margin, outputs)
    values = as_values(bounds)
    # The new task file is validated before anything is written, and written last, after the other files succeeded.
    task_file = None
    if task is not None:
        require_sibling("parts", "the bounds of a task folder")
        from guiderail_parts.task_file import PartTaskFile, read_task_file, write_task_file

        task_file = validate_options(PartTaskFile, {**dict(read_task_file(task)), "bounds": values}, str(task))
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
    files = [str(path) for path in (draw, out, None if task is None else task / "task.yaml") if path is not None]
    written = {"written": ", ".join(files)} if files else {}
    remarks = other_units(demonstrations)
    remark = {"remark": "; ".join(remarks)} if remarks else {}
    return {"demonstrations": str(file), **rows, "fastest per second": fastest, **written, **remark}


def as_values(bounds: DemonstratedBounds) -> dict[str, Any]:
    """Return bounds as values for a task file: a list for each phase, or one list; None for an unbounded output."""

    def plain(rows: np.ndarray) -> list[Any]:
        lists = [[float(f"{value:.9g}") if np.isfinite(value) else None for value in row] for row in rows]
        return lists if len(lists) > 1 else lists[0]

    values: dict[str, Any] = {"lower": plain(bounds.lower), "upper": plain(bounds.upper)}
    return values | ({"phases": bounds.phases.tolist()} if len(bounds.phases) > 1 else {})


def _draw(bounds: DemonstratedBounds, demonstrations: Any, picture: Path) -> None:
    from guiderail.tools.visualization.figures import new_figure, save_figure

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


_MAX_COMPONENTS = 8  # largest number of mixture components in the comparison with a default primitive


def validate_demonstrations(
    file: Path, draw: Path | None = None, *, fit: bool = False, log: Callable[[str], object] | None = None
) -> dict[str, Any]:
    """Read demonstrations and return their number, durations, ranges and spread, with the fit of a primitive.

    The fit is the deviation of a primitive with default parameters. If `fit` is True, it is the result of
    `fit_primitive`.

    Args:
        file: File of demonstrations, or a folder of files.
        draw: Picture to write, with the mean, two standard deviations and the range.
        fit: True to fit the parameters of a primitive, which takes seconds.
        log: Function that receives sentences on the progress of the fit.

    Raises:
        InputError: If the demonstrations are invalid, or cannot be drawn or fitted.
    """
    if draw is not None:
        check_picture(draw)
    if not path_exists(file):
        raise InputError(f"there is no file {file}: name demonstrations (.npz, .csv or a folder of them)")
    if file.suffix not in ENDINGS and not file.is_dir():
        raise InputError(f"{file} has the ending {file.suffix!r}: demonstrations are .npz or .csv")
    demonstrations = load_demonstrations(file)
    common = demonstrations.resampled()
    outputs = np.stack(common.outputs)
    spread = outputs.std(axis=0) if len(outputs) > 1 else np.zeros(outputs.shape[1:])
    durations = [float(t[-1] - t[0]) for t in demonstrations.times]
    summary = {
        "file": str(file),
        "demonstrations": demonstrations.num_demonstrations,
        "outputs": list(demonstrations.names),
        "shortest": min(durations),
        "longest": max(durations),
        "points": [len(t) for t in demonstrations.times],
        "lowest": outputs.min(axis=(0, 1)).round(6).tolist(),
        "highest": outputs.max(axis=(0, 1)).round(6).tolist(),
        "tightest": spread.min(axis=0).round(6).tolist(),
        "widest": spread.max(axis=0).round(6).tolist(),
    }
    fitted = fit_primitive(demonstrations, log) if fit else _default_deviation(common)
    if draw is not None:
        draw_demonstrations(common, draw)
        summary["picture"] = str(draw)
    summary |= fitted
    remarks = [*other_units(demonstrations), *_irregularities(demonstrations), *_truncated_files(file)]
    remarks = [*remarks, *([summary["remark"]] if "remark" in summary else [])]
    return summary | ({"remark": "; ".join(remarks)} if remarks else {})


def other_units(demonstrations: Demonstrations) -> list[str]:
    """Return a sentence for each demonstration more than `UNIT_RATIO` times larger or smaller than the median one."""
    lengths = np.linalg.norm(np.ptp(np.stack(demonstrations.resampled().outputs), axis=1), axis=1)
    median = float(np.median(lengths))
    return [
        f"demonstration {index} extends over {length:.3g} and the median one over {median:.3g}: check its unit"
        for index, length in enumerate(lengths)
        if max(length, median) > UNIT_RATIO * min(length, median)
    ]


def _irregularities(demonstrations: Demonstrations) -> list[str]:
    """Return a sentence for each gap in time, and for each output of a demonstration with a jump."""
    remarks = []
    for index, (times, outputs) in enumerate(zip(demonstrations.times, demonstrations.outputs, strict=True)):
        periods = np.diff(times)
        k = int(periods.argmax())
        if periods[k] > GAP_RATIO * np.median(periods):
            remarks.append(
                f"demonstration {index} has a gap of {periods[k]:.3g} after the time {times[k]:.4g}, and a median "
                f"period of {np.median(periods):.3g}: check that no samples are missing"
            )
        speeds = np.abs(np.diff(outputs, axis=0)) / periods[:, None]  # a gap in time alone does not raise the speed
        for name, speed, values in zip(demonstrations.names, speeds.T, outputs.T, strict=True):
            k = int(speed.argmax())
            if speed.any() and speed[k] > JUMP_RATIO * np.median(speed[speed > 0.0]):
                remarks.append(
                    f"{name} of demonstration {index} jumps from {values[k]:.4g} to {values[k + 1]:.4g} after the time "
                    f"{times[k]:.4g}: check this sample"
                )
    return remarks


def _truncated_files(file: Path) -> list[str]:
    """Return a sentence for each CSV file that does not end with a line break and may therefore be truncated."""
    files = visible_files(file, (".csv",)) if file.is_dir() else [file] if file.suffix == ".csv" else []
    return [
        f"the last line of {path} has no line end: check that the file is whole"
        for path in files
        if path.read_bytes()[-1:] not in (b"\n", b"\r")
    ]


def _default_deviation(common: Demonstrations) -> dict[str, Any]:
    """Return the deviation of a default primitive from resampled demonstrations, and a remark if it is large."""
    from guiderail.models.primitives.deviation import describe_deviation, measure_deviation

    components = min(_MAX_COMPONENTS, len(common.times[0]) // 4)
    if components < 1:
        return {}
    reference = _fit_reference(common, components)
    deviation, miss = measure_deviation(reference, SquaredExponential(), lambda_=6.0, beta=6.0, horizon=40)
    remark = {} if deviation <= 1.0 else {"remark": describe_deviation(deviation, miss)}
    return {"default_deviation": float(f"{deviation:.4g}"), **remark}


def _fit_reference(common: Demonstrations, components: int | None) -> ReferenceTrajectory:
    """Fit a reference; for a single demonstration, its standard deviation is `_variance_floor`."""
    floor = _variance_floor(common)
    if common.num_demonstrations == 1:
        return ReferenceTrajectory.from_demonstrations(common, components, prior_std=floor)
    return ReferenceTrajectory.from_demonstrations(common, components, floor=floor)


def fit_primitive(demonstrations: Demonstrations, log: Callable[[str], object] | None = None) -> dict[str, Any]:
    """Return the parameters of a primitive that reproduces the demonstrations, and the deviation with the defaults.

    Raises:
        InputError: If there are fewer than three demonstrations, or too few steps.
    """
    from guiderail.models.primitives.fit import fit

    chosen = fit(demonstrations, floor=_variance_floor(demonstrations), log=log)
    share = share_within_spread(chosen.reference, SquaredExponential(), lambda_=6.0, beta=6.0)
    verdict = "follows the demonstrations" if share >= MIN_SHARE else "LEAVES the demonstrations: use these values"
    return {
        "components": chosen.components,
        "length_scale": float(f"{chosen.kernel.length_scale:.4g}"),
        "lambda_": float(f"{chosen.lambda_:.4g}"),
        "beta": float(f"{chosen.lambda_:.4g}"),
        "why": chosen.why,
        "with the defaults": f"λ = β = 6 and length_scale = 0.5: {share:.1%} of the steps within; {verdict}",
    }


def draw_demonstrations(common: Demonstrations, picture: Path) -> None:
    """Draw resampled demonstrations, the mean and two standard deviations of the reference, and the range.

    Raises:
        InputError: If the picture cannot be written.
    """
    from guiderail.tools.visualization.figures import new_figure, save_figure

    outputs, reference = np.stack(common.outputs), _fit_reference(common, None)
    figure, axes = new_figure(len(common.names), 1, (8.0, 2.2 * len(common.names)))
    for o, (axis, name) in enumerate(zip(axes[:, 0], common.names, strict=True)):
        axis.plot(common.times[0], outputs[..., o].T, color="0.6", linewidth=0.8)
        mean, width = reference.means[:, o], 2 * reference.standard_deviations[:, o]
        axis.fill_between(reference.times, mean - width, mean + width, color="tab:blue", alpha=0.25, linewidth=0)
        axis.plot(reference.times, mean, color="tab:blue")
        for bound in (outputs[..., o].min(), outputs[..., o].max()):
            axis.axhline(bound, color="firebrick", linewidth=0.8, linestyle="--")
        axis.set(ylabel=name, xlabel="time" if o + 1 == len(common.names) else "")
    axes[0, 0].set_title("demonstrations, mean and two standard deviations, lowest and highest", fontsize=9)
    save_figure(figure, picture)


def _variance_floor(demonstrations: Demonstrations) -> np.ndarray:
    """Return the smallest standard deviations (O,): identical demonstrations would have a singular covariance."""
    return 1e-3 * np.maximum(np.ptp(np.concatenate(demonstrations.outputs), axis=0), 1e-9)
