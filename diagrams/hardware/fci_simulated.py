"""Simulated robot for the driver fci: the simulator franky-sim with a task's tool, workpiece and fixture in its world.

franky-sim simulates an FR3 in MuJoCo and answers libfranka's network protocol. It estimates no external wrench and does
not check commands for discontinuities or collisions. The external torques are added here from the simulated contact.
The tests of `PoseMotionLimiter`, which computes the commands, check that these are continuous.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from franky_sim import SimulationServer
from franky_sim.mujoco_simulator import FrankaMujocoRobot, MujocoSimulator
from pydrake.math import RigidTransform

from guiderail.diagrams.stations.arm import ArmControllerPlant
from guiderail.diagrams.stations.mujoco import MujocoContact, constraint_torques, mujoco_parts
from guiderail.diagrams.stations.workcell import ConvexWorkcell
from guiderail.models.common.errors import InputError

ROBOT, FLANGE_HEIGHT = "robot0_", 0.107  # prefix of names in the simulator; from seventh link to flange [m]
STEP = 0.001  # period of the protocol [s]
RESIDUAL_FRICTION = 0.1  # friction of a joint [Nm]; libfranka's torques are "without gravity and friction"
FILTER_TIME = 0.02  # time constant of the external torque's low-pass filter [s]


class SimulatedFranka(FrankaMujocoRobot):
    """Robot that reports the external torques of the simulated contact.

    Args:
        positions: Initial joint positions (7,) [rad].
    """

    def __init__(self, positions: np.ndarray):
        super().__init__(initial_q=tuple(positions))
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

    def __init__(self, workcell: Any, fixture_offset: RigidTransform = RigidTransform()):  # noqa: B008
        """Construct the simulator.

        Args:
            workcell: Workcell of the task, a `ConvexWorkcell`.
            fixture_offset: Pose of the actual target frame in the nominal target frame.
        """
        super().__init__()
        self.model_of_arm = ArmControllerPlant(workcell, "panda")
        plant = self.model_of_arm.plant
        context = plant.CreateDefaultContext()
        X_FlangeTool = self.model_of_arm.arm.tool_center.CalcPose(context, plant.GetFrameByName("panda_flange"))
        X_WFixture = workcell.X_WT @ fixture_offset @ workcell.X_FT.inverse()
        if not isinstance(workcell, ConvexWorkcell):
            raise InputError(f"the simulated robot collides convex solids, and {type(workcell).__name__} has none")
        fixture, workpiece, assets = mujoco_parts(
            workcell.fixture_surfaces(), workcell.workpiece_surfaces(), MujocoContact()
        )
        self._parts = ((fixture, X_WFixture), (workpiece, RigidTransform([0, 0, FLANGE_HEIGHT]) @ X_FlangeTool))
        self._assets = assets
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
        for (element, X), parent in zip(self._parts, (self.worldbody, last), strict=True):
            element.set("pos", " ".join(map(str, X.translation())))
            element.set("quat", " ".join(map(str, X.rotation().ToQuaternion().wxyz())))
            parent.append(element)
        # The tool replaces the hand, which stays in the model for the simulator's gripper but does not collide.
        for body in last.iter("body"):
            if body.get("name", "").startswith((ROBOT + "hand", ROBOT + "left", ROBOT + "right")):
                for geometry in body.findall("geom"):
                    geometry.attrib.update(contype="0", conaffinity="0")
        return self._arm


def serve(
    simulator: WorkcellSimulator,
    pose: np.ndarray,
    seconds: float,
    rate: float = 1.0,
    host: str = "127.0.0.1",
    on_ready: Callable[[str], None] = print,
) -> None:
    """Simulate the robot by the wall clock, and answer libfranka's protocol.

    On a machine that is too slow for the rate, the robot's clock falls behind.

    Args:
        simulator: Simulator of the robot and the parts.
        pose: Initial pose of the tool center, (6,).
        seconds: Simulated time to run [s].
        rate: Rate of the robot's clock relative to the wall clock.
        host: Address of this machine to listen on.
        on_ready: Function that is called with the address when clients can connect.
    """
    with simulator:
        simulator.add_arm(pose)
        with SimulationServer(simulator, [host]) as server:
            on_ready(host)
            start = time.monotonic()
            for step in range(1, round(seconds / STEP) + 1):
                server.run_once(realtime=False)
                due = start + STEP / rate * step
                delay = time.monotonic() - due
                time.sleep(max(0.0, -delay))
                start += max(0.0, delay)  # a delay is not made up for
