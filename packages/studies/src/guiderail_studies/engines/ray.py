"""Engine that runs jobs on a Ray cluster, or on a local Ray of this machine."""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Iterator, Mapping
from typing import Any, Self

from guiderail.models.common.errors import InputError, import_extra
from guiderail_studies.engines.engine import GIVEN_UP, MAX_ATTEMPTS, Engine, Outcome, Work, register_engine
from guiderail_studies.engines.process import DEFAULT_PROCESSES

LOCAL = "local"
CONNECT_TIMEOUT = 5.0  # time within which a cluster must answer [s]; Ray itself tries for minutes


@register_engine("ray")
class RayEngine(Engine):
    """Engine on a Ray cluster, which runs as many jobs at once as it has cores, or on a local Ray.

    The study's folder must be on a path that all machines share, so that the job of a lost machine can resume.
    """

    def __init__(self, processes: int | None = None, address: str | None = None):
        """Construct the engine.

        Args:
            processes: Number of jobs that run at once on a local Ray; 2 by default.
            address: Address of a cluster, as `ray.init` takes it; the variable RAY_ADDRESS by default. Without either,
                a local Ray is started.

        Raises:
            InputError: If Ray is not installed, or `processes` is given for a cluster.
        """
        self._ray = import_extra("ray")
        self._address = address or os.environ.get("RAY_ADDRESS") or LOCAL
        if self._address != LOCAL and processes is not None:
            raise InputError("a Ray cluster runs as many jobs at once as it has cores: leave --processes out")
        if self._address == LOCAL:
            self.processes = DEFAULT_PROCESSES if processes is None else processes

    def __enter__(self) -> Self:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        quiet = {"log_to_driver": False, "configure_logging": True, "logging_level": logging.CRITICAL}
        local = {"num_cpus": self.processes, "include_dashboard": False, "_node_ip_address": "127.0.0.1"}
        try:
            _reach(self._address)
            self._ray.init(self._address, **quiet, **(local if self._address == LOCAL else {}))
        except Exception as error:  # Ray's errors have no common type
            reason = next(iter(str(error).splitlines()), type(error).__name__)
            raise InputError(f"there is no Ray at {self._address} ({reason}): start one, or give --address") from error
        return self

    def run(self, work: Work, jobs: Mapping[int, Any]) -> Iterator[tuple[int, Outcome]]:
        """Yield keys and outcomes of the jobs as they finish."""
        # Ray itself assigns the job of a lost worker to another worker.
        remote = self._ray.remote(num_cpus=1, max_retries=MAX_ATTEMPTS - 1)(work_on)
        shared = self._ray.put(work)
        waiting = {remote.remote(shared, job): key for key, job in jobs.items()}
        while waiting:
            (done,), _ = self._ray.wait(list(waiting), num_returns=1)
            key = waiting.pop(done)
            try:
                outcome = self._ray.get(done)
            except self._ray.exceptions.RayError as error:
                outcome = Outcome(failure=f"{GIVEN_UP} ({type(error).__name__})")
            yield key, outcome

    def __exit__(self, *error: object) -> None:
        self._ray.shutdown()  # also ends this study's remaining tasks on the cluster


def _reach(address: str) -> None:
    """Raise an OSError if nothing listens at an address with a host and a port."""
    host, _, port = address.rpartition("//")[2].rpartition(":")
    if host and port.isdigit():
        socket.create_connection((host.strip("[]"), int(port)), CONNECT_TIMEOUT).close()


def work_on(work: Work, job: Any) -> Outcome:
    """Run `work` on a job; Ray names its workers after this function."""
    return work(job)
