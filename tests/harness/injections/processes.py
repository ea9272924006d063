"""Kills and holds up real processes at the two ends of a bus, by the wall's clock, and checks the robot's side.

    python tests/injections/processes.py --injections 20       # a minute or two

A simulated robot with its deputy is one process, who commands it another. What is checked is what a third one hears on
the bus. Only what was killed is started anew. It ends with 1 if anything is wrong.
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
from guiderail.diagrams.hardware.lcm.driver import IiwaDriver
from guiderail.diagrams.stations.arm import ArmControllerPlant
from guiderail.diagrams.tasks.bnc_connector.workcell import BncWorkcell

STANDSTILL, STOPPED_WITHIN, DETECTED_WITHIN = 0.05, 0.05, 0.06  # [rad/s], [s] of the robot's clock
# [s] of the robot's clock, after which a robot that is gone is sent nothing any more: found, damped, told so; without a
# status a step takes one and a half periods.
SILENT_AFTER = 0.95
HELD_UP = (0.1, 0.3, 1.0)  # [s] of the robot's clock
MOVES = 0.15  # [rad/s]


class Ear:
    """Everything that is said on the bus, with the robot's clock."""

    def __init__(self, url: str):
        self.lcm = DrakeLcm(url)
        self.clock, self.speed, self.is_acting, self.torque = 0.0, 0.0, False, np.zeros(7)
        self.speeds: list[tuple[float, float]] = []
        self.acting: list[float] = []
        self.commands: list[tuple[float, float]] = []  # when it came by the wall's clock, and the largest torque
        self.limits = np.array(safety_limits(ArmControllerPlant(BncWorkcell()).plant, IiwaDriver).torque)
        self.wrong: list[str] = []
        self.lcm.Subscribe(IiwaDriver.status_channel, self._status)
        self.lcm.Subscribe(IiwaDriver.command_channel, self._command)
        self.lcm.Subscribe(IiwaDriver.heartbeat_channel(), self._word)

    def _status(self, message: bytes) -> None:
        status = lcmt_iiwa_status.decode(message)
        self.clock, self.speed = 1e-6 * status.utime, float(np.abs(status.joint_velocity_estimated).max())
        self.speeds.append((self.clock, self.speed))

    def _command(self, message: bytes) -> None:
        torque = IiwaDriver.decode_command(message)
        if torque is None or len(torque) != 7 or not (np.abs(torque) <= self.limits + 1e-12).all():
            self.wrong.append(f"sent {torque}")
            return
        self.commands.append((time.monotonic(), float(np.abs(torque).max())))

    def _word(self, message: bytes) -> None:
        self.is_acting = bool(message[-1])
        if self.is_acting:
            self.acting.append(self.clock)

    def listen(self, seconds: float) -> None:
        """By the wall's clock."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            self.lcm.HandleSubscriptions(max(1, int(1000 * left)))

    def wait_for_motion(self, seconds: float, rate: float) -> bool:
        """Whether the arm moves within so long, by the wall's clock, and has moved for a while."""
        end = time.monotonic() + seconds
        since = None
        while time.monotonic() < end:
            self.listen(0.01)
            if self.is_acting:
                since = None
            elif self.speed > MOVES:
                since = since or time.monotonic()
            if since is not None and time.monotonic() - since > 0.7 / rate:
                return True
        return False

    def forget(self) -> None:
        """Before something happens."""
        for heard in (self.speeds, self.acting, self.commands, self.wrong):
            heard.clear()


def robot(url: str, rate: float) -> subprocess.Popen:
    """A simulated one, with its deputy."""
    call = f"from guiderail.tools.cli.main import main; main(['sim-driver', '--url', {url!r}, '--rate', '{rate}'])"
    return subprocess.Popen([sys.executable, "-c", call], stderr=subprocess.DEVNULL)


def controller(url: str, rate: float) -> subprocess.Popen:
    """Who commands it."""
    program = str(Path(__file__).with_name("controller.py"))
    return subprocess.Popen([sys.executable, program, url, str(rate)], stderr=subprocess.DEVNULL)


def check_arm(ear: Ear, before: float, until: float) -> list[str]:
    """Whether the arm was stopped in time by the deputy, on the robot's clock."""
    wrong = list(ear.wrong)
    detected = next((clock for clock in ear.acting if clock > before), None)
    if detected is None:
        fastest = max((speed for clock, speed in ear.speeds if clock > before + DETECTED_WITHIN), default=0.0)
        # Something else may have stopped it just before, such as a machine that is too busy for its controller.
        return wrong if fastest < STANDSTILL else [*wrong, f"nobody stopped the arm: {fastest:.2f} rad/s"]
    if detected - before > DETECTED_WITHIN:
        wrong.append(f"found after {1000 * (detected - before):.0f} ms")
    after = [speed for clock, speed in ear.speeds if detected + STOPPED_WITHIN < clock < until]
    if after and max(after) > STANDSTILL:
        wrong.append(f"{max(after):.3f} rad/s after {STOPPED_WITHIN} s")
    return wrong


def main() -> int:
    """Prints a row for each kind; 1 if anything was wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--injections", type=int, default=20)
    parser.add_argument("--rate", type=float, default=0.5, help="of the robot's clock to the wall's")
    arguments = parser.parse_args()
    os.environ.setdefault("DRAKE_ALLOW_NETWORK", "lcm")
    rate, url = arguments.rate, f"udpm://239.255.76.67:{20000 + os.getpid() % 20000}?ttl=0"
    ear, rng = Ear(url), np.random.default_rng(0)
    set_realtime_priority()
    ends = {"robot": robot(url, rate), "controller": controller(url, rate)}
    counts: Counter[tuple[str, str]] = Counter()
    kinds = ["controller killed", "controller held up", "robot killed", "robot held up"]
    try:
        for number in range(arguments.injections):
            kind = kinds[number % len(kinds)]
            who = kind.split()[0]
            if not ear.wait_for_motion(90.0, rate):
                print(f"WRONG  before {kind}: the arm does not move")
                return 1
            ear.listen(float(rng.uniform(0.0, 0.5)) / rate)
            ear.forget()
            before, happened = ear.clock, time.monotonic()
            if kind.endswith("killed"):
                ends[who].kill()
                ends[who].wait()
                ear.listen(1.2 / rate)
                ends[who] = {"robot": robot, "controller": controller}[who](url, rate)
                until = ear.clock
            else:
                held_up = float(rng.choice(HELD_UP))
                ends[who].send_signal(signal.SIGSTOP)
                ear.listen(held_up / rate)
                ends[who].send_signal(signal.SIGCONT)
                until = ear.clock
                ear.listen(0.2 / rate)
            if who == "controller":
                wrong = check_arm(ear, before, until)
            else:
                wrong = list(ear.wrong)
                late = [when for when, _ in ear.commands if when - happened > SILENT_AFTER / rate]
                if kind == "robot killed" and late:
                    wrong.append(f"{len(late)} commands to a robot that is gone")
            counts[kind, "wrong" if wrong else "well"] += 1
            for words in wrong:
                print(f"WRONG  {kind}: {words}", flush=True)
        goes_on = ear.wait_for_motion(90.0, rate)
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
