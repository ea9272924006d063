"""Kill and pause real processes that share a bus, and check that the arm is stopped in time.

    python tests/harness/injections/processes.py --injections 20       # one or two minutes

The first process is a simulated robot with its safety monitor, the second commands the robot, and the third is a second
safety monitor. This process checks the messages on the bus. Killed processes are restarted, paused ones continue. The
exit code is 1 if a check failed.

On a busy machine, a bound of a time is longer by the time for which the checked process was ready to run and had no
core. If the arm does not move, because processes miss their deadlines, all are started again at half the rate.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
from drake import lcmt_iiwa_status
from pydrake.lcm import DrakeLcm

from guiderail.diagrams.stations.arm import ArmControllerPlant
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail_hardware.drivers.clock import set_realtime_priority
from guiderail_hardware.drivers.driver import safety_limits
from guiderail_hardware.drivers.lcm import HEARTBEAT_FORMAT, IiwaDriver
from guiderail_hardware.models.joint_status import MAX_SENDERS

STANDSTILL = 0.05  # largest joint speed of a stopped arm [rad/s]
STOPPED_WITHIN, DETECTED_WITHIN = 0.05, 0.06  # from detection to standstill, from fault to detection [s, robot's clock]
# Longest time by the robot's clock for which commands are sent after the robot was killed: detection, damping, zero
# torque [s]. Without statuses a step of the controller takes one and a half periods.
SILENT_AFTER = 0.95
PAUSES = (0.1, 0.3, 1.0)  # durations of pauses by the robot's clock [s]
MISSED_WITHIN, MISSED_FOR = 0.08, 0.9  # the arm must be stopped between these times after the loss of a monitor [s]
READY_WITHIN = 300.0  # time until all programs send messages, which start slowly on a busy machine [s]
MOVES_WITHIN = 10.0  # time by the robot's clock until all programs then move the arm [s]
MIN_RATE = 0.02  # smallest rate of the robot's clock
MOVING = 0.15  # speed of the fastest joint of a moving arm [rad/s]


class Listener:
    """Record of the messages on the bus, with the robot's clock."""

    def __init__(self, url: str):
        self.lcm = DrakeLcm(url)
        self.clock, self.speed, self.torque = 0.0, 0.0, np.zeros(7)
        self.is_stopping: dict[int, bool] = {}  # by the number of a safety monitor
        self.speeds: list[tuple[float, float]] = []  # robot's clock [s], speed of the fastest joint [rad/s]
        self.stop_times: list[float] = []  # robot's clock at heartbeats of monitors that stop the arm [s]
        self.commands: list[tuple[float, float]] = []  # wall clock time of the arrival [s], largest torque [Nm]
        self.limits = np.array(safety_limits(ArmControllerPlant(BncWorkcell()).plant, IiwaDriver).torque)
        self.failures: list[str] = []
        self.lcm.Subscribe(IiwaDriver.status_channel, self._status)
        self.lcm.Subscribe(IiwaDriver.command_channel, self._command)
        for number in range(MAX_SENDERS):
            self.lcm.Subscribe(IiwaDriver.heartbeat_channel(number), self._heartbeat)

    def _status(self, message: bytes) -> None:
        status = lcmt_iiwa_status.decode(message)
        self.clock, self.speed = 1e-6 * status.utime, float(np.abs(status.joint_velocity_estimated).max())
        self.speeds.append((self.clock, self.speed))

    def _command(self, message: bytes) -> None:
        command = IiwaDriver.decode_command(message)
        torque = None if command is None else command[0]
        if torque is None or len(torque) != 7 or not (np.abs(torque) <= self.limits + 1e-12).all():
            self.failures.append(f"sent {torque}")
            return
        self.commands.append((time.monotonic(), float(np.abs(torque).max())))

    def _heartbeat(self, message: bytes) -> None:
        _, is_stopping, sender, _ = HEARTBEAT_FORMAT.unpack(message)
        self.is_stopping[sender] = is_stopping
        if is_stopping:
            self.stop_times.append(self.clock)

    @property
    def is_stopped_by_monitor(self) -> bool:
        """True if a safety monitor stops the arm."""
        return any(self.is_stopping.values())

    def listen(self, seconds: float) -> None:
        """Receive messages for `seconds` of wall clock time [s]."""
        end = time.monotonic() + seconds
        while (remaining := end - time.monotonic()) > 0.0:
            self.lcm.HandleSubscriptions(max(1, int(1000 * remaining)))

    def wait_for_motion(self, rate: float) -> bool:
        """Wait until all programs send messages, and then for 0.7 s of motion (robot's clock) without a stop.

        Returns:
            False if the arm does not move although all programs send messages, or if a program sends none.
        """
        self.is_stopping.clear()
        self.commands.clear()
        clock, end, since = self.clock, time.monotonic() + READY_WITHIN, None
        while time.monotonic() < end and not (len(self.is_stopping) > 1 and self.commands and self.clock != clock):
            self.listen(0.01)
        end = time.monotonic() + MOVES_WITHIN / rate
        while time.monotonic() < end:
            self.listen(0.01)
            if self.is_stopped_by_monitor:
                since = None
            elif self.speed > MOVING and len(self.is_stopping) > 1:
                since = since or time.monotonic()
            if since is not None and time.monotonic() - since > 0.7 / rate:
                return True
        return False

    def clear(self) -> None:
        """Clear the records before an injection."""
        for records in (self.speeds, self.stop_times, self.commands, self.failures):
            records.clear()
        self.is_stopping.clear()


def start_robot(url: str, rate: float) -> subprocess.Popen:
    """Start a simulated robot with its safety monitor."""
    call = f"from guiderail.tools.cli.main import main; main(['sim-driver', '--url', {url!r}, '--rate', '{rate}'])"
    return subprocess.Popen([sys.executable, "-c", call], stderr=subprocess.DEVNULL)


def start_controller(url: str, rate: float) -> subprocess.Popen:
    """Start the program that commands the robot."""
    program = str(Path(__file__).with_name("controller.py"))
    return subprocess.Popen([sys.executable, program, url, str(rate)], stderr=subprocess.DEVNULL)


def start_monitor(url: str, rate: float) -> subprocess.Popen:
    """Start a second safety monitor."""
    call = f"from guiderail.tools.cli.main import main; main(['safety-monitor', '--url', {url!r}, '--rate', '{rate}'])"
    return subprocess.Popen([sys.executable, "-c", call], stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)


def waiting_time(process: subprocess.Popen) -> float:
    """Return the time for which threads of a process were ready to run and had no core [s]; 0 if it is unknown."""
    total = 0.0
    for path in Path(f"/proc/{process.pid}/task").glob("*/schedstat"):
        with contextlib.suppress(OSError, IndexError, ValueError):  # a thread has ended
            total += 1e-9 * float(path.read_text().split()[1])
    return total


def check_controller_stop(listener: Listener, before: float, until: float, waited: float) -> list[str]:
    """Check that the controller stopped the arm after the loss of the safety monitor; return the failures."""
    first, last = before + MISSED_WITHIN + STOPPED_WITHIN + waited, min(before + MISSED_FOR, until)
    fastest = max((speed for clock, speed in listener.speeds if first < clock < last), default=0.0)
    return listener.failures + ([f"the arm was not stopped: {fastest:.2f} rad/s"] if fastest > STANDSTILL else [])


def check_monitor_stop(listener: Listener, before: float, until: float, waited: float) -> list[str]:
    """Check that the safety monitor stopped the arm in time by the robot's clock; return the failures.

    `before` and `until` are the robot's clock before and after the injection [s], and `waited` is the time for which
    the checked process had no core, by the same clock [s].
    """
    failures = list(listener.failures)
    detected = next((clock for clock in listener.stop_times if clock > before), None)
    if detected is None:
        fastest = max(
            (speed for clock, speed in listener.speeds if clock > before + DETECTED_WITHIN + waited), default=0.0
        )
        # The controller may already have stopped the arm, for example because it missed a deadline on a busy machine.
        return failures if fastest < STANDSTILL else [*failures, f"the arm was not stopped: {fastest:.2f} rad/s"]
    if detected - before > DETECTED_WITHIN + waited:
        failures.append(f"detected after {1000 * (detected - before):.0f} ms")
    after = [speed for clock, speed in listener.speeds if detected + STOPPED_WITHIN + waited < clock < until]
    if after and max(after) > STANDSTILL:
        failures.append(f"{max(after):.3f} rad/s after {STOPPED_WITHIN} s")
    return failures


def main() -> int:
    """Run the injections; return 1 if a check failed, otherwise 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--injections", type=int, default=20)
    parser.add_argument("--rate", type=float, default=0.5, help="rate of the robot's clock relative to the wall clock")
    arguments = parser.parse_args()
    os.environ.setdefault("DRAKE_ALLOW_NETWORK", "lcm")
    rate, url = arguments.rate, f"udpm://239.255.76.67:{20000 + os.getpid() % 20000}?ttl=0"
    listener, rng = Listener(url), np.random.default_rng(0)
    set_realtime_priority()
    start = {"robot": start_robot, "controller": start_controller, "monitor": start_monitor}
    processes = {name: program(url, rate) for name, program in start.items()}
    checks = {"controller": check_monitor_stop, "monitor": check_controller_stop}
    checked = {"controller": "robot", "monitor": "controller", "robot": "controller"}
    counts: Counter[tuple[str, str]] = Counter()
    kinds = [f"{name} {action}" for name in ("controller", "robot", "monitor") for action in ("killed", "paused")]
    try:
        for number in range(arguments.injections):
            kind = kinds[number % len(kinds)]
            name = kind.split()[0]
            while not listener.wait_for_motion(rate):
                if rate < 2.0 * MIN_RATE:
                    print(f"FAIL  before {kind}: the arm does not move")
                    return 1
                rate *= 0.5
                print(f"before {kind}: the arm does not move; all programs start again at rate {rate:g}", flush=True)
                for other, process in processes.items():
                    process.kill()
                    process.wait()
                    processes[other] = start[other](url, rate)
            listener.listen(float(rng.uniform(0.0, 0.5)) / rate)
            listener.clear()
            before, wall_time = listener.clock, time.monotonic()
            judged = processes[checked[name]]
            waited = -waiting_time(judged)
            if kind.endswith("killed"):
                processes[name].kill()
                processes[name].wait()
                listener.listen(1.2 / rate)
                until = listener.clock
                waited += waiting_time(judged)
                processes[name] = start[name](url, rate)
            else:
                pause = float(rng.choice(PAUSES[1:] if name == "monitor" else PAUSES))
                processes[name].send_signal(signal.SIGSTOP)
                listener.listen(pause / rate)
                processes[name].send_signal(signal.SIGCONT)
                until = listener.clock
                waited += waiting_time(judged)
                listener.listen(0.2 / rate)
            if name in checks:
                failures = checks[name](listener, before, until, rate * waited)
            else:
                failures, last = list(listener.failures), SILENT_AFTER / rate + waited
                late = [arrival for arrival, _ in listener.commands if arrival - wall_time > last]
                if kind == "robot killed" and late:
                    failures.append(f"{len(late)} commands after the robot was killed")
            counts[kind, "failed" if failures else "passed"] += 1
            for failure in failures:
                print(f"FAIL  {kind}: {failure}", flush=True)
        is_moving = listener.wait_for_motion(rate)
    finally:
        for process in processes.values():
            process.send_signal(signal.SIGCONT)
            process.kill()
            process.wait()
    for kind in kinds:
        print(f"{kind:<22}{counts[kind, 'passed']:>4} passed {counts[kind, 'failed']:>4} failed")
    print("the arm moves at the end" if is_moving else "FAIL  the arm does not move at the end")
    return 0 if is_moving and not any(outcome == "failed" for _, outcome in counts) else 1


if __name__ == "__main__":
    sys.exit(main())
