"""Guidance sct with a robot model that reaches each command one control period later."""

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, ZeroOrderHold

from guiderail.diagrams.guidance.guidance import OUTPUTS, check_guidance_ports
from guiderail.diagrams.guidance.prior import PlacedTemplate
from guiderail.diagrams.guidance.sct import ActiveConstraintFilter, SctGuidance
from guiderail.models.common.arrays import round_period
from guiderail.models.common.errors import InputError
from guiderail.models.templates import load_template

PERIOD = round_period(0.01)
MUG = {"mug_tip": RigidTransform()}
START = np.array([0.0, -0.28, 0.12, 0.0, 0.0, 0.0])


class Loop:
    """Closed loop of a guidance and a robot whose pose is the command of the control period before."""

    def __init__(self, guidance, start=START):
        self.guidance = guidance
        builder = DiagramBuilder()
        builder.AddSystem(guidance)
        self.robot = builder.AddSystem(ZeroOrderHold(PERIOD, 6))
        builder.Connect(guidance.GetOutputPort("desired_pose"), self.robot.get_input_port())
        builder.Connect(self.robot.get_output_port(), guidance.GetInputPort("pose"))
        for name in ("action", "wrench"):
            builder.ExportInput(guidance.GetInputPort(name), name)
        self.diagram = builder.Build()
        self.simulator = Simulator(self.diagram)
        self.context = self.simulator.get_mutable_context()
        self.robot.GetMyMutableContextFromRoot(self.context).SetDiscreteState(start)
        self.diagram.GetInputPort("wrench").FixValue(self.context, np.zeros(6))
        self.action = self.diagram.GetInputPort("action").FixValue(
            self.context, np.zeros(guidance.GetInputPort("action").size())
        )
        self.steps = 0

    def initialize(self):
        self.simulator.Initialize()
        return self

    def step(self, action):
        self.action.GetMutableData().set_value(action)
        self.steps += 1
        self.simulator.AdvanceTo(self.steps * PERIOD)
        return self.value("desired_pose")

    def value(self, name):
        port = self.guidance.GetOutputPort(name)
        return port.Eval(self.guidance.GetMyContextFromRoot(self.context)).copy()


@pytest.fixture
def template():
    return load_template("pouring")


def test_sct_has_the_common_ports(template):
    guidance = SctGuidance(template, MUG, PERIOD)
    inputs = [guidance.get_input_port(i).get_name() for i in range(guidance.num_input_ports())]
    outputs = [guidance.get_output_port(i).get_name() for i in range(guidance.num_output_ports())]
    assert inputs == ["action", "pose", "wrench", "frame_poses"]
    assert set(outputs) == {
        *OUTPUTS,
        "state",
        "transition_distance",
        "progress",
        "measured_violation",
        "state_max_wrench",
    }
    check_guidance_ports(guidance, pose_size=6, wrench_size=6)


def test_command_stays_at_the_start_when_action_is_zero(template):
    loop = Loop(SctGuidance(template, MUG, PERIOD)).initialize()
    for _ in range(5):
        np.testing.assert_allclose(loop.step(np.zeros(3)), START, atol=1e-9)


def test_action_displaces_the_command_for_a_whole_period(template):
    loop = Loop(SctGuidance(template, MUG, PERIOD)).initialize()
    first = loop.step(np.array([0.0, 1.0, 0.0]))
    np.testing.assert_allclose(first - START, [0, 0.15 * PERIOD, 0, 0, 0, 0], atol=1e-9)
    for k in range(2, 8):
        displacement = loop.step(np.array([0.0, 1.0, 0.0])) - START
        np.testing.assert_allclose(displacement[1], k * 0.15 * PERIOD, atol=1e-9)


def test_sct_reaches_all_states_and_reports_progress(template):
    loop = Loop(SctGuidance(template, MUG, PERIOD)).initialize()
    states, progress, worst = [], [], 0.0
    for _ in range(600):
        loop.step(np.array([0.0, 0.9, -0.3]))
        states.append(int(loop.value("state")[0]))
        progress.append(loop.value("progress")[0])
        worst = max(worst, loop.value("constraint_violation")[0])
    assert sorted(set(states)) == [0, 1, 2]
    assert worst <= 1e-9
    assert loop.value("transition_distance")[0] == pytest.approx(0.0, abs=0.02)
    assert progress[-1] == pytest.approx(
        sum(state.weight * (state.starts_at - state.ends_at) for state in template.states), abs=0.02
    )


def test_last_command_is_repeated_when_an_action_is_invalid(template):
    loop = Loop(SctGuidance(template, MUG, PERIOD)).initialize()
    before = loop.step(np.array([0.0, 1.0, 0.0]))
    for _ in range(3):
        np.testing.assert_array_equal(loop.step(np.array([np.nan, 0.0, np.inf])), before)
        assert loop.value("fallback")[0] == 1.0
    assert loop.step(np.array([0.0, 1.0, 0.0]))[1] > before[1]
    assert loop.value("fallback")[0] == 0.0


def test_command_is_relative_to_the_frames_of_the_objects(template):
    """Equal actions lead to an equal path relative to the mug."""
    paths = []
    for shift in (np.zeros(3), np.array([0.1, -0.2, 0.05])):
        guidance = SctGuidance(template, MUG, PERIOD)
        loop = Loop(guidance, START + np.concatenate([shift, np.zeros(3)]))
        guidance.set_frames(loop.context, {"mug_tip": RigidTransform(shift)})
        loop.initialize()
        path = np.array([loop.step(np.array([0.2, 0.9, -0.3])) for _ in range(300)])
        path[:, :3] -= shift
        paths.append(path)
    np.testing.assert_allclose(paths[0], paths[1], atol=1e-9)


def test_command_is_the_request_without_active_constraints(template):
    loop = Loop(SctGuidance(template, MUG, PERIOD, active_constraints=False)).initialize()
    for _ in range(200):
        desired = loop.step(np.array([0.0, 0.0, -1.0]))
    assert desired[2] < 0.12 - 0.25  # [m]; below the surface of the table


def test_velocity_input_satisfies_the_constraints(template):
    velocity = load_template("end_effector_velocity")
    loop = Loop(SctGuidance(template, MUG, PERIOD, input_mapping=velocity)).initialize()
    rng = np.random.default_rng(0)
    for _ in range(200):
        loop.step(rng.choice([-1.0, 1.0], 6))
        assert loop.value("constraint_violation")[0] <= 1e-9


def test_filter_stops_at_the_mug_when_a_pose_is_requested(template):
    """The filter alone, with a constant requested pose inside the mug."""
    builder = DiagramBuilder()
    safe = builder.AddSystem(ActiveConstraintFilter(template, MUG, PERIOD))
    request = builder.AddSystem(ConstantVectorSource(np.array([0.0, 0.0, -0.05, 0.0, 0.0, 2.0])))
    robot = builder.AddSystem(ZeroOrderHold(PERIOD, 6))
    builder.Connect(request.get_output_port(), safe.GetInputPort("requested_pose"))
    builder.Connect(robot.get_output_port(), safe.GetInputPort("pose"))
    builder.Connect(safe.GetOutputPort("desired_pose"), robot.get_input_port())
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    robot.GetMyMutableContextFromRoot(context).SetDiscreteState(START)
    simulator.Initialize()
    for k in range(1, 400):
        simulator.AdvanceTo(k * PERIOD)
        assert safe.GetOutputPort("commanded_violation").Eval(safe.GetMyContextFromRoot(context))[0] <= 1e-9
    desired = safe.GetOutputPort("desired_pose").Eval(safe.GetMyContextFromRoot(context))
    assert np.linalg.norm(desired[:3]) < 0.09  # [m]; the constraints keep the tip at about this distance


def test_prior_knowledge_refuses_invalid_templates():
    with pytest.raises(InputError, match="a template is a SharedControlTemplate"):
        PlacedTemplate("grid_clamp.yaml", {"hole": RigidTransform()})
