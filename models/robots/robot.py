"""Robots and tools as data: what a station has to know of either beyond its model file.

A robot is one file of this package and a model: the file makes a `Robot` and calls `register_robot`, and from then on
`find_robot(name)` knows it. An installed package adds its own by an entry point of the group `guiderail.robots`
(`guiderail.end_effectors` for tools), a script by calling `register_robot`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform

from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import Registry

DEFAULT_ROBOT = "iiwa14"
DEFAULT_END_EFFECTOR = "connector_tool"


@dataclass(frozen=True)
class JointDrives:
    """Springs and dampers that hold joints at desired positions.

    Attributes:
        stiffness: of each joint, (n,) [Nm/rad], or [N/m] where it slides.
        inertia: that each drive typically moves, rotor included, (n,) [kg m²] or [kg]: damping is critical for it.
    """

    stiffness: tuple[float, ...]
    inertia: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.stiffness) != len(self.inertia):
            raise InputError("joint drives need as many inertias as stiffnesses")
        if not all(0.0 < value < math.inf for value in (*self.stiffness, *self.inertia)):
            raise InputError("the stiffness and the inertia of a joint's drive must be positive")

    @property
    def damping(self) -> tuple[float, ...]:
        """Of each joint, (n,) [Nms/rad] or [Ns/m]."""
        return tuple(2.0 * math.sqrt(k * m) for k, m in zip(self.stiffness, self.inertia, strict=True))


@dataclass(frozen=True)
class Robot:
    """An arm of six or more joints.

    Attributes:
        name: by which it is found.
        title: what a person calls it.
        model: its URDF or SDF file, or a file of Drake model directives (.yaml); directives find the packages that lie
            in their own folder. Each joint needs an actuator with its limit of effort, the inertia of its rotor and
            the ratio of its gear: without reflected inertia no impedance is stable at a step of milliseconds.
        base_frame: that stands at the world's origin, unless the model itself welds it to the world.
        flange_frame: where a tool is bolted on; its z points away from the arm.
        joints: from the base to the flange.
        home: joint positions with the flange pointing down in front of the robot, far from limits and singularities:
            where inverse kinematics starts, (n,) [rad].
        tool_turn: about the flange's z, by which tools are bolted on: at home, with the last joint in the middle of
            its range, a tool turned by this has its own x along the base's [rad].
        apparent_rotor_inertia: how much of the rotors' reflected inertia is left when the joints are controlled by
            torque; feedback of the joint torque makes a rotor appear lighter (Albu-Schäffer, Ott, Hirzinger 2007).
        drives: of the joints when they are controlled by position; None where nobody wrote them down.
        level_posture: joint positions with the flange's z level, for a tool that is held like a cup, (n,) [rad]; None
            where nobody wrote them down.
        source: where the model's numbers come from, for whoever quotes them.
    """

    name: str
    title: str
    model: Path
    base_frame: str
    flange_frame: str
    joints: tuple[str, ...]
    home: tuple[float, ...]
    tool_turn: float = 0.0
    apparent_rotor_inertia: float = 1.0
    drives: JointDrives | None = None
    level_posture: tuple[float, ...] | None = None
    source: str = ""

    def __post_init__(self) -> None:
        if len(self.joints) < 6 or len(set(self.joints)) != len(self.joints):
            raise InputError(f"robot {self.name!r} must name six joints or more, each once, not {self.joints}")
        for what, values in (("home", self.home), ("level_posture", self.level_posture)):
            if values is not None and not _are_numbers(values, self.num_joints):
                raise InputError(f"robot {self.name!r}: {what} must be {self.num_joints} joint positions, not {values}")
        if not 0.0 < self.apparent_rotor_inertia <= 1.0:
            raise InputError(f"robot {self.name!r}: apparent_rotor_inertia must be more than 0 and at most 1")
        if self.drives is not None and len(self.drives.stiffness) != self.num_joints:
            raise InputError(f"robot {self.name!r}: it has {self.num_joints} joints, so it needs as many drives")

    @property
    def num_joints(self) -> int:
        """Of the arm."""
        return len(self.joints)


@dataclass(frozen=True)
class EndEffector:
    """What is bolted to a flange: a rigid tool, or a gripper.

    Attributes:
        name: by which it is found.
        title: what a person calls it.
        model: its URDF or SDF file.
        mount_frame: that is bolted to the flange.
        tool_centre: the frame P that a station commands: the centre of compliance, z back towards the flange. It is
            fixed to the mount.
        bodies: all bodies, the mount's first.
        X_FlangeMount: where the mount is on a flange that the robot's `tool_turn` has turned.
        joints: that are actuated, a gripper's; none for a rigid tool. A gripper's joints that mimic another are not.
        opening: of every joint by name, those that mimic others too: where an episode starts, [rad] or [m].
        drives: of those joints.
        source: where the model's numbers come from.
    """

    name: str
    title: str
    model: Path
    mount_frame: str
    tool_centre: str
    bodies: tuple[str, ...]
    X_FlangeMount: RigidTransform = field(default_factory=RigidTransform)
    joints: tuple[str, ...] = ()
    opening: Mapping[str, float] = field(default_factory=dict)
    drives: JointDrives | None = None
    source: str = ""

    def __post_init__(self) -> None:
        if not self.bodies:
            raise InputError(f"end effector {self.name!r} must name its bodies, the mount's first")
        missing = [name for name in self.joints if name not in self.opening]
        if missing or not _are_numbers(tuple(self.opening.values()), len(self.opening)):
            raise InputError(f"end effector {self.name!r} needs an opening, a number, for each of its joints")
        if len(self.drives.stiffness if self.drives else ()) != len(self.joints):
            raise InputError(f"end effector {self.name!r} needs a drive for each of its {len(self.joints)} joints")

    @property
    def is_gripper(self) -> bool:
        """Whether something of it moves."""
        return bool(self.joints)


_ROBOTS: Registry[Robot] = Registry("robot", package="guiderail.models.robots", entry_points="guiderail.robots")
_END_EFFECTORS: Registry[EndEffector] = Registry(
    "end effector", package="guiderail.models.robots", entry_points="guiderail.end_effectors"
)


def register_robot(robot: Robot) -> Robot:
    """Makes a robot known by its name, which is given once."""
    return _ROBOTS.register(robot.name, robot)


def find_robot(name: str | Robot) -> Robot:
    """The robot of that name; a robot is its own.

    Raises:
        InputError: if there is none; the sentence has the nearest name.
    """
    return name if isinstance(name, Robot) else _ROBOTS.get(name)


def robot_names() -> list[str]:
    """Of all robots, sorted."""
    return _ROBOTS.names()


def register_end_effector(end_effector: EndEffector) -> EndEffector:
    """Makes an end effector known by its name, which is given once."""
    return _END_EFFECTORS.register(end_effector.name, end_effector)


def find_end_effector(name: str | EndEffector) -> EndEffector:
    """The end effector of that name; an end effector is its own.

    Raises:
        InputError: if there is none; the sentence has the nearest name.
    """
    return name if isinstance(name, EndEffector) else _END_EFFECTORS.get(name)


def end_effector_names() -> list[str]:
    """Of all end effectors, sorted."""
    return _END_EFFECTORS.names()


def _are_numbers(values: Sequence[float], count: int) -> bool:
    return len(values) == count and bool(np.isfinite(np.asarray(values, dtype=float)).all())
