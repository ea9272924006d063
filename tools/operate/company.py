"""A process that ends with the one that started it, however that one ends."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def companion(code: str) -> Iterator[subprocess.Popen]:
    """Runs Python code in a process of its own, which is gone after the block, and wherever this process is.

    It holds one end of a pipe, and the system closes the other one even where this process is killed.

    Args:
        code: what it runs; its standard input is that pipe.
    """
    watched = f"from {__name__} import end_with_input; end_with_input()\n{code}"
    # Ctrl-C is meant for us: whoever needs the other one still, to bring an arm to rest, ends it afterwards.
    process = subprocess.Popen([sys.executable, "-c", watched], stdin=subprocess.PIPE, start_new_session=True)
    try:
        yield process
    finally:
        process.terminate()
        process.wait()


def end_with_input() -> None:
    """Ends this process where its standard input ends."""

    def wait() -> None:
        while os.read(0, 1024):
            pass
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
