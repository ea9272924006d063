"""Import of demonstrations from LeRobot datasets, ROS bags and CSV files; export to LeRobot and MCAP."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import did_you_mean
from guiderail.models.primitives import Demonstrations
from guiderail.models.primitives.io import MAX_NUMBERS
from guiderail.tools.files import ENDINGS, check_new, path_exists
from guiderail_data.formats.csv_layouts import read_csv_files
from guiderail_data.formats.lerobot import INFO, read_lerobot, write_lerobot
from guiderail_data.formats.recorded import describe_time_shift
from guiderail_data.formats.ros_bag import find_bags, read_bags, write_mcap
from guiderail_data.reading import load_demonstrations, visible_files
from guiderail_data.validate import other_units

WRITERS: dict[str, Callable[[Path, Demonstrations], list[str]]] = {"lerobot": write_lerobot, "mcap": write_mcap}
"""Export formats by name."""


def import_recording(
    source: Path,
    out: Path,
    *,
    signal: str | None = None,
    target: Sequence[float] | None = None,
    rate: float | None = None,
    **csv_options: str | None,
) -> dict[str, Any]:
    """Import demonstrations from a LeRobot dataset, bags or CSV files into a file.

    Args:
        source: File or folder.
        out: File to write, .npz or .csv; it must not exist.
        signal: ROS topic or LeRobot feature, by default the choice of `choose_signal`; refused for CSV files.
        target: Pose of the task's target in the recording's frame, [x y z] in meters and [rx ry rz] in degrees.
        rate: Sampling rate of the result [1/s]; the recording's by default.
        csv_options: Units and conventions that a CSV file does not state, see `read_csv_files`.

    Returns:
        Summary of the demonstrations, with the assumptions made.

    Raises:
        InputError: If the source cannot be read, a required unit or signal is neither stated in it nor given, an
            option is out of range or does not apply to the source, or `out` cannot be written.
    """
    if out.suffix not in ENDINGS:
        raise InputError(f"{out} has the ending {out.suffix!r}: demonstrations are .npz or .csv")
    check_new(out, "file")
    if not path_exists(source):
        raise InputError(f"there is no {source}: name a LeRobot dataset, a bag, an .mcap or .csv file, or a folder")
    if (source / INFO).is_file():
        recorded, kind = read_lerobot(source, signal), "a LeRobot dataset"
        if target is not None:
            raise InputError("a LeRobot dataset does not state which numbers are a pose: leave --target out")
    elif find_bags(source):
        recorded, kind = read_bags(source, signal, target), "ROS bags"
    elif source.suffix == ".csv" or (source.is_dir() and visible_files(source, (".csv",))):
        if signal is not None:
            raise InputError("a CSV file holds one motion and no signals to choose from: leave --signal out")
        recorded, kind = read_csv_files(source, target=target, **csv_options), "CSV files"
    else:
        remedy = (
            "name the bag's folder, with its metadata.yaml"
            if source.suffix == ".db3"
            else "write the poses of each motion to a CSV file with the columns t, x_m, y_m, z_m, qx, qy, qz and qw"
        )
        raise InputError(
            f"{source} is not a LeRobot dataset, a bag, an .mcap or .csv file, or a folder of them: {remedy}"
        )
    given = [name for name, value in csv_options.items() if value is not None]
    if given and kind != "CSV files":
        raise InputError(f"leave --{given[0].replace('_', '-')} out: it is stated in {kind}")
    demonstrations = Demonstrations(recorded.times, recorded.outputs, recorded.names)
    if rate is not None:
        demonstrations = _at_rate(demonstrations, rate)
    numbers = sum(len(t) + y.size for t, y in zip(demonstrations.times, demonstrations.outputs, strict=True))
    if numbers > MAX_NUMBERS:
        raise InputError(
            f"{source} holds {numbers} numbers, and a file at most {MAX_NUMBERS}: give --rate to resample them"
        )
    demonstrations.save(out)
    remarks = other_units(demonstrations)
    return (
        {"out": str(out), "from": kind}
        | _summarize(demonstrations)
        | {"assumed": "; ".join(recorded.assumptions) or "nothing"}
        | ({"remark": "; ".join(remarks)} if remarks else {})
    )


def export_demonstrations(source: Path, out: Path, kind: str, rate: float | None = None) -> dict[str, Any]:
    """Write the demonstrations of a file or folder in another format; return a summary.

    Args:
        source: File or folder of demonstrations.
        out: Folder to write; it must not exist.
        kind: Format, a key of `WRITERS`.
        rate: Sampling rate of the result [1/s]; the demonstrations' by default.

    Raises:
        InputError: For an unknown format, demonstrations that it cannot represent, a rate out of range, or a folder
            that cannot be written.
    """
    if kind not in WRITERS:
        raise InputError(f"there is no format {kind!r}: {did_you_mean(kind, WRITERS)}")
    check_new(out, "folder")
    demonstrations, notes = load_demonstrations(source), []
    if rate is not None:
        notes = describe_time_shift(demonstrations)
        demonstrations = _at_rate(demonstrations, rate)
    notes = WRITERS[kind](out, demonstrations) + notes
    return {"out": str(out), "to": kind} | _summarize(demonstrations) | {"note": "; ".join(notes)}


def _at_rate(demonstrations: Demonstrations, rate: float) -> Demonstrations:
    """Resample demonstrations at a rate [1/s], and shift each of them to begin at time zero."""
    if not (np.isfinite(rate) and rate > 0):
        raise InputError(f"--rate is in samples per second and must be positive, not {rate}")
    samples = sum(float(t[-1] - t[0]) * rate for t in demonstrations.times)
    if samples * (1 + demonstrations.num_outputs) > MAX_NUMBERS:
        raise InputError(
            f"--rate {rate:g} makes {samples:.3g} samples; a file holds at most {MAX_NUMBERS} numbers: give a lower one"
        )
    times, outputs = [], []
    for index, (t, y) in enumerate(zip(demonstrations.times, demonstrations.outputs, strict=True)):
        at = np.arange(int(np.floor((t[-1] - t[0]) * rate + 1e-9)) + 1) / rate
        if len(at) < 2:
            raise InputError(
                f"--rate {rate:g} leaves one sample of demonstration {index}, which lasts {t[-1] - t[0]:g} s: give a "
                "higher one"
            )
        times.append(at)
        outputs.append(np.column_stack([np.interp(at + t[0], t, column) for column in y.T]))
    return Demonstrations(times, outputs, demonstrations.names)


def _summarize(demonstrations: Demonstrations) -> dict[str, Any]:
    rates = [float(1.0 / np.median(np.diff(t))) for t in demonstrations.times]
    return {
        "demonstrations": demonstrations.num_demonstrations,
        "outputs": list(demonstrations.names),
        "samples": [len(t) for t in demonstrations.times],
        "samples per second": f"{min(rates):.4g} to {max(rates):.4g}"
        if max(rates) - min(rates) > 0.01
        else f"{rates[0]:.4g}",
    }
