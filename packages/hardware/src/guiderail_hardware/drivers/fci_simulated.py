"""Simulated robot for the driver fci: the simulator franky-sim with a task's tool, workpiece and fixture in its world.

franky-sim simulates an FR3 in MuJoCo and answers libfranka's network protocol. It estimates no external wrench and has
no reflexes. Both are added here: the external torques from the simulated contact, the reflexes by `ReflexDetector`.
"""

from __future__ import annotations

import select
import socket
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable
from contextlib import ExitStack, closing
from typing import Any

import mujoco
import numpy as np
from franky_sim.franka_robot_protocol import (
    AutomaticErrorRecoveryCommand,
    MoveStatus,
    RobotCommand,
    RobotMode,
    SetCollisionBehaviorCommand,
    UDPCommand,
)
from franky_sim.franka_robot_server import FrankaRobotServer
from franky_sim.franka_server import BaseCommand
from franky_sim.mujoco_simulator import FrankaMujocoRobot, MujocoSimulator
from pydrake.math import RigidTransform

from guiderail.diagrams.stations.arm import ArmControllerPlant
from guiderail.diagrams.tasks.insertion import part_poses
from guiderail_hardware.drivers.fci_lockstep import LockstepServer
from guiderail_hardware.drivers.fci_reflexes import Reflex, ReflexDetector
from guiderail_hardware.station import payload_on_flange
from guiderail_mujoco.station import FIXTURE, WORKPIECE, MujocoContact, constraint_torques, mujoco_parts
from guiderail_mujoco.surfaces import surfaces_of

ROBOT, FLANGE_HEIGHT = "robot0_", 0.107  # prefix of the simulator's names; distance of flange and link 7 [m]
STEP = 0.001  # period of the protocol [s]
# Steps of the engine in a period. With one step, a contact with a time constant of 2 ms lasts a single step: the tool
# bounces from it every 5 ms, and joint velocities jump by 0.07 rad/s.
SUBSTEPS = 4
# Rate of the robot's clock relative to the wall clock between the station's requests, in lockstep without a motion.
IDLE_RATE = 0.1
REPEAT_INTERVAL = 0.2  # wall clock time after which the state of a waiting robot is sent again [s]
RESIDUAL_FRICTION = 0.1  # friction of a joint [Nm]; libfranka's torques are "without gravity and friction"
# A robot without motion is held by joint stiffness [Nm/rad] and damping [Nms/rad], in place of its brakes. With the
# simulator's own gains, ten times these, a held joint whose tool is in contact vibrates with every step.
HOLDING_STIFFNESS = (450.0, 450.0, 350.0, 350.0, 200.0, 200.0, 200.0)
HOLDING_DAMPING = (45.0, 45.0, 35.0, 35.0, 20.0, 20.0, 20.0)
FILTER_TIME = 0.02  # time constant of the external torque's low-pass filter [s]
NUM_ERRORS = 41  # length of libfranka's list of errors


class SimulatedFranka(FrankaMujocoRobot):
    """Robot that reports the external torques of the simulated contact.

    Args:
        positions: Initial joint positions (7,) [rad].
        p_LinkTool: Position of the tool center in the seventh link (3,) [m].
    """

    def __init__(self, positions: np.ndarray, p_LinkTool: np.ndarray):
        super().__init__(initial_q=tuple(positions), kp=HOLDING_STIFFNESS, kv=HOLDING_DAMPING)
        self._p_LinkTool = p_LinkTool
        self._external, self._contact, self.external_wrench = np.zeros(7), np.zeros(7), np.zeros(6)

    def add_contact(self) -> None:
        """Add the contact torques of one engine step to their mean over the period."""
        # No joint friction, like libfranka's estimate. Forces of joint limits are included; no task reaches a limit.
        self._contact += constraint_torques(self._model, self._data)[self._dof_addrs] / SUBSTEPS

    def _post_step(self) -> None:
        self._external += STEP / FILTER_TIME * (self._contact - self._external)
        self._contact = np.zeros(7)
        super()._post_step()

    def detect_reflex(self, detector: ReflexDetector, command: np.ndarray) -> Reflex | None:
        """Return the reason why a commanded torque (7,) [Nm] causes a reflex, or None."""
        model, data = self._model, self._data
        assert model is not None
        assert data is not None
        link = model.body(ROBOT + "fr3_link7").id
        R_WorldLink = data.xmat[link].reshape(3, 3)
        jacobian = np.zeros((6, model.nv))
        mujoco.mj_jac(model, data, jacobian[:3], jacobian[3:], data.xpos[link] + R_WorldLink @ self._p_LinkTool, link)
        wrench = np.linalg.lstsq(jacobian[:, self._dof_addrs].T, self._external)[0]
        # In the axes of the seventh link: the thresholds are equal along all axes.
        self.external_wrench = wrench = (wrench.reshape(2, 3) @ R_WorldLink).ravel()
        return detector.detect(command, data.qpos[self._qpos_addrs], data.qvel[self._dof_addrs], self._external, wrench)

    @property
    def state(self) -> Any:
        """State message, with the external torque of the arm on its surroundings."""
        state = super().state
        # The tool replaces the hand, but the simulator reports the hand's mass.
        return state.replace(tau_ext_hat_filtered=tuple(-self._external), m_ee=0.0)


class WorkcellSimulator(MujocoSimulator):
    """Simulated FR3 with a task's parts: the workpiece on the flange, and the fixture in the world."""

    def __init__(self, workcell: Any, joint_friction: float = RESIDUAL_FRICTION):
        """Construct the simulator of a task's workcell with convex solids, with a friction of each joint [Nm].

        Raises:
            InputError: If the workcell has no convex solids, or more pairs of surfaces than MuJoCo distinguishes.
        """
        super().__init__()
        self.model_of_arm = ArmControllerPlant(workcell, "panda")
        plant = self.model_of_arm.plant
        context = plant.CreateDefaultContext()
        X_FlangeTool = self.model_of_arm.arm.tool_center.CalcPose(context, plant.GetFrameByName("panda_flange"))
        self._X_LinkTool = RigidTransform([0, 0, FLANGE_HEIGHT]) @ X_FlangeTool
        fixture, workpiece, assets = mujoco_parts(*surfaces_of(workcell), MujocoContact())
        self._workcell: Any = workcell
        self._parts, self._assets, self._joint_friction = (fixture, workpiece), assets, joint_friction
        self._arm: SimulatedFranka | None = None

    def add_arm(self, pose: np.ndarray) -> SimulatedFranka:
        """Add the robot with its tool center at a pose (6,) in the target frame, and the task's parts."""
        positions = self.model_of_arm.solve(pose, self.model_of_arm.posture)
        self.add_robot(initial_q=tuple(positions))
        self._arm = self._robots[0] = SimulatedFranka(positions, self._X_LinkTool.translation())
        root = self.scene
        option = root.find("option")
        assert option is not None
        option.attrib.update(cone="elliptic", impratio="10", ccd_iterations="100")
        for joint in root.iterfind(".//joint[@frictionloss]"):  # in the default class, and in the wrist's joints
            joint.set("frictionloss", str(self._joint_friction))
        asset = root.find("asset")
        assert asset is not None
        asset.extend(self._assets)
        last = next(body for body in self.worldbody.iter("body") if body.get("name") == ROBOT + "fr3_link7")
        for element, parent in zip(self._parts, (self.worldbody, last), strict=True):
            parent.append(element)
            for body in element.iter("body"):
                body.set("gravcomp", "1")  # the payload below has the weight of the workpiece
        # The robot compensates the weight of the load that the client sets.
        payload = payload_on_flange(self.model_of_arm)
        moments = payload.Shift(payload.get_com()).CalcRotationalInertia()
        values = (*moments.get_moments(), *moments.get_products())
        body = ET.SubElement(last, "body", name="payload", pos=f"0 0 {FLANGE_HEIGHT}")
        attributes = {"pos": payload.get_com(), "mass": [payload.get_mass()], "fullinertia": values}
        ET.SubElement(body, "inertial", {name: " ".join(map(str, value)) for name, value in attributes.items()})
        # The tool replaces the hand. The hand stays in the model for the simulator's gripper, but does not collide.
        for body in last.iter("body"):
            if body.get("name", "").startswith((ROBOT + "hand", ROBOT + "left", ROBOT + "right")):
                for geometry in body.findall("geom"):
                    geometry.attrib.update(contype="0", conaffinity="0")
            if body.get("name", "").startswith((ROBOT + "left", ROBOT + "right")):
                body.set("gravcomp", "1")  # the robot compensates the weight of the hand without its fingers, 0.3 N
        return self._arm

    def _start(self) -> None:
        super()._start()
        self.model.opt.timestep = STEP / SUBSTEPS

    def _step(self) -> None:
        assert self._arm is not None
        for _ in range(SUBSTEPS):
            super()._step()
            self._arm.add_contact()

    def move_parts(self, X_TTactual: RigidTransform, X_PWorkpiece: RigidTransform) -> None:
        """Place the actual target frame in the nominal target frame, and the workpiece relative to the tool center."""
        workcell = self._workcell
        X_WFixture = workcell.X_WT @ X_TTactual @ workcell.X_FT.inverse()
        for name, X in ((FIXTURE, X_WFixture), (WORKPIECE, self._X_LinkTool @ X_PWorkpiece)):
            body = self.model.body(name)
            body.pos, body.quat = X.translation(), X.rotation().ToQuaternion().wxyz()


class _CollisionBehaviorCommand(SetCollisionBehaviorCommand):
    def handle(self, server: _RobotServer) -> None:
        server.detector.set_thresholds(self.upper_torque_thresholds_nominal, self.upper_force_thresholds_nominal)
        super().handle(server)


class _ErrorRecoveryCommand(AutomaticErrorRecoveryCommand):
    def handle(self, server: _RobotServer) -> None:
        server.reflex = None
        super().handle(server)


class _RobotServer(FrankaRobotServer):
    """Server of libfranka's protocol that can wait for the client's answer to a state, and has reflexes."""

    def __init__(self, robot: SimulatedFranka, host: str, detector: ReflexDetector):
        super().__init__(robot, [host])
        self._answered, self._answered_motion = -1, 0
        self.detector, self.reflex = detector, None
        self._command = np.zeros(7)
        self._FrankaServer__command_class_map |= {
            RobotCommand.kSetCollisionBehavior: _CollisionBehaviorCommand,
            RobotCommand.kAutomaticErrorRecovery: _ErrorRecoveryCommand,
        }

    @property
    def is_controlled(self) -> bool:
        """True once the client has answered a state of the current motion; it does not answer the first states."""
        return self.current_motion_id > 0 and self._answered_motion == self.current_motion_id

    @property
    def is_waiting(self) -> bool:
        """True if the client has not answered the last state of its motion yet."""
        return self.is_controlled and self._answered < self._FrankaServer__message_id - 1

    @property
    def robot_state(self) -> Any:
        """State message, with the error of a reflex."""
        state = super().robot_state
        if self.reflex is None:
            return state
        errors = tuple(number == self.reflex for number in range(NUM_ERRORS))
        return state.replace(errors=errors, reflex_reason=errors, robot_mode=RobotMode.kReflex)

    def start_motion(self, controller_mode: Any, motion_generator_mode: Any, motion_id: int) -> None:
        """Start a motion.

        Raises:
            RuntimeError: If a reflex has not been cleared.
        """
        if self.reflex is not None:
            raise RuntimeError(f"a motion is requested after {self.reflex.name.lower()}")
        self._command = np.zeros(7)
        self.detector.begin()
        super().start_motion(controller_mode, motion_generator_mode, motion_id)

    def check_reflexes(self) -> Reflex | None:
        """Abort the motion by a reflex if there is a reason; return the reason, or None."""
        if not self.is_controlled:
            return None
        reflex, motion = self.robot.detect_reflex(self.detector, self._command), self.current_motion_id
        if reflex is not None:
            self.reflex = reflex
            self.stop_motion(send_preemption_signal=False)
            self.reset_current_motion_id()
            BaseCommand.send_response(self._tcp_socket, RobotCommand.kMove, motion, MoveStatus.kReflexAborted)
        return reflex

    def repeat_state(self) -> None:
        """Send the last state again, because the client ends its motion after a second without a state."""
        self._FrankaServer__message_id -= 1
        self.send_state()

    def wait(self, lockstep: socket.socket, timeout: float) -> None:
        """Wait for a message of the client or on the socket `lockstep`, at most `timeout` [s]."""
        sockets = (self._tcp_socket or self._FrankaServer__server_socket, self._FrankaServer__udp_socket, lockstep)
        select.select([one for one in sockets if one is not None], [], [], timeout)

    def _handle_udp_command(self, command_data: bytes) -> None:
        command = UDPCommand.from_bytes(command_data)
        self._answered, self._answered_motion = command.message_id, self.current_motion_id
        self._command = np.array(command.tau_J_d)
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
    log: Callable[[str], None] = print,
) -> None:
    """Simulate the robot and answer libfranka's protocol, in lockstep with a `FciLockstepClock` if one is connected.

    In lockstep and during a motion, the robot's clock waits for the station's requests, and for the client's answer to
    each state. In lockstep without a motion, the clock runs slowly (`IDLE_RATE`) between requests and never stops,
    because every read of a state in libfranka waits for a new state. Without a station in lockstep the clock follows
    the wall clock, or falls behind it on a slow machine.

    Args:
        simulator: Simulator of the robot and the parts.
        pose: Initial pose of the tool center, (6,).
        parts: Poses of the parts, the arguments of `WorkcellSimulator.move_parts`.
        seconds: Simulated time to run [s].
        rate: Rate of the robot's clock relative to the wall clock, positive; not used in lockstep.
        host: Address of this machine to listen on.
        log: Function that shows the address when clients can connect, and the reason of each reflex.
    """
    with ExitStack() as stack:
        stack.enter_context(simulator)
        plant = simulator.model_of_arm.plant
        detector = ReflexDetector(
            plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits(), plant.GetVelocityUpperLimits()
        )
        server = _RobotServer(simulator.add_arm(pose), host, detector)
        server.init()
        stack.callback(server.cleanup)
        lockstep = stack.enter_context(closing(LockstepServer(host)))
        simulator.start()
        simulator.move_parts(*parts)
        log(f"the simulated Franka listens at {host}")
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
            if (reflex := server.check_reflexes()) is not None:
                wrench = np.round(server.robot.external_wrench, 1).tolist()
                log(f"{reflex.name.lower()} after {step * STEP:.3f} s, with an external wrench of {wrench} N, Nm")
            server.send_state()
