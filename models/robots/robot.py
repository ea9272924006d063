"""Robots and end effectors as data, and their registries.

The robots of this package are in `catalog.py`, each with a model file and a row in `BUILT_IN` of
`models/common/registry.py`; `find_robot(name)` returns one. An installed package adds a robot by an entry point
"robot:NAME" of the group `guiderail` ("end_effector:NAME"), a script by a call of `register_robot`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pydrake.math import RigidTransform

from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import Registry


@dataclass(frozen=True)
class JointDrives:
    """Position control of joints by springs and dampers; the values are in the order of the joints."""

    stiffness: tuple[float, ...]  # stiffness of each joint, (n,) [Nm/rad], or [N/m] for a prismatic joint
    # Typical inertia of each joint including its rotor, (n,) [kg m²] or [kg], for critical damping.
    inertia: tuple[float, ...]

    @property
    def damping(self) -> tuple[float, ...]:
        """Critical damping of each joint, (n,) [Nms/rad] or [Ns/m]."""
        return tuple(2.0 * math.sqrt(k * m) for k, m in zip(self.stiffness, self.inertia, strict=True))


@dataclass(frozen=True)
class Robot:
    """Robot arm with six or more joints.

    Attributes:
        name: Name in the registry.
        title: Name for users.
        model: URDF or SDF file, or a file of Drake model directives (.yaml) with its packages in the same folder. Each
            joint needs an actuator with effort limit, rotor inertia and gear ratio, because an impedance controller
            with a period of milliseconds is unstable without reflected inertia. The transmissions must be in the order
            of the joints.
        base_frame: Frame that is welded to the world's origin, unless a joint of the model file moves or fixes it.
        flange_frame: Frame to which tools are mounted; its z axis points away from the arm.
        joints: Names of the joints (n,) from the base to the flange, each once.
        home: Joint positions (n,) [rad] at which inverse kinematics starts: the flange points down in front of the
            robot, far from singularities and from the limits of the model file.
        tool_turn: Rotation of the tool mount about the flange's z axis [rad]. It aligns the tool's x axis with the
            base's x axis if the last joint is in the middle of its range and the other joints are at home.
        apparent_rotor_inertia: Fraction of the rotors' reflected inertia that acts on the joints under torque control;
            joint torque feedback reduces it (Albu-Schäffer, Ott, Hirzinger 2007).
        drives: Drives of the joints under position control; None if unknown.
        level_posture: Joint positions (n,) [rad] at which the flange's z axis is horizontal, for a gripper that holds
            an upright cup; None if unknown.
        source: Source of the model's numbers.

    Raises:
        InputError: If there are fewer than six joints, a joint occurs twice, or `apparent_rotor_inertia` is not in (0,
            1].
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
        if not 0.0 < self.apparent_rotor_inertia <= 1.0:
            raise InputError(f"robot {self.name!r}: apparent_rotor_inertia must be more than 0 and at most 1")

    @property
    def num_joints(self) -> int:
        """Number of joints of the arm."""
        return len(self.joints)


@dataclass(frozen=True)
class EndEffector:
    """End effector: a rigid tool or a gripper.

    Raises:
        InputError: If `opening` lacks a finite position of an actuated joint.
    """

    name: str  # name in the registry
    title: str  # name for users
    model: Path  # URDF or SDF file
    mount_frame: str  # frame that is mounted to the flange
    # Name of the frame P whose pose a station commands: the center of compliance, with z towards the flange, fixed to
    # the mount.
    tool_center: str
    bodies: tuple[str, ...]  # names of all bodies, the mount first
    # Pose of the mount in the flange frame, after a rotation of that frame by the robot's `tool_turn`.
    X_FlangeMount: RigidTransform = field(default_factory=RigidTransform)
    joints: tuple[str, ...] = ()  # names of the actuated joints of a gripper, without mimic joints; empty for a tool
    # Positions of all joints by name, including mimic joints, at the start of an episode [rad] or [m].
    opening: Mapping[str, float] = field(default_factory=dict)
    drives: JointDrives | None = None  # drives of the actuated joints
    source: str = ""  # source of the model's numbers

    def __post_init__(self) -> None:
        if not all(math.isfinite(self.opening.get(name, math.nan)) for name in self.joints):
            raise InputError(f"end effector {self.name!r} needs a finite opening position for each of its joints")

    @property
    def is_gripper(self) -> bool:
        """True if the end effector has actuated joints."""
        return bool(self.joints)


def _check_robot(name: str, robot: object) -> None:
    if not isinstance(robot, Robot):
        raise InputError(f"a robot is registered as a Robot object, not {brief(robot)}")


def _check_end_effector(name: str, end_effector: object) -> None:
    if not isinstance(end_effector, EndEffector):
        raise InputError(f"an end effector is registered as an EndEffector object, not {brief(end_effector)}")


ROBOTS: Registry[Robot] = Registry("robot", plugin="robot", check=_check_robot)
END_EFFECTORS: Registry[EndEffector] = Registry("end effector", plugin="end_effector", check=_check_end_effector)
robot_names, end_effector_names = ROBOTS.names, END_EFFECTORS.names


def register_robot(robot: Robot) -> Robot:
    """Add `robot`, whose name is not registered yet, to the registry and return it.

    Args:
        robot: Robot.
    """
    return ROBOTS.register(getattr(robot, "name", "?"), robot)


def find_robot(name: str | Robot) -> Robot:
    """Return the robot with a name; a `Robot` is returned unchanged."""
    return name if isinstance(name, Robot) else ROBOTS.get(name)


def register_end_effector(end_effector: EndEffector) -> EndEffector:
    """Add `end_effector`, whose name is not registered yet, to the registry and return it."""
    return END_EFFECTORS.register(getattr(end_effector, "name", "?"), end_effector)


def find_end_effector(name: str | EndEffector) -> EndEffector:
    """Return the end effector with a name; an `EndEffector` is returned unchanged."""
    return name if isinstance(name, EndEffector) else END_EFFECTORS.get(name)
