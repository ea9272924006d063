"""What came of the inputs that were tried, for the count at the end of a long run."""

import faulthandler
import resource
import signal
from collections import Counter
from pathlib import Path

MOST_SECONDS = 2.0  # of CPU, for one input
MOST_BYTES = 200_000_000  # beyond what the process had before it
STUCK = 300  # s of the clock, after which what does not even hear a signal is ended

TRIED: Counter[tuple[str, str]] = Counter()
measuring = False  # in a counted run; tests make no assertion about time


class TooSlowError(BaseException):
    """An input took too long; no handler of the code under test takes this for its own."""


def attempt(target: str, refusal: type[Exception], call):
    """What `call` returns, or None where it refuses; anything else that it raises is a failure.

    Args:
        target: the kind of input, for the count.
        refusal: how it may refuse.
        call: what tries the input.
    """
    TRIED[target, "inputs"] += 1
    try:
        with _Limits(target) if measuring else _NoLimits():
            result = call()
    except refusal as error:
        said = str(error)
    except TooSlowError:
        TRIED[target, "hangs"] += 1
        raise
    except Exception:
        TRIED[target, "tracebacks"] += 1
        raise
    else:
        TRIED[target, "accepted"] += 1
        return result
    TRIED[target, "refused"] += 1
    # One sentence: it is printed as it is.
    assert "\n" not in said
    assert 0 < len(said) < 1000
    return None


class _NoLimits:
    def __enter__(self):
        return self

    def __exit__(self, *error):
        return None


class _Limits:
    """Ends what takes more than its CPU time, and counts what takes more than its memory."""

    def __init__(self, target: str):
        self.target = target

    def __enter__(self):
        faulthandler.dump_traceback_later(STUCK, exit=True)
        Path("/proc/self/clear_refs").write_text("5")  # the peak is measured from here on
        self.before = _status("VmRSS")
        signal.signal(signal.SIGPROF, _too_slow)
        signal.setitimer(signal.ITIMER_PROF, MOST_SECONDS)

    def __exit__(self, *error):
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        faulthandler.cancel_dump_traceback_later()
        if (grown := _status("VmHWM") - self.before) > MOST_BYTES:
            TRIED[self.target, "too large"] += 1
            raise MemoryError(f"it took {grown / 1e6:.0f} MB")


def _too_slow(number, frame):
    raise TooSlowError(f"it takes more than {MOST_SECONDS:g} s")


def _status(name: str) -> int:
    """A line of /proc/self/status [bytes]."""
    line = next(one for one in Path("/proc/self/status").read_text().splitlines() if one.startswith(name))
    return 1024 * int(line.split()[1])


def bound_memory() -> None:
    """Nothing here may take what the machine needs: an array of terabytes is refused as anywhere."""
    resource.setrlimit(resource.RLIMIT_AS, (12 * 2**30, 12 * 2**30))
