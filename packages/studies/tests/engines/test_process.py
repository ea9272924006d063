import os
import signal
import subprocess
import sys
import threading

import pytest

from guiderail.models.common.errors import InputError
from guiderail_studies.engines.engine import ENGINES, make_engine, register_engine
from oracles.work import die, work

# Program that runs two jobs without end in two workers.
PARENT = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)  # jobs in a shell's background ignore SIGINT
from oracles.work import wait
from guiderail_studies.engines.engine import make_engine
if __name__ == "__main__":
    with make_engine("process", 2) as engine:
        list(engine.run(wait, {0: 0, 1: 1}))
"""


def run(function, jobs, processes=2):
    """Return the outcome of each job in the process engine."""
    with make_engine("process", processes) as engine:
        return dict(engine.run(function, jobs))


def has_ended(process):
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return True
    return False


def test_process_engine_runs_every_job_and_ends_its_workers():
    rows = {key: outcome.rows[0] for key, outcome in run(work, {n: n for n in range(7)}).items()}
    assert {key: row["square"] for key, row in rows.items()} == {n: n * n for n in range(7)}
    assert {row["threads"] for row in rows.values()} == {"1"}
    workers = {row["process"] for row in rows.values()}
    assert os.getpid() not in workers
    assert all(map(has_ended, workers))


def test_single_process_is_the_calling_process(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert run(work, {0: 3}, processes=1)[0].rows[0]["process"] == os.getpid()


def test_job_of_a_killed_worker_is_run_by_another(tmp_path):
    result = run(work, {0: tmp_path / "once", 1: 5})
    assert result[0].rows[0] == {"found": str(tmp_path / "once")}
    assert result[1].rows[0]["square"] == 25


def test_job_fails_when_three_workers_are_lost():
    result = run(die, {n: n for n in range(4)})
    assert [result[n].rows[0]["square"] for n in (0, 2)] == [0, 4]
    for n in (1, 3):
        assert result[n].failure == "3 workers were lost running it, one after the other, the last by exit code 3"


@pytest.mark.parametrize("stop_signal", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_workers_end_when_the_study_is_killed(stop_signal, tmp_path):
    (tmp_path / "parent.py").write_text(PARENT)
    paths = os.pathsep.join(filter(None, sys.path))
    with subprocess.Popen(
        [sys.executable, tmp_path / "parent.py"],
        env=os.environ | {"PYTHONPATH": paths},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as parent:
        assert parent.stdout is not None
        timeout = threading.Timer(60, parent.kill)  # [s]
        timeout.start()
        workers = {int(parent.stdout.readline()) for _ in range(2)}
        assert len(workers - {parent.pid}) == 2
        parent.send_signal(stop_signal)
        # The workers write to the same pipe, which ends when the last worker ends.
        assert parent.communicate() == ("", None)
        timeout.cancel()
        assert parent.returncode == -stop_signal


def test_engine_refuses_unsupported_arguments():
    assert {"process", "ray"} <= set(ENGINES.names())
    with pytest.raises(InputError, match="did you mean process"):
        make_engine("proces")
    with pytest.raises(InputError, match="--engine ray"):
        make_engine("process", address="auto")
    with pytest.raises(InputError, match="the number of processes must be a whole number of at least 1, not 0"):
        make_engine("process", 0)


def test_registration_refuses_an_object_that_is_not_callable():
    with pytest.raises(InputError, match="registered with a function or a class, not with 3"):
        register_engine("lab")(3)
    assert "lab" not in ENGINES.names()


def test_study_refuses_an_engine_that_is_none(monkeypatch):
    monkeypatch.setattr(ENGINES, "_entries", dict(ENGINES._entries))
    monkeypatch.setattr(ENGINES, "_origins", dict(ENGINES._origins))
    register_engine("lab", lambda *arguments, **options: None)
    with pytest.raises(InputError, match="the engine 'lab' must be an Engine, not None"):
        make_engine("lab")
