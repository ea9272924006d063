import numpy as np
import pytest
from pydrake.math import RigidTransform

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import pose_to_transform, transform_to_pose
from guiderail.models.templates import load_template
from guiderail.systems.sct_input_mapping import SctInputMapping

PERIOD = 0.01
FRAMES = {"mug_tip": RigidTransform([0.1, 0.0, 0.0])}
POSE = np.array([0.1, -0.06, 0.06, 0.0, 0.0, -1.2])


@pytest.fixture(scope="module")
def template():
    return load_template("pouring")


@pytest.fixture
def system(template):
    return SctInputMapping(template, FRAMES, PERIOD)


def requested(system, action, state, pose=POSE, frames=None):
    context = system.CreateDefaultContext()
    system.get_action_input_port().FixValue(context, action)
    system.get_pose_input_port().FixValue(context, pose)
    system.get_state_input_port().FixValue(context, [state])
    if frames:
        system.frames.set(context, frames)
    return system.get_requested_pose_output_port().Eval(context)


def test_input_mapping_has_its_ports(system):
    assert [system.get_input_port(i).get_name() for i in range(system.num_input_ports())] == ["action", "pose", "state"]
    assert system.get_action_input_port().size() == 3
    assert system.get_output_port().get_name() == "requested_pose"


@pytest.mark.parametrize("state", [0, 1, 2])
def test_input_mapping_displaces_by_the_law(system, template, state):
    action = np.array([0.3, 0.9, -0.4])
    X_WE = pose_to_transform(POSE)
    expected = template.displace(X_WE, template.map(state, action, X_WE, FRAMES, PERIOD))
    np.testing.assert_allclose(requested(system, action, state), transform_to_pose(expected), atol=1e-15)


def test_input_mapping_depends_on_the_state(system):
    towards = np.array([0.0, 1.0, 0.0])
    moved = requested(system, towards, 1) - POSE
    tilted = requested(system, towards, 2) - POSE
    np.testing.assert_allclose(moved, [0.0, 0.15 * PERIOD, 0.0, 0.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(tilted, [0.0, 0.0, 0.0, 0.0, 0.0, -0.8 * PERIOD], atol=1e-12)


def test_input_mapping_uses_a_frame_set_by_a_reset(system):
    context = system.CreateDefaultContext()
    before = system.frames.eval(context)["mug_tip"].translation().copy()
    with pytest.raises(InputError, match="the template has no frame lid"):
        system.frames.set(context, {"mug_tip": RigidTransform([0.5, -0.06, 0.0]), "lid": RigidTransform()})
    np.testing.assert_array_equal(system.frames.eval(context)["mug_tip"].translation(), before)
    # With the mug at the side instead of ahead, the same input is across the bearing and causes no tilt.
    aside = requested(system, np.array([0.0, 1.0, 0.0]), 2, frames={"mug_tip": RigidTransform([0.5, -0.06, 0.0])})
    np.testing.assert_allclose(aside, POSE, atol=1e-12)


def test_input_mapping_refuses_an_unknown_frame(system):
    with pytest.raises(InputError, match="no frame cup, only mug_tip"):
        system.frames.set(system.CreateDefaultContext(), {"cup": RigidTransform()})


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_input_mapping_returns_nan_for_a_nan_action(system, bad):
    assert np.isnan(requested(system, np.array([0.0, bad, 0.0]), 1)).all()


@pytest.mark.parametrize("state", [-1.0, -0.5, 0.99, 3.0, np.nan, np.inf])
def test_input_mapping_returns_nan_for_an_unknown_state(system, state):
    assert np.isnan(requested(system, np.zeros(3), state)).all()


@pytest.mark.parametrize("period", [0.0, -1.0, float("nan")])
def test_input_mapping_refuses_invalid_arguments(template, period):
    with pytest.raises(InputError, match="period"):
        SctInputMapping(template, FRAMES, period)
    with pytest.raises(InputError, match="mug_tip"):
        SctInputMapping(template, {}, PERIOD)
