"""A real iiwa behind LCM, with the same ports as a simulated station; and the robot's side of it, simulated."""

from __future__ import annotations

import numpy as np
from drake import lcmt_iiwa_command, lcmt_iiwa_status
from pydrake.lcm import DrakeLcm, DrakeLcmInterface, Subscriber
from pydrake.manipulation import (
    BuildIiwaControl,
    IiwaCommandSender,
    IiwaControlMode,
    IiwaDriver,
    IiwaStatusReceiver,
    kIiwaLcmStatusPeriod,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.lcm import LcmInterfaceSystem, LcmPublisherSystem, LcmSubscriberSystem
from pydrake.systems.primitives import Multiplexer

from guiderail.diagrams.stations.arm import KnownArm, add_arm, add_impedance_control
from guiderail.diagrams.stations.station import PLANT_PERIOD, Impedance, Station, add_workcell_plant
from guiderail.diagrams.stations.workcell import Workcell
from guiderail.models.errors import InputError
from guiderail.models.robots.iiwa import IIWA14
from guiderail.models.robots.robot import DEFAULT_END_EFFECTOR, EndEffector
from guiderail.systems.joint_torque_wrench import JointTorqueWrench

STATUS_CHANNEL, COMMAND_CHANNEL = "IIWA_STATUS", "IIWA_COMMAND"
NUM_JOINTS = IIWA14.num_joints


class HardwareStation(Station):
    """The impedance controller on this machine, the arm at the other end of Drake's LCM messages.

    Torques go out on `IIWA_COMMAND`, joint states come in on `IIWA_STATUS`. The robot's own controller, in torque mode,
    carries its weight: here nothing compensates gravity a second time. The wrench is estimated from the joints'
    external torques; there is no wrist sensor. `start` waits for the robot's first status, and the first pose that
    is held is where the robot then is.
    """

    def __init__(
        self,
        workcell: Workcell,
        lcm: DrakeLcmInterface | None = None,
        impedance: Impedance = Impedance(),  # noqa: B008 (frozen)
        period: float = PLANT_PERIOD,
        wrench_time_constant: float = 0.02,
        robot_timeout: float = 10.0,
        end_effector: EndEffector | str = DEFAULT_END_EFFECTOR,
    ):
        """
        Args:
            workcell: for its target frame and for what is held; the fixture is real.
            lcm: the bus; Drake's default unless given.
            impedance: at the tool centre.
            period: at which commands are sent [s].
            wrench_time_constant: of the wrench estimate's low-pass filter [s].
            robot_timeout: how long an initialization waits for the robot [s].
            end_effector: which tool is bolted on, or its name; a gripper has a driver of its own, and stays open here.
        """
        super().__init__()
        builder = DiagramBuilder()
        bus = lcm or DrakeLcm()
        builder.AddNamedSystem("lcm", LcmInterfaceSystem(bus))
        known = KnownArm(workcell, IIWA14, end_effector)
        subscriber = builder.AddNamedSystem(
            "status_subscriber",
            LcmSubscriberSystem.Make(
                STATUS_CHANNEL,
                lcmt_iiwa_status,
                bus,
                use_cpp_serializer=True,
                wait_for_message_on_initialization_timeout=robot_timeout,
            ),
        )
        status = builder.AddNamedSystem("status", IiwaStatusReceiver(NUM_JOINTS))
        state = builder.AddNamedSystem("state", Multiplexer([NUM_JOINTS, NUM_JOINTS]))
        wrench = builder.AddNamedSystem(
            "wrench",
            JointTorqueWrench(
                known.plant,
                known.arm.target,
                known.arm.tool_centre,
                period=period,
                time_constant=wrench_time_constant,
            ),
        )
        torque = add_impedance_control(
            builder,
            known,
            impedance,
            period,
            state=state.get_output_port(),
            wrench=wrench.get_wrench_output_port(),
            compensate_gravity=False,
        )
        sender = builder.AddNamedSystem("command", IiwaCommandSender(NUM_JOINTS, IiwaControlMode.kTorqueOnly))
        publisher = builder.AddNamedSystem(
            "command_publisher",
            LcmPublisherSystem.Make(
                COMMAND_CHANNEL, lcmt_iiwa_command, bus, publish_period=period, use_cpp_serializer=True
            ),
        )
        builder.Connect(subscriber.get_output_port(), status.get_input_port())
        builder.Connect(status.get_position_measured_output_port(), state.get_input_port(0))
        builder.Connect(status.get_velocity_estimated_output_port(), state.get_input_port(1))
        builder.Connect(status.get_position_measured_output_port(), wrench.get_positions_input_port())
        builder.Connect(status.get_torque_external_output_port(), wrench.get_external_torque_input_port())
        builder.Connect(torque, sender.get_torque_input_port())
        builder.Connect(sender.get_output_port(), publisher.get_input_port())
        builder.BuildInto(self)

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
                f"no robot answers on LCM channel {STATUS_CHANNEL}: start its driver, and check the bus's URL"
            ) from error

    def set_pose(self, context: Context, pose: np.ndarray) -> None:
        """A real arm can't be put anywhere.

        Raises:
            InputError: always; move it there by desired poses.
        """
        raise InputError("a real arm can't be put to a pose by a reset: move it there by desired poses")


class SimulatedIiwa(Diagram):
    """What a real iiwa and its driver are to `HardwareStation`: listens for torques, answers with joint states."""

    def __init__(
        self,
        workcell: Workcell,
        lcm: DrakeLcmInterface,
        time_step: float = kIiwaLcmStatusPeriod,
        end_effector: EndEffector | str = DEFAULT_END_EFFECTOR,
    ):
        """
        Args:
            workcell: what stands in the world and what is held.
            lcm: the bus.
            time_step: of the plant [s]; the status goes out every 5 ms, as the real driver's does.
            end_effector: which tool is bolted on, or its name; a gripper has a driver of its own, and stays open here.
        """
        super().__init__()
        builder = DiagramBuilder()
        builder.AddNamedSystem("lcm", LcmInterfaceSystem(lcm))
        self.plant, self.scene_graph, self.arm = add_workcell_plant(
            builder, workcell, time_step, lambda plant: add_arm(plant, workcell, IIWA14, end_effector, as_rigid=True)
        )
        self._known = KnownArm(workcell, IIWA14, end_effector)
        BuildIiwaControl(
            builder, lcm, self.plant, self.arm.model, IiwaDriver(control_mode="torque_only"), self._known.plant
        )
        builder.BuildInto(self)

    def set_pose(self, context: Context, pose: np.ndarray) -> None:
        """Puts the arm at rest with its tool centre at `pose`, (6,); `context` is the root context."""
        self._known.place(self.plant, self.arm.model, context, pose)


def serve(robot: SimulatedIiwa, lcm: DrakeLcm, start: np.ndarray, seconds: float, patience: float) -> float:
    """Runs a simulated arm for another process: one step, then it waits for the torque that answers its status.

    So neither side ever outruns the other, however slow a machine is.

    Args:
        robot: the arm.
        lcm: its bus.
        start: pose at which the tool starts, (6,).
        seconds: of simulated time to run.
        patience: how long to wait for each command, and ten times as long for the first [s of wall clock].

    Returns:
        The simulated time at which it ended: less than `seconds` if commands stopped.
    """
    commands = Subscriber(lcm, COMMAND_CHANNEL, lcmt_iiwa_command)
    simulator = Simulator(robot)
    robot.set_pose(simulator.get_mutable_context(), start)
    simulator.Initialize()
    steps, missed = 0, 0
    while steps * kIiwaLcmStatusPeriod < seconds:
        answered = commands.count
        tries = 100 if answered == 0 else 10
        for _ in range(tries):
            lcm.HandleSubscriptions(int(1000 * patience / 10))
            if commands.count > answered:
                break
            # A datagram may be lost, and before its first command the other side may not have been listening.
            simulator.get_system().ForcedPublish(simulator.get_context())
        else:
            missed += 1
            break
        steps += 1
        simulator.AdvanceTo(steps * kIiwaLcmStatusPeriod)
    return steps * kIiwaLcmStatusPeriod


def drive_in_step(simulator: Simulator, lcm: DrakeLcm, seconds: float, patience: float) -> None:
    """Advances a hardware station at the pace of the robot's own clock: a step for each status that arrives.

    Raises:
        InputError: if the robot falls silent.
    """
    statuses = Subscriber(lcm, STATUS_CHANNEL, lcmt_iiwa_status)
    start = simulator.get_context().get_time()
    steps = round(seconds / PLANT_PERIOD)
    for step in range(steps):
        seen = statuses.count
        for _ in range(10):
            lcm.HandleSubscriptions(int(1000 * patience / 10))
            if statuses.count > seen:
                break
        else:
            raise InputError("the robot fell silent: look at its driver and start again")
        simulator.AdvanceTo(start + (step + 1) * PLANT_PERIOD)
