"""Inverse kinematics: accuracy, distance from the posture, joint limits, repeatability, and refusals."""

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable

from guiderail.models.common.errors import InputError
from guiderail.models.robots.inverse_kinematics import solve_inverse_kinematics
from guiderail.models.robots.mounting import add_robot
from guiderail.models.robots.robot import find_robot
from guiderail.systems.support.drake_multibody import pose_to_transform


class Arm:
    """Robot arm without a tool, and the inverse kinematics of its flange."""

    def __init__(self, name):
        self.robot = find_robot(name)
        self.plant = MultibodyPlant(0.0)
        self.flange = add_robot(self.plant, self.robot).flange
        self.plant.Finalize()
        self.context = self.plant.CreateDefaultContext()
        self.home = np.array(self.robot.home)
        self.lower, self.upper = self.plant.GetPositionLowerLimits(), self.plant.GetPositionUpperLimits()

    def pose(self, q):
        self.plant.SetPositions(self.context, q)
        return self.flange.CalcPoseInWorld(self.context)

    def solve(self, X, posture=None):
        posture = self.home if posture is None else posture
        return solve_inverse_kinematics(self.plant, self.plant.world_frame(), self.flange, X, posture)

    def error(self, q, X):
        """Return the norm of the pose error, translation [m] and rotation [rad] together."""
        D = X.inverse() @ self.pose(q)
        return np.linalg.norm([np.linalg.norm(D.translation()), D.rotation().ToAngleAxis().angle()])

    def jacobian(self, q):
        self.plant.SetPositions(self.context, q)
        world = self.plant.world_frame()
        return self.plant.CalcJacobianSpatialVelocity(
            self.context, JacobianWrtVariable.kV, self.flange, np.zeros(3), world, world
        )

    def random_pose(self, rng):
        """Return a random flange pose near the pose at home."""
        shift = rng.uniform([-0.1, -0.1, -0.1, -1.0, -0.3, -0.3], [0.1, 0.1, 0.1, 1.0, 0.3, 0.3])
        X, X_WHome = pose_to_transform(shift), self.pose(self.home)
        return RigidTransform(X.rotation() @ X_WHome.rotation(), X.translation() + X_WHome.translation())


@pytest.fixture(scope="module", params=["iiwa14", "panda", "ur5e"])
def arm(request):
    return Arm(request.param)


def test_solution_is_exact_within_limits_and_deterministic(arm):
    rng = np.random.default_rng(0)
    for _ in range(20):
        X = arm.random_pose(rng)
        q = arm.solve(X)
        assert arm.error(q, X) < 1e-9
        assert ((q >= arm.lower) & (q <= arm.upper)).all()
        np.testing.assert_array_equal(arm.solve(X), q)


def test_solution_is_nearest_to_the_posture(arm):
    """No null-space motion reduces the distance from the posture."""
    rng = np.random.default_rng(1)
    for _ in range(10):
        q = arm.solve(arm.random_pose(rng))
        J = arm.jacobian(q)
        difference = q - arm.home
        null_space_part = difference - np.linalg.pinv(J) @ (J @ difference)
        assert np.linalg.norm(null_space_part) < 1e-4
        assert np.linalg.norm(difference) < 2.0


def test_solution_is_the_posture_when_the_posture_has_the_pose():
    arm = Arm("panda")
    np.testing.assert_allclose(arm.solve(arm.pose(arm.home)), arm.home, atol=1e-7)


def test_solution_is_within_limits_when_the_posture_is_not():
    arm = Arm("panda")
    X = arm.pose(arm.home)
    posture = arm.home.copy()
    posture[6] = arm.upper[6] + 1.0
    q = arm.solve(X, posture)
    assert (q <= arm.upper).all()
    assert arm.error(q, X) < 1e-9


def test_solution_is_found_when_the_posture_is_far_away():
    """If the search from a distant posture fails, further searches start at random postures around it."""
    arm = Arm("ur5e")
    X = arm.pose(arm.home)
    for seed in range(10):
        posture = np.random.default_rng(seed).uniform(-3.0, 3.0, 6)
        q = arm.solve(X, posture)
        assert arm.error(q, X) < 1e-9


@pytest.mark.parametrize(("name", "joint"), [("ur5e", 4), ("ur5e", 2), ("iiwa14", 5)])
def test_solution_is_found_for_a_singular_pose(name, joint):
    arm = Arm(name)
    singular = arm.home.copy()
    singular[joint] = 0.0
    X = arm.pose(singular)
    near = singular + 0.05 * np.cos(np.arange(len(singular)))
    q = arm.solve(X, near)
    assert arm.error(q, X) < 1e-9
    assert np.abs(q - near).max() < 0.5


def test_solve_refuses_a_pose_out_of_reach(arm):
    with pytest.raises(InputError, match=r"can't reach \[2\. *0\. *0\. *\] m: move the workcell nearer"):
        arm.solve(RigidTransform([2.0, 0.0, 0.0]))


def test_solve_refuses_a_pose_beyond_a_joint_limit():
    """At a pose near the base with the flange down, the elbow would be beyond its limit."""
    arm = Arm("panda")
    X = RigidTransform(arm.pose(arm.home).rotation(), [0.05, 0.0, 0.1])
    with pytest.raises(InputError, match="only beyond a joint's limit"):
        arm.solve(X)
