"""Jobs on a Ray cluster, or on a Ray of this machine alone."""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Iterator, Mapping
from typing import Any, Self

from guiderail.models.common.errors import InputError
from guiderail.tools.experiments.engines.engine import ATTEMPTS, GIVEN_UP, Engine, Outcome, Work, register_engine
from guiderail.tools.experiments.engines.process import PROCESSES

LOCAL = "local"
REACHED = 5.0  # s, within which a cluster answers; Ray itself asks for minutes


@register_engine("ray")
class RayEngine(Engine):
    """As many jobs side by side as a cluster has cores, on whatever machine they are.

    The study's folder must be on a path that all machines share; there a job goes on whose worker or machine is lost.
    """

    def __init__(self, processes: int | None = None, address: str | None = None):
        """
        Args:
            processes: side by side, without a cluster.
            address: of a cluster, as `ray.init` takes it; that of the variable RAY_ADDRESS unless given, and without
                either a Ray of this machine alone is started.

        Raises:
            InputError: if Ray is not installed, or both are given.
        """
        try:
            import ray
        except ImportError:
            raise InputError("the engine ray needs Ray: pip install 'guiderail[ray]', or leave --engine out") from None
        self._ray: Any = ray
        self._address = address or os.environ.get("RAY_ADDRESS") or LOCAL
        if self._address != LOCAL and processes is not None:
            raise InputError("a Ray cluster runs as many jobs side by side as it has cores: leave --processes out")
        if self._address == LOCAL:
            self.processes = PROCESSES if processes is None else processes

    def __enter__(self) -> Self:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        quiet = {"log_to_driver": False, "configure_logging": True, "logging_level": logging.CRITICAL}
        alone = {"num_cpus": self.processes, "include_dashboard": False, "_node_ip_address": "127.0.0.1"}
        try:
            _reach(self._address)
            self._ray.init(self._address, **quiet, **(alone if self._address == LOCAL else {}))
        except Exception as error:  # its errors have no common type
            words = next(iter(str(error).splitlines()), type(error).__name__)
            raise InputError(f"there is no Ray at {self._address} ({words}): start one, or give --address") from error
        return self

    def run(self, work: Work, jobs: Mapping[int, Any]) -> Iterator[tuple[int, Outcome]]:
        """The jobs' keys and outcomes as they are done."""
        # Ray gives a job of a lost worker to another by itself.
        remote = self._ray.remote(num_cpus=1, max_retries=ATTEMPTS - 1)(work_on)
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
        self._ray.shutdown()  # what a cluster still does for this process ends with it


def _reach(address: str) -> None:
    """Raises an OSError if nothing listens at an address with a host and a port."""
    host, _, port = address.rpartition("//")[2].rpartition(":")
    if host and port.isdigit():
        socket.create_connection((host.strip("[]"), int(port)), REACHED).close()


def work_on(work: Work, job: Any) -> Outcome:
    """Ray names a worker by the function that it runs."""
    return work(job)
