import os
import sys
import time

import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.evaluation import forks
from guiderail.tools.evaluation.forks import check_processes, forked_map, num_cores


@pytest.mark.parametrize("processes", [1, 2, 3, 9])
def test_forked_map_yields_results_in_order(processes):
    assert list(forked_map(lambda i: i * i, 7, processes)) == [i * i for i in range(7)]


def test_forked_map_uses_several_processes():
    def slow(index):
        time.sleep(0.05)  # [s], so that the first process cannot finish all calls alone
        return os.getpid()

    result = set(forked_map(slow, 6, 3))
    assert len(result) > 1
    assert os.getpid() not in result
    assert set(forked_map(slow, 1, 3)) == {os.getpid()}


def test_forked_map_raises_the_error_of_a_process():
    def refuse(index):
        raise InputError(f"{index} is refused")

    with pytest.raises(InputError, match="is refused"):
        list(forked_map(refuse, 3, 2))
    with pytest.raises(SystemExit, match="condition 'x > 0' failed"):  # as a failed assertion of Drake raises
        list(forked_map(lambda index: sys.exit("condition 'x > 0' failed"), 3, 2))
    with pytest.raises(RuntimeError, match="_Unpicklable"):
        list(forked_map(lambda index: _raise(), 3, 2))


class _UnpicklableError(Exception):
    """Exception that cannot be unpickled, because `args` has fewer entries than the constructor has parameters."""

    def __init__(self, first, second):
        super().__init__("message")


def _raise():
    raise _UnpicklableError(1, 2)


def test_forked_map_raises_when_a_process_is_killed():
    with pytest.raises(RuntimeError, match="was killed"):
        list(forked_map(lambda index: os.kill(os.getpid(), 9), 3, 2))


def test_forked_map_ends_its_processes_when_closed():
    results = forked_map(lambda index: os.getpid(), 50, 2)
    worker = next(results)
    results.close()
    with pytest.raises(ProcessLookupError):
        os.kill(worker, 0)


def test_check_processes_returns_the_number_of_cores(monkeypatch):
    assert num_cores() >= 1
    monkeypatch.setattr(forks, "num_cores", lambda: 7)
    assert check_processes(None) == 7
    assert check_processes(3) == 3
    with pytest.raises(InputError, match="the number of processes must be a whole number of at least 1, not 0"):
        check_processes(0)
