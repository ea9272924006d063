"""Driver on ROS 2 without a ROS installation: target poses for a Cartesian controller of ros2_control, over DDS.

The middleware is Eclipse Cyclone DDS, whose Python package has its own library. DDS is the default middleware of every
ROS 2 distribution, so nothing is installed or configured on the robot. This driver has been tested between two
processes, not with a robot.
"""

from __future__ import annotations

import logging
import random
import time as clock
from collections import deque
from dataclasses import dataclass
from typing import Any, ClassVar
from urllib.parse import parse_qsl, urlsplit

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable

from guiderail.models.common.errors import InputError, import_extra
from guiderail.models.common.registry import did_you_mean
from guiderail.models.robots.inverse_kinematics import pose_error
from guiderail.models.robots.mounting import add_robot
from guiderail.models.robots.robot import find_robot
from guiderail_hardware.drivers.driver import Check, PoseDriver, register_driver
from guiderail_hardware.models.joint_status import MALFORMED_STATUS, JointStatus
from guiderail_hardware.models.motion_limits import MotionLimits
from guiderail_hardware.models.robot_impedance import RobotImpedance

logger = logging.getLogger(__name__)

MAX_WRENCH_AGE = 0.1  # age above which a wrench is no measurement of the present contact [s]
MAX_STATUS_AGE = 0.02  # age above which a joint state is no target of a stop [s]
NUM_POSES = 3  # number of targets until most wrong statuses are detected
NUM_MESSAGES = 32  # number of messages that are taken at a time
SWITCH_TIMEOUT = 2.0  # longest wait for the controller manager [s]
MAX_DOMAIN = 232  # largest number of a DDS domain
# The limits of the reference implementation's trajectories on a UR: controllers publish no limits of their target.
MOTION_LIMITS = MotionLimits((0.25, 1.2, 12.0), (1.05, 1.4, 14.0))


@dataclass(frozen=True)
class Ros2Address:
    """Topics and names on a ROS 2 network, the parts of an address `DOMAIN/NAMESPACE?name=value&…`.

    Raises:
        InputError: If the domain or a name is invalid.
    """

    domain: int = 0  # ROS_DOMAIN_ID
    namespace: str = ""  # namespace of the topics
    target: str = "target_pose"  # PoseStamped: target of the controller
    joints: str = "joint_states"  # JointState
    wrench: str = "external_wrench"  # WrenchStamped: wrench of the surroundings on the tool
    frame: str = "base"  # axes of the wrench, "base" or "tool"
    controller: str = ""  # Cartesian controller that is activated before the first target; empty: it is active already
    hold: str = ""  # controller that is activated in its place by a stop; empty: the target becomes the present pose
    manager: str = "controller_manager"  # node of the controller manager

    @classmethod
    def parse(cls, url: str) -> Ros2Address:
        """Return the parts of an address.

        Raises:
            InputError: If the address is invalid.
        """
        parts = urlsplit(url if "://" in url else f"ros2://{url}")
        options = dict(parse_qsl(parts.query, keep_blank_values=True))
        known = set(cls.__dataclass_fields__) - {"domain", "namespace"}
        for name in options:
            if name not in known:
                raise InputError(f"an address of ROS 2 has no option {name!r}: {did_you_mean(name, known)}")
        if not (parts.netloc or "0").isdecimal() or int(parts.netloc or 0) > MAX_DOMAIN:
            raise InputError(f"an address of ROS 2 begins with its domain, 0 to {MAX_DOMAIN}, not {parts.netloc!r}")
        if options.get("frame", "base") not in ("base", "tool"):
            raise InputError(f"the wrench's frame is base or tool, not {options['frame']!r}")
        return cls(int(parts.netloc or 0), parts.path.strip("/"), **options)

    def topic(self, name: str) -> str:
        """Return the name of a topic on the bus."""
        absolute = name.strip("/") if name.startswith("/") or not self.namespace else f"{self.namespace}/{name}"
        return f"rt/{absolute}"

    def service(self, name: str) -> tuple[str, str]:
        """Return the names of a service's topics on the bus, for requests and responses."""
        node = f"{self.namespace}/{self.manager}" if self.namespace else self.manager
        return f"rq/{node}/{name}Request", f"rr/{node}/{name}Reply"


class Ros2Bus:
    """Connection to the topics of a robot.

    Args:
        address: Topics and names.
        robot_side: True for a program that plays the robot: it writes what a driver reads, and the other way round.
    """

    def __init__(self, address: Ros2Address, *, robot_side: bool = False):
        import_extra("cyclonedds")
        from cyclonedds.core import Policy, Qos
        from cyclonedds.domain import DomainParticipant
        from cyclonedds.pub import DataWriter
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        from guiderail_hardware.drivers import ros2_messages as messages

        self.messages, self.address = messages, address
        self._participant = DomainParticipant(address.domain)
        newest = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(NUM_MESSAGES))
        # Of targets only the newest matters: a lost one is not sent again, because the next one follows.
        target = Qos(Policy.Reliability.Reliable(0), Policy.History.KeepLast(1))

        def topic(name: str, kind: type) -> Any:
            return Topic(self._participant, name, kind)

        joints = topic(address.topic(address.joints), messages.JointState)
        wrench = topic(address.topic(address.wrench), messages.WrenchStamped)
        targets = topic(address.topic(address.target), messages.PoseStamped)
        requests, responses = address.service("switch_controller")
        switch = topic(requests, messages.SwitchControllerRequest)
        switched = topic(responses, messages.SwitchControllerResponse)
        service = Qos(Policy.Reliability.Reliable(10**9), Policy.History.KeepLast(8))
        self.joints: Any
        self.wrench: Any
        self.requests: Any
        self.responses: Any
        if robot_side:
            self.joints, self.wrench = (DataWriter(self._participant, each, qos=newest) for each in (joints, wrench))
            self.responses = DataWriter(self._participant, switched, qos=service)
            self.requests = DataReader(self._participant, switch, qos=service)
        else:
            self.joints, self.wrench = (DataReader(self._participant, each, qos=newest) for each in (joints, wrench))
            self.target = DataWriter(self._participant, targets, qos=target)
            self.responses = DataReader(self._participant, switched, qos=service)
            self.requests = DataWriter(self._participant, switch, qos=service)
        # The reader keeps more than the newest: a target of another program must not hide behind one of this program.
        received = Qos(Policy.Reliability.Reliable(0), Policy.History.KeepLast(NUM_MESSAGES))
        self.targets = DataReader(self._participant, targets, qos=received)

    @staticmethod
    def take(reader: Any) -> list[Any]:
        """Return the messages that have arrived, oldest first; a reader also reports writers that have left."""
        return [sample for sample in reader.take(NUM_MESSAGES) if sample.sample_info.valid_data]


@register_driver("ros2")
class Ros2Driver(PoseDriver):
    """Franka arm with 7 joints under a Cartesian impedance controller of ros2_control, such as CRISP's.

    The driver reads `JointState` and `WrenchStamped` and writes `PoseStamped` targets. The target is moved towards the
    measured pose until stiffness times error is inside the bound of the force, so that the controller, configured with
    the station's stiffness, applies no larger force. The measured wrench is reported as joint torques Jᵀ F.

    A status is malformed if no joint states or wrenches arrive, a joint is missing, or the wrench is late.
    Joint states of alternating senders, or different ones with the same time stamp, count as conflicts, and targets of
    another sender as foreign commands.
    """

    name = robot = "panda"
    torque_reflex_limits: ClassVar[tuple[float, ...]] = (
        87.0,
        87.0,
        87.0,
        87.0,
        12.0,
        12.0,
        12.0,
    )  # joint torque limits [Nm]
    has_command_timeout = True  # the controller holds the arm at its last target
    motion_limits = MOTION_LIMITS

    def __init__(self, url: str = "0", *, bus: Any = None):
        """Construct the driver and join the network.

        Args:
            url: Address, see `Ros2Address`.
            bus: Connection; by default a `Ros2Bus`.

        Raises:
            InputError: If the address is invalid, or Cyclone DDS is not installed.
        """
        super().__init__(url)
        self.address = Ros2Address.parse(url)
        self._bus = bus or Ros2Bus(self.address)
        model = find_robot(self.robot)
        self._plant = MultibodyPlant(0.0)
        self._flange = add_robot(self._plant, model).flange
        self._plant.Finalize()
        self._context = self._plant.CreateDefaultContext()
        self._joint_names, self._base = model.joints, model.base_frame
        self._X_FlangeTool = RigidTransform()
        self._impedance: RobotImpedance | None = None
        self._status: JointStatus | None = None
        self._wrench: np.ndarray | None = None
        self._wrench_arrival = -np.inf
        self._last: Any = None  # last joint state
        self._arrival = -np.inf  # local time of its arrival [s]
        self._poses: deque[RigidTransform] = deque(maxlen=NUM_POSES)  # measured poses at the last targets
        self._positions, self._positions_time = np.zeros(0), -np.inf  # joint positions at the last, and its local time
        self._is_active = False
        self._conflicts = 0

    def configure(self, impedance: RobotImpedance) -> None:
        """Set tool and impedance, with which targets are bounded; the controller's own parameters are not changed."""
        self._impedance, self._X_FlangeTool = impedance, impedance.X_FlangeTool

    def read(self) -> JointStatus | None:
        """Return the newest status; None before the first joint state."""
        self._count_foreign_commands()
        for sample in self._bus.take(self._bus.wrench):
            F, M = sample.wrench.force, sample.wrench.torque
            self._wrench, self._wrench_arrival = np.array([F.x, F.y, F.z, M.x, M.y, M.z]), clock.monotonic()
        samples = self._bus.take(self._bus.joints)
        for sample in samples:
            self._conflicts += self._last is not None and contradicts(sample, self._last)
            self._last = sample
        if samples:
            self._status, self._arrival = self._decode(samples[-1]), clock.monotonic()
        return self._status

    def _decode(self, message: Any) -> JointStatus:
        """Return the status of a joint state; malformed if a joint or the present wrench is missing."""
        places = {name: index for index, name in enumerate(message.name)}
        names = list(self._joint_names)
        if not set(names) <= set(places) and len(message.name) == len(names):
            names = sorted(message.name)  # another prefix, such as fr3_ for panda_
        sizes = {len(message.position), len(message.velocity), len(message.name)}
        is_late = clock.monotonic() - self._wrench_arrival > MAX_WRENCH_AGE
        if not set(names) <= set(places) or len(sizes) > 1 or is_late or self._wrench is None:
            return MALFORMED_STATUS
        order = [places[name] for name in names]
        q, v = (np.array(values, dtype=float)[order] for values in (message.position, message.velocity))
        stamp = message.header.stamp
        torque = np.full(len(q), np.nan)
        if np.isfinite(q).all():
            self._plant.SetPositions(self._context, q)
            torque = self._calc_jacobian().T @ self._in_base(self._wrench)
        time = stamp.sec + 1e-9 * stamp.nanosec
        return JointStatus(time, q, v, torque, self._conflicts, self.num_foreign_commands)

    def _in_base(self, wrench: np.ndarray) -> np.ndarray:
        """Return a wrench (6,) in the axes of the base; the positions must be set in the context."""
        if self.address.frame == "base":
            return wrench
        R = self._calc_pose().rotation().matrix()
        return np.concatenate([R @ wrench[:3], R @ wrench[3:]])

    def _count_foreign_commands(self) -> None:
        """Count targets of other programs."""
        for sample in self._bus.take(self._bus.targets):
            # Cyclone DDS gives one of the two handles with a sign and the other without.
            difference = int(sample.sample_info.publication_handle) - int(self._bus.target.instance_handle)
            self.num_foreign_commands += difference % 2**64 != 0

    def check_setup(self) -> list[Check]:
        """Check the messages of the robot and the controller that receives targets."""
        matched = self._num_controllers()
        speed, acceleration, jerk = self.motion_limits.linear
        readable = self._status is not None and self._status.is_readable
        return [
            Check("messages", "joint states and wrenches arrive" if readable else self._missing(), readable),
            Check("controller", f"{matched} programs receive {self.address.target}, expected one", matched == 1),
            Check("motion", f"targets up to {speed:.2f} m/s, {acceleration:.1f} m/s² and {jerk:.0f} m/s³"),
            Check("stiffness", "the controller must have the stiffness of the station: the force bound depends on it"),
            Check(
                "untested",
                "this driver has not been tested on a robot: start with half the force limit and a hand on the "
                "emergency stop",
            ),
        ]

    def _missing(self) -> str:
        if self._status is None:
            return f"no joint states on {self.address.joints} in the domain {self.address.domain}"
        return f"no wrench on {self.address.wrench}, or joints other than {', '.join(self._joint_names)}"

    def _num_controllers(self) -> int:
        """Return the number of programs that receive targets, without this one."""
        return max(len(self._bus.target.get_matched_subscriptions()) - 1, 0)

    def write_pose(self, X_BaseTool: RigidTransform, time: float) -> None:
        """Send a target whose force stays inside the bound; the first call activates the controller.

        `time` is not used: targets are stamped with the time of this machine's clock. If the measured positions are
        farther from those of the last target than the arm can have moved, nothing is sent.

        Raises:
            InputError: If the driver is not configured or has no status, or the controller cannot be activated.
        """
        del time
        impedance, status = self._impedance, self._status
        if impedance is None or status is None or not status.is_readable:
            raise InputError("the driver ros2 is used before it is configured, or without a status")
        if self._is_active and not self._is_reachable(status.positions):
            return  # the station stops the arm at its next step; a target beside a wrong pose would move it
        self._positions, self._positions_time = status.positions, clock.monotonic()
        X_BaseActual = self._calc_pose_at(status.positions)
        if not self._is_active:
            self._send(X_BaseActual)  # a controller that is activated would jump to an older target
            if self.address.controller:
                self._switch([self.address.controller], [self.address.hold] if self.address.hold else [])
            self._is_active = True
            self._poses.clear()
        self._poses.append(X_BaseActual)
        self._send(bounded_target(X_BaseTool, X_BaseActual, impedance))

    def _is_reachable(self, positions: np.ndarray) -> bool:
        """Return True if the arm can have moved to positions (n,) since the last target [rad]."""
        elapsed = clock.monotonic() - self._positions_time + self.period
        return bool((np.abs(positions - self._positions) <= self._plant.GetVelocityUpperLimits() * elapsed).all())

    def _send(self, X_BaseTool: RigidTransform) -> None:
        messages, p = self._bus.messages, X_BaseTool.translation()
        q = X_BaseTool.rotation().ToQuaternion()
        now = clock.time()
        stamp = messages.Time(int(now), int(1e9 * (now % 1.0)))
        pose = messages.Pose(messages.Point(*p.tolist()), messages.Quaternion(q.x(), q.y(), q.z(), q.w()))
        self._bus.target.write(messages.PoseStamped(messages.Header(stamp, self._base), pose))

    def _switch(self, activated: list[str], deactivated: list[str], *, waits: bool = True) -> None:
        """Ask the controller manager to switch controllers.

        Raises:
            InputError: If it refuses or does not answer.
        """
        messages, number = self._bus.messages, random.getrandbits(31)
        request = messages.SwitchControllerRequest(
            guid=random.getrandbits(63), number=number, activate_controllers=activated,
            deactivate_controllers=deactivated,
        )  # fmt: skip
        self._bus.requests.write(request)
        end = clock.monotonic() + (SWITCH_TIMEOUT if waits else 0.0)
        while clock.monotonic() < end:
            for response in self._bus.take(self._bus.responses):
                if response.number == number and response.ok:
                    return
                if response.number == number:
                    raise InputError(f"the controller manager refuses to activate {activated[0]}: {response.message}")
            clock.sleep(1e-3)
        if waits:
            raise InputError(
                f"{self.address.manager} does not answer in {SWITCH_TIMEOUT:.0f} s: activate {activated[0]} with "
                "ros2 control, and leave controller= out of the address, or use rmw_cyclonedds_cpp on the robot"
            )

    def stop(self) -> None:
        """Hold the arm: the target becomes its last valid pose, and the controller `hold` takes over if there is one.

        The newest statuses may be the wrong ones for which the arm is stopped, so that the pose is that of a target a
        few periods before. If joint states have stopped, this pose is old, and the controller keeps the last target.
        """
        if not self._is_active:
            return
        self._is_active = False
        if clock.monotonic() - self._arrival <= MAX_STATUS_AGE:
            self._send(self._poses[0])
        if self.address.hold:
            self._switch([self.address.hold], [self.address.controller], waits=False)

    def _calc_pose_at(self, positions: np.ndarray) -> RigidTransform:
        self._plant.SetPositions(self._context, positions)
        return self._calc_pose()

    def _calc_pose(self) -> RigidTransform:
        return self._flange.CalcPoseInWorld(self._context) @ self._X_FlangeTool

    def _calc_jacobian(self) -> np.ndarray:
        """Return the Jacobian of the tool center in the base's axes, (6, n), translational part first."""
        world = self._plant.world_frame()
        J = self._plant.CalcJacobianSpatialVelocity(
            self._context, JacobianWrtVariable.kV, self._flange, self._X_FlangeTool.translation(), world, world
        )
        return J[[3, 4, 5, 0, 1, 2]]


@register_driver("ros2_ur5e")
class Ros2UrDriver(Ros2Driver):
    """UR5e with 6 joints under a Cartesian impedance controller of ros2_control."""

    name = robot = "ur5e"
    torque_reflex_limits = (60.0, 60.0, 60.0, 14.0, 14.0, 14.0)  # largest external joint torques [Nm]


def contradicts(sample: Any, last: Any) -> bool:
    """Return True if a joint state has another sender than the last one, or the same time but other values."""
    if sample.sample_info.publication_handle != last.sample_info.publication_handle:
        return True
    values = [(message.position, message.velocity) for message in (sample, last)]
    return bool(sample.header.stamp == last.header.stamp and values[0] != values[1])


def bounded_target(
    X_BaseTool: RigidTransform, X_BaseActual: RigidTransform, impedance: RobotImpedance
) -> RigidTransform:
    """Return the target nearest to X_BaseTool in the direction of the error whose spring force is inside the bound.

    The error e is scaled until each component of K e is at most `RobotImpedance.max_wrench`.
    """
    error = pose_error(X_BaseTool, X_BaseActual)[[3, 4, 5, 0, 1, 2]]
    wrench = np.abs(impedance.stiffness @ error)
    share = min(1.0, float(np.min(impedance.max_wrench / np.maximum(wrench, 1e-12))))
    if share == 1.0:
        return X_BaseTool
    angle = float(np.linalg.norm(error[3:]))
    turn = RotationMatrix() if angle == 0.0 else _rotation(error[3:] / angle, share * angle)
    return RigidTransform(turn @ X_BaseActual.rotation(), X_BaseActual.translation() + share * error[:3])


def _rotation(axis: np.ndarray, angle: float) -> RotationMatrix:
    from pydrake.common.eigen_geometry import AngleAxis

    return RotationMatrix(AngleAxis(angle, axis))
