"""Task folders of many pairs of meshes: in parallel, resumable, with a table of results and failures."""

from __future__ import annotations

import json
import shutil
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from guiderail.models.common.arrays import as_whole
from guiderail.models.common.errors import InputError
from guiderail.tools.files import write_atomically
from guiderail.tools.tables import write_table
from guiderail_parts.create_task import create_task
from guiderail_parts.geometry.assembly_check import MAX_SHRINK, OverlapError
from guiderail_parts.isolation import IsolatedError, run_isolated
from guiderail_parts.pairs import Pair

STORE, TABLE = "parts.json", "parts"  # file with the result of each pair, and table without its ending
COLUMNS = (
    "part", "error", "shrink_mm", "clearance_mm", "deviation_mm", "pieces", "real_time_factor", "inserted",
    "demonstrations_seated", "total_s",
)  # fmt: skip
CPU_SECONDS = 900  # CPU time after which the preparation of a pair is stopped [s]


def create_with_shrink(pair: Pair, folder: Path, log: Callable[[str], None], **options: Any) -> dict[str, Any]:
    """Create the task folder of a pair and return its measured properties, with `shrink_mm`.

    As long as the parts overlap, the plug is shrunk by the distance that the refusal proposes. `options` are those of
    `create_task`; the pair's own options replace them.

    Raises:
        InputError: If the pair is refused.
    """
    arguments = {"unit": pair.unit, **options, **pair.options}
    shrink = float(arguments.pop("shrink", 0.0))
    while True:
        try:
            measured = create_task(pair.plug, pair.socket, folder, shrink=shrink, log=log, **arguments)
            return {**measured, "shrink_mm": round(1e3 * shrink, 4)}
        except OverlapError as error:
            log(str(error))
            if error.shrink is None or shrink + error.shrink > MAX_SHRINK:
                raise
            shrink += error.shrink  # repeated until the parts do not overlap


def create_tasks(
    pairs: Sequence[Pair],
    out: Path,
    *,
    processes: int = 1,
    retry: bool = False,
    log: Callable[[str], None] = lambda sentence: None,
    **options: Any,
) -> dict[str, dict[str, Any]]:
    """Create the task folder of each pair below `out`, and return the results by name.

    Each pair is prepared in a process of its own, so that a failure does not end the others. A result is the measured
    properties, or {"error": reason}. Results are stored, and stored results are not computed again; the table
    `parts.csv` and `parts.md` has one row for each pair, and `logs/` the messages.

    Args:
        pairs: Pairs with different names.
        out: Folder; an existing one is continued.
        processes: Number of pairs that are prepared at the same time.
        retry: True to prepare refused pairs again.
        log: Function called with a sentence on each finished pair.
        options: Options of `create_task` for all pairs; a pair's own options replace them.

    Raises:
        InputError: If `processes` is less than 1, or the stored results are damaged.
    """
    as_whole(processes, "--processes", 1)
    (out / "logs").mkdir(parents=True, exist_ok=True)
    results = _read_results(out / STORE)
    if retry:
        results = {name: result for name, result in results.items() if "error" not in result}
    lock = threading.Lock()

    def prepare(pair: Pair) -> None:
        folder, file = out / pair.name, out / "logs" / f"{pair.name}.txt"
        shutil.rmtree(folder, ignore_errors=True)  # of a pair without a result: left by a killed process
        with file.open("w", encoding="utf-8") as stream:

            def write(sentence: str) -> None:
                stream.write(f"{sentence}\n")
                stream.flush()

            try:
                result = run_isolated(_prepare, pair, folder, write, options, cpu_seconds=CPU_SECONDS)
            except IsolatedError as error:
                result = {"error": str(error)}
            if "error" in result:
                write(result["error"])
        with lock:
            results[pair.name] = result
            write_atomically(out / STORE, json.dumps(results, indent=1).encode())
            write_table(out / TABLE, [_row(name, results[name]) for name in sorted(results)])
            log(f"{pair.name}: {result.get('error', 'task folder created')}")

    with ThreadPoolExecutor(processes) as pool:
        list(pool.map(prepare, [pair for pair in pairs if pair.name not in results]))
    return {pair.name: results[pair.name] for pair in pairs}


def _prepare(pair: Pair, folder: Path, log: Callable[[str], None], options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the result of a pair; run in a process of its own."""
    try:
        return json.loads(json.dumps(create_with_shrink(pair, folder, log, **options), default=str))
    except InputError as error:
        return {"error": str(error)}


def _row(name: str, result: Mapping[str, Any]) -> dict[str, Any]:
    return {"part": name, **{column: result.get(column) for column in COLUMNS[1:]}}


def _read_results(file: Path) -> dict[str, dict[str, Any]]:
    if not file.exists():
        return {}
    try:
        results = json.loads(file.read_text(encoding="utf-8"))
        if not all(isinstance(result, dict) for result in results.values()):
            raise ValueError("results are measurements by name")
    except (OSError, ValueError, AttributeError) as error:
        raise InputError(f"{file} is damaged: restore it, or remove it to prepare all pairs again") from error
    return results
