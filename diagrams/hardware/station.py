"""A real arm behind LCM, with the same ports as a simulated station; and the robot's side of it, simulated."""

from __future__ import annotations

import time as wall_time
from collections.abc import Sequence

import numpy as np
from drake import lcmt_iiwa_command, lcmt_iiwa_status, lcmt_panda_command, lcmt_panda_status
from pydantic import Field
from pydrake.common.value import Value
from pydrake.lcm import DrakeLcmInterface
from pydrake.manipulation import BuildIiwaControl, IiwaDriver
from pydrake.multibody.parsing import ModelDirective
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.lcm import LcmInterfaceSystem, LcmSubscriberSystem, SerializerInterface
from pydrake.systems.primitives import MatrixGain

from guiderail.diagrams.envs.options import Number, Options
from guiderail.diagrams.hardware.bus import open_bus
from guiderail.diagrams.hardware.driver import MICROSECOND, Driver
from guiderail.diagrams.hardware.monitor import WordSerializer, word_channel
from guiderail.diagrams.stations.arm import ArmControllerPlant, ArmModel, add_arm
from guiderail.diagrams.stations.impedance_control import add_controller
from guiderail.diagrams.stations.registry import register_station
from guiderail.diagrams.stations.station import (
    Impedance,
    Station,
    add_workcell_plant,
    export_station_ports,
    to_wrench_order,
)
from guiderail.diagrams.stations.workcell import Workcell
from guiderail.models.common.errors import InputError
from guiderail.models.common.parsing import follow_directives
from guiderail.models.common.registry import did_you_mean
from guiderail.models.control.joint_status import MAX_MISSED_MESSAGES, StatusLimits
from guiderail.models.robots.iiwa import IIWA14
from guiderail.models.robots.panda import PANDA
from guiderail.models.robots.robot import DEFAULT_END_EFFECTOR, EndEffector, Robot, find_robot
from guiderail.systems.command_watchdog import CommandWatchdog
from guiderail.systems.heartbeat_monitor import HeartbeatMonitor
from guiderail.systems.joint_torque_wrench import JointTorqueWrench
from guiderail.systems.pose_rate_limiter import PoseRateLimiter
from guiderail.systems.status_watchdog import StatusWatchdog
from guiderail.systems.torque_publisher import TorquePublisher
from guiderail.systems.torque_safety_limiter import SafetyLimits, TorqueSafetyLimiter

# Of what a driver stops at by itself: how much is sent, how much of the surroundings' is borne, and of a joint's speed.
TORQUE_SHARE, EXTERNAL_SHARE, VELOCITY_SHARE = 0.9, 0.8, 0.8


def _encode_iiwa(time: float, torque: np.ndarray) -> bytes:
    command = lcmt_iiwa_command()
    command.utime = round(time / MICROSECOND)
    command.num_torques, command.joint_torque = len(torque), torque.tolist()
    return command.encode()


def _encode_panda(time: float, torque: np.ndarray) -> bytes:
    del time  # Drake's driver for a Panda drops what is not of about now, by the clock that machines agree on
    command = lcmt_panda_command()
    command.utime = wall_time.time_ns() // 1000
    command.num_joint_torque, command.joint_torque = len(torque), torque.tolist()
    command.control_mode_expected = lcmt_panda_status.CONTROL_MODE_TORQUE
    return command.encode()


IIWA_DRIVER = Driver(
    name="iiwa",
    status_channel="IIWA_STATUS",
    command_channel="IIWA_COMMAND",
    status_type=lcmt_iiwa_status,
    status_fields=("joint_position_measured", "joint_velocity_estimated", "joint_torque_external"),
    external_torque_sign=1.0,
    command_type=lcmt_iiwa_command,
    encode=_encode_iiwa,
    has_command_timeout=False,
    torque_reflex_limits=tuple(60.0 * share for share in (1.0, 1.0, 1.0, 0.5, 0.2, 0.2, 0.1)),
)
# Franka's external torque is what the arm does to the surroundings. The trips are those of libfranka's examples.
PANDA_DRIVER = Driver(
    name="panda",
    status_channel="PANDA_STATUS",
    command_channel="PANDA_COMMAND",
    status_type=lcmt_panda_status,
    status_fields=("joint_position", "joint_velocity", "joint_torque_external"),
    external_torque_sign=-1.0,
    command_type=lcmt_panda_command,
    encode=_encode_panda,
    has_command_timeout=True,
    torque_reflex_limits=(20.0, 20.0, 18.0, 18.0, 16.0, 14.0, 12.0),
)
DRIVERS = {IIWA14.name: IIWA_DRIVER, PANDA.name: PANDA_DRIVER}
"""By the name of the robot."""


def find_driver(robot: Robot | str) -> Driver:
    """The driver of a robot.

    Raises:
        InputError: if there is none.
    """
    name = robot if isinstance(robot, str) else robot.name
    if name not in DRIVERS:
        raise InputError(f"nothing here speaks to a robot {name!r} over LCM: {did_you_mean(name, DRIVERS)}")
    return DRIVERS[name]


def safety_limits(plant: MultibodyPlant, driver: Driver) -> SafetyLimits:
    """Limits below those at which the driver stops by itself, and below the joints' own.

    Args:
        plant: the arm as its controller knows it.
        driver: of the arm.
    """
    torque_reflex_limits = np.array(driver.torque_reflex_limits)
    return SafetyLimits(
        velocity=tuple((VELOCITY_SHARE * plant.GetVelocityUpperLimits()).tolist()),
        torque=tuple(np.minimum(TORQUE_SHARE * torque_reflex_limits, plant.GetEffortUpperLimits()).tolist()),
        external_torque=tuple((EXTERNAL_SHARE * torque_reflex_limits).tolist()),
    )


class _StatusSerializer(SerializerInterface):
    """Reads whatever comes: a message that can't be read must not end the process that stops the arm."""

    def __init__(self, driver: Driver):
        SerializerInterface.__init__(self)
        self._driver = driver

    def CreateDefaultValue(self) -> Value:
        """No status yet."""
        return Value[object]()

    def Deserialize(self, buffer: bytes, abstract_value: Value) -> None:
        """A message as a `JointStatus`."""
        abstract_value.set_value(self._driver.decode(bytes(buffer)))


class HardwareOptions(Options):
    """Of a station whose arm is real."""

    robot: str = Field(IIWA14.name, description="which arm")
    end_effector: str = Field(DEFAULT_END_EFFECTOR, description="which tool")
    lcm_url: str = Field("", description="the bus; LCM's own default where it is empty")
    robot_timeout: Number = Field(10.0, gt=0, description="how long to wait for the robot's first status [s]")


@register_station("hardware", world="workcell", options=HardwareOptions, is_simulated=False)
class HardwareStation(Station):
    """The impedance controller on this machine, the arm at the other end of Drake's LCM messages.

    Torques go out as commands, joint states come in as statuses: see `DRIVERS`. The robot's own controller, in torque
    mode, carries its weight: here nothing compensates gravity a second time. The wrench is estimated from the joints'
    external torques; there is no wrist sensor. `start` waits for the robot's first status. Then nothing is sent until
    statuses have come for the settling time, and from there the arm takes over gradually, where it is.

    A `StatusWatchdog` judges what comes, a `HeartbeatMonitor` hears whoever stands by at the robot, and a `TorqueSafetyLimiter`
    judges what is measured and sent; they stop the arm, `fault` says why, and `resume` goes on. In real time
    `tell_time` says before each step what the clock on the wall shows. Beside every station's ports it has these
    outputs, the last of them under the names that they have in Drake's own stations, after the name of the driver and a
    dot:

    =====================  =====  =====================================================================================
    output                 size   meaning
    =====================  =====  =====================================================================================
    `fault`                1      why the arm is stopped: a code of `Fault`
    `arm_state`            1      what it does: a number of `ArmState`
    `position_measured`    n      of the joints [rad]
    `velocity_estimated`   n      [rad/s]
    `state_estimated`      2n     both
    `torque_external`      n      what the surroundings do to the joints [Nm], whatever sign the driver gives it
    `torque_commanded`     n      what is sent [Nm]
    =====================  =====  =====================================================================================
    """

    wraps_angles = True

    def __init__(
        self,
        workcell: Workcell,
        lcm: DrakeLcmInterface | None = None,
        impedance: Impedance = Impedance(),  # noqa: B008 (frozen)
        period: float | None = None,
        wrench_time_constant: float = 0.02,
        robot_timeout: float = 10.0,
        end_effector: EndEffector | str = DEFAULT_END_EFFECTOR,
        *,
        robot: Robot | str = IIWA14,
        lcm_url: str = "",
        limits: SafetyLimits | None = None,
        status_limits: StatusLimits | None = None,
    ):
        """
        Args:
            workcell: for its target frame and for what is held; the fixture is real.
            lcm: the bus; unless given, the one at `lcm_url`.
            impedance: at the tool centre.
            period: at which commands are sent [s]; the driver's unless given.
            wrench_time_constant: of the wrench estimate's low-pass filter [s].
            robot_timeout: how long an initialization waits for the robot [s].
            end_effector: which tool is bolted on, or its name; a gripper has a driver of its own, and stays open here.
            robot: which arm, or its name.
            lcm_url: of the bus; LCM's own default where it is empty.
            limits: of what is measured and sent; `safety_limits` unless given.
            status_limits: of the statuses; unless given, they follow from the joints' speeds and the period.

        Raises:
            InputError: if nothing here speaks to such a robot, or at such a URL.
        """
        super().__init__()
        robot = find_robot(robot)
        self.driver = driver = find_driver(robot)
        self.lcm = bus = lcm or open_bus(lcm_url)
        self.lcm_url = lcm_url
        self.period = period = driver.period if period is None else period
        self.controller_plant = known = ArmControllerPlant(workcell, robot, end_effector)
        self.limits = limits = limits or safety_limits(known.plant, driver)
        self.impedance, self._robot, self._end_effector = impedance, robot, end_effector
        self._robot_timeout, self._wrench_time_constant = robot_timeout, wrench_time_constant
        num_joints = known.plant.num_positions()
        builder = DiagramBuilder()
        builder.AddNamedSystem("lcm", LcmInterfaceSystem(bus))
        subscriber = builder.AddNamedSystem(
            "status_subscriber",
            LcmSubscriberSystem(driver.status_channel, _StatusSerializer(driver), bus, robot_timeout),
        )
        status_limits = status_limits or StatusLimits.at_rate(known.plant.GetVelocityUpperLimits().tolist(), period)
        self.status_limits = status_limits
        self._status = status = builder.AddNamedSystem("status", StatusWatchdog(status_limits, period=period))
        words = builder.AddNamedSystem(
            "deputy_subscriber", LcmSubscriberSystem(word_channel(driver.command_channel), WordSerializer(), bus)
        )
        # A deputy speaks as often as the robot; it may be late by as much again.
        self._deputy = deputy = builder.AddNamedSystem(
            "deputy", HeartbeatMonitor(period=period, timeout=2.0 * MAX_MISSED_MESSAGES * period)
        )
        positions = builder.AddNamedSystem("positions", MatrixGain(np.eye(num_joints, 2 * num_joints)))
        velocities = builder.AddNamedSystem("velocities", MatrixGain(np.eye(num_joints, 2 * num_joints, num_joints)))
        wrench = builder.AddNamedSystem(
            "wrench",
            JointTorqueWrench(
                known.plant,
                known.target,
                known.tool_centre,
                period=period,
                time_constant=wrench_time_constant,
            ),
        )
        watchdog = builder.AddNamedSystem("watchdog", CommandWatchdog(period))
        ramp = builder.AddNamedSystem("ramp", PoseRateLimiter(period=period))
        controller, monitor = add_controller(builder, known, impedance, period, compensate_gravity=False)
        self._guard = guard = builder.AddNamedSystem("guard", TorqueSafetyLimiter(known.plant, limits, period=period))
        publisher = builder.AddNamedSystem(
            "command_publisher",
            TorquePublisher(bus, driver.command_channel, driver.encode, num_joints, period=period),
        )
        state, external_torque = status.get_estimated_state_output_port(), status.get_external_torque_output_port()
        pose = controller.get_pose_output_port()
        for source, target in (
            (subscriber.get_output_port(), status.get_status_input_port()),
            (state, positions.get_input_port()),
            (state, velocities.get_input_port()),
            (state, controller.get_estimated_state_input_port()),
            (positions.get_output_port(), wrench.get_positions_input_port()),
            (external_torque, wrench.get_external_torque_input_port()),
            (pose, watchdog.get_pose_input_port()),
            (watchdog.get_safe_pose_output_port(), ramp.get_desired_pose_input_port()),
            (pose, ramp.get_pose_input_port()),
            (guard.get_blend_factor_output_port(), ramp.get_blend_factor_input_port()),
            (ramp.get_limited_pose_output_port(), controller.get_desired_pose_input_port()),
            (controller.get_impedance_wrench_output_port(), monitor.get_impedance_wrench_input_port()),
            (controller.get_generalized_force_output_port(), guard.get_torque_input_port()),
            (state, guard.get_estimated_state_input_port()),
            (external_torque, guard.get_external_torque_input_port()),
            (wrench.get_wrench_output_port(), guard.get_wrench_input_port()),
            (pose, guard.get_pose_input_port()),
            (watchdog.get_safe_pose_output_port(), guard.get_desired_pose_input_port()),
            (status.get_fault_output_port(), deputy.get_status_fault_input_port()),
            (words.get_output_port(), deputy.get_heartbeat_input_port()),
            (deputy.get_fault_output_port(), guard.get_status_fault_input_port()),
            (status.get_age_output_port(), guard.get_status_age_input_port()),
            (status.get_is_new_output_port(), guard.get_status_is_new_input_port()),
            (watchdog.get_command_timed_out_output_port(), guard.get_command_timed_out_input_port()),
            (guard.get_safe_torque_output_port(), publisher.get_torque_input_port()),
            (guard.get_is_sending_output_port(), publisher.get_is_sending_input_port()),
        ):
            builder.Connect(source, target)
        export_station_ports(
            builder,
            watchdog.get_desired_pose_input_port(),
            watchdog.get_command_time_input_port(),
            pose=pose,
            wrench=wrench.get_wrench_output_port(),
            contact_force=monitor.get_contact_force_output_port(),
            saturation=controller.get_saturation_output_port(),
            command_timed_out=guard.get_not_following_output_port(),
        )
        builder.ExportOutput(guard.get_fault_output_port(), "fault")
        builder.ExportOutput(guard.get_arm_state_output_port(), "arm_state")
        for name, port in (
            ("position_measured", positions.get_output_port()),
            ("velocity_estimated", velocities.get_output_port()),
            ("state_estimated", state),
            ("torque_external", external_torque),
            ("torque_commanded", guard.get_safe_torque_output_port()),
        ):
            builder.ExportOutput(port, f"{driver.name}.{name}")
        builder.BuildInto(self)

    def get_fault_output_port(self):
        """Why the arm is stopped, (1,): a code of `Fault`."""
        return self.GetOutputPort("fault")

    def get_arm_state_output_port(self):
        """What the arm does, (1,): a number of `ArmState`."""
        return self.GetOutputPort("arm_state")

    def start(self, simulator: Simulator) -> None:
        """Initializes a simulator that runs this station: waits for the robot, and holds where it is.

        Raises:
            InputError: if no robot answers.
        """
        try:
            simulator.Initialize()
        except RuntimeError as error:
            if "Timed out" not in str(error):
                raise
            raise InputError(
                f"no robot answers on LCM channel {self.driver.status_channel}: start its driver, and check the bus's "
                "URL"
            ) from error

    def stop(self, context: Context) -> None:
        """Brings the arm to rest because somebody asks for it; `context` is the root context."""
        self._guard.stop(self._guard.GetMyMutableContextFromRoot(context))

    def resume(self, context: Context) -> None:
        """Goes on after a stop, from where the arm is; `context` is the root context.

        Raises:
            InputError: if the arm is not stopped, not yet at rest, or something is wrong still.
        """
        self._guard.resume(self._guard.GetMyMutableContextFromRoot(context))

    def tell_time(self, context: Context, clock: float) -> None:
        """What the clock on the wall shows [s], for the next step in real time; `context` is the root context.

        Without it each step is a period after the one before.
        """
        self._status.get_clock_input_port().FixValue(self._status.GetMyMutableContextFromRoot(context), [clock])

    def has_safety_monitor(self, context: Context) -> bool:
        """Whether somebody stands by at the robot, and still speaks; `context` is this station's own."""
        return self._deputy.is_alive(self.GetSubsystemContext(self._deputy, context))

    def copy_state_from(self, context: Context, before: Context) -> None:
        """Goes on as another station of the same arm left off: nothing is waited for, and the arm is not let go.

        Args:
            context: this station's own, initialized.
            before: the other station's own, whose bus is the same.
        """
        context.SetStateAndParametersFrom(before)

    def set_pose(self, context: Context, pose: np.ndarray) -> None:
        """A real arm can't be put anywhere.

        Raises:
            InputError: always; move it there by desired poses.
        """
        raise InputError("a real arm can't be put to a pose by a reset: move it there by desired poses")

    def clone(self, workcell: Workcell) -> HardwareStation:
        """Another station of the same arm on the same bus, with the same limits."""
        return HardwareStation(
            workcell,
            self.lcm,
            self.impedance,
            self.period,
            self._wrench_time_constant,
            self._robot_timeout,
            self._end_effector,
            robot=self._robot,
            lcm_url=self.lcm_url,
            limits=self.limits,
            status_limits=self.status_limits,
        )

    def force_of(self, positions: np.ndarray, external_torque: np.ndarray) -> np.ndarray:
        """The force on the tool that external torques (n,) [Nm] of a resting arm mean, (3,) [N]."""
        J = self._jacobian(positions)
        return np.linalg.solve(J @ J.T + 1e-4 * np.eye(6), J @ external_torque)[3:]

    def load_of_force(self, positions: np.ndarray) -> np.ndarray:
        """The share of each joint's greatest torque that the impedance's force and torque can take, (n,).

        They are limited along and about each axis of the target by itself: it is of the worst corner of that box.
        Above 1 the guard clips what the impedance wants; the driver would stop at more than 1 / `TORQUE_SHARE`.

        Args:
            positions: of the joints, (n,) [rad].
        """
        J, limits = self._jacobian(positions), to_wrench_order(self.impedance.limits)
        return (limits[:3] @ np.abs(J[3:]) + limits[3:] @ np.abs(J[:3])) / np.array(self.limits.torque)

    def _jacobian(self, positions: np.ndarray) -> np.ndarray:
        """Of the tool centre in the target's axes, (6, n), its rotation first."""
        plant, arm = self.controller_plant.plant, self.controller_plant.arm
        context = plant.CreateDefaultContext()
        plant.SetPositions(context, positions)
        return plant.CalcJacobianSpatialVelocity(
            context, JacobianWrtVariable.kV, arm.tool_centre, np.zeros(3), arm.target, arm.target
        )


class SimulatedIiwa(Diagram):
    """What a real iiwa and its driver are to `HardwareStation`: listens for torques, answers with joint states."""

    def __init__(
        self,
        workcell: Workcell,
        lcm: DrakeLcmInterface,
        time_step: float = IIWA_DRIVER.period,
        end_effector: EndEffector | str = DEFAULT_END_EFFECTOR,
        directives: Sequence[ModelDirective] = (),
    ):
        """
        Args:
            workcell: what stands in the world and what is held.
            lcm: the bus.
            time_step: of the plant [s], a divisor of the status's period.
            end_effector: which tool is bolted on, or its name; a gripper has a driver of its own, and stays open here.
            directives: what stands around them.

        Raises:
            InputError: if the directives can't be followed.
        """
        super().__init__()
        builder = DiagramBuilder()
        builder.AddNamedSystem("lcm", LcmInterfaceSystem(lcm))

        def add(plant: MultibodyPlant) -> ArmModel:
            arm = add_arm(plant, workcell, IIWA14, end_effector, as_rigid=True)
            follow_directives(plant, directives)
            return arm

        self.plant, self.scene_graph, self.arm = add_workcell_plant(builder, workcell, time_step, add)
        self.controller_plant = ArmControllerPlant(workcell, IIWA14, end_effector)
        BuildIiwaControl(
            builder,
            lcm,
            self.plant,
            self.arm.model,
            IiwaDriver(control_mode="torque_only", lcm_status_period=IIWA_DRIVER.period),
            self.controller_plant.plant,
        )
        builder.BuildInto(self)

    def simulator(self) -> Simulator:
        """Runs it, not initialized.

        All that is continuous in it is the driver's low-pass filter. Each time at which an integrator asks how that
        changes, the contact is solved anew, which costs more than all else: once in a step is enough.
        """
        simulator = Simulator(self)
        ResetIntegratorFromFlags(simulator, "explicit_euler", self.plant.time_step())
        simulator.get_mutable_integrator().set_fixed_step_mode(True)
        return simulator

    def set_pose(self, context: Context, pose: np.ndarray) -> None:
        """Puts the arm at rest with its tool centre at `pose`, (6,); `context` is the root context."""
        self.controller_plant.place(self.plant, self.arm.model, context, pose)
