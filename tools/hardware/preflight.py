"""What a person should know of a robot before it moves, and whether it is as it should be."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import Context

from guiderail.diagrams.hardware.station import HardwareStation
from guiderail.models.common.errors import InputError
from guiderail.models.common.units import MM
from guiderail.tools.hardware.slow_motion import distance

FARTHEST, FARTHEST_TURN = 0.15, 1.0  # [m], [rad] from the skill's start, beyond which nobody wants to approach it alone
STANDSTILL = 0.05  # [rad/s] of a joint
UNLOADED = 5.0  # [N]: what a robot feels at rest whose payload is known to it
LISTENING = 20  # statuses before anything is judged


@dataclass(frozen=True)
class Check:
    """What a person should know, and whether it is as it should be."""

    name: str
    words: str
    is_well: bool = True


def check_robot(station: HardwareStation, context: Context, start: np.ndarray, commands: int) -> list[Check]:
    """What the robot's statuses say, and what is assumed of it.

    Args:
        station: that has heard it for a moment.
        context: the root context, of a simulator of the station alone.
        start: where the skill starts, (6,).
        commands: how many the robot was sent meanwhile, by whomever.
    """
    plant, arm = station.controller_plant.plant, station.controller_plant.arm
    pose = station.get_pose_output_port().Eval(context)
    away, turned = distance(pose, start)
    name = station.driver.name
    positions, velocities = (
        station.GetOutputPort(f"{name}.{signal}").Eval(context)
        for signal in ("position_measured", "velocity_estimated")
    )
    external = station.GetOutputPort(f"{name}.torque_external").Eval(context)
    force = float(np.linalg.norm(station.force_of(positions, external)))
    fastest = float(np.abs(velocities).max())
    p_WT = arm.target.CalcPoseInWorld(plant.CreateDefaultContext()).translation()
    lower, upper = plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits()
    payload = sum(body.default_mass() for body in arm.tool)
    load, along = station.load_of_force(positions).max(), station.impedance.limits[:3]
    limits, has_safety_monitor = station.limits, station.has_safety_monitor(context)
    nobody = "nobody stands by: start guiderail stand-by on the driver's machine"
    somebody = "somebody commands it: end the other program, or wait until the deputy has brought the arm to rest"
    by_itself = "needed by no driver of this kind: it stops by itself where commands stop"
    return [
        Check("robot", f"{name}, {len(positions)} joints, {station.driver.status_channel}"),
        Check(
            "deputy",
            by_itself
            if station.driver.has_command_timeout
            else "stands by at the robot"
            if has_safety_monitor
            else nobody,
            station.driver.has_command_timeout or has_safety_monitor,
        ),
        Check(
            "joints",
            f"{np.rad2deg(positions).round(1).tolist()} degrees",
            bool((lower < positions).all() and (positions < upper).all()),
        ),
        Check("commands", somebody if commands else "nobody else commands it", not commands),
        Check("standstill", f"fastest joint {fastest:.3f} rad/s", fastest < STANDSTILL),
        Check("payload", f"{payload:.2f} kg bolted to the flange, as the robot must have been told"),
        Check("load", f"{force:.1f} N felt at rest", force < UNLOADED),
        Check("target", f"at {p_WT} m of the base"),
        Check("tool", f"at {pose[:3].round(4)} m and {np.rad2deg(pose[3:]).round(1)} degrees of the target"),
        Check(
            "start",
            f"{away / MM:.0f} mm and {np.rad2deg(turned):.0f} degrees away",
            away < FARTHEST and turned < FARTHEST_TURN,
        ),
        Check(
            "force",
            f"at most {max(along):.0f} N commanded along an axis, {np.linalg.norm(along):.0f} N askew, "
            f"{limits.force:.0f} N felt",
        ),
        Check("torques", f"at most {list(limits.torque)} Nm sent; the full force takes {load:.0%} of the nearest"),
        Check("workspace", f"from {limits.lower} to {limits.upper} m around the target"),
    ]


def confirm_checks(
    checks: Sequence[Check],
    say: Callable[[str], None],
    *,
    again: Callable[[], Sequence[Check]],
    is_confirmed: bool,
) -> None:
    """Says them, and has them confirmed.

    Args:
        checks: of before.
        say: what a person is told.
        again: the checks of now: while a person thinks, anything may happen.
        is_confirmed: nobody is asked.

    Raises:
        InputError: if one fails, before or after the question, or nobody confirms.
    """
    for check in checks:
        say(f"{'ok ' if check.is_well else 'NOT'}  {check.name:<12}{check.words}")
    _refuse_wrong(checks)
    if not is_confirmed:
        confirm("Is all of this so, and is the workspace clear?")
        _refuse_wrong(again())


def _refuse_wrong(checks: Sequence[Check]) -> None:
    wrong = [check for check in checks if not check.is_well]
    if wrong:
        raise InputError(f"the arm stays where it is: {wrong[0].name}: {wrong[0].words}")


def confirm(question: str) -> None:
    """Asks a person.

    Raises:
        InputError: unless the answer is yes.
    """
    if not sys.stdin.isatty():
        raise InputError("nobody is there to confirm this: read it, and say --yes")
    try:
        answer = input(f"{question} Type yes: ")
    except EOFError:
        answer = ""
    if answer.strip().lower() != "yes":
        raise InputError("not confirmed: nothing moves")
