"""Counts of fuzzed inputs by outcome, with limits of CPU time and memory."""

import faulthandler
import resource
import signal
from collections import Counter
from contextlib import nullcontext
from pathlib import Path

from hypothesis import settings

MAX_SECONDS = 2.0  # largest CPU time of an input [s]
MAX_BYTES = 200_000_000  # largest growth of memory by an input [bytes]
TIMEOUT = 300  # wall-clock time after which a process that ignores signals is ended [s]

COUNTS: Counter[tuple[str, str]] = Counter()
measuring = False  # only fuzz.py checks the limits


def few_inputs(test):
    """Try ten inputs among the other tests; `make fuzz` and the profile "long" try many."""
    return settings(max_examples=10)(test) if settings().max_examples <= 30 else test


class TooSlowError(BaseException):
    """Error of an input that takes too long.

    The class is not derived from `Exception`, because the code under test must not handle the error.
    """


def attempt(target: str, refusal: type[Exception], call):
    """Return the result of `call`, or None if the input is refused; other exceptions are failures.

    Args:
        target: Kind of input, for the counts.
        refusal: Exception of a refusal.
        call: Function that reads the input.
    """
    COUNTS[target, "inputs"] += 1
    outcome = "tracebacks"
    try:
        with _Limits(target) if measuring else nullcontext():
            result = call()
        outcome = "accepted"
        return result
    except refusal as error:
        outcome, message = "refused", str(error)
    except TooSlowError:
        outcome = "hangs"
        raise
    finally:
        COUNTS[target, outcome] += 1
    # The message is printed as one sentence.
    assert "\n" not in message
    assert 0 < len(message) < 1000
    return None


class _Limits:
    """Context manager that limits the CPU time and memory of an input."""

    def __init__(self, target: str):
        self.target = target

    def __enter__(self):
        faulthandler.dump_traceback_later(TIMEOUT, exit=True)
        Path("/proc/self/clear_refs").write_text("5")  # resets the peak of the resident memory
        self.before = _status("VmRSS")
        signal.signal(signal.SIGPROF, _too_slow)
        signal.setitimer(signal.ITIMER_PROF, MAX_SECONDS)

    def __exit__(self, *error):
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        faulthandler.cancel_dump_traceback_later()
        if (grown := _status("VmHWM") - self.before) > MAX_BYTES:
            COUNTS[self.target, "too large"] += 1
            raise MemoryError(f"the input took {grown / 1e6:.0f} MB")


def _too_slow(number, frame):
    raise TooSlowError(f"the input takes more than {MAX_SECONDS:g} s")


def _status(name: str) -> int:
    """Return an entry of /proc/self/status [bytes]."""
    lines = Path("/proc/self/status").read_text().splitlines()
    line = next(line for line in lines if line.startswith(name))
    return 1024 * int(line.split()[1])


def bound_memory() -> None:
    """Limit the address space, because an array of terabytes must raise a MemoryError."""
    resource.setrlimit(resource.RLIMIT_AS, (12 * 2**30, 12 * 2**30))
