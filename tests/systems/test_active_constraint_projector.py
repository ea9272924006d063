import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import pose_to_transform
from guiderail.models.templates import parse_template
from guiderail.systems.shared_control_template import ActiveConstraintProjector

PERIOD = 2.0**-7
ABOVE = """
inputs: 3
frames: [slab]
max_speed_m_per_s: 0.5
max_speed_rad_per_s: 1.0
states:
  above:
    input_mapping: [{kind: translation, inputs: [0, 1, 2], speed_m_per_s: 0.5}]
"""
TEMPLATE = parse_template(
    "name: slab"
    + ABOVE
    + """    active_constraints:
      - {kind: keep_above, frame: slab, height_m: 0.1}
      - {kind: fixed_orientation, frame: slab}
    transition_distance: {kind: height, frame: slab}
    starts_at_m: 1.0
    ends_at_m: 0.0
"""
)
FRAMES = {"slab": RigidTransform()}
START = np.array([0.0, 0.0, 0.3, 0.0, 0.0, 0.0])


class Rig:
    """Projector with settable inputs."""

    def __init__(self, start=START, max_tracking_error=np.inf, template=TEMPLATE):
        self.system = ActiveConstraintProjector(template, FRAMES, PERIOD, max_tracking_error)
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.state = self.system.get_state_input_port().FixValue(self.context, [0.0])
        self.measured = self.system.get_pose_input_port().FixValue(self.context, start)
        self.request = self.system.get_requested_pose_input_port().FixValue(self.context, start)
        self.simulator.Initialize()
        self.steps = 0

    def step(self, request, measured=None, state=None):
        """Run one control step; return the command and the fallback flag of this step."""
        # In a diagram a zero-order hold outputs the request, so the request changes after the previous instant.
        self.simulator.AdvanceTo((self.steps + 0.5) * PERIOD)
        self.request.GetMutableData().set_value(request)
        if state is not None:
            self.state.GetMutableData().set_value([state])
        if measured is not None:
            self.measured.GetMutableData().set_value(measured)
        self.steps += 1
        self.simulator.AdvanceTo(self.steps * PERIOD)
        return self.desired(), self.value("fallback")

    def desired(self):
        return self.system.get_desired_pose_output_port().Eval(self.context).copy()

    def value(self, name):
        return self.system.GetOutputPort(name).Eval(self.context)[0]


def test_request_is_commanded_when_it_satisfies_the_constraints():
    rig = Rig()
    request = START + [0.001, -0.002, 0.001, 0.0, 0.0, 0.0]
    desired, fallback = rig.step(request)
    np.testing.assert_allclose(desired, request, atol=1e-15)
    assert fallback == 0.0


def test_every_command_satisfies_the_constraints():
    rig = Rig()
    rng = np.random.default_rng(0)
    for _ in range(300):
        rig.step(np.concatenate([rng.normal(size=3), rng.uniform(-np.pi, np.pi, 3)]))
        X_WE = pose_to_transform(rig.desired())
        assert TEMPLATE.violation(0, X_WE, FRAMES) <= 1e-9
        assert rig.value("commanded_violation") <= 1e-9


def test_projector_respects_the_speed_limits():
    rig = Rig()
    last = START
    for _ in range(150):
        desired, _ = rig.step(np.array([5.0, 0.0, -5.0, 0.0, 0.0, 0.0]))
        assert np.linalg.norm(desired[:3] - last[:3]) <= 0.5 * PERIOD * (1 + 1e-9)
        last = desired
    assert last[2] == pytest.approx(0.1)  # lowest height [m] above the slab
    assert last[0] > 0.1


def test_projector_updates_once_at_each_instant():
    rig = Rig()
    step = np.array([0.001, 0.0, 0.0, 0.0, 0.0, 0.0])
    rig.step(START + step)
    # Before the events of an instant, the output is the command of the step before the last.
    np.testing.assert_allclose(rig.value("last_desired_pose"), START[0])
    rig.step(START + 2 * step)
    np.testing.assert_allclose(rig.system.get_last_desired_pose_output_port().Eval(rig.context), START + step)


def test_projector_repeats_the_last_command_for_a_nan_request():
    rig = Rig()
    before, _ = rig.step(START + [0.002, 0.0, 0.0, 0.0, 0.0, 0.0])
    for request in (np.full(6, np.nan), START + [0.0, 0.0, np.inf, 0.0, 0.0, 0.0]):
        desired, fallback = rig.step(request)
        assert fallback == 1.0
        np.testing.assert_array_equal(desired, before)


@pytest.mark.parametrize("state", [-1.0, -0.5, 0.99, float(len(TEMPLATE.states)), np.nan, np.inf])
def test_projector_repeats_the_last_command_for_an_unknown_state(state):
    rig = Rig()
    before, _ = rig.step(START + [0.002, 0.0, 0.0, 0.0, 0.0, 0.0])
    desired, fallback = rig.step(START, state=state)
    assert fallback == 1.0
    np.testing.assert_array_equal(desired, before)
    X_WE = pose_to_transform(START)
    violations = [TEMPLATE.violation(index, X_WE, FRAMES) for index in range(len(TEMPLATE.states))]
    assert rig.value("measured_violation") == max(violations)


def test_command_waits_when_the_tracking_error_is_too_large():
    rig = Rig(max_tracking_error=0.02)
    for _ in range(100):
        desired, fallback = rig.step(np.array([1.0, 0.0, 0.3, 0.0, 0.0, 0.0]), measured=START)
    assert fallback == 1.0
    assert 0.02 < desired[0] < 0.02 + 2 * 0.5 * PERIOD
    # A request for the last command does not reduce the tracking error.
    assert rig.step(desired)[1] == 1.0
    # A request towards the measured pose reduces the tracking error and is commanded.
    desired, fallback = rig.step(START)
    assert fallback == 0.0
    assert desired[0] < 0.02


@pytest.mark.parametrize(("distance", "fallback"), [(0.4999, 0.0), (0.5, 0.0), (0.5001, 1.0)])
def test_command_waits_only_above_the_largest_tracking_error(distance, fallback):
    rig = Rig(max_tracking_error=0.5)
    rig.step(START, measured=START + [distance, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert rig.step(START - [0.1, 0.0, 0.0, 0.0, 0.0, 0.0])[1] == fallback


def test_waiting_command_inside_the_constraints_is_unchanged():
    """The projection of the command would differ from the command by rounding errors."""
    rig, rng = Rig(template=RAISED), np.random.default_rng(0)
    for _ in range(30):
        before, fallback = rig.step(START + rng.normal(scale=[0.1] * 3 + [1.0] * 3))
        assert fallback == 0.0
        for _ in range(2):
            desired, fallback = rig.step(NOT_FINITE)
            assert fallback == 1.0
            np.testing.assert_array_equal(desired, before)


# The lowest height of the second state is 2 mm above the threshold of the transition. One period can raise a command
# by 3.9 mm.
RAISED = parse_template(
    "name: step"
    + ABOVE
    + """    active_constraints: [{kind: keep_above, frame: slab, height_m: 0.1}]
    transition_distance: {kind: height, frame: slab}
    starts_at_m: 1.0
    transitions: [{to: higher, below_m: 0.3}]
  higher:
    input_mapping: [{kind: translation, inputs: [0, 1, 2], speed_m_per_s: 0.5}]
    active_constraints: [{kind: keep_above, frame: slab, height_m: 0.302}]
    transition_distance: {kind: height, frame: slab}
    starts_at_m: 0.3
    ends_at_m: 0.0
"""
)
NOT_FINITE = np.full(6, np.nan)
DOWN = START + [0.0, 0.0, -0.1, 0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("request_", "measured"), [(DOWN, START - [0.0, 0.0, 0.02, 0.0, 0.0, 0.0]), (NOT_FINITE, START), (DOWN, NOT_FINITE)]
)
def test_waiting_command_moves_inside_after_a_transition(request_, measured):
    rig = Rig(max_tracking_error=0.01, template=RAISED)
    assert RAISED.can_enter(1, pose_to_transform(rig.desired()), FRAMES, PERIOD)
    before, _ = rig.step(START, measured=measured)
    for _ in range(5):
        desired, fallback = rig.step(request_, state=1.0)
        assert fallback == 1.0
        assert rig.value("commanded_violation") <= 1e-9
        assert np.linalg.norm(desired[:3] - before[:3]) <= 0.5 * PERIOD * (1 + 1e-9)
        before = desired
    np.testing.assert_allclose(desired, [0.0, 0.0, 0.302, 0.0, 0.0, 0.0], atol=1e-9)


def test_waiting_command_moves_inside_when_an_object_moves():
    rig = Rig(max_tracking_error=0.02)
    rig.step(START, measured=START + [0.0, 0.0, -0.05, 0.0, 0.0, 0.0])
    rig.system.frames.set(rig.context, {"slab": RigidTransform([0.0, 0.0, 0.3])})
    # This command was computed before the object moved.
    last, _ = rig.step(START)
    for _ in range(30):
        desired, fallback = rig.step(START)
        assert fallback == 1.0
        assert np.linalg.norm(desired - last) <= 0.5 * PERIOD * (1 + 1e-9)
        last = desired
    assert desired[2] == pytest.approx(0.4)
    assert rig.value("commanded_violation") <= 1e-9


@pytest.mark.parametrize(("tolerance", "expected"), [(0.1, 0.5), (0.09995, 0.5 + 0.5 * PERIOD)])
def test_waiting_command_moves_only_above_the_tolerance(monkeypatch, tolerance, expected):
    monkeypatch.setattr("guiderail.models.laws.template_law.INSIDE", tolerance)
    rig = Rig(start=START + [0.0, 0.0, 0.2, 0.0, 0.0, 0.0])
    rig.system.frames.set(rig.context, {"slab": RigidTransform([0.0, 0.0, 0.5])})  # violation of exactly 0.1 m
    assert rig.step(NOT_FINITE)[0][2] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("pose", [NOT_FINITE, *(START + [0.0, 0.0, 0.0, 0.0, bad, 0.0] for bad in (np.nan, np.inf))])
@pytest.mark.parametrize("max_tracking_error", [0.02, np.inf])
def test_command_waits_while_the_measured_pose_is_not_finite(max_tracking_error, pose):
    rig = Rig(max_tracking_error=max_tracking_error)
    request = START + [0.001, 0.0, 0.0, 0.0, 0.0, 0.0]
    before, _ = rig.step(START, measured=pose)
    for _ in range(5):
        desired, fallback = rig.step(request)
        assert fallback == 1.0
        np.testing.assert_array_equal(desired, before)
    rig.step(request, measured=START)
    desired, fallback = rig.step(request)
    np.testing.assert_allclose(desired, request, atol=1e-15)
    assert fallback == 0.0


def test_projector_refuses_a_nan_initial_pose():
    with pytest.raises(InputError, match="measured pose must be finite"):
        Rig(start=START + [0.0, np.nan, 0.0, 0.0, 0.0, 0.0])


def test_projector_refuses_a_frame_that_is_not_finite():
    frames = {"slab": RigidTransform([0.0, np.nan, 0.0])}
    with pytest.raises(InputError, match="frame slab must be at a finite pose"):
        ActiveConstraintProjector(TEMPLATE, frames, PERIOD)
    rig = Rig()
    with pytest.raises(InputError, match="frame slab must be at a finite pose"):
        rig.system.frames.set(rig.context, frames)
    rig.step(START)
    assert rig.value("fallback") == 0.0


def test_initialization_fails_when_a_frame_is_not_finite():
    rig = Rig()
    valid = rig.context.get_numeric_parameter(0).CopyToVector()
    rig.context.get_mutable_numeric_parameter(0).SetFromVector([*valid[:2], np.nan, *valid[3:]])
    with pytest.raises(InputError, match="must be finite at the start"):
        rig.simulator.Initialize()


def test_last_command_is_repeated_while_a_frame_is_nan():
    """The NaN is written without `set`, which would refuse the pose."""
    rig = Rig()
    before, _ = rig.step(START)
    valid = rig.context.get_numeric_parameter(0).CopyToVector()
    rig.context.get_mutable_numeric_parameter(0).SetFromVector([*valid[:2], np.nan, *valid[3:]])
    desired, fallback = rig.step(DOWN)
    np.testing.assert_array_equal(desired, before)
    assert fallback == 1.0
    rig.context.get_mutable_numeric_parameter(0).SetFromVector(valid)
    rig.step(DOWN)
    assert rig.step(DOWN)[1] == 0.0
    assert rig.desired()[2] < START[2]


@pytest.mark.parametrize(
    ("start", "steps", "violation"),  # start pose (6,), control steps, and least violation of the first command
    [([0.0, 0.0, 0.05, 0.0, 0.0, 0.2], 40, 0.1), ([0.0, 0.0, 0.0, 0.9, 0.0, 0.0], 200, 0.5)],
)
def test_command_moves_inside_when_the_robot_starts_outside(start, steps, violation):
    rig = Rig(np.array(start))
    violations = []
    for _ in range(steps):
        rig.step(rig.desired())
        violations.append(rig.value("commanded_violation"))
    assert violations[0] > violation
    assert (np.diff(violations) <= 1e-12).all()
    assert violations[-1] <= 1e-9


def test_last_command_of_the_start_is_moved_towards_the_constraints():
    """The measured start is outside; the first last command is already a command, within the speed of one period."""
    start = np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.0])
    rig = Rig(start)
    last = rig.system.get_last_desired_pose_output_port().Eval(rig.context)
    np.testing.assert_allclose(last, start + [0, 0, 0.5 * PERIOD, 0, 0, 0], atol=1e-9)


def test_measured_violation_is_evaluated_at_the_measured_pose():
    rig = Rig()
    rig.step(START, measured=np.array([0.0, 0.0, 0.07, 0.0, 0.0, 0.0]))
    assert rig.value("measured_violation") == pytest.approx(0.03)
    assert rig.value("commanded_violation") == 0.0


def test_projector_uses_a_frame_set_by_a_reset():
    rig = Rig()
    rig.system.frames.set(rig.context, {"slab": RigidTransform([0.0, 0.0, 0.15])})
    for _ in range(60):
        desired, _ = rig.step(np.zeros(6))
    assert desired[2] == pytest.approx(0.25)


def test_projector_refuses_constraints_that_contradict():
    contradictory = parse_template(
        "name: slab"
        + ABOVE
        + """    active_constraints:
      - {kind: keep_above, frame: slab, height_m: 0.1}
      - {kind: box, frame: slab, lower_m: [-1, -1, 0], upper_m: [1, 1, 0.05]}
    transition_distance: {kind: height, frame: slab}
    starts_at_m: 1.0
    ends_at_m: 0.0
"""
    )
    with pytest.raises(InputError, match=r"slab, state above: active constraint 1 \(KeepAbove\) contradicts 2 \(Box\)"):
        ActiveConstraintProjector(contradictory, FRAMES, PERIOD)
    ActiveConstraintProjector(contradictory.without_active_constraints(), FRAMES, PERIOD)


@pytest.mark.parametrize(
    "start", [[0.0, 0.0, -0.15, 0.0, 0.0, 0.0], [0.0, 0.0, 0.3, 1.2, 0.0, 0.0], [0.0, 0.0, -300.0, 0.0, 0.0, 0.0]]
)
def test_projector_refuses_a_start_far_outside_its_constraints(start):
    with pytest.raises(InputError, match=r"outside of the active constraints of the template slab, state above"):
        Rig(np.array(start))
