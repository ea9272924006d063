"""Independent readers of demonstrations and templates, a reference for the content of accepted files."""

import csv
from decimal import Decimal
from pathlib import Path

import numpy as np
import yaml


def npz_demonstrations(path: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """Read times (N,) and outputs (N, O) of each demonstration with `numpy.load`."""
    with np.load(path, allow_pickle=False) as file:
        times, outputs = file["times"], file["outputs"]
        if "lengths" in file:
            ends = [sum(file["lengths"].tolist()[: m + 1]) for m in range(len(file["lengths"]))]
            starts = [0, *ends[:-1]]
            parts = [(times[a:b], outputs[a:b]) for a, b in zip(starts, ends, strict=True)]
        else:
            parts = [(times if times.ndim == 1 else times[m], outputs[m]) for m in range(len(outputs))]
    return [_drop_repeated(_doubles(t), _doubles(y)) for t, y in parts]


def csv_demonstrations(path: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """Read times (N,) and outputs (N, O) of each demonstration, with numbers parsed by `decimal.Decimal`."""
    text = path.read_bytes().decode("utf-8").removeprefix("\ufeff")
    rows = list(csv.reader(text.splitlines())) if '"' in text else [line.split(",") for line in text.splitlines()]
    header, body = [name.strip() for name in rows[0]], [row for row in rows[1:] if row not in ([], [""])]
    numbers = [[float(Decimal(field.strip())) for field in row] for row in body]
    if header[:2] != ["demonstration", "time"]:
        return [_drop_repeated(np.array([row[0] for row in numbers]), np.array([row[1:] for row in numbers]))]
    parts = []
    for label in sorted({row[0] for row in numbers}):
        samples = [row[1:] for row in numbers if row[0] == label]
        parts.append(_drop_repeated(np.array([row[0] for row in samples]), np.array([row[1:] for row in samples])))
    return parts


def template_numbers(text: str) -> dict[tuple[str, ...], float]:
    """Return every number of a template by its path of keys, read with PyYAML and evaluated with Python's `eval`."""
    data = yaml.safe_load(text)
    parameters = {name: float(_evaluate(value, {})) for name, value in (data.get("parameters") or {}).items()}
    result: dict[tuple[str, ...], float] = {("parameters", name): value for name, value in parameters.items()}

    def walk(path, entry):
        if isinstance(entry, dict):
            for key, value in entry.items():
                walk((*path, str(key)), value)
        elif isinstance(entry, list):
            for number, value in enumerate(entry):
                walk((*path, str(number)), value)
        elif isinstance(entry, int | float) and not isinstance(entry, bool):
            result[path] = float(entry)
        elif isinstance(entry, str) and path[-1] not in ("kind", "frame", "to", "name"):
            result[path] = float(_evaluate(entry, parameters))

    for key in ("inputs", "max_speed_m_per_s", "max_speed_rad_per_s", "states"):
        walk((key,), data[key])
    return result


def _evaluate(entry, parameters):
    return eval(entry, {"__builtins__": {}}, parameters) if isinstance(entry, str) else entry


def _doubles(values: np.ndarray) -> np.ndarray:
    return np.array([float(value) for value in values.ravel().tolist()]).reshape(values.shape)


def _drop_repeated(t: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return times and outputs without the samples that equal the previous sample in time and outputs."""
    indices = [n for n in range(len(t)) if n == 0 or t[n] != t[n - 1] or (y[n] != y[n - 1]).any()]
    return t[indices], y[indices]
