"""Faults of the statuses of a moving simulated Franka: each is detected in time, and the arm comes to rest.

    python tests/harness/fci/faults.py --instants 5

The kinds of `injections/kinds.py` that change statuses are injected. Kinds that are impossible with this protocol are
left out: libfranka decodes messages, and a connection has one robot, one controller and no safety monitor. The
requirements are the same as in `injections/campaign.py`. The exit code is 1 if a requirement is not met.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from drake import lcmt_iiwa_status

sys.path.insert(0, str(Path(__file__).parents[1]))
from fci.simulated_franka import SimulatedRun
from injections.campaign import DURATION, MAX_STEPS, SLOW, SLOW_AFTER, has_effect
from injections.kinds import GROWTH, KINDS, PERIOD, Fault, Kind

from guiderail.models.control import joint_status
from guiderail_hardware.drivers.fci import FciDriver
from guiderail_hardware.drivers.lcm import MICROSECOND, IiwaDriver
from guiderail_hardware.models.joint_status import JointStatus
from guiderail_hardware.robot.connection import subprocess_tied_to_parent
from guiderail_hardware.robot.sim_driver import START
from guiderail_hardware.systems.torque_safety_limiter import STOPPED

CENTER = START + np.array([0.0, 0.0, 0.02, 0.0, 0.0, 0.0])
AMPLITUDE, FREQUENCY = (
    np.array([0.01, 0.01, 0.0, 0.15, 0.0, 0.0]),
    1.0,
)  # amplitude and frequency of the motion [m, rad], [Hz]
IMPOSSIBLE = ("second robot", "random bytes", "message cut off")
STATUS_KINDS = [kind for kind in KINDS if kind.where in ("sensor", "network") and not kind.name.startswith(IMPOSSIBLE)]


class FaultyDriver(FciDriver):
    """Driver with injected faults of the statuses.

    Attributes:
        fault: Applied fault; None for unchanged statuses.
        has_effect: True if the fault has changed a status by more than the sensitivity.
        speed: True speed of the fastest joint [rad/s].
    """

    def __init__(self, url: str):
        super().__init__(url)
        self.fault: Fault | None = None
        self.has_effect, self.speed, self._where, self._start = False, 0.0, "", np.nan
        self._time, self._changed = np.nan, joint_status.MALFORMED_STATUS

    def begin(self, kind: Kind, rng: np.random.Generator) -> None:
        """Begin a fault at the next status."""
        assert kind.make is not None
        self.fault, self._where, self._start, self.has_effect = kind.make(rng), kind.where, np.nan, False

    def read(self) -> JointStatus | None:
        """Return the newest status, changed by the fault."""
        status = super().read()
        if status is None or not status.is_readable:
            return status
        self.speed = float(np.abs(status.velocities).max())
        if self.fault is None or status.time == self._time:
            self._time, self._changed = status.time, status if self.fault is None else self._changed
            return self._changed
        self._start = status.time if np.isnan(self._start) else self._start
        message = encode(status)
        relayed = self.fault(message, status.time - self._start)
        self.has_effect |= has_effect(message, relayed, self._where)
        self._time = status.time
        if relayed:
            self._changed = IiwaDriver.decode(relayed[-1])
        return self._changed


def encode(status: JointStatus) -> bytes:
    """Return a status as an encoded iiwa status message."""
    message = lcmt_iiwa_status()
    message.utime, message.num_joints = round(status.time / MICROSECOND), len(status.positions)
    for name in lcmt_iiwa_status.__slots__[2:]:
        setattr(message, name, [0.0] * message.num_joints)
    for name, values in zip(
        IiwaDriver.status_fields, (status.positions, status.velocities, status.external_torque), strict=True
    ):
        setattr(message, name, values.tolist())
    return message.encode()


class Campaign:
    """Moving simulated robot with faults of its statuses."""

    def __init__(self) -> None:
        self.run, self.steps = SimulatedRun(FaultyDriver), 0
        self.driver: FaultyDriver = self.run.station.driver

    def step(self) -> None:
        """Set the next desired pose of the motion, and advance by a status period."""
        angle = 2.0 * np.pi * FREQUENCY * PERIOD * self.steps
        self.run.pose = CENTER + AMPLITUDE * np.sin(angle + np.array([0.0, 0.5 * np.pi, 0.0, 0.0, 0.0, 0.0]))
        self.steps += 1
        self.run.station.get_desired_pose_input_port().FixValue(self.run.context, self.run.pose)
        self.run.clock.advance(self.run.simulator, self.run.station, 1)

    @property
    def is_stopped(self) -> bool:
        """True if the arm is being stopped."""
        return self.run["arm_state"][0] in STOPPED

    def move(self, seconds: float) -> float:
        """Move without a fault for `seconds` [s]; return the largest joint speed [rad/s]."""
        speed = 0.0
        for _ in range(round(seconds / PERIOD)):
            self.step()
            speed = max(speed, self.driver.speed)
        assert not self.is_stopped, self.run.describe()
        return speed

    def inject(self, kind: Kind, rng: np.random.Generator) -> str:
        """Inject a fault during the motion and print the result; return the failed requirements as text."""
        reference = self.move(1.0 + float(rng.uniform(0.0, 0.5)))  # a whole period
        self.driver.begin(kind, rng)
        elapsed, detected, late, fastest, steps = 0.0, np.nan, 0.0, 0.0, 0
        while elapsed < DURATION - 1e-9 and steps < MAX_STEPS:
            self.step()
            steps += 1
            elapsed += PERIOD * self.driver.has_effect
            detected = elapsed if np.isnan(detected) and self.is_stopped else detected
            fastest = max(fastest, self.driver.speed)
            late = max(late, self.driver.speed if elapsed > SLOW_AFTER - 1e-9 else 0.0)
        cause = joint_status.Fault(int(self.run["fault"][0])).name
        self.driver.fault = None
        if self.is_stopped:
            self.driver.recover()
            self.run.resume()
        failures = []
        if kind.is_detectable and self.driver.has_effect:
            failures += ["late" if detected > kind.bound + 1e-9 else "undetected"] * (not detected <= kind.bound + 1e-9)
            failures += [f"{late:.2f} rad/s"] * (late >= SLOW) + ["faster"] * (fastest > GROWTH * reference)
        times = f"bound {1e3 * kind.bound:>4.0f}, detected {1e3 * detected:>4.0f} ms"
        speeds = f"then {late:.2f} rad/s, {fastest / reference:.2f} times as fast"
        state = "FAIL" if failures else "ok"
        print(f"{state:<6}{kind.name:<32}{times}, {speeds}; {cause} {' '.join(failures)}", flush=True)
        return " ".join(failures)


def main() -> int:
    """Run the campaign; return 1 if a requirement was not met, otherwise 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--instants", type=int, default=5, help="instants for each kind of fault")
    parser.add_argument("--kinds", nargs="*", help="names of kinds (default: all)")
    arguments = parser.parse_args()
    kinds = [kind for kind in STATUS_KINDS if not arguments.kinds or kind.name in arguments.kinds]
    campaign, num_failed = Campaign(), 0
    code = (
        "from guiderail_hardware.robot.sim_driver import run_sim_driver\n"
        f"run_sim_driver({campaign.run.host!r}, 1e5, 60.0, driver='fci', log=lambda _: None)"
    )
    with subprocess_tied_to_parent(code):
        campaign.run.start()
        campaign.run.advance(1.2)
        for instant in range(arguments.instants):
            for number, kind in enumerate(kinds):
                num_failed += bool(campaign.inject(kind, np.random.default_rng([instant, number])))
    print(f"{arguments.instants * len(kinds)} injections, {num_failed} with a failed requirement")
    return 1 if num_failed else 0


if __name__ == "__main__":
    sys.exit(main())
