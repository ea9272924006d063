"""What workers are given to do in tests of engines: importable wherever they are."""

import os
import signal
import sys
import time
from pathlib import Path

from guiderail.tools.experiments.engines.engine import Outcome


def work(job):
    """A number is squared; a path is where this process kills itself unless the path exists by then."""
    if isinstance(job, Path):
        if job.exists():
            return Outcome(({"found": str(job)},))
        job.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return Outcome(({"square": job**2, "process": os.getpid(), "threads": os.environ["OMP_NUM_THREADS"]},))


def die(job):
    """No worker survives an odd number."""
    if job % 2:
        os._exit(3)
    return Outcome(({"square": job**2},))


def wait(job):
    """Says which process it is, and never ends."""
    sys.stdout.write(f"{os.getpid()}\n")
    sys.stdout.flush()
    while True:
        time.sleep(60)
