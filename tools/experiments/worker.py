"""Work of a worker on a job, and the job's log: which worker ran it when, and why it failed."""

from __future__ import annotations

import os
import socket
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from guiderail.models.common.errors import InputError
from guiderail.tools.experiments.engines.engine import Outcome
from guiderail.tools.learning.run_folder import installed_versions

BEGIN = " begins on "


class HasLog(Protocol):
    """Job with a log."""

    @property
    def log(self) -> Path:
        """Log file; its folder exists before any worker starts."""


@dataclass(frozen=True)
class Attempt:
    """Work on a job that always ends in an outcome, and refuses a worker whose results would differ.

    Attributes:
        work: Returns the rows of a job.
        versions: Package versions that the worker must have: other versions give other bits.
    """

    work: Callable[[Any], list[dict[str, Any]]]
    versions: Mapping[str, str]

    def __call__(self, job: HasLog) -> Outcome:
        """Return the rows of a job, or one sentence on its failure."""
        host = socket.gethostname()
        if not job.log.parent.is_dir():
            return Outcome(failure=f"{host} has no {job.log.parent}: --out must be a folder that all workers share")
        installed = installed_versions()
        for name, version in self.versions.items():
            if installed.get(name) != version:
                return Outcome(
                    failure=f"{host} has {name} {installed.get(name)} instead of {version}: install the same versions "
                    "everywhere, because results depend on them"
                )
        _append(job, f"{BEGIN}{host}, process {os.getpid()}\n")
        try:
            rows = self.work(job)
        except InputError as error:
            _append(job, f" failed: {error}\n")
            return Outcome(failure=str(error))
        except (Exception, SystemExit) as error:  # Drake's own assertions arrive as SystemExit
            _append(job, f" failed:\n{traceback.format_exc()}")
            message = " ".join(str(error).split())[:200]
            return Outcome(failure=f"{type(error).__name__}: {message} (the traceback is in {job.log})")
        _append(job, " is done\n")
        return Outcome(tuple(rows))


def count_attempts(log: Path, start: int = 0) -> int:
    """Return how many workers started a job, counted from byte `start` of its log; 0 while it waits."""
    try:
        return log.read_bytes()[start:].count(BEGIN.encode())
    except FileNotFoundError:
        return 0


def _append(job: HasLog, text: str) -> None:
    """Append a line with a time to the log; if the disk is full, the job continues without it."""
    with suppress(OSError), job.log.open("a", encoding="utf-8") as file:
        file.write(f"{datetime.now(UTC):%Y-%m-%d %H:%M:%S}{text}")
