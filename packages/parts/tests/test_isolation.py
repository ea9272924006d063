"""An isolated function returns its result or raises an error with the reason."""

import os
import resource
import signal

import pytest

from guiderail_parts.isolation import IsolatedError, run_isolated


def fail():
    raise ValueError("no volume")


def loop_forever():
    while True:
        pass


def loop_forever_without_signal():
    signal.signal(signal.SIGXCPU, signal.SIG_IGN)
    loop_forever()


def cpu_limit_inside_a_limit_of_100_s():
    """Return the CPU limits [s] of an isolated function whose parent process has a limit of 100 s."""
    resource.setrlimit(resource.RLIMIT_CPU, (100, 100))
    return run_isolated(lambda: resource.getrlimit(resource.RLIMIT_CPU), cpu_seconds=1000)


def kill_own_process():
    os.kill(os.getpid(), signal.SIGKILL)


def test_run_isolated_returns_the_result():
    assert run_isolated(lambda a, b: a + b, [1], [2], cpu_seconds=5) == [1, 2]


@pytest.mark.parametrize(
    ("function", "reason"),
    [
        (fail, "ValueError: no volume"),
        (os.abort, "aborted"),
        (loop_forever, "more than 1 s of CPU time"),
        (loop_forever_without_signal, "more than 1 s of CPU time"),
        (kill_own_process, "was killed, maybe for lack of memory"),
    ],
)
def test_run_isolated_raises_the_reason_when_a_function_fails(function, reason):
    with pytest.raises(IsolatedError, match=reason):
        run_isolated(function, cpu_seconds=1)


def test_run_isolated_does_not_raise_an_existing_cpu_limit():
    assert run_isolated(cpu_limit_inside_a_limit_of_100_s, cpu_seconds=1000) == (100, 100)


def test_run_isolated_limits_memory():
    with pytest.raises(IsolatedError, match="too much memory"):
        run_isolated(bytearray, 2**30, cpu_seconds=5, max_bytes=2**27)
    assert len(run_isolated(bytearray, 2**20, cpu_seconds=5, max_bytes=2**27)) == 2**20
