"""Wrench that has the same power as generalized forces of the pose coordinates."""

import numpy as np
import pytest

from guiderail.systems import PoseWrench
from guiderail.systems.support.drake_multibody import pose_to_transform

STEP = 1e-6


@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (0.7, -0.4, 0.3), (-2.0, 1.2, -1.5), (3.0, -1.5, 0.1)])
def test_wrench_has_the_power_of_the_generalized_forces(angles):
    rng = np.random.default_rng(0)
    pose, force = np.array([0.1, -0.2, 0.3, *angles]), rng.normal(size=6)
    system = PoseWrench()
    context = system.CreateDefaultContext()
    system.get_pose_input_port().FixValue(context, pose)
    system.get_generalized_force_input_port().FixValue(context, force)
    wrench = system.get_wrench_output_port().Eval(context)
    for change in np.eye(6):
        after = pose_to_transform(pose + STEP * change)
        before = pose_to_transform(pose - STEP * change)
        rotation = (after.rotation() @ before.rotation().inverse()).ToAngleAxis()
        displacement = np.concatenate([after.translation() - before.translation(), rotation.angle() * rotation.axis()])
        assert displacement / (2 * STEP) @ wrench == pytest.approx(change @ force, abs=1e-6)


def test_wrench_is_finite_at_a_singular_pose():
    system = PoseWrench()
    context = system.CreateDefaultContext()
    system.get_pose_input_port().FixValue(context, [0.0, 0.0, 0.0, 0.0, np.pi / 2, 0.0])
    system.get_generalized_force_input_port().FixValue(context, np.ones(6))
    assert np.isfinite(system.get_wrench_output_port().Eval(context)).all()
