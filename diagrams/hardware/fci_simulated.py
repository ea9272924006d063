"""Simulated robot for the driver fci: the simulator franky-sim with a task's tool, workpiece and fixture in its world.

franky-sim simulates an FR3 in MuJoCo and answers libfranka's network protocol. It estimates no external wrench and does
not check commands for discontinuities or collisions. The external torques are added here from the simulated contact.
The tests of `PoseMotionLimiter`, which computes the commands, check that these are continuous.
"""

from __future__ import annotations

import select
import socket
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable
from contextlib import ExitStack, closing
from typing import Any

import numpy as np
from franky_sim.franka_robot_protocol import UDPCommand
from franky_sim.franka_robot_server import FrankaRobotServer
from franky_sim.mujoco_simulator import FrankaMujocoRobot, MujocoSimulator
from pydrake.math import RigidTransform

from guiderail.diagrams.hardware.fci_lockstep import LockstepServer
from guiderail.diagrams.hardware.station import payload_on_flange
from guiderail.diagrams.stations.arm import ArmControllerPlant
from guiderail.diagrams.stations.mujoco import FIXTURE, WORKPIECE, MujocoContact, constraint_torques, mujoco_parts
from guiderail.diagrams.stations.workcell import ConvexWorkcell
from guiderail.diagrams.tasks.insertion import part_poses
from guiderail.models.common.errors import InputError

ROBOT, FLANGE_HEIGHT = "robot0_", 0.107  # prefix of names in the simulator; from seventh link to flange [m]
STEP = 0.001  # period of the protocol [s]
IDLE_RATE = 0.1  # rate of the clock of a robot without motion while its station computes
REPEAT_INTERVAL = 0.2  # wall clock time after which the state of a waiting robot is sent again [s]
RESIDUAL_FRICTION = 0.1  # friction of a joint [Nm]; libfranka's torques are "without gravity and friction"
# A robot without motion is held by joint stiffness [Nm/rad] and damping [Nms/rad], in place of its brakes. With the
# simulator's own gains, ten times these, a held joint whose tool is in contact vibrates with every step.
HOLDING_STIFFNESS = (450.0, 450.0, 350.0, 350.0, 200.0, 200.0, 200.0)
HOLDING_DAMPING = (45.0, 45.0, 35.0, 35.0, 20.0, 20.0, 20.0)
FILTER_TIME = 0.02  # time constant of the external torque's low-pass filter [s]


class SimulatedFranka(FrankaMujocoRobot):
    """Robot that reports the external torques of the simulated contact.

    Args:
        positions: Initial joint positions (7,) [rad].
    """

    def __init__(self, positions: np.ndarray):
        super().__init__(initial_q=tuple(positions), kp=HOLDING_STIFFNESS, kv=HOLDING_DAMPING)
        self._external = np.zeros(7)

    def _post_step(self) -> None:
        # As libfranka's estimate, without the joint friction; with the forces of joint limits, which no task reaches.
        contact = constraint_torques(self._model, self._data)[self._dof_addrs]
        self._external += STEP / FILTER_TIME * (contact - self._external)
        super()._post_step()

    @property
    def state(self) -> Any:
        """State message, with the external torque of the arm on its surroundings."""
        state = super().state
        # The tool replaces the hand, whose mass the simulator reports.
        return state.replace(tau_ext_hat_filtered=tuple(-self._external), m_ee=0.0)


class WorkcellSimulator(MujocoSimulator):
    """Simulated FR3 with a task's parts: the workpiece on the flange, and the fixture in the world."""

    def __init__(self, workcell: Any):
        """Construct the simulator of a task's workcell, a `ConvexWorkcell`.

        Raises:
            InputError: If the workcell has no convex solids.
        """
        super().__init__()
        self.model_of_arm = ArmControllerPlant(workcell, "panda")
        plant = self.model_of_arm.plant
        context = plant.CreateDefaultContext()
        X_FlangeTool = self.model_of_arm.arm.tool_center.CalcPose(context, plant.GetFrameByName("panda_flange"))
        self._X_LinkTool = RigidTransform([0, 0, FLANGE_HEIGHT]) @ X_FlangeTool
        if not isinstance(workcell, ConvexWorkcell):
            raise InputError(f"the simulated robot collides convex solids, and {type(workcell).__name__} has none")
        fixture, workpiece, assets = mujoco_parts(
            workcell.fixture_surfaces(), workcell.workpiece_surfaces(), MujocoContact()
        )
        self._workcell: Any = workcell
        self._parts, self._assets = (fixture, workpiece), assets
        self._arm: SimulatedFranka | None = None

    def add_arm(self, pose: np.ndarray) -> SimulatedFranka:
        """Add the robot with its tool center at a pose (6,) in the target frame, and the task's parts."""
        positions = self.model_of_arm.solve(pose, self.model_of_arm.posture)
        self.add_robot(initial_q=tuple(positions))
        self._arm = self._robots[0] = SimulatedFranka(positions)
        root = self.scene
        option = root.find("option")
        assert option is not None
        option.attrib.update(cone="elliptic", impratio="10", ccd_tolerance="1e-9", ccd_iterations="100")
        for joint in root.iterfind("default//joint[@frictionloss]"):
            joint.set("frictionloss", str(RESIDUAL_FRICTION))
        asset = root.find("asset")
        assert asset is not None
        asset.extend(self._assets)
        last = next(body for body in self.worldbody.iter("body") if body.get("name") == ROBOT + "fr3_link7")
        for element, parent in zip(self._parts, (self.worldbody, last), strict=True):
            parent.append(element)
        # The robot compensates the weight of the load that the client sets.
        payload = payload_on_flange(self.model_of_arm)
        moments = payload.Shift(payload.get_com()).CalcRotationalInertia()
        values = (*moments.get_moments(), *moments.get_products())
        body = ET.SubElement(last, "body", name="payload", pos=f"0 0 {FLANGE_HEIGHT}")
        attributes = {"pos": payload.get_com(), "mass": [payload.get_mass()], "fullinertia": values}
        ET.SubElement(body, "inertial", {name: " ".join(map(str, value)) for name, value in attributes.items()})
        # The tool replaces the hand, which stays in the model for the simulator's gripper but does not collide.
        for body in last.iter("body"):
            if body.get("name", "").startswith((ROBOT + "hand", ROBOT + "left", ROBOT + "right")):
                for geometry in body.findall("geom"):
                    geometry.attrib.update(contype="0", conaffinity="0")
        return self._arm

    def move_parts(self, X_TTactual: RigidTransform, X_PWorkpiece: RigidTransform) -> None:
        """Place the actual target frame in the nominal one, and the workpiece relative to the tool center."""
        workcell = self._workcell
        X_WFixture = workcell.X_WT @ X_TTactual @ workcell.X_FT.inverse()
        for name, X in ((FIXTURE, X_WFixture), (WORKPIECE, self._X_LinkTool @ X_PWorkpiece)):
            body = self.model.body(name)
            body.pos, body.quat = X.translation(), X.rotation().ToQuaternion().wxyz()


class _RobotServer(FrankaRobotServer):
    """Server of libfranka's protocol that can wait for the client's answer to a state."""

    def __init__(self, robot: SimulatedFranka, host: str):
        super().__init__(robot, [host])
        self._answered, self._answered_motion = -1, 0

    @property
    def is_controlled(self) -> bool:
        """True if the client answers each state of a motion with a command; it does not answer the first states."""
        return self.current_motion_id > 0 and self._answered_motion == self.current_motion_id

    @property
    def is_waiting(self) -> bool:
        """True if the client has not answered the last state yet."""
        return self.is_controlled and self._answered < self._FrankaServer__message_id - 1

    def repeat_state(self) -> None:
        """Send the last state again, because the client ends its motion after a second without one."""
        self._FrankaServer__message_id -= 1
        self.send_state()

    def wait(self, other: socket.socket, timeout: float) -> None:
        """Wait until the client or the socket `other` has sent something, for at most `timeout` [s]."""
        sockets = (self._tcp_socket or self._FrankaServer__server_socket, self._FrankaServer__udp_socket, other)
        select.select([one for one in sockets if one is not None], [], [], timeout)

    def _handle_udp_command(self, command_data: bytes) -> None:
        self._answered, self._answered_motion = UDPCommand.from_bytes(command_data).message_id, self.current_motion_id
        super()._handle_udp_command(command_data)

    def _reset_state(self) -> None:
        self._answered, self._answered_motion = -1, 0
        super()._reset_state()


def serve(
    simulator: WorkcellSimulator,
    pose: np.ndarray,
    parts: tuple[RigidTransform, RigidTransform],
    seconds: float,
    rate: float = 1.0,
    host: str = "127.0.0.1",
    on_ready: Callable[[str], None] = print,
) -> None:
    """Simulate the robot and answer libfranka's protocol, in lockstep with a `FciLockstepClock` if one is connected.

    In lockstep the robot's clock waits for the station's requests, and for the client's answer to each state of a
    motion. Without motion it runs on slowly, because libfranka waits for a new state whenever one is read.
    Without a station in lockstep the clock follows the wall clock, or falls behind it on a slow machine.

    Args:
        simulator: Simulator of the robot and the parts.
        pose: Initial pose of the tool center, (6,).
        parts: Poses of the parts, the arguments of `WorkcellSimulator.move_parts`.
        seconds: Simulated time to run [s].
        rate: Rate of the robot's clock relative to the wall clock.
        host: Address of this machine to listen on.
        on_ready: Function that is called with the address when clients can connect.
    """
    with ExitStack() as stack:
        stack.enter_context(simulator)
        server = _RobotServer(simulator.add_arm(pose), host)
        server.init()
        stack.callback(server.cleanup)
        lockstep = stack.enter_context(closing(LockstepServer(host)))
        simulator.start()
        simulator.move_parts(*parts)
        on_ready(host)
        step, until, is_asked, sent = 0, 0, False, time.monotonic()
        while step * STEP < seconds:
            server.process_commands()
            if not is_asked and (request := lockstep.receive()) is not None:
                is_asked, until = True, step + round(request.get("advance", 0.0) / STEP)
                if "parts" in request:
                    simulator.move_parts(*part_poses(*map(np.array, request["parts"])))
            is_controlled, is_synchronous = server.is_controlled, lockstep.is_connected
            if is_asked and step >= until and not server.is_waiting:
                lockstep.answer(step * STEP)
                is_asked = False
                continue
            if not is_synchronous:
                due, is_asked = sent + STEP / rate, False
            elif is_controlled:
                due = np.inf if server.is_waiting or step >= until else 0.0
            else:
                due = sent + (STEP if step < until else STEP / IDLE_RATE)
            if (delay := due - time.monotonic()) > 0.0:
                server.wait(lockstep.socket, min(delay, REPEAT_INTERVAL))
                if is_synchronous and is_controlled and time.monotonic() - sent > REPEAT_INTERVAL:
                    server.repeat_state()
                    sent = time.monotonic()
                continue
            step, sent = step + 1, time.monotonic()
            simulator.step()
            server.send_state()
