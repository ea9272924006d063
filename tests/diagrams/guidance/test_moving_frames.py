"""Frames of a template from a port: one source moves all subsystems of the guidance."""

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.guidance.sct import SctGuidance
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import transform_to_pose
from guiderail.models.templates import load_template, parse_template
from guiderail.systems import SctStateMachine

PERIOD = 0.02
START = np.array([0.1, -0.06, 0.06, 0.0, 0.0, -1.2])
HERE, THERE = RigidTransform([0.1, 0.0, 0.0]), RigidTransform([0.13, 0.02, 0.01])


@pytest.fixture
def simulator():
    template = load_template("pouring")
    guidance = SctGuidance(template, dict.fromkeys(template.frames, HERE), PERIOD)
    simulator = Simulator(guidance)
    context = simulator.get_mutable_context()
    guidance.GetInputPort("action").FixValue(context, np.full(template.inputs, 0.5))
    guidance.GetInputPort("pose").FixValue(context, START)
    guidance.GetInputPort("wrench").FixValue(context, np.zeros(6))
    return simulator


def commands(simulator, steps=10):
    """Return what the guidance outputs after each of some control steps."""
    guidance, context, rows = simulator.get_system(), simulator.get_mutable_context(), []
    names = ("desired_pose", "state", "transition_distance", "progress", "constraint_violation")
    start = round(context.get_time() / PERIOD)
    for step in range(start, start + steps):
        simulator.AdvanceTo((step + 1) * PERIOD)
        rows.append(np.concatenate([guidance.GetOutputPort(name).Eval(context) for name in names]))
    return np.array(rows)


def fix(simulator, X):
    guidance = simulator.get_system()
    port = guidance.GetInputPort("frame_poses")
    port.FixValue(simulator.get_mutable_context(), np.tile(transform_to_pose(X), port.size() // 6))


def test_port_has_the_effect_of_the_parameters(simulator):
    guidance, context = simulator.get_system(), simulator.get_mutable_context()
    pristine = context.Clone()
    guidance.set_frames(context, dict.fromkeys(load_template("pouring").frames, THERE))
    simulator.Initialize()
    expected = commands(simulator)
    context.SetTimeStateAndParametersFrom(pristine)
    fix(simulator, THERE)
    simulator.Initialize()
    np.testing.assert_array_equal(commands(simulator), expected)
    context.SetTimeStateAndParametersFrom(pristine)
    fix(simulator, HERE)
    simulator.Initialize()
    assert not np.array_equal(commands(simulator), expected)


def test_commands_stay_inside_the_constraints_of_a_frame_that_moves(simulator):
    fix(simulator, HERE)
    simulator.Initialize()
    commands(simulator, 5)  # the start is outside of the constraints
    for x in np.linspace(0.0, 0.005, 20):
        fix(simulator, RigidTransform([0.1 + x, 0.0, 0.0]))
        assert commands(simulator, 1)[0, -1] <= 1e-6


def test_port_has_the_poses_of_several_frames_in_their_order():
    text = """
name: two
inputs: 3
frames: [near, far]
max_speed_m_per_s: 0.5
max_speed_rad_per_s: 1.0
states:
  only:
    input_mapping: [{kind: translation, inputs: [0, 1, 2], speed_m_per_s: 0.5, frame: near}]
    active_constraints: [{kind: keep_above, frame: near, height_m: 0.0}]
    transition_distance: {kind: height, frame: far}
    starts_at_m: 1.0
    ends_at_m: 0.0
"""
    template = parse_template(text)
    machine = SctStateMachine(template, dict.fromkeys(template.frames, RigidTransform()), PERIOD)
    context = machine.CreateDefaultContext()
    machine.get_pose_input_port().FixValue(context, np.array([0.0, 0.0, 0.5, 0.0, 0.0, 0.0]))
    poses = [transform_to_pose(RigidTransform([0.0, 0.0, z])) for z in (0.1, 0.2)]
    machine.get_frame_poses_input_port().FixValue(context, np.concatenate(poses))
    frames = machine.frames.eval(context)
    assert [frames[name].translation()[2] for name in ("near", "far")] == [0.1, 0.2]
    assert machine.get_transition_distance_output_port().Eval(context)[0] == pytest.approx(0.3)


def test_pose_that_is_not_finite_is_refused(simulator):
    fix(simulator, HERE)
    simulator.Initialize()
    simulator.get_system().GetInputPort("frame_poses").FixValue(
        simulator.get_mutable_context(), np.full(simulator.get_system().GetInputPort("frame_poses").size(), np.nan)
    )
    with pytest.raises(InputError, match="must be at a finite pose"):
        commands(simulator, 1)
