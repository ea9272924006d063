"""Kill and pause real processes at the two ends of a bus, by the wall clock, and check the robot's side.

    python tests/harness/injections/processes.py --injections 20       # one or two minutes

One process is a simulated robot with its safety monitor, one commands it, and one is a second safety monitor; this one
checks the messages on the bus. Only killed processes are restarted. The exit code is 1 if a check failed.
"""

from __future__ import annotations

import argparse
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

from guiderail.diagrams.hardware.clock import set_realtime_priority
from guiderail.diagrams.hardware.driver import safety_limits
from guiderail.diagrams.hardware.lcm import HEARTBEAT_FORMAT, IiwaDriver
from guiderail.diagrams.stations.arm import ArmControllerPlant
from guiderail.diagrams.tasks.bnc_connector.task import BncWorkcell
from guiderail.models.control.joint_status import MAX_SENDERS

STANDSTILL, STOPPED_WITHIN, DETECTED_WITHIN = 0.05, 0.05, 0.06  # [rad/s], [s] of the robot's clock
# Time by the robot's clock after which a robot that is gone is sent no command: detection, damping, zero torque [s].
# Without a status a step takes one and a half periods.
SILENT_AFTER = 0.95
PAUSES = (0.1, 0.3, 1.0)  # by the robot's clock [s]
MISSED_WITHIN, MISSED_FOR = 0.08, 0.9  # times between which a missing monitor must keep the arm stopped [s]
MOVING = 0.15  # speed of the fastest joint of a moving arm [rad/s]


class Listener:
    """Messages on the bus, with the robot's clock."""

    def __init__(self, url: str):
        self.lcm = DrakeLcm(url)
        self.clock, self.speed, self.torque = 0.0, 0.0, np.zeros(7)
        self.is_stopping: dict[int, bool] = {}  # by the number of a safety monitor
        self.speeds: list[tuple[float, float]] = []
        self.acting: list[float] = []
        self.commands: list[tuple[float, float]] = []  # wall clock time of the arrival, largest torque
        self.limits = np.array(safety_limits(ArmControllerPlant(BncWorkcell()).plant, IiwaDriver).torque)
        self.wrong: list[str] = []
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
            self.wrong.append(f"sent {torque}")
            return
        self.commands.append((time.monotonic(), float(np.abs(torque).max())))

    def _heartbeat(self, message: bytes) -> None:
        _, is_stopping, sender = HEARTBEAT_FORMAT.unpack(message)
        self.is_stopping[sender] = is_stopping
        if is_stopping:
            self.acting.append(self.clock)

    @property
    def is_acting(self) -> bool:
        """True if a safety monitor stops the arm."""
        return any(self.is_stopping.values())

    def listen(self, seconds: float) -> None:
        """Receive for some wall clock time [s]."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            self.lcm.HandleSubscriptions(max(1, int(1000 * left)))

    def wait_for_motion(self, seconds: float, rate: float) -> bool:
        """Wait at most some wall clock time [s]; return True once the arm has moved for a while without a stop."""
        end = time.monotonic() + seconds
        since = None
        while time.monotonic() < end:
            self.listen(0.01)
            if self.is_acting:
                since = None
            elif self.speed > MOVING:
                since = since or time.monotonic()
            if since is not None and time.monotonic() - since > 0.7 / rate:
                return True
        return False

    def clear(self) -> None:
        """Clear the records before an injection."""
        for records in (self.speeds, self.acting, self.commands, self.wrong):
            records.clear()
        self.is_stopping.clear()


def robot(url: str, rate: float) -> subprocess.Popen:
    """Start a simulated robot with its safety monitor."""
    call = f"from guiderail.tools.cli.main import main; main(['sim-driver', '--url', {url!r}, '--rate', '{rate}'])"
    return subprocess.Popen([sys.executable, "-c", call], stderr=subprocess.DEVNULL)


def controller(url: str, rate: float) -> subprocess.Popen:
    """Start the commanding program."""
    program = str(Path(__file__).with_name("controller.py"))
    return subprocess.Popen([sys.executable, program, url, str(rate)], stderr=subprocess.DEVNULL)


def monitor(url: str, rate: float) -> subprocess.Popen:
    """Start a second safety monitor."""
    call = f"from guiderail.tools.cli.main import main; main(['safety-monitor', '--url', {url!r}, '--rate', '{rate}'])"
    return subprocess.Popen([sys.executable, "-c", call], stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)


def check_rest(listener: Listener, before: float, until: float) -> list[str]:
    """Check that the commanding program stopped the arm after its safety monitor had gone; return the problems."""
    first, last = before + MISSED_WITHIN + STOPPED_WITHIN, min(before + MISSED_FOR, until)
    fastest = max((speed for clock, speed in listener.speeds if first < clock < last), default=0.0)
    return listener.wrong + ([f"the arm was not stopped: {fastest:.2f} rad/s"] if fastest > STANDSTILL else [])


def check_arm(listener: Listener, before: float, until: float) -> list[str]:
    """Check that the safety monitor stopped the arm in time, by the robot's clock; return the problems."""
    wrong = list(listener.wrong)
    detected = next((clock for clock in listener.acting if clock > before), None)
    if detected is None:
        fastest = max((speed for clock, speed in listener.speeds if clock > before + DETECTED_WITHIN), default=0.0)
        # The arm may have been stopped just before, for example because the machine is too busy for its controller.
        return wrong if fastest < STANDSTILL else [*wrong, f"the arm was not stopped: {fastest:.2f} rad/s"]
    if detected - before > DETECTED_WITHIN:
        wrong.append(f"detected after {1000 * (detected - before):.0f} ms")
    after = [speed for clock, speed in listener.speeds if detected + STOPPED_WITHIN < clock < until]
    if after and max(after) > STANDSTILL:
        wrong.append(f"{max(after):.3f} rad/s after {STOPPED_WITHIN} s")
    return wrong


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
    start = {"robot": robot, "controller": controller, "monitor": monitor}
    ends = {name: program(url, rate) for name, program in start.items()}
    counts: Counter[tuple[str, str]] = Counter()
    kinds = [f"{name} {what}" for name in ("controller", "robot", "monitor") for what in ("killed", "held up")]
    try:
        for number in range(arguments.injections):
            kind = kinds[number % len(kinds)]
            process = kind.split()[0]
            if not listener.wait_for_motion(90.0, rate):
                print(f"WRONG  before {kind}: the arm does not move")
                return 1
            listener.listen(float(rng.uniform(0.0, 0.5)) / rate)
            listener.clear()
            before, happened = listener.clock, time.monotonic()
            if kind.endswith("killed"):
                ends[process].kill()
                ends[process].wait()
                listener.listen(1.2 / rate)
                until = listener.clock
                ends[process] = start[process](url, rate)
            else:
                held_up = float(rng.choice(PAUSES[1:] if process == "monitor" else PAUSES))
                ends[process].send_signal(signal.SIGSTOP)
                listener.listen(held_up / rate)
                ends[process].send_signal(signal.SIGCONT)
                until = listener.clock
                listener.listen(0.2 / rate)
            if process == "controller":
                wrong = check_arm(listener, before, until)
            elif process == "monitor":
                wrong = check_rest(listener, before, until)
            else:
                wrong = list(listener.wrong)
                late = [when for when, _ in listener.commands if when - happened > SILENT_AFTER / rate]
                if kind == "robot killed" and late:
                    wrong.append(f"{len(late)} commands to a robot that is gone")
            counts[kind, "wrong" if wrong else "well"] += 1
            for problem in wrong:
                print(f"WRONG  {kind}: {problem}", flush=True)
        goes_on = listener.wait_for_motion(90.0, rate)
    finally:
        for end in ends.values():
            end.send_signal(signal.SIGCONT)
            end.kill()
            end.wait()
    for kind in kinds:
        print(f"{kind:<22}{counts[kind, 'well']:>4} well {counts[kind, 'wrong']:>4} wrong")
    print("the arm moves at the end" if goes_on else "WRONG  the arm does not move at the end")
    return 0 if goes_on and not any(name == "wrong" for _, name in counts) else 1


if __name__ == "__main__":
    sys.exit(main())
