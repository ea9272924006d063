"""Parts of a hardware station for a robot that follows desired poses with its own impedance controller."""

from __future__ import annotations

import numpy as np
from pydrake.multibody.tree import JacobianWrtVariable, SpatialInertia
from pydrake.systems.framework import DiagramBuilder, OutputPort

from guiderail.diagrams.hardware.driver import Driver, PoseDriver, RobotImpedance
from guiderail.diagrams.stations.arm import ArmControllerPlant
from guiderail.diagrams.stations.station import Impedance, to_wrench_order
from guiderail.models.common.errors import InputError
from guiderail.models.control.cartesian_impedance import damping_matrix
from guiderail.systems.pose_publisher import PosePublisher
from guiderail.systems.pose_rate_limiter import PoseRateLimiter


def make_rate_limiter(driver: Driver, period: float) -> PoseRateLimiter:
    """Return the limiter of desired poses: it limits the speed, for a `PoseDriver` also acceleration and jerk."""
    if isinstance(driver, PoseDriver):
        from guiderail.systems.pose_motion_limiter import PoseMotionLimiter  # its library is in the extra fci

        return PoseMotionLimiter(driver.motion_limits, period=period)
    return PoseRateLimiter(period=period)


def add_pose_publisher(
    builder: DiagramBuilder,
    driver: PoseDriver,
    model: ArmControllerPlant,
    pose: OutputPort,
    arm_state: OutputPort,
    period: float,
) -> None:
    """Add a publisher that sends `pose` to the robot while `arm_state` permits, and otherwise stops it."""
    X_BaseTarget = model.target.CalcPoseInWorld(model.plant.CreateDefaultContext())
    publisher = builder.AddNamedSystem(
        "publisher", PosePublisher(driver.write_pose, driver.stop, X_BaseTarget, period=period)
    )
    builder.Connect(pose, publisher.get_pose_input_port())
    builder.Connect(arm_state, publisher.get_arm_state_input_port())


def payload_on_flange(model: ArmControllerPlant) -> SpatialInertia:
    """Return the spatial inertia of tool and workpiece about the flange's origin, in the flange's axes."""
    context, arm = model.plant.CreateDefaultContext(), model.arm
    return model.plant.CalcSpatialInertia(context, arm.wrist.frame_on_parent(), [body.index() for body in arm.tool])


def make_robot_impedance(model: ArmControllerPlant, impedance: Impedance) -> RobotImpedance:
    """Return the impedance for a robot's own controller, with the damping matrix of the nominal posture.

    Raises:
        InputError: If the axes of target and base differ: the wrench is limited along the target's, the robot uses the
            base's.
    """
    plant, arm = model.plant, model.arm
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, model.posture)
    base = plant.world_frame()
    if not model.target.CalcPoseInWorld(context).rotation().IsNearlyIdentity(1e-6):
        raise InputError("a robot with an impedance of its own needs a target with the axes of its base")
    K = np.diag(to_wrench_order(impedance.stiffness))
    J = plant.CalcJacobianSpatialVelocity(context, JacobianWrtVariable.kV, arm.tool_center, np.zeros(3), base, base)[
        [3, 4, 5, 0, 1, 2]
    ]
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
