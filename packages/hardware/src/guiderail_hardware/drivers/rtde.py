"""Driver on Universal Robots' RTDE: sends the wrenches of an impedance to the controller's force mode (500 Hz).

The client is ur-rtde (MIT license). Its command `servoL` does not bound the force. With `directTorque`, the 500 Hz loop
would run in Python, and PolyScope 5.26 is required. Force mode bounds the force by the commanded wrench in the
controller's own loop, and runs on every e-Series. This driver has not been tested on a real robot.
"""

from __future__ import annotations

import logging
import threading
import time as clock
from types import SimpleNamespace
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable
from scipy.spatial.transform import Rotation

from guiderail.models.common.errors import InputError, import_extra
from guiderail.models.robots.inverse_kinematics import pose_error
from guiderail.models.robots.mounting import add_robot
from guiderail.models.robots.robot import find_robot
from guiderail.systems.support.drake_multibody import transform_to_vector
from guiderail_hardware.drivers.driver import Check, PoseDriver, register_driver
from guiderail_hardware.models.joint_status import MALFORMED_STATUS, JointStatus
from guiderail_hardware.models.motion_limits import MotionLimits
from guiderail_hardware.models.robot_impedance import RobotImpedance

logger = logging.getLogger(__name__)

# Defaults of URScript's movel: 0.25 m/s, 1.2 m/s², 1.05 rad/s, 1.4 rad/s²; each acceleration is reached in 0.1 s.
# Universal Robots publishes no limits of a commanded jerk.
UR_MOTION_LIMITS = MotionLimits((0.25, 1.2, 12.0), (1.05, 1.4, 14.0))
WATCHDOG_FREQUENCY = 10.0  # the controller ends its program when commands arrive less often [Hz]
MAX_ZEROED_FORCE = 15.0  # largest force that is attributed to drift when the sensor is zeroed [N]
MAX_POSE_DIFFERENCE = 0.02  # largest distance of the robot's calibrated tool center from the model's [m]
NO_TRANSFORM = 2  # argument `type` of forceMode: the force frame is not transformed
RECOVERY_TIME = 2.0  # longest wait until the robot reports no stop after a recovery [s]
NUM_ATTEMPTS = 10  # attempts to read values that belong to one message
# The controller's frame "base" is rotated by 180° about z from the model's base frame. In the model's frame, the arm
# points along +x if all joint positions are zero.
X_ControllerBase = RigidTransform(RotationMatrix.MakeZRotation(np.pi), [0.0, 0.0, 0.0])
VARIABLES = ["timestamp", "actual_q", "actual_qd", "actual_TCP_force", "actual_TCP_pose", "safety_status_bits"]


@register_driver("rtde")
class RtdeDriver(PoseDriver):
    """Universal Robots UR5e with PolyScope 5.10 or later, in remote control.

    The commanded wrench is K e, clipped to the largest wrench of the impedance; e is the error of the tool center's
    pose in the axes of the base. In force mode the controller moves the tool with a bounded speed until its sensor
    measures the commanded wrench. At rest the arm therefore acts as a spring with a bounded force. The controller's own
    loop damps the motion.

    The robot measures the wrench F of the surroundings on the tool, which is reported as joint torques Jᵀ F. After a
    protective or emergency stop, or if the robot's program has ended, the status is malformed until `recover`. If no
    command arrives for 1 / `WATCHDOG_FREQUENCY`, the controller ends its program and the arm stops.
    """

    name = robot = "ur5e"
    torque_reflex_limits = (60.0, 60.0, 60.0, 14.0, 14.0, 14.0)  # largest external joint torques [Nm]
    has_command_timeout = True
    hold_off = 0.25  # statuses are checked for this time before the first command [s]
    motion_limits = UR_MOTION_LIMITS

    def __init__(self, url: str = "", *, client: Any = None):
        """Construct the driver; the first `read` connects to the robot.

        Args:
            url: Host name or address of the robot.
            client: Namespace with `RTDEControlInterface`, `RTDEReceiveInterface` and `DashboardClient`; by default the
                classes of ur-rtde.

        Raises:
            InputError: If ur-rtde is not installed, or no host is named.
        """
        super().__init__(url)
        if not url:
            raise InputError("the driver rtde needs the robot's host: give --robot-url")
        self._client = client or SimpleNamespace(
            RTDEControlInterface=import_extra("rtde_control").RTDEControlInterface,
            RTDEReceiveInterface=import_extra("rtde_receive").RTDEReceiveInterface,
            DashboardClient=import_extra("dashboard_client").DashboardClient,
        )
        self._receiver: Any = None
        self._control: Any = None
        self._impedance: RobotImpedance | None = None
        self._status: JointStatus | None = None
        self._is_active = self._is_lost = False
        self._is_zeroed = False  # the force sensor was zeroed on this connection
        self._has_failed_to_stop = False  # the controller may still apply the last wrench
        self._stopping: threading.Thread | None = None
        self._plant = MultibodyPlant(0.0)
        self._flange = add_robot(self._plant, find_robot(self.robot)).flange
        self._plant.Finalize()
        self._context = self._plant.CreateDefaultContext()
        self._X_FlangeTool = RigidTransform()

    def configure(self, impedance: RobotImpedance) -> None:
        """Set tool center and payload, zero the force sensor and start the controller's program; nothing moves.

        Call it after `read` has returned a status. While poses are commanded, only the impedance is replaced. The force
        sensor is zeroed once per connection, by the first call. Later the tool may be in contact: zeroing would hide
        the contact force from the controller, which would then add the bounded force to it.

        Raises:
            InputError: If the robot cannot be connected, has not been read or refuses a setting, or if at the first
                call its force sensor measures more than `MAX_ZEROED_FORCE`.
        """
        self._check_connected()
        self._impedance, self._X_FlangeTool = impedance, impedance.X_FlangeTool
        if self._is_active:
            return
        if self._control is None:
            try:
                self._control = self._client.RTDEControlInterface(self.url)
            except Exception as error:  # the client raises RuntimeError and its own types
                raise InputError(f"the robot at {self.url} cannot start the control program: {error}") from None
        inertia = impedance.inertia
        order = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
        self._check(
            self._control.setTargetPayload(
                impedance.mass, impedance.center_of_mass.tolist(), [float(inertia[i, j]) for i, j in order]
            ),
            "payload",
        )
        self._check(self._control.setTcp(transform_to_vector(impedance.X_FlangeTool).tolist()), "tool center")
        if self._is_zeroed:
            return
        force = float(np.linalg.norm(self._receiver.getActualTCPForce()[:3]))
        if not force <= MAX_ZEROED_FORCE:  # refuses NaN
            raise InputError(f"the robot measures {force:.0f} N: free its tool before the force sensor is zeroed")
        self._check(self._control.zeroFtSensor(), "zeroing of the force sensor")
        self._is_zeroed = True

    def read(self) -> JointStatus | None:
        """Return the newest status, malformed after a stop or a lost connection; None before the robot answers."""
        if self._is_lost:
            return MALFORMED_STATUS
        if self._receiver is None:
            try:
                self._receiver = self._client.RTDEReceiveInterface(self.url, -1.0, VARIABLES)
            except RuntimeError:
                return None
        receiver = self._receiver
        try:
            if not receiver.isConnected():
                raise RuntimeError("connection lost")
            if self.error:
                return MALFORMED_STATUS
            for _ in range(NUM_ATTEMPTS):
                time = receiver.getTimestamp()
                getters = (receiver.getActualQ, receiver.getActualQd, receiver.getActualTCPForce)
                q, v, F = (np.array(getter(), dtype=float) for getter in getters)
                if receiver.getTimestamp() == time:
                    break
            else:
                return self._status
            self._keep_alive(time)
        except RuntimeError:
            self._is_lost = True
            return MALFORMED_STATUS
        if self._status is None or time != self._status.time:
            self._status = JointStatus(time, q, v, self._calc_jacobian(q).T @ _turn(F))
        return self._status

    @property
    def error(self) -> str:
        """Reason why the robot accepts no commands; empty if there is none, or the connection is lost."""
        if self._receiver is None or self._is_lost:
            return ""
        if self._receiver.isEmergencyStopped():
            return "emergency stop"
        if self._receiver.isProtectiveStopped():
            return "protective stop"
        if self._control is not None and not self._control.isProgramRunning():
            return "its program has ended"
        return ""

    def check_setup(self) -> list[Check]:
        """Check state, program and kinematics of the robot; without a readable status, check only the state.

        Raises:
            InputError: If the robot has not been read.
        """
        self._check_connected()
        if self._status is None:
            return [Check("state", self.error or f"the robot at {self.url} sends no readable status", passed=False)]
        distance = self._kinematic_distance()
        speed, acceleration, jerk = self.motion_limits.linear
        return [
            Check("state", self.error or "normal, its program is running", not self.error),
            Check(
                "kinematics",
                f"the robot's tool center is {1e3 * distance:.1f} mm from the model's",
                distance <= MAX_POSE_DIFFERENCE,
            ),
            Check("force sensor", "zeroed once, at the connection: the tool must have been free"),
            Check("motion", f"commands up to {speed:.2f} m/s, {acceleration:.1f} m/s² and {jerk:.0f} m/s³"),
            Check(
                "untested",
                "this driver has not been tested on a robot: start with half the force limit and a hand on the "
                "emergency stop",
            ),
        ]

    def write_pose(self, X_BaseTool: RigidTransform, time: float) -> None:
        """Command the wrench of the impedance towards a pose of the tool center in the robot's base frame.

        `time` is not used: force mode has no time stamps.

        Raises:
            InputError: If the driver is not configured, the robot refuses its watchdog, or before the first command the
                robot's tool center differs from the model's by more than `MAX_POSE_DIFFERENCE`.
        """
        del time
        impedance, status = self._impedance, self._status
        if impedance is None or status is None:
            raise InputError("the driver rtde is used before it is configured")
        if not self._is_active:
            self._finish_stop()
            distance = self._kinematic_distance()
            if not distance <= MAX_POSE_DIFFERENCE:  # refuses NaN
                raise InputError(
                    f"the tool center of the robot at {self.url} is {1e3 * distance:.0f} mm from that of the "
                    f"{self.name}'s model: it is another robot, or another tool is active"
                )
            self._check(self._control.setWatchdog(WATCHDOG_FREQUENCY), "watchdog")
            self._is_active, self._has_failed_to_stop = True, False
        # Computed with the station's model, so that driver and station agree; the robot's own pose may differ by 1 mm.
        X_BaseActual = self._calc_pose(status.positions)
        error = pose_error(X_BaseTool, X_BaseActual)[[3, 4, 5, 0, 1, 2]]
        limits = impedance.max_wrench
        wrench = np.clip(impedance.stiffness @ error, -limits, limits)
        X_ControllerTool = X_ControllerBase @ X_BaseActual
        frame = [*X_ControllerTool.translation(), 0.0, 0.0, 0.0]  # wrenches act at the tool center
        speed = [self.motion_limits.linear[0]] * 3 + [self.motion_limits.angular[0]] * 3
        if not self._control.forceMode(frame, [1] * 6, _turn(wrench).tolist(), NO_TRANSFORM, speed):
            logger.warning("the robot at %s refused a command", self.url)

    def stop(self) -> None:
        """Leave force mode and brake the tool; the controller then holds the arm."""
        if self._is_active:
            self._is_active = False
            # In a thread, because the call blocks until the arm has stopped, and this program's loop must not block.
            self._stopping = threading.Thread(target=self._stop_force_mode, daemon=True)
            self._stopping.start()

    def _stop_force_mode(self) -> None:
        """Leave force mode; if the robot refuses, its watchdog is no longer reset and ends the robot's program."""
        try:
            has_stopped = bool(self._control.forceModeStop())
        except Exception:  # the client raises RuntimeError and its own types
            has_stopped = False
        if not has_stopped:
            self._has_failed_to_stop = True
            logger.error("the robot at %s does not leave force mode: its watchdog ends its program", self.url)

    def recover(self) -> None:
        """End a protective stop, and start the controller's program again; the arm does not move.

        Raises:
            InputError: If the connection is lost, or the robot has not been read or still accepts no commands.
        """
        self._is_active = False
        if self._is_lost:
            raise InputError(f"the connection to the robot at {self.url} is lost: restart guiderail")
        self._check_connected()
        self._finish_stop()
        try:
            self._end_protective_stop()
        except Exception as error:  # the client raises RuntimeError and its own types
            raise InputError(f"the robot at {self.url} cannot recover: {error}") from None
        end = clock.monotonic() + RECOVERY_TIME
        while self.error and clock.monotonic() < end:
            clock.sleep(0.01)
        if self.error:
            raise InputError(f"the robot at {self.url} cannot recover: {self.error}")

    def _end_protective_stop(self) -> None:
        if self._receiver.isProtectiveStopped():
            dashboard = self._client.DashboardClient(self.url)
            dashboard.connect()
            dashboard.closeSafetyPopup()
            dashboard.unlockProtectiveStop()
            dashboard.disconnect()
        if self._control is not None and (self._has_failed_to_stop or not self._control.isProgramRunning()):
            self._control.reuploadScript()
            self._has_failed_to_stop = False

    def _keep_alive(self, time: float) -> None:
        """Reset the controller's watchdog at each new status while no wrench is commanded."""
        is_new = self._status is None or time != self._status.time
        is_stopping = self._has_failed_to_stop or (self._stopping is not None and self._stopping.is_alive())
        if is_new and self._control is not None and not self._is_active and not is_stopping:
            self._control.kickWatchdog()

    def _finish_stop(self) -> None:
        if self._stopping is not None:
            self._stopping.join()
            self._stopping = None

    def _check_connected(self) -> None:
        """Raise an `InputError` if `read` has not connected to the robot yet."""
        if self._receiver is None:
            raise InputError("the driver rtde is used before it has read a status")

    def _check(self, accepted: bool, what: str) -> None:
        if not accepted:
            raise InputError(f"the robot at {self.url} refuses its configuration: {what}")

    def _kinematic_distance(self) -> float:
        """Return the distance of the robot's tool center from the model's [m]."""
        actual = X_ControllerBase.inverse() @ _to_transform(self._receiver.getActualTCPPose())
        assert self._status is not None
        return float(np.linalg.norm(actual.translation() - self._calc_pose(self._status.positions).translation()))

    def _calc_pose(self, positions: np.ndarray) -> RigidTransform:
        self._plant.SetPositions(self._context, positions)
        return self._flange.CalcPoseInWorld(self._context) @ self._X_FlangeTool

    def _calc_jacobian(self, positions: np.ndarray) -> np.ndarray:
        """Return the Jacobian of the tool center in the base's axes, (6, n), translational part first."""
        self._plant.SetPositions(self._context, positions)
        world = self._plant.world_frame()
        J = self._plant.CalcJacobianSpatialVelocity(
            self._context, JacobianWrtVariable.kV, self._flange, self._X_FlangeTool.translation(), world, world
        )
        return J[[3, 4, 5, 0, 1, 2]]


def _turn(wrench: np.ndarray) -> np.ndarray:
    """Convert a wrench (6,) from the controller's base axes to the model's, or back."""
    return np.array([-1.0, -1.0, 1.0, -1.0, -1.0, 1.0]) * wrench


def _to_transform(vector: list[float]) -> RigidTransform:
    """Return the transform of a position and a rotation vector (6,)."""
    return RigidTransform(RotationMatrix(Rotation.from_rotvec(vector[3:]).as_matrix()), vector[:3])
