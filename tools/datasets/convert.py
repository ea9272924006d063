"""`guiderail import` and `guiderail export`: demonstrations from and to the formats of others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import did_you_mean
from guiderail.models.primitives import Demonstrations
from guiderail.models.primitives.io import MAX_NUMBERS
from guiderail.tools.datasets.formats.csv_layouts import read_csv_files
from guiderail.tools.datasets.formats.lerobot import INFO, read_lerobot, write_lerobot
from guiderail.tools.datasets.formats.recorded import Recorded, from_zero
from guiderail.tools.datasets.formats.ros_bag import find_bags, read_bags, write_mcap
from guiderail.tools.datasets.paths import ENDINGS, check_new, is_there, load_demonstrations

WRITERS: dict[str, Callable[[Path, Demonstrations], list[str]]] = {"lerobot": write_lerobot, "mcap": write_mcap}
"""What demonstrations are exported to, by name."""


def import_recording(
    source: Path,
    out: Path,
    *,
    signal: str | None = None,
    target: Sequence[float] | None = None,
    rate: float | None = None,
    **of_csv: str | None,
) -> dict[str, Any]:
    """Writes demonstrations from a LeRobot dataset, bags or CSV files; returns what was found and what was assumed.

    Args:
        source: a file or a folder.
        out: .npz or .csv; it must not exist.
        signal: a topic or a feature, of which a CSV file has none; found out unless given.
        target: pose of the task's target in the recording's frame, [x y z] in metres and [rx ry rz] in degrees.
        rate: to resample to [1/s]; as recorded unless given.
        of_csv: unit, time_unit, quaternion and angles, see `read_csv_files`.

    Raises:
        InputError: if it can't be read, doesn't say what only whoever recorded it knows, or `out` can't be written.
    """
    if out.suffix not in ENDINGS:
        raise InputError(f"{out} has the ending {out.suffix!r}: demonstrations are .npz or .csv")
    check_new(out, "file")
    if not is_there(source):
        raise InputError(f"there is no {source}: name a LeRobot dataset, a bag, an .mcap or .csv file, or a folder")
    if (source / INFO).is_file():
        found, kind = read_lerobot(source, signal), "a LeRobot dataset"
        if target is not None:
            raise InputError("a LeRobot dataset does not say which numbers are a pose: leave --target out")
    elif source.suffix == ".mcap" or (source.is_dir() and find_bags(source)):
        found, kind = read_bags(source, signal, target), "ROS 2 bags"
    elif source.suffix == ".csv" or (source.is_dir() and any(source.glob("*.csv"))):
        if signal is not None:
            raise InputError("a CSV file holds one motion and no signals to choose from: leave --signal out")
        found, kind = read_csv_files(source, target=target, **of_csv), "CSV files"
    else:
        raise InputError(f"{source} is no LeRobot dataset, bag, .mcap or .csv file, nor a folder of them")
    given = [name for name, value in of_csv.items() if value is not None]
    if given and kind != "CSV files":
        raise InputError(f"{kind} say themselves what --{given[0].replace('_', '-')} would: leave it out")
    demonstrations = Demonstrations(found.times, found.outputs, found.names)
    if rate is not None:
        demonstrations = _at_rate(demonstrations, rate)
    numbers = sum(len(t) + y.size for t, y in zip(demonstrations.times, demonstrations.outputs, strict=True))
    if numbers > MAX_NUMBERS:
        raise InputError(f"{source} holds {numbers} numbers, and a file {MAX_NUMBERS}: give --rate to resample them")
    demonstrations.save(out)
    return (
        {"out": str(out), "from": kind}
        | _described(demonstrations)
        | {"assumed": "; ".join(found.assumed) or "nothing"}
    )


def export_demonstrations(source: Path, out: Path, kind: str, rate: float | None = None) -> dict[str, Any]:
    """Writes demonstrations in another format; returns what was written.

    Args:
        source: of demonstrations.
        out: a folder that does not exist.
        kind: one of `WRITERS`.
        rate: to resample to [1/s]; as recorded unless given.

    Raises:
        InputError: for an unknown format, demonstrations that it can't hold, or a place that can't be written to.
    """
    if kind not in WRITERS:
        raise InputError(f"there is no format {kind!r}: {did_you_mean(kind, WRITERS)}")
    check_new(out, "folder")
    demonstrations, notes = load_demonstrations(source), []
    if rate is not None:
        notes = from_zero(demonstrations)
        demonstrations = _at_rate(demonstrations, rate)
    notes = WRITERS[kind](out, demonstrations) + notes
    return {"out": str(out), "to": kind} | _described(demonstrations) | {"note": "; ".join(notes)}


def _at_rate(demonstrations: Demonstrations, rate: float) -> Demonstrations:
    if not (np.isfinite(rate) and rate > 0):
        raise InputError(f"--rate is samples in a second and must be positive, not {rate}")
    samples = sum(float(t[-1] - t[0]) * rate for t in demonstrations.times)
    if samples * (1 + demonstrations.num_outputs) > MAX_NUMBERS:
        raise InputError(
            f"--rate {rate:g} makes {samples:.3g} samples, and a file holds {MAX_NUMBERS} numbers: give a lower one"
        )
    times, outputs = [], []
    for t, y in zip(demonstrations.times, demonstrations.outputs, strict=True):
        at = np.arange(int(np.floor((t[-1] - t[0]) * rate + 1e-9)) + 1) / rate
        times.append(at)
        outputs.append(np.column_stack([np.interp(at + t[0], t, column) for column in y.T]))
    return Demonstrations(times, outputs, demonstrations.names)


def _described(demonstrations: Demonstrations) -> dict[str, Any]:
    rates = [float(1.0 / np.median(np.diff(t))) for t in demonstrations.times]
    return {
        "demonstrations": demonstrations.num_demonstrations,
        "outputs": list(demonstrations.names),
        "samples": [len(t) for t in demonstrations.times],
        "samples a second": f"{min(rates):.4g} to {max(rates):.4g}"
        if max(rates) - min(rates) > 0.01
        else f"{rates[0]:.4g}",
    }


__all__ = ["Recorded", "export_demonstrations", "import_recording"]
