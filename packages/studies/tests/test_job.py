from dataclasses import dataclass
from pathlib import Path

import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.learning.run_folder import installed_versions
from guiderail_studies.job import attempt, count_attempts


@dataclass(frozen=True)
class Job:
    log: Path
    error: BaseException | None = None


def work(job):
    if job.error is not None:
        raise job.error
    return [{"success_rate": 1.0}]


def test_log_has_the_attempts_and_the_outcome(tmp_path):
    job, versions = Job(tmp_path / "log.txt"), installed_versions()
    assert count_attempts(job.log, "first") == 0
    assert attempt(job, work=work, versions=versions, call="first").rows == ({"success_rate": 1.0},)
    assert "is done" in job.log.read_text()
    attempt(job, work=work, versions=versions, call="second")
    assert (count_attempts(job.log, "first"), count_attempts(job.log, "second")) == (1, 1)


@pytest.mark.parametrize(
    ("error", "message", "is_traced"),
    [
        (InputError("learning diverged: train with less"), "learning diverged: train with less", False),
        (ZeroDivisionError("by\nzero"), "ZeroDivisionError: by zero (the traceback is in ", True),
        (SystemExit("abort: Failure at plant.cc"), "SystemExit: abort: Failure at plant.cc (", True),
    ],
)
def test_failure_of_any_kind_is_one_sentence(error, message, is_traced, tmp_path):
    job = Job(tmp_path / "log.txt", error)
    failure = attempt(job, work=work, versions=installed_versions(), call="first").failure
    assert failure.startswith(message)
    assert "\n" not in failure
    assert ("Traceback" in job.log.read_text()) == is_traced


def test_worker_with_other_versions_is_refused(tmp_path):
    job = Job(tmp_path / "log.txt")
    failure = attempt(job, work=work, versions=installed_versions() | {"numpy": "0.9"}, call="first").failure
    assert "instead of 0.9: install the same versions" in failure
    assert not job.log.exists()


def test_worker_without_the_study_folder_is_refused(tmp_path):
    job = Job(tmp_path / "elsewhere" / "log.txt")
    failure = attempt(job, work=work, versions=installed_versions(), call="first").failure
    assert "--out must be a folder that all workers share" in failure
    assert not (tmp_path / "elsewhere").exists()
