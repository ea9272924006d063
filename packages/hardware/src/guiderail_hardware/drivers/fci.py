"""Driver for the Franka Control Interface: sends desired poses to a compiled Cartesian impedance loop at 1 kHz.

The client is franky 2 (MIT license). It runs libfranka's loop in a thread without the GIL. Its Cartesian impedance
controller accepts references at any rate, and bounds errors, forces and torque rates. It ends a torque motion by
damping. With pylibfranka, Franka's own binding, the 1 kHz loop would run in Python.
"""

from __future__ import annotations

import logging
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.math import RigidTransform

from guiderail.models.common.errors import InputError, import_extra
from guiderail_hardware.drivers.driver import Check, PoseDriver, register_driver
from guiderail_hardware.models.joint_status import MALFORMED_STATUS, JointStatus
from guiderail_hardware.models.motion_limits import MotionLimits
from guiderail_hardware.models.robot_impedance import RobotImpedance

logger = logging.getLogger(__name__)

NO_ERRORS = "[]"  # the client's list of errors as text, if the robot has none
MAX_TORQUE_STEP = 1.0  # largest change of a torque within 1 ms [Nm]; the interface's limit
POSTURE_STIFFNESS = 5.0  # stiffness of the posture task in the null space [Nm/rad]
STOP_TIME = 0.5  # longest duration of a stop by damping [s]
RECONNECTION_TIME = 10.0  # longest wait for a robot whose connection was lost [s]
# Collision thresholds of the robot, relative to the impedance's largest wrench along an axis. The force threshold is at
# least the threshold in libfranka's examples [N], because the robot's estimate has an error of some newtons.
FORCE_THRESHOLD_SHARE, MIN_FORCE_THRESHOLD = 2.5, 20.0
MAX_TOOL_ERROR = 1e-4  # largest error of an entry of the tool frame's matrix that the robot reports [m, 1]
MAX_MASS_ERROR = 0.05  # largest error of the mass that the robot reports [kg]
REALTIME_FILE = Path("/sys/kernel/realtime")  # contains 1 on a kernel with real-time priorities
TORQUE_THRESHOLD = (20.0, 20.0, 18.0, 18.0, 16.0, 14.0, 12.0)  # collision thresholds [Nm] of libfranka's examples


@register_driver("fci")
class FciDriver(PoseDriver):
    """Franka Emika Panda or FR3 on the Franka Control Interface.

    The external torque of the interface is the torque of the arm on its surroundings. After a reflex the status is
    malformed until `recover` has cleared the error, so the station stops. If this program ends, libfranka's loop also
    ends and the robot brakes. If this program hangs, the robot holds the last desired pose with the bounded wrench.
    """

    name = robot = "panda"
    torque_reflex_limits = TORQUE_THRESHOLD
    has_command_timeout = True
    hold_off = 0.25  # statuses are checked for this time before the first command [s]; the robot needs no pause
    is_spring_and_damper = True
    # A fifth of the robot's linear and four fifths of its angular velocity, and half of its accelerations and jerks. A
    # single axis has 1/√3 of a limit, which still lets a policy turn a bayonet at 1 rad/s.
    motion_limits = MotionLimits((0.34, 6.5, 3250.0), (2.0, 12.5, 6250.0))

    def __init__(self, url: str = "", *, client: Any = None):
        """Construct the driver; the first `read` connects to the robot.

        Args:
            url: Host name or address of the robot.
            client: The module franky, or a test double of it; imported by default.

        Raises:
            InputError: If franky is not installed, or `url` is empty.
        """
        super().__init__(url)
        if not url:
            raise InputError("the driver fci needs the robot's host: give --robot-url")
        self._franky = client or import_extra("franky")
        self._robot: Any = None
        self._is_lost = False
        self._motion: Any = None
        self._impedance: RobotImpedance | None = None

    def configure(self, impedance: RobotImpedance) -> None:
        """Set tool center, payload and collision thresholds, and the impedance of the next motion.

        During a motion this call has no effect, because the robot would refuse new settings. After a lost connection,
        `recover` configures the robot.

        Raises:
            InputError: If the robot refuses the configuration, or has not been read.
        """
        if self._motion is not None:
            return
        self._check_connected()
        self._impedance = impedance
        if self._is_lost:
            return
        robot, franky = self._robot, self._franky
        force, torque = _collision_thresholds(impedance)
        try:
            X_NP = RigidTransform(robot.state.F_T_NE.matrix).InvertAndCompose(impedance.X_FlangeTool)
            robot.set_ee(X_NP.GetAsMatrix4().ravel(order="F").tolist())
            robot.set_load(impedance.mass, impedance.center_of_mass.tolist(), impedance.inertia.ravel("F").tolist())
            robot.set_collision_behavior(list(TORQUE_THRESHOLD), [force] * 3 + [torque] * 3)
        except (franky.NetworkException, RuntimeError):
            self._is_lost = True
        except (franky.Exception, ValueError) as error:
            raise InputError(f"the robot at {self.url} refuses its configuration: {error}") from None

    def read(self) -> JointStatus | None:
        """Return the newest status, malformed after a reflex or a lost connection; None before the robot answers."""
        franky = self._franky
        if self._is_lost:
            return MALFORMED_STATUS  # each further call of the client would block for a second
        if self._robot is None:
            try:
                self._robot = franky.Robot(self.url, realtime_config=franky.RealtimeConfig.Ignore)
            except franky.NetworkException:
                return None
        state = self._read_state()
        if state is None or str(state.current_errors) != NO_ERRORS:
            return MALFORMED_STATUS
        q, v, external = (np.array(part, dtype=float) for part in (state.q, state.dq, state.tau_ext_hat_filtered))
        return JointStatus(state.time.to_sec(), q, v, -external)

    @property
    def error(self) -> str:
        """Reason of a reflex of the robot; empty if there is none, or the connection is lost."""
        state = None if self._robot is None else self._read_state()
        errors = NO_ERRORS if state is None else str(state.current_errors)
        return "" if errors == NO_ERRORS else errors

    def _read_state(self) -> Any:
        """Return the client's state of the robot, or None if the connection is lost."""
        if not self._is_lost:
            try:
                return self._robot.state  # without a motion, each call waits for a new state
            except (self._franky.Exception, RuntimeError):  # a socket raises RuntimeError("Net Exception")
                self._is_lost = True
        return None

    def check_setup(self) -> list[Check]:
        """Return checks of the robot's mode, tool and payload and of this machine's kernel, with the limits in use.

        Raises:
            InputError: If the driver is not configured.
        """
        impedance = self._impedance
        if impedance is None:
            raise InputError("the driver fci is used before it is configured")
        state = self._read_state()
        if state is None:
            return [Check("connection", f"the robot at {self.url} does not answer", passed=False)]
        mode = str(state.robot_mode).rpartition(".")[2]
        tool = np.array(state.F_T_EE.matrix) - impedance.X_FlangeTool.GetAsMatrix4()
        error = float(np.abs(tool).max())
        mass = float(state.m_ee) + float(state.m_load)
        speed, acceleration, jerk = self.motion_limits.linear
        is_realtime = REALTIME_FILE.is_file() and REALTIME_FILE.read_text().strip() == "1"
        return [
            Check("mode", f"{mode}; it must be Idle: unlock the joints and activate FCI in Desk", mode == "Idle"),
            Check("tool center", f"as configured, within {error:.1e} m", error <= MAX_TOOL_ERROR),
            Check(
                "mass",
                f"the robot reports {mass:.2f} kg, this program has set {impedance.mass:.2f} kg; if they differ, "
                "choose the end effector 'none' in Desk",
                abs(mass - impedance.mass) <= MAX_MASS_ERROR,
            ),
            Check(
                "reflex",
                f"at {_collision_thresholds(impedance)[0]:.0f} N of external force, and "
                f"{TORQUE_THRESHOLD} Nm of external torques",
            ),
            Check(
                "motion",
                f"commands up to {speed:.2f} m/s, {acceleration:.1f} m/s² and {jerk:.0f} m/s³, and "
                f"{self.motion_limits.angular[0]:.1f} rad/s",
            ),
            Check(
                "kernel",
                "with real-time priorities"
                if is_realtime
                else "without real-time priorities: late packets are likely, and the robot stops after 20 of them",
                True if is_realtime else None,
            ),
        ]

    def write_pose(self, X_BaseTool: RigidTransform, time: float) -> None:
        """Make the impedance follow a pose of the tool center in the robot's base frame; `time` is not used.

        Raises:
            InputError: If the driver is not configured.
        """
        del time
        franky, impedance = self._franky, self._impedance
        if impedance is None:
            raise InputError("the driver fci is used before it is configured")
        reference = franky.CartesianReference(target=franky.Affine(X_BaseTool.GetAsMatrix4()))
        if self._motion is None:
            self._motion = self._make_motion(impedance)
            self._motion.set_reference(reference)
            self._robot.move(self._motion, asynchronous=True)
        else:
            self._motion.set_reference(reference)

    def _make_motion(self, impedance: RobotImpedance) -> Any:
        franky = self._franky
        limits = impedance.max_wrench
        motion = franky.CartesianImpedanceTrackingMotion(
            # A bounded error bounds the spring's wrench also if no new reference arrives (`SpringReference`).
            # With franky's own `force_constraints` (2.0.0) the simulated arm accelerated to 5 rad/s.
            translational_error_clip=limits[:3] / np.diag(impedance.stiffness)[:3],
            rotational_error_clip=limits[3:] / np.diag(impedance.stiffness)[3:],
            max_delta_tau=MAX_TORQUE_STEP,
            posture_task=franky.PostureTask(impedance.posture, POSTURE_STIFFNESS),
        )
        gains = franky.CartesianImpedanceGains()
        gains.stiffness, gains.damping = impedance.stiffness, impedance.damping
        motion.set_gains(gains)
        return motion

    def stop(self) -> None:
        """Damp the arm to rest by libfranka's loop; the brakes hold it afterwards."""
        if self._motion is not None:
            self._motion = None
            try:
                self._robot.move(self._franky.TorqueStopMotion(max_duration=STOP_TIME), asynchronous=True)
            except (self._franky.Exception, RuntimeError) as error:
                # A reflex has ended the motion, or the connection is lost.
                logger.warning("the robot at %s brakes by itself: %s", self.url, error)

    def recover(self) -> None:
        """Clear the error of a reflex, or connect again after the connection was lost; the arm does not move.

        Raises:
            InputError: If the error persists, or the robot does not answer or has not been read.
        """
        self._check_connected()
        self._motion = None
        if self._robot is not None:
            with suppress(self._franky.Exception, RuntimeError):
                self._robot.join_motion(STOP_TIME)  # raises the error of the last motion here, not in the next motion
        is_recovered = False
        if not self._is_lost:
            is_recovered = self._clear_errors()
        if self._is_lost:
            self._reconnect()
            is_recovered = self._clear_errors()
        if not is_recovered:
            raise InputError(f"the robot at {self.url} cannot recover: {self.error or 'the connection is lost'}")

    def _check_connected(self) -> None:
        """Raise an `InputError` if `read` has not connected to the robot yet."""
        if self._robot is None and not self._is_lost:
            raise InputError("the driver fci is used before it has read a status")

    def _clear_errors(self) -> bool:
        """Clear the robot's errors; return False if they persist or the connection is lost."""
        try:
            return bool(self._robot.recover_from_errors())
        except (self._franky.NetworkException, RuntimeError):
            self._is_lost = True
            return False
        except self._franky.Exception as error:
            raise InputError(f"the robot at {self.url} cannot recover: {error}") from None

    def _reconnect(self) -> None:
        self._is_lost, self._robot = False, None
        end = time.monotonic() + RECONNECTION_TIME
        while self.read() is None:
            if time.monotonic() > end:
                self._is_lost = True
                raise InputError(f"the robot at {self.url} does not answer")
            time.sleep(0.1)
        if self._impedance is not None:
            self.configure(self._impedance)


def _collision_thresholds(impedance: RobotImpedance) -> tuple[float, float]:
    """Return the external force [N] and torque [Nm] along an axis at which the robot stops by a reflex."""
    force, torque = (FORCE_THRESHOLD_SHARE * float(np.max(part)) for part in np.split(impedance.max_wrench, 2))
    return max(force, MIN_FORCE_THRESHOLD), torque
