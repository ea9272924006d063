"""Who is at the other end of the bus: a robot, or in a rehearsal a simulated one in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from guiderail.diagrams.hardware.clock import Clock, WallClock, check_rate
from guiderail.diagrams.hardware.lcm.simulated import LockstepClock
from guiderail.diagrams.hardware.station import HardwareStation
from guiderail.models.common.errors import InputError
from guiderail.models.common.units import MM
from guiderail.models.robots.robot import DEFAULT_ROBOT
from guiderail.tools.hardware.scenario import load_scenario


@contextmanager
def subprocess_tied_to_parent(code: str) -> Iterator[subprocess.Popen]:
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


PATIENCE = 20.0  # [s] of wall clock that a rehearsal in step waits for a status
LONGEST = 7 * 24 * 3600.0  # [s] of the robot's clock: it is there until the rehearsal is over
# Contact takes a simulated robot with 1 kHz longer than the wall's clock would allow, on the machines that we know.
REHEARSAL_RATE = 0.2


@dataclass(frozen=True)
class RobotConnection:
    """The other end of the bus.

    Args:
        lcm_url: of the bus; LCM's own default where it is empty, and in a rehearsal one of this process alone.
        robot: which arm.
        rehearse: a simulated robot stands in, in a process of its own.
        lockstep: of a rehearsal: each side waits for the other instead of going by the wall's clock.
        rate: of a simulated robot's clock to the wall's.
        scenario: a file that says the first three of these, and what stands around a simulated robot.

    Raises:
        InputError: for a real robot that should wait, or a simulated one that there is not.
    """

    lcm_url: str = ""
    robot: str = DEFAULT_ROBOT
    sim: bool = False
    synchronous: bool = False
    rate: float = REHEARSAL_RATE
    scenario: Path | None = None

    @classmethod
    def in_scenario(cls, file: Path | None, **given: Any) -> RobotConnection:
        """What a scenario's file says, if there is one, and for the rest what is given by name.

        Raises:
            InputError: for a file that makes no sense, or another robot or bus than the file's.
        """
        if file is None:
            return cls(**given)
        said = load_scenario(file)
        for name, theirs in (("robot", said.robot), ("lcm_url", said.lcm_url)):
            if given.get(name) and theirs and given[name] != theirs:
                option = name.replace("_", "-")
                raise InputError(f"{file} says {theirs}, and --{option} {given[name]}: leave one of the two out")
        sim = said.is_simulated or given.get("sim", False)
        url = given.get("lcm_url", "") if sim else said.lcm_url or given.get("lcm_url", "")
        return cls(**given | {"lcm_url": url, "robot": said.robot, "scenario": file, "sim": sim})

    def __post_init__(self) -> None:
        if self.synchronous and not self.sim:
            raise InputError("a real robot waits for nobody: --lockstep is for a rehearsal")
        if self.sim and self.robot != DEFAULT_ROBOT:
            raise InputError(f"only the {DEFAULT_ROBOT} has a simulated driver to rehearse with, not {self.robot}")
        if self.sim and self.lcm_url:
            raise InputError(
                "a rehearsal has a bus of its own, so that no real driver ever hears it: leave --lcm-url out"
            )
        check_rate(self.rate)

    def environment(self, station: str) -> dict[str, Any]:
        """Options of an environment whose station is there."""
        url = self.lcm_url
        if self.sim:
            # With a time to live of zero no message leaves this machine.
            url = f"udpm://239.255.76.67:{20000 + os.getpid() % 20000}?ttl=0"
        options: dict[str, Any] = {"station": station, "lcm_url": url, "robot": self.robot}
        # A simulated robot starts with the command.
        return options | ({"robot_timeout": 60.0} if self.sim else {})

    def paces(self, station: HardwareStation) -> tuple[Clock, WallClock]:
        """How time passes, and the wall's clock, whether it counts or not."""
        channel, period = station.driver.status_channel, station.period
        clock = WallClock(station.lcm, channel, period, self.rate if self.sim else 1.0)
        return (LockstepClock(station.lcm, PATIENCE, channel, period) if self.synchronous else clock), clock

    def timing(self, station: HardwareStation, clock: WallClock) -> Mapping[str, Any]:
        """How regularly the robot was heard, where the wall's clock counts."""
        if self.synchronous:
            return {}
        return {
            "milliseconds_between_statuses": {
                "period": station.period / (self.rate if self.sim else 1.0) / MM,
                "99 %": clock.gaps.quantile(0.99) / MM,
                "longest": clock.gaps.longest / MM,
            }
        }

    @contextmanager
    def standing_in(self, task: str, url: str, imports: Sequence[str] = ()) -> Iterator[None]:
        """A simulated robot in front of a task's fixture; nobody, of a real robot.

        Args:
            task: its name.
            url: of the bus.
            imports: what registers the task: modules, files and task folders.
        """
        if not self.sim:
            yield
            return
        arguments = ["sim-driver", "--url", url, "--task", task, "--command-timeout", "300", "--seconds", str(LONGEST)]
        arguments += [] if self.synchronous else ["--rate", str(self.rate)]
        arguments += [word for module in imports for word in ("--import", module)]
        arguments += [] if self.scenario is None else ["--scenario", str(self.scenario.resolve())]
        with subprocess_tied_to_parent(f"from guiderail.tools.cli.main import main; main({arguments!r})"):
            yield
