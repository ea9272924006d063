"""Connection to the robot driver: real hardware, or a simulated driver in a subprocess."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from numbers import Real
from pathlib import Path
from typing import Any

from pydrake.lcm import DrakeLcm

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.models.common.errors import InputError, brief
from guiderail.models.robots import DEFAULT_ROBOT
from guiderail.models.robots.robot import find_robot
from guiderail_hardware.drivers.clock import Clock, WallClock, check_rate
from guiderail_hardware.drivers.driver import find_driver
from guiderail_hardware.drivers.fci_lockstep import FciLockstepClock
from guiderail_hardware.drivers.lcm import LcmDriver
from guiderail_hardware.drivers.lcm_simulated import LockstepClock, SimulatedIiwa
from guiderail_hardware.robot.scenario import load_scenario
from guiderail_hardware.station import HardwareStation

MILLISECOND = 0.001  # [s]
LOCKSTEP_TIMEOUT = 20.0  # longest wait for a status in lockstep [s of wall clock time]
COMMAND_TIMEOUT = 300.0  # longest wait of the simulated driver for an acknowledgement [s of wall clock time]
MAX_DURATION = 7 * 24 * 3600.0  # longest run of a simulated driver, by the robot's clock [s]
DEFAULT_RATE = 0.2  # rate of a simulated robot's clock; contact simulation at 1 kHz is slower than real time
FCI = "fci"  # driver of a Franka arm over the Franka Control Interface
SIMULATED = (DEFAULT_ROBOT, FCI)  # drivers that have a simulated robot
ROBOT_TIMEOUT = 60.0  # longest wait for the first status of a simulated driver, including its start [s]
NO_REALTIME_PRIORITY = "no real-time priority: on a busy machine, late commands may stop the arm"

Log = Callable[[str], None]


@contextmanager
def subprocess_tied_to_parent(code: str) -> Iterator[subprocess.Popen[Any]]:
    """Run Python code in a child process that exits when its parent does, even if the parent is killed.

    The child's standard input is a pipe; the operating system closes the other end when the parent exits.
    """
    program = f"from {__name__} import exit_with_parent; exit_with_parent()\n{code}"
    # A new session: Ctrl-C must not end the child, which this process needs to bring the arm to rest.
    process = subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, start_new_session=True)
    try:
        yield process
    finally:
        process.terminate()
        process.wait()
        assert process.stdin is not None
        process.stdin.close()


class DriverEndedError(InputError):
    """Error for a simulated driver whose process has ended."""


def watch_process(clock: Clock, process: subprocess.Popen[Any] | None) -> None:
    """Let a clock raise `DriverEndedError` when the process of a simulated driver, if there is one, has ended."""
    if process is not None:
        clock.check_robot = partial(_refuse_ended, process)


def _refuse_ended(process: subprocess.Popen[Any]) -> None:
    if process.poll() is not None:
        raise DriverEndedError(f"the simulated driver has ended (exit code {process.returncode}): start again")


def check_simulation(driver: str, scenario: Path | None, joint_friction: float | None) -> None:
    """Check the options of a simulated robot.

    Raises:
        InputError: If the joint friction is negative or not a finite number, or the driver fci has a scenario.
    """
    if joint_friction is not None and not (isinstance(joint_friction, Real) and 0.0 <= joint_friction < math.inf):
        raise InputError(f"joint_friction must be at least 0 and finite, not {brief(joint_friction)}")
    if driver == FCI and scenario is not None:
        raise InputError(
            "the simulated robot of the driver fci has only the task's surroundings: leave the scenario out"
        )


def exit_with_parent() -> None:
    """Exit this process when its standard input is closed."""

    def wait() -> None:
        while os.read(0, 1024):
            pass
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


@dataclass(frozen=True)
class RobotConnection:
    """Connection to the robot driver.

    Raises:
        InputError: If the options contradict each other, driver or robot is unknown or has no simulation, or the rate
            or the joint friction is out of range.
    """

    robot_url: str = ""  # address of the driver, LCM's default if empty; a simulated driver has its own bus
    robot: str = ""  # name of the arm; by default the driver's, or `DEFAULT_ROBOT`
    driver: str = ""  # name of the driver; empty for the one with the robot's name
    sim: bool = False  # use a simulated driver, in its own process
    # Run station and simulated driver in lockstep instead of by the wall clock. Always True for the simulated robot of
    # the driver fci, because at 1 kHz it is slower than real time on most machines.
    synchronous: bool = False
    rate: float | None = None  # rate of a simulated robot's clock to the wall clock; `DEFAULT_RATE` by default
    scenario: Path | None = None  # scenario file with robot, address and surroundings
    joint_friction: float | None = None  # friction of each joint of a simulated Franka [Nm], for experiments

    @classmethod
    def from_scenario(cls, file: Path | None, **options: Any) -> RobotConnection:
        """Return the connection with the given options, and with the robot and address of a scenario file, if given.

        Args:
            file: Scenario file, or None.
            **options: Fields of the connection. A file for a simulated driver sets `sim`.

        Raises:
            InputError: As `RobotConnection`, or if the file is invalid or contradicts the options.
        """
        if file is None:
            return cls(**options)
        scenario = load_scenario(file)
        for name, value in (("robot", scenario.robot), ("robot_url", scenario.robot_url)):
            if options.get(name) and value and options[name] != value:
                option = name.replace("_", "-")
                raise InputError(f"{file} has {value}, and --{option} {options[name]}: leave one of the two out")
        sim = scenario.is_simulated or options.get("sim", False)
        url = options.get("robot_url", "") if sim else scenario.robot_url or options.get("robot_url", "")
        return cls(**options | {"robot_url": url, "robot": scenario.robot, "scenario": file, "sim": sim})

    def __post_init__(self) -> None:
        if not self.robot:
            own = find_driver(self.driver) if self.driver else None
            object.__setattr__(self, "robot", getattr(own, "robot", "") or getattr(own, "name", "") or DEFAULT_ROBOT)
        if self.synchronous and not self.sim:
            raise InputError("a real robot does not wait for commands: --synchronous is for a simulated driver, --sim")
        if self.sim and not self.driver:
            find_robot(self.robot)
        if self.sim and (driver := self.driver or self.robot) not in SIMULATED:
            raise InputError(f"these drivers have a simulated robot: {', '.join(SIMULATED)}, not {driver}")
        check_simulation(self.driver if self.sim else "", self.scenario, self.joint_friction)
        if self.sim and self.robot_url:
            raise InputError(
                "a simulated driver has a bus of its own, so that no real driver receives its messages: leave "
                "--robot-url out"
            )
        if self.sim and self.driver == FCI:
            object.__setattr__(self, "synchronous", True)
        if self.rate is None:
            return
        check_rate(self.rate)
        if not self.sim:
            raise InputError("a real robot's clock has its own rate: --rate is for a simulated driver, --sim")
        if self.synchronous:
            raise InputError("a synchronous simulation has no rate relative to the wall clock: leave --rate out")

    @property
    def clock_rate(self) -> float:
        """Rate of the robot's clock relative to the wall clock: 1 for a real robot."""
        return (self.rate or DEFAULT_RATE) if self.sim else 1.0

    def environment_options(self, station: str) -> dict[str, Any]:
        """Return the environment options of a hardware station on this connection."""
        url = self.robot_url
        if self.sim:
            # With a time to live of 0, no message leaves this machine.
            url = f"udpm://239.255.76.67:{20000 + os.getpid() % 20000}?ttl=0"
            if self.driver == FCI:
                url = _loopback_address(os.getpid())
        options: dict[str, Any] = {"station": station, "robot_url": url, "robot": self.robot, "driver": self.driver}
        return options | ({"robot_timeout": ROBOT_TIMEOUT} if self.sim else {})

    def clocks(self, station: HardwareStation) -> tuple[Clock, WallClock]:
        """Return a station's clock and a wall clock, which are one object except in lockstep."""
        wall_clock = WallClock(station.driver, station.period, self.clock_rate)
        if not self.synchronous:
            return wall_clock, wall_clock
        if not isinstance(station.driver, LcmDriver):
            return FciLockstepClock(station.driver.url, LOCKSTEP_TIMEOUT, station.period), wall_clock
        return LockstepClock(station.driver, LOCKSTEP_TIMEOUT, station.period), wall_clock

    def timing(self, station: HardwareStation, clock: WallClock) -> Mapping[str, Any]:
        """Return statistics of the intervals between statuses [ms]; empty in lockstep."""
        if self.synchronous:
            return {}
        return {
            "milliseconds_between_statuses": {
                "period": station.period / self.clock_rate / MILLISECOND,
                "99 %": clock.intervals.quantile(0.99) / MILLISECOND,
                "longest": clock.intervals.longest / MILLISECOND,
            }
        }

    @contextmanager
    def simulated_driver(
        self, task: str, url: str, imports: Sequence[str] = ()
    ) -> Iterator[subprocess.Popen[Any] | None]:
        """Run the simulated driver of an arm in front of a task's fixture; for a real robot, do nothing and yield None.

        The simulated driver listens at `url` and imports the modules `imports`.

        Raises:
            InputError: If the surroundings of the scenario file cannot be simulated.
        """
        if not self.sim:
            yield None
            return
        rate = None if self.synchronous else self.clock_rate
        scenario = None if self.scenario is None else str(self.scenario.resolve())
        if self.scenario is not None and (directives := load_scenario(self.scenario).directives):
            SimulatedIiwa(EnvConfig.resolve(task, {}).declared.workcell(), DrakeLcm("memq://"), directives=directives)
        code = (
            "import sys\n"
            "from pathlib import Path\n"
            "from guiderail.models.common.errors import InputError\n"
            "from guiderail.tools.imports import import_modules\n"
            "from guiderail_hardware.robot import sim_driver\n"
            "try:\n"
            f"    import_modules({list(imports)!r})\n"
            f"    sim_driver.run_sim_driver({url!r}, {MAX_DURATION!r}, {COMMAND_TIMEOUT!r}, {task!r}, rate={rate!r}, "
            f"scenario={scenario!r} and Path({scenario!r}), driver={self.driver!r}, "
            f"joint_friction={self.joint_friction!r})\n"
            "except InputError as error:\n"
            "    sys.exit(f'guiderail: {error}')\n"
        )
        with subprocess_tied_to_parent(code) as process:
            yield process


def _loopback_address(pid: int) -> str:
    """Return an address of this machine, different for each process number that Linux allows."""
    high, low = divmod(pid, 254)
    return f"127.{high // 256}.{high % 256}.{low + 1}"
