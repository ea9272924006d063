"""Jobs of the tests of study engines, importable in workers."""

import os
import signal
import sys
import time
from pathlib import Path

from guiderail_studies.engines.engine import Outcome


def work(job):
    """Square a number; for a path, report an existing file, or create the file and kill this process."""
    if isinstance(job, Path):
        if job.exists():
            return Outcome(({"found": str(job)},))
        job.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return Outcome(({"square": job**2, "process": os.getpid(), "threads": os.environ["OMP_NUM_THREADS"]},))


def die(job):
    """Square an even number; end the worker process for an odd number."""
    if job % 2:
        os._exit(3)
    return Outcome(({"square": job**2},))


def wait(job):
    """Print the process id and wait until the process is killed."""
    sys.stdout.write(f"{os.getpid()}\n")
    sys.stdout.flush()
    while True:
        time.sleep(60)
