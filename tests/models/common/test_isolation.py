"""An isolated function returns its result, or an error with the reason."""

import os
import resource
import signal

import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.common.isolation import IsolatedError, run_isolated


def fail():
    raise ValueError("no volume")


def spin():
    while True:
        pass


def spin_on():
    signal.signal(signal.SIGXCPU, signal.SIG_IGN)
    spin()


def limit_and_isolate():
    resource.setrlimit(resource.RLIMIT_CPU, (100, 100))
    return run_isolated(lambda: resource.getrlimit(resource.RLIMIT_CPU), cpu_seconds=1000)


def kill():
    os.kill(os.getpid(), signal.SIGKILL)


def test_run_isolated_returns_the_result():
    assert run_isolated(lambda a, b: a + b, [1], [2], cpu_seconds=5) == [1, 2]


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (fail, "ValueError: no volume"),
        (os.abort, "aborted"),
        (spin, "more than 1 s of CPU time"),
        (spin_on, "more than 1 s of CPU time"),
        (kill, "was killed, maybe for lack of memory"),
    ],
)
def test_run_isolated_gives_the_reason_when_a_function_fails(function, words):
    with pytest.raises(IsolatedError, match=words):
        run_isolated(function, cpu_seconds=1)


def test_run_isolated_keeps_a_lower_limit_of_the_system():
    assert run_isolated(limit_and_isolate, cpu_seconds=1000) == (100, 100)


@pytest.mark.parametrize("seconds", [1.5, 0, "1", None])
def test_run_isolated_refuses_a_limit_that_is_not_whole_seconds(seconds):
    with pytest.raises(InputError, match="cpu_seconds must be a whole number of at least 1"):
        run_isolated(os.getpid, cpu_seconds=seconds)


def test_run_isolated_limits_memory():
    with pytest.raises(IsolatedError, match="too much memory"):
        run_isolated(bytearray, 2**30, cpu_seconds=5, max_bytes=2**27)
    assert len(run_isolated(bytearray, 2**20, cpu_seconds=5, max_bytes=2**27)) == 2**20
