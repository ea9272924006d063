"""Hardware station: a real arm with the same ports as a simulated station."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from pydrake.common.value import Value
from pydrake.multibody.tree import Frame, JacobianWrtVariable, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, MatrixGain

from guiderail.diagrams.envs.options import Field, Number, Options
from guiderail.diagrams.stations.arm import ArmControllerPlant
from guiderail.diagrams.stations.impedance_control import add_controller
from guiderail.diagrams.stations.registry import register_station
from guiderail.diagrams.stations.station import (
    CONTROL_PERIOD,
    ControllerPlant,
    Impedance,
    Station,
    command_timeout,
    export_station_ports,
    tare_steps,
    to_wrench_order,
    whole_multiple,
)
from guiderail.diagrams.stations.workcell import Workcell
from guiderail.diagrams.wiring import add_system
from guiderail.models.common.errors import InputError
from guiderail.models.control.cartesian_impedance import damping_matrix
from guiderail.models.robots import DEFAULT_END_EFFECTOR, DEFAULT_ROBOT
from guiderail.models.robots.robot import EndEffector, Robot, find_robot
from guiderail.systems.command_checks import CommandWatchdog
from guiderail.systems.support.declarations import output_getter
from guiderail.systems.wrench_sensors import JointTorqueWrench
from guiderail.systems.wrench_signals import WrenchTare
from guiderail_hardware.drivers.driver import (
    Driver,
    PoseDriver,
    check_driver,
    check_robot,
    open_driver,
    safety_limits,
    torque_tolerance,
)
from guiderail_hardware.drivers.driver import status_limits as default_status_limits
from guiderail_hardware.models.joint_status import MAX_MISSED_MESSAGES, Fault, StatusLimits
from guiderail_hardware.models.robot_impedance import RobotImpedance
from guiderail_hardware.models.round_trip import max_round_trip
from guiderail_hardware.systems.heartbeat_monitor import HeartbeatMonitor
from guiderail_hardware.systems.pose_publisher import PosePublisher
from guiderail_hardware.systems.pose_rate_limiter import PoseRateLimiter
from guiderail_hardware.systems.spring_reference import SpringReference
from guiderail_hardware.systems.status_watchdog import StatusWatchdog
from guiderail_hardware.systems.torque_publisher import TorquePublisher
from guiderail_hardware.systems.torque_safety_limiter import SafetyLimits, TorqueSafetyLimiter

PROCESS_CHECK_PERIOD = 0.5  # time between checks of the robot's program during the wait for its first status [s]


class HardwareOptions(Options):
    """Options of a station with a real arm."""

    robot: str = Field(DEFAULT_ROBOT, description="name of the arm")
    end_effector: str = Field(DEFAULT_END_EFFECTOR, description="name of the tool on the flange")
    driver: str = Field("", description="driver of the robot; default: the one with the robot's name")
    robot_url: str = Field("", description="LCM URL of the driver's bus, or host of the robot; default: LCM's default")
    robot_timeout: Number = Field(10.0, gt=0, description="longest wait for the robot's first status [s]")


@register_station("hardware", workcell_kind="insertion", options=HardwareOptions, is_simulated=False)
class HardwareStation(Station):
    """A real arm with an impedance at its tool center, connected by a `Driver`.

    Statuses are joint states. Commands are the joint torques of this station's impedance controller. With a
    `PoseDriver`, commands are desired poses, and the robot's own program runs the impedance controller. The robot's own
    controller compensates gravity in torque mode, so this station does not. The wrench is estimated from the external
    joint torques; there is no wrist sensor. `start` waits for the first status. Nothing is sent until statuses have
    been valid for the settling time. Then the torques are blended in, and the arm stays at its pose until there is a
    valid command.

    A `StatusWatchdog` checks the statuses, a `HeartbeatMonitor` the safety monitor's heartbeat, and a
    `TorqueSafetyLimiter` measurements and torques. Each of these systems can stop the arm; the output ``fault`` is then
    the reason, and `resume` ends the stop. A `Clock` calls `receive` before each step. With a `PoseDriver` there is no
    input ``max_wrench``, because the bound of the robot's own controller is fixed. This station has the following
    outputs in addition to the ports of every station. As in Drake's own stations, the driver's name and a dot precede
    the names of joint ports:

    =====================  =====  =====================================================================================
    output                 size   meaning
    =====================  =====  =====================================================================================
    `fault`                1      reason of a stop, a code of `Fault`
    `arm_state`            1      lifecycle state of the arm, a number of `ArmState`
    `position_measured`    n      joint positions [rad]
    `velocity_estimated`   n      joint velocities [rad/s]
    `state_estimated`      2n     joint positions and velocities
    `torque_external`      n      torques of the surroundings on the joints [Nm], with the same sign for every driver
    `torque_commanded`     n      limited torques of this station's controller [Nm]; not sent to a `PoseDriver`
    =====================  =====  =====================================================================================

    Attributes:
        driver, robot, period, control_period, limits, status_limits, impedance: Arguments of the constructor, or their
            defaults.
        controller_plant: Model of the arm for the controller.
    """

    wraps_angles = True

    def __init__(
        self,
        workcell: Workcell,
        driver: Driver | str | None = None,
        impedance: Impedance = Impedance(),  # noqa: B008 (frozen)
        period: float | None = None,
        wrench_time_constant: float = 0.02,
        robot_timeout: float = 10.0,
        end_effector: EndEffector | str = DEFAULT_END_EFFECTOR,
        *,
        robot: Robot | str = DEFAULT_ROBOT,
        robot_url: str = "",
        limits: SafetyLimits | None = None,
        status_limits: StatusLimits | None = None,
        tare: bool = False,
        control_period: float = CONTROL_PERIOD,
    ):
        """Construct the station.

        Args:
            workcell: Target frame and held workpiece; the fixture is real.
            driver: Connection to the robot, or the name of a driver that is opened at `robot_url`; by default the
                driver with the robot's name.
            impedance: Impedance at the tool center.
            period: Period of a command [s]; the driver's by default.
            wrench_time_constant: Time constant of the wrench estimate's low-pass filter [s].
            robot_timeout: Longest time that `start` waits for the robot [s].
            end_effector: Tool on the flange, or its name; a gripper is modeled open and is not commanded.
            robot: The arm, or its name.
            robot_url: Address of the robot: LCM's URL, or a host; LCM's default if empty.
            limits: Limits of measurements and torques; `safety_limits` by default.
            status_limits: Limits of a status; by default they follow from the joints' velocity limits, the period and
                the driver's `hold_off`.
            tare: True subtracts the wrench that is measured after the start, when the tool must be free, from the
                output `wrench`. The safety limits apply to the wrench before the subtraction.
            control_period: Time between commands of a skill [s], a whole multiple of `period`.

        Raises:
            InputError: If the robot has no driver or does not fit it (`check_robot`), the driver is incomplete
                (`check_driver`), the address is unusable, the settling time is shorter than the driver's `hold_off`, or
                the control period is no multiple of `period`.
        """
        super().__init__()
        robot = find_robot(robot)
        if not isinstance(driver, Driver):
            driver = open_driver(driver or robot, robot_url)
        check_driver(driver)
        check_robot(driver, robot)
        self.driver, self.robot = driver, robot
        self.period = period = driver.period if period is None else period
        self.control_period = control_period
        whole_multiple(control_period, period)
        self.controller_plant = ArmControllerPlant(workcell, robot, end_effector)
        plant = self.controller_plant.plant
        self.limits = limits or safety_limits(plant, driver)
        self.status_limits = default_status_limits(plant, driver, period) if status_limits is None else status_limits
        if self.status_limits.settling_time < driver.hold_off:
            raise InputError(
                f"the driver {driver.name} accepts no commands for {driver.hold_off:g} s: the settling time must be as "
                f"long, not {self.status_limits.settling_time:g} s"
            )
        self.impedance, self._end_effector = impedance, end_effector
        if not isinstance(driver, PoseDriver):  # otherwise the impedance runs on the robot
            frequencies = impedance_frequencies(self.controller_plant, impedance)
            longest = max_round_trip(frequencies, impedance.damping_ratio, self.limits.decay_time, period=period)
            longest = min(longest, self.status_limits.max_round_trip)
            self.status_limits = replace(self.status_limits, max_round_trip=longest)
        self._robot_timeout, self._wrench_time_constant, self._tare = robot_timeout, wrench_time_constant, tare
        self._build()

    def _build(self) -> None:
        period, model, builder, guard = self.period, self.controller_plant, DiagramBuilder(), self.driver.guard
        n = model.plant.num_positions()
        status = StatusWatchdog(model.plant, self.status_limits, torque_tolerance(self.limits), period=period)
        self._status = builder.AddNamedSystem("status", status)
        state, external_torque = status.get_estimated_state_output_port(), status.get_external_torque_output_port()
        # Heartbeats are sent with the statuses, and may be twice as late.
        heartbeat = HeartbeatMonitor(period=period, timeout=2.0 * MAX_MISSED_MESSAGES * period)
        self._heartbeat = add_system(builder, "heartbeat", heartbeat, status_fault=status.get_fault_output_port())
        positions = add_system(builder, "positions", MatrixGain(np.eye(n, 2 * n)), state).get_output_port()
        velocities = add_system(builder, "velocities", MatrixGain(np.eye(n, 2 * n, n)), state).get_output_port()
        wrench = JointTorqueWrench(
            model.plant, model.target, model.tool_center, period=period, time_constant=self._wrench_time_constant
        )
        add_system(builder, "wrench", wrench, positions=positions, external_torque=external_torque)
        measured_wrench = wrench.get_wrench_output_port()
        watchdog = builder.AddNamedSystem("watchdog", CommandWatchdog(period, command_timeout(self.control_period)))
        safe_pose = watchdog.get_safe_pose_output_port()
        rate_limiter = make_rate_limiter(self.driver, period)
        add_system(builder, "rate_limiter", rate_limiter, desired_pose=safe_pose)
        limited_pose = rate_limiter.get_limited_pose_output_port()
        controller, impedance_monitor, tank = add_controller(
            builder, model, self.impedance, period, contact_wrench=measured_wrench, compensate_gravity=False
        )
        self._tank = tank
        pose = controller.get_pose_output_port()
        self._limiter = limiter = add_system(
            builder,
            "limiter",
            TorqueSafetyLimiter(model.plant, self.limits, period=period, can_hold=self.driver.can_hold),
            torque=controller.get_generalized_force_output_port(),
            estimated_state=state,
            external_torque=external_torque,
            wrench=measured_wrench,
            pose=pose,
            desired_pose=safe_pose,
            status_fault=heartbeat.get_fault_output_port(),
            status_age=status.get_age_output_port(),
            velocity=status.get_velocity_output_port(),
            reported_speed=status.get_reported_speed_output_port(),
            command_timed_out=watchdog.get_command_timed_out_output_port(),
        )
        builder.Connect(state, controller.get_estimated_state_input_port())
        builder.Connect(limited_pose, (tank or controller).get_desired_pose_input_port())
        builder.Connect(pose, watchdog.get_pose_input_port())
        builder.Connect(pose, rate_limiter.get_pose_input_port())
        for system in (watchdog, rate_limiter):
            builder.Connect(limiter.get_blend_factor_output_port(), system.get_blend_factor_input_port())
        safe_torque, arm_state = limiter.get_safe_torque_output_port(), limiter.get_arm_state_output_port()
        if isinstance(self.driver, PoseDriver):
            X_BaseTarget = model.target.CalcPoseInWorld(model.plant.CreateDefaultContext())
            poses = PosePublisher(guard.write_pose, guard.stop, X_BaseTarget, period=period)
            sent_pose = limited_pose
            if self.driver.is_spring_and_damper:
                reference = SpringReference(model, make_robot_impedance(model, self.impedance))
                impedance_wrench = controller.get_impedance_wrench_output_port()
                add_system(builder, "reference", reference, estimated_state=state, impedance_wrench=impedance_wrench)
                sent_pose = reference.get_reference_pose_output_port()
            add_system(builder, "publisher", poses, pose=sent_pose, arm_state=arm_state)
            # The torques of the robot's own controller are unknown: velocities are compared with positions only.
            no_torque = builder.AddSystem(ConstantVectorSource(np.zeros(n)))
            builder.Connect(no_torque.get_output_port(), status.get_torque_input_port())
        else:
            add_system(
                builder,
                "publisher",
                TorquePublisher(guard.write, n, period=period, hold=guard.hold),
                torque=safe_torque,
                is_sending=limiter.get_is_sending_output_port(),
                is_holding=limiter.get_is_holding_output_port(),
            )
            builder.Connect(safe_torque, status.get_torque_input_port())
        if self._tare:
            tare = WrenchTare(period, *tare_steps(period))
            add_system(builder, "tare", tare, measured_wrench=measured_wrench)
            measured_wrench = tare.get_tared_wrench_output_port()
        max_wrench = None
        if tank is not None and not isinstance(self.driver, PoseDriver):
            max_wrench = tank.get_max_wrench_input_port()
        export_station_ports(
            builder,
            watchdog.get_desired_pose_input_port(),
            watchdog.get_command_time_input_port(),
            pose=pose,
            wrench=measured_wrench,
            contact_force=impedance_monitor.get_contact_force_output_port(),
            impedance_force=impedance_monitor.get_impedance_force_output_port(),
            saturation=controller.get_saturation_output_port(),
            command_timed_out=limiter.get_not_following_output_port(),
            max_wrench=max_wrench,
        )
        builder.ExportOutput(limiter.get_fault_output_port(), "fault")
        builder.ExportOutput(arm_state, "arm_state")
        for name, port in (
            ("position_measured", positions),
            ("velocity_estimated", velocities),
            ("state_estimated", state),
            ("torque_external", external_torque),
            ("torque_commanded", safe_torque),
        ):
            builder.ExportOutput(port, f"{self.driver.name}.{name}")
        builder.BuildInto(self)

    get_fault_output_port = output_getter("fault", "reason of a stop, (1,), a code of `Fault`")
    get_arm_state_output_port = output_getter("arm_state", "arm's state, (1,), a number of `ArmState`")

    def start(self, simulator: Simulator, check_process: Callable[[], object] | None = None) -> None:
        """Wait for the robot's first status, and initialize a simulator that contains this station.

        During the wait `check_process` is called, which raises an error if the robot's program has ended. While another
        station controls the arm, use `take_over`, which does not wait.

        Raises:
            InputError: If no status arrives in time, the driver raises an exception while it is read, or a `PoseDriver`
                cannot be configured.
        """
        end, guard = time.monotonic() + self._robot_timeout, self.driver.guard
        guard.forget_errors()
        guard.receive()
        while guard.read() is None:
            if (left := end - time.monotonic()) <= 0.0:
                raise InputError(f"no robot answers on {self.driver}: start its driver, and check the address")
            if check_process is not None:
                check_process()
            guard.receive(min(left, PROCESS_CHECK_PERIOD))
        guard.check_readable()
        if isinstance(self.driver, PoseDriver):
            guard.call_at_rest("configure", make_robot_impedance(self.controller_plant, self.impedance))
        self.receive(simulator.get_mutable_context())
        guard.check_readable()
        simulator.Initialize()

    def take_over(self, simulator: Simulator, other: HardwareStation, other_context: Context) -> None:
        """Initialize a simulator that contains this station, and take control from another station without a gap.

        This method does not wait. If the driver fails, it raises no exception, because the arm may be moving. A new
        motion begins, so the energy tank is full. See `copy_state_from` for `other` and `other_context`.
        """
        self.driver.guard.receive()
        if isinstance(self.driver, PoseDriver):
            self.driver.guard.configure(make_robot_impedance(self.controller_plant, self.impedance))
        self.receive(simulator.get_mutable_context())
        simulator.Initialize()
        self.copy_state_from(self.GetMyMutableContextFromRoot(simulator.get_mutable_context()), other, other_context)
        self._refill_tank(simulator.get_mutable_context())

    def _refill_tank(self, context: Context) -> None:
        """Fill the energy tank if there is one; `context` is the root context."""
        if self._tank is not None:
            self._tank.refill(self._tank.GetMyMutableContextFromRoot(context))

    def receive(self, context: Context, clock: float | None = None) -> None:
        """Read the newest status and heartbeat before a step; `context` is the root context.

        If a command has failed since the last step, the arm is stopped, and damped as soon as commands can be sent
        again. `clock` is the wall clock time [s]; without it, each step counts as one period after the previous step.
        """
        guard = self.driver.guard
        guard.receive()
        heartbeats = guard.read_heartbeats()
        newest, round_trip = guard.read(), guard.measure_round_trip(heartbeats, clock)
        if newest is not None:
            newest = replace(newest, round_trip=round_trip)
        status, heartbeat = (system.GetMyMutableContextFromRoot(context) for system in (self._status, self._heartbeat))
        self._status.get_status_input_port().FixValue(status, Value[object](newest))
        self._heartbeat.get_heartbeats_input_port().FixValue(heartbeat, Value[object](heartbeats))
        if clock is not None:
            self._status.get_clock_input_port().FixValue(status, [clock])
        limiter = self._limiter.GetMyMutableContextFromRoot(context)
        if guard.take_refusal():
            self._limiter.refuse_hold(limiter)
        if guard.take_failure():
            self._status.forget_torque(status)
            self._limiter.stop(limiter, Fault.COMMAND_FAILED)
        elif guard.take_recovery():
            self._limiter.damp_again(limiter)

    def stop(self, context: Context) -> None:
        """Damp the arm to rest; `context` is the root context."""
        self._limiter.stop(self._limiter.GetMyMutableContextFromRoot(context))

    def resume(self, context: Context) -> None:
        """End a stop, and continue from the arm's current pose; `context` is the root context.

        Without a valid command the arm stays at its pose, even if it was moved by hand during the stop. The energy tank
        is full again.

        Raises:
            InputError: If the arm is not stopped, not yet at rest, or a fault persists.
        """
        self._limiter.resume(self._limiter.GetMyMutableContextFromRoot(context))
        self._refill_tank(context)

    def describe_round_trip(self) -> str:
        """Return the round trip of the last commands in words; empty if it is unknown."""
        seconds, longest = self.driver.guard.round_trip.seconds, self.status_limits.max_round_trip
        return "" if np.isnan(seconds) else f"round trip {1e3 * seconds:.1f} ms, at most {1e3 * longest:.1f} ms"

    def read_max_wrench(self, context: Context) -> np.ndarray | None:
        """Return the value of the input ``max_wrench``, (8,), or None without one; `context` is this station's own."""
        port = self.GetInputPort("max_wrench") if self.HasInputPort("max_wrench") else None
        return port.Eval(context).copy() if port is not None and port.HasValue(context) else None

    def has_safety_monitor(self, context: Context) -> bool:
        """Return True if the safety monitor's heartbeat is received; `context` is this station's own."""
        return self._heartbeat.is_alive(self.GetSubsystemContext(self._heartbeat, context))

    def copy_state_from(self, context: Context, other: HardwareStation, other_context: Context) -> None:
        """Copy the state of another station on the same driver, so that this station takes control without a gap.

        The other station is a `clone` of this station, or the original of this clone. Both contexts are contexts of
        the stations, not root contexts; `context` is initialized.
        """
        context.SetStateAndParametersFrom(other_context)
        for system, source, port in (
            (self._status, other._status, "status"),
            (self._heartbeat, other._heartbeat, "heartbeats"),
        ):
            value = source.GetInputPort(port).Eval(other.GetSubsystemContext(source, other_context))
            system.GetInputPort(port).FixValue(self.GetMutableSubsystemContext(system, context), Value[object](value))

    def set_pose(self, context: Context, pose: np.ndarray) -> None:
        """Raise `InputError`, because a reset cannot set the pose of a real arm."""
        raise InputError("a reset cannot set the pose of a real arm: move it there by desired poses")

    def clone(self, workcell: Workcell) -> HardwareStation:
        """Return another station of the same arm on the same driver, with the same limits."""
        return HardwareStation(
            workcell,
            self.driver,
            self.impedance,
            self.period,
            self._wrench_time_constant,
            self._robot_timeout,
            self._end_effector,
            robot=self.robot,
            limits=self.limits,
            status_limits=self.status_limits,
            tare=self._tare,
            control_period=self.control_period,
        )

    def estimate_force(self, positions: np.ndarray, external_torque: np.ndarray) -> np.ndarray:
        """Return the force on the tool at rest in the axes of the target frame, (3,) [N], without a filter.

        Joint positions [rad] and external torques [Nm] are (n,).
        """
        J = tool_jacobian(self.controller_plant, positions, self.controller_plant.target)
        return np.linalg.solve(J @ J.T + 1e-4 * np.eye(6), J @ external_torque)[3:]

    def max_torque_shares(self, positions: np.ndarray) -> np.ndarray:
        """Return the largest joint torques of the impedance's wrench, as shares of their limits, (n,).

        The joint positions are (n,) [rad]. The wrench is limited along and about each axis of the target separately;
        the result is for the worst corner of this box of wrenches. The torque limiter clips at a share of 1. The
        robot's reflex stops the arm at a share of at least 1 / `TORQUE_SHARE`, which clipped torques do not reach.
        """
        J = tool_jacobian(self.controller_plant, positions, self.controller_plant.target)
        limits = to_wrench_order(self.impedance.limits)
        return (limits[:3] @ np.abs(J[3:]) + limits[3:] @ np.abs(J[:3])) / np.array(self.limits.torque)


def tool_jacobian(model: ControllerPlant, positions: np.ndarray, frame: Frame) -> np.ndarray:
    """Return the Jacobian of the tool center at positions (n,) in the axes of a frame, (6, n), rotation first."""
    context = model.plant.CreateDefaultContext()
    model.plant.SetPositions(context, positions)
    return model.plant.CalcJacobianSpatialVelocity(
        context, JacobianWrtVariable.kV, model.tool_center, np.zeros(3), frame, frame
    )


def impedance_frequencies(model: ControllerPlant, impedance: Impedance) -> np.ndarray:
    """Return the natural frequencies of the impedance's modes in the nominal posture, (6,) [rad/s]."""
    context = model.plant.CreateDefaultContext()
    model.plant.SetPositions(context, model.posture)
    J = tool_jacobian(model, model.posture, model.target)[[3, 4, 5, 0, 1, 2]]
    Lambda_inverse = J @ np.linalg.solve(model.plant.CalcMassMatrix(context), J.T)
    K = np.diag(to_wrench_order(impedance.stiffness))
    return np.sqrt(np.maximum(np.linalg.eigvals(Lambda_inverse @ K).real, 0.0))


def make_rate_limiter(driver: Driver, period: float) -> PoseRateLimiter:
    """Return the limiter of the desired poses' speed, and for a `PoseDriver` also of their acceleration and jerk."""
    if isinstance(driver, PoseDriver):
        from guiderail_hardware.systems.pose_motion_limiter import (
            PoseMotionLimiter,  # needs ruckig, an optional dependency
        )

        return PoseMotionLimiter(driver.motion_limits, period=period)
    return PoseRateLimiter(period=period)


def payload_on_flange(model: ArmControllerPlant) -> SpatialInertia:
    """Return the spatial inertia of tool and workpiece about the flange's origin, in the flange's axes."""
    context, arm = model.plant.CreateDefaultContext(), model.arm
    return model.plant.CalcSpatialInertia(context, arm.wrist.frame_on_parent(), [body.index() for body in arm.tool])


def make_robot_impedance(model: ArmControllerPlant, impedance: Impedance) -> RobotImpedance:
    """Return the impedance for a robot's own controller, with the damping matrix of the nominal posture.

    Raises:
        InputError: If the axes of target and base differ: the station limits the wrench along the target's axes, but
            the robot along the axes of its base.
    """
    plant, arm = model.plant, model.arm
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, model.posture)
    if not model.target.CalcPoseInWorld(context).rotation().IsNearlyIdentity(1e-6):
        raise InputError("a robot with an impedance of its own needs a target with the axes of its base")
    K = np.diag(to_wrench_order(impedance.stiffness))
    J = tool_jacobian(model, model.posture, plant.world_frame())[[3, 4, 5, 0, 1, 2]]
    Lambda_inverse = J @ np.linalg.solve(plant.CalcMassMatrix(context), J.T)
    flange, payload = arm.wrist.frame_on_parent(), payload_on_flange(model)
    about_center = payload.Shift(payload.get_com()).CalcRotationalInertia()
    return RobotImpedance(
        X_FlangeTool=model.tool_center.CalcPose(context, flange),
        stiffness=K,
        damping=damping_matrix(K, Lambda_inverse, impedance.damping_ratio),
        max_wrench=to_wrench_order(impedance.limits),
        posture=model.posture,
        mass=payload.get_mass(),
        center_of_mass=payload.get_com(),
        inertia=about_center.CopyToFullMatrix3(),
    )
