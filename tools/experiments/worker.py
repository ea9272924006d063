"""What a worker does with a job, and what it leaves in the job's log: who took it when, and why it failed."""

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

BEGINS = " begins on "


class Logged(Protocol):
    """A job."""

    @property
    def log(self) -> Path:
        """The file that says what became of it; its folder is there before any worker is."""


@dataclass(frozen=True)
class Attempt:
    """Work that refuses a worker where results would be others, and that ends in an outcome whatever happens.

    Attributes:
        work: gives a job's rows.
        versions: what the worker must have installed: of other versions come other bits.
    """

    work: Callable[[Any], list[dict[str, Any]]]
    versions: Mapping[str, str]

    def __call__(self, job: Logged) -> Outcome:
        """The rows of a job, or one sentence."""
        host = socket.gethostname()
        if not job.log.parent.is_dir():
            return Outcome(failure=f"{host} has no {job.log.parent}: --out must be a folder that all workers share")
        found = installed_versions()
        for name, version in self.versions.items():
            if found.get(name) != version:
                other = f"{host} has {name} {found.get(name)}, and {version} is wanted"
                return Outcome(failure=f"{other}: install the same versions everywhere, or results are not the same")
        _note(job, f"{BEGINS}{host}, process {os.getpid()}\n")
        try:
            rows = self.work(job)
        except InputError as error:
            _note(job, f" failed: {error}\n")
            return Outcome(failure=str(error))
        except (Exception, SystemExit) as error:  # Drake's own assertions arrive as SystemExit
            _note(job, f" failed:\n{traceback.format_exc()}")
            words = " ".join(str(error).split())[:200]
            return Outcome(failure=f"{type(error).__name__}: {words} (the traceback is in {job.log})")
        _note(job, " is done\n")
        return Outcome(tuple(rows))


def attempts(log: Path, after: int = 0) -> int:
    """How many workers took a job, counted from a byte of its log on; 0 while it waits."""
    try:
        return log.read_bytes()[after:].count(BEGINS.encode())
    except FileNotFoundError:
        return 0


def _note(job: Logged, words: str) -> None:
    """A log that cannot be written, on a disk that is full, fails nothing that could go on."""
    with suppress(OSError), job.log.open("a", encoding="utf-8") as file:
        file.write(f"{datetime.now(UTC):%Y-%m-%d %H:%M:%S}{words}")
