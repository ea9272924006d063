"""Reader and writer of LeRobot datasets of version 3, without LeRobot itself, which needs other dependency versions."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from guiderail.models.common.errors import InputError, brief
from guiderail.models.primitives import Demonstrations
from guiderail.models.primitives.io import MAX_LINES
from guiderail.tools.files import atomic_folder
from guiderail.tools.tables import check_parquet
from guiderail_data.formats.recorded import Recorded, choose_signal, describe_time_shift, is_rate

VERSION = "v3.0"
INFO = Path("meta") / "info.json"
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
TASK = "guiderail demonstration"
_INDEX_FEATURES = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}


def read_lerobot(folder: Path, signal: str | None) -> Recorded:
    """Return one motion per episode of a dataset, with times from its frame indices [s].

    Args:
        folder: Folder of the dataset.
        signal: Name of a feature with a vector of floats; None to choose one by the rules of `choose_signal`.

    Raises:
        InputError: If the folder is not a LeRobot dataset of version 3, a file is damaged, there are more than
            `MAX_LINES` frames, or no single feature can be chosen.
    """
    import pyarrow as arrow
    import pyarrow.parquet as parquet

    try:
        info = json.loads((folder / INFO).read_text(encoding="utf-8"))
        version, features, fps = str(info["codebase_version"]), dict(info["features"]), info["fps"]
        if isinstance(fps, bool | str):
            raise TypeError("fps is not a number")
        fps = float(fps)
        vectors = [name for name, feature in features.items() if _is_vector(name, feature)]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise InputError(f"{folder} is not a LeRobot dataset: its {INFO} is missing or damaged") from error
    if not 0.0 < fps < np.inf:
        raise InputError(f"{folder} has {fps:g} frames a second: correct fps in its {INFO}")
    if not version.startswith("v3"):
        raise InputError(f"{folder} is a LeRobot dataset of version {version}: convert it to v3.0 by LeRobot's script")
    chosen, assumptions = choose_signal(sorted(vectors), signal, str(folder), "--signal")
    # macOS adds hidden files to copied folders.
    files = sorted(file for file in (folder / "data").rglob("*.parquet") if not file.name.startswith("."))
    if not files:
        raise InputError(f"{folder} has no data/*.parquet: copy the whole dataset")
    check_parquet(files, MAX_LINES)
    columns = [chosen, "frame_index", "episode_index"]
    try:
        tables = [parquet.read_table(file, columns=columns) for file in files]
        values = np.concatenate([np.array(table[chosen].to_pylist(), dtype=float) for table in tables])
        values = values.reshape(len(values), -1)  # a feature of size 1 is stored as scalars, not as lists
        frames, episodes = (
            np.concatenate([table[name].to_numpy() for table in tables]) for name in ("frame_index", "episode_index")
        )
    except (arrow.ArrowException, OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{folder} holds data that its {INFO} does not describe: {brief(str(error))}") from error
    names = _names(features[chosen], values.shape[1])
    rates = [name for name in names if is_rate(name)]
    if rates and signal is None:
        raise InputError(
            f"{chosen} of {folder} has {rates[0]}, whose name states a change, a rate or a force instead of a "
            "position: name another feature with --signal, or this one to import it as it is"
        )
    assumptions += [
        f"time is the frame index at {fps:g} frames per second",
        "numbers are kept as they are: a LeRobot dataset does not state their unit or frame",
    ]
    recorded = Recorded([], [], names, assumptions)
    for episode in np.unique(episodes):
        rows = np.flatnonzero(episodes == episode)
        rows = rows[np.argsort(frames[rows], kind="stable")]
        recorded.times.append(frames[rows] / fps)
        recorded.outputs.append(values[rows])
    return recorded


def _is_vector(name: str, feature: dict[str, Any]) -> bool:
    kind = str(feature.get("dtype", ""))
    return len(feature.get("shape", ())) == 1 and name not in _INDEX_FEATURES and kind.startswith("float")


def _names(feature: dict[str, Any], size: int) -> tuple[str, ...]:
    names = feature.get("names")
    if isinstance(names, dict):  # some datasets have {"motors": [...]}
        names = next(iter(names.values()), None)
    if isinstance(names, list) and len(names) == size:
        return tuple(str(name) for name in names)
    return tuple(f"y{i + 1}" for i in range(size))


def write_lerobot(folder: Path, demonstrations: Demonstrations) -> list[str]:
    """Write a dataset in which the demonstrated motion is both the action and the state; return remarks.

    The folder must be new or empty.

    Raises:
        InputError: If the demonstrations have no common rate, the rate rounds to zero, a value exceeds the range of
            32-bit floats, or the folder cannot be written.
    """
    steps = np.concatenate([np.diff(t) for t in demonstrations.times])
    period = float(np.median(steps))
    if np.abs(steps - period).max() > 1e-3 * period:
        raise InputError(
            "a LeRobot dataset has one rate, and these demonstrations have several: give --rate to resample them"
        )
    motion = Feature(tuple(demonstrations.names), demonstrations.outputs)
    write_features(folder, {"action": motion, "observation.state": motion}, period)
    notes = ["action and observation.state are both the demonstrated motion, as 32-bit numbers"]
    return notes + describe_time_shift(demonstrations)


@dataclass(frozen=True)
class Feature:
    """Signal of every episode of a dataset."""

    names: tuple[str, ...]  # names of its components
    episodes: Sequence[np.ndarray]  # values (n, size) of each episode


def write_features(folder: Path, signals: Mapping[str, Feature], period: float, task: str = TASK) -> None:
    """Write a dataset of signals that are sampled together.

    Args:
        folder: Folder, new or empty.
        signals: Signals by the name of their feature; an episode has equally many samples of each.
        period: Time between samples [s].
        task: Description of the task.

    Raises:
        InputError: If the rate rounds to zero, a value exceeds the range of 32-bit floats, or the folder cannot be
            written.
    """
    import pandas as pd
    import pyarrow as arrow
    import pyarrow.parquet as parquet

    fps = round(1.0 / period, 6)
    if fps == 0.0:
        raise InputError(
            f"a LeRobot dataset states frames per second, and {period:g} s between frames is too long: give --rate"
        )
    fps = int(fps) if float(fps).is_integer() else fps
    values = {name: np.concatenate([*signal.episodes]) for name, signal in signals.items()}
    largest = max(float(np.abs(array).max()) for array in values.values())
    if largest > np.finfo(np.float32).max:
        raise InputError(f"a LeRobot dataset holds numbers of 32 bits, which a value of {largest:g} exceeds")
    values = {name: array.astype(np.float32) for name, array in values.items()}
    lengths = [len(episode) for episode in next(iter(signals.values())).episodes]
    frames = np.concatenate([np.arange(n) for n in lengths])
    episodes = np.repeat(np.arange(len(lengths)), lengths)
    columns = {
        **{
            name: arrow.FixedSizeListArray.from_arrays(arrow.array(array.ravel()), array.shape[1])
            for name, array in values.items()
        },
        "timestamp": arrow.array((frames / fps).astype(np.float32)),
        "frame_index": arrow.array(frames.astype(np.int64)),
        "episode_index": arrow.array(episodes.astype(np.int64)),
        "index": arrow.array(np.arange(len(frames), dtype=np.int64)),
        "task_index": arrow.array(np.zeros(len(frames), dtype=np.int64)),
    }
    features: dict[str, Any] = {
        name: {"dtype": "float32", "shape": [len(signal.names)], "names": list(signal.names)}
        for name, signal in signals.items()
    }
    features |= {name: {"dtype": kind, "shape": [1], "names": None} for name, kind in _INDEX_FEATURES.items()}
    ends = np.cumsum(lengths)
    episode_columns = {
        "episode_index": list(range(len(lengths))),
        "tasks": [[task]] * len(lengths),
        "length": lengths,
        "data/chunk_index": [0] * len(lengths),
        "data/file_index": [0] * len(lengths),
        "dataset_from_index": [int(end - n) for end, n in zip(ends, lengths, strict=True)],
        "dataset_to_index": [int(end) for end in ends],
        "meta/episodes/chunk_index": [0] * len(lengths),
        "meta/episodes/file_index": [0] * len(lengths),
    }
    info = {
        "codebase_version": VERSION,
        "robot_type": None,
        "total_episodes": len(lengths),
        "total_frames": len(frames),
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 500,
        "fps": fps,
        "splits": {"train": f"0:{len(lengths)}"},
        "data_path": DATA_PATH,
        "video_path": None,
        "features": features,
    }
    with atomic_folder(folder) as part:
        for path, table in (
            (DATA_PATH.format(chunk_index=0, file_index=0), columns),
            ("meta/episodes/chunk-000/file-000.parquet", episode_columns),
        ):
            (part / path).parent.mkdir(parents=True)
            parquet.write_table(arrow.table(table), part / path)
        tasks = pd.DataFrame({"task_index": [0]}, index=pd.Index([task], name="task"))
        tasks.to_parquet(part / "meta" / "tasks.parquet")
        (part / INFO).write_text(json.dumps(info, indent=4), encoding="utf-8")
        stats = json.dumps(_statistics(columns, values), indent=4)
        (part / "meta" / "stats.json").write_text(stats, encoding="utf-8")


def _statistics(columns: Mapping[str, Any], values: Mapping[str, np.ndarray]) -> dict[str, Any]:
    statistics = {}
    for name, column in columns.items():
        numbers = values[name].astype(float) if name in values else column.to_numpy()[:, None]
        reduced = {"min": numbers.min(0), "max": numbers.max(0), "mean": numbers.mean(0), "std": numbers.std(0)}
        statistics[name] = {key: value.tolist() for key, value in reduced.items()} | {"count": [len(numbers)]}
    return statistics
