import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.systems.framework import DiagramBuilder

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import pose_to_transform, transform_to_pose
from guiderail.models.templates import load_template
from guiderail.systems.shared_control_template import SctInputMapping

PERIOD = 0.01
FRAMES = {"mug_tip": RigidTransform([0.1, 0.0, 0.0])}
POSE = np.array([0.1, -0.06, 0.06, 0.0, 0.0, -1.2])


@pytest.fixture(scope="module")
def template():
    return load_template("pouring")


@pytest.fixture
def system(template):
    return SctInputMapping(template, FRAMES, PERIOD)


def requested_pose(system, action, state, pose=POSE, frames=None):
    """Return the requested pose (6,)."""
    context = system.CreateDefaultContext()
    system.get_action_input_port().FixValue(context, action)
    system.get_pose_input_port().FixValue(context, pose)
    system.get_state_input_port().FixValue(context, [state])
    if frames:
        system.frames.set(context, frames)
    return system.get_requested_pose_output_port().Eval(context)


@pytest.mark.parametrize("state", [0, 1, 2])
def test_requested_pose_is_displaced_by_the_template(system, template, state):
    action = np.array([0.3, 0.9, -0.4])
    X_WE = pose_to_transform(POSE)
    expected = template.displace(X_WE, template.map(state, action, X_WE, FRAMES, PERIOD))
    np.testing.assert_allclose(requested_pose(system, action, state), transform_to_pose(expected), atol=1e-15)


def test_input_mapping_depends_on_the_state(system):
    action = np.array([0.0, 1.0, 0.0])
    translation = requested_pose(system, action, 1) - POSE
    tilt = requested_pose(system, action, 2) - POSE
    np.testing.assert_allclose(translation, [0.0, 0.15 * PERIOD, 0.0, 0.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(tilt, [0.0, 0.0, 0.0, 0.0, 0.0, -0.8 * PERIOD], atol=1e-12)


def test_input_mapping_uses_a_frame_set_by_a_reset(system):
    context = system.CreateDefaultContext()
    before = system.frames.eval(context)["mug_tip"].translation().copy()
    with pytest.raises(InputError, match="the template has no frame lid"):
        system.frames.set(context, {"mug_tip": RigidTransform([0.5, -0.06, 0.0]), "lid": RigidTransform()})
    np.testing.assert_array_equal(system.frames.eval(context)["mug_tip"].translation(), before)
    # With the mug at the side, the input is perpendicular to the direction of the mug and causes no tilt.
    pose = requested_pose(system, np.array([0.0, 1.0, 0.0]), 2, frames={"mug_tip": RigidTransform([0.5, -0.06, 0.0])})
    np.testing.assert_allclose(pose, POSE, atol=1e-12)


def test_input_mapping_refuses_an_unknown_frame(system):
    with pytest.raises(InputError, match="no frame cup, only mug_tip"):
        system.frames.set(system.CreateDefaultContext(), {"cup": RigidTransform()})
    builder = DiagramBuilder()
    builder.AddSystem(system)
    with pytest.raises(InputError, match=r"pass system\.GetMyMutableContextFromRoot"):
        system.frames.set(builder.Build().CreateDefaultContext(), {"mug_tip": RigidTransform()})


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_requested_pose_is_nan_when_the_action_is_not_finite(system, number):
    assert np.isnan(requested_pose(system, np.array([0.0, number, 0.0]), 1)).all()


@pytest.mark.parametrize("state", [-1.0, -0.5, 0.99, 3.0, np.nan, np.inf])
def test_requested_pose_is_nan_when_the_state_is_unknown(system, state):
    assert np.isnan(requested_pose(system, np.zeros(3), state)).all()


def test_input_mapping_refuses_a_missing_frame(template):
    with pytest.raises(InputError, match="mug_tip"):
        SctInputMapping(template, {}, PERIOD)
