"""Commands for arbitrary requests: inside the constraints, within the speeds, and near to the request."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from guiderail.models.common.transforms import RigidTransform, RotationMatrix
from guiderail.models.templates import Command, SharedControlTemplate, TemplateState, Transition
from guiderail.models.templates import constraints as ac
from guiderail.models.templates import mappings as im
from guiderail.models.templates import shape_constraints as sc
from guiderail.models.templates import transitions as td
from guiderail.models.templates.geometry import angle_between, between

SEEDS = st.integers(0, 2**32 - 1)
PERIOD = 0.02


def state(name="only", constraints=(), to=(), **changes):
    numbers = {"starts_at": 1.0, "ends_at": 0.0, **changes}
    return TemplateState(
        name, (im.Translation((0, 1, 2), 0.5),), tuple(constraints), td.Height("f"), transitions=to, **numbers
    )


def template(*states, speed=0.2, turn=1.0, initial=0):
    return SharedControlTemplate("s", 3, ("f",), states or (state(),), initial, speed, turn)


def pose(rng, spread):
    R = Rotation.from_rotvec(spread * rng.standard_normal(3))
    return RigidTransform(RotationMatrix(R.as_matrix()), spread * rng.standard_normal(3))


F = {"f": RigidTransform()}


def load(s, A, B):
    distance = np.linalg.norm(B.translation() - A.translation()) / (s.max_speed_m_per_s * PERIOD)
    return max(distance, angle_between(A.rotation(), B.rotation()) / (s.max_speed_rad_per_s * PERIOD))


@given(SEEDS, st.sampled_from([1e-4, 1e-3, 1e-2, 1.0]))
def test_command_reaches_the_speed_limit_without_constraints(seed, spread):
    rng = np.random.default_rng(seed)
    s = template(speed=rng.uniform(0.01, 1), turn=rng.uniform(0.1, 3))
    last, request = pose(rng, 0.3), pose(rng, spread)
    request = RigidTransform(request.rotation() @ last.rotation(), last.translation() + request.translation())
    command = s.command(0, last, request, F, PERIOD)
    target = load(s, last, request)
    most = min(1.0, 1.0 / target)
    assert 0.979 * most <= command.fraction <= most * (1 + 1e-12)  # or one step shorter, where rounding exceeds a speed
    expected = between(last, request, command.fraction)
    np.testing.assert_allclose(command.X_WE.GetAsMatrix34(), expected.GetAsMatrix34(), atol=1e-7)
    assert load(s, last, command.X_WE) <= 1 + 1e-9


UNDONE = [ac.Cylinder("f", max_radius_m=0.002), ac.KeepAbove(0.0, "f"), ac.Funnel("f", 0.001, 0.006, 1.0)]


def wander(s, seed, height=0.02, climb=(-1e-3, 4e-4), steps=300):
    """Return commands and their states for random requests that start above the object."""
    rng = np.random.default_rng(seed)
    number, last = 0, RigidTransform([0.0, 0.0, height])
    for _ in range(steps):
        to = last.translation() + [*rng.choice([-1e-3, 1e-3], 2), rng.uniform(*climb)]
        last = s.command(number, last, RigidTransform(to), F, PERIOD).X_WE
        yield number, last
        number = s.next_state(number, last, F, PERIOD)


@pytest.mark.parametrize("seed", range(4))
def test_command_is_inside_when_one_constraint_undoes_another(seed):
    s = template(state(constraints=UNDONE[::-1]), speed=0.05)
    assert s.violation(0, s.project(0, RigidTransform([0.003, 0.0, 0.009]), F), F) > 5e-4
    pairs = list(wander(s, seed, height=0.006, climb=(-4e-4, 1e-3)))
    assert max(s.violation(number, X, F) for number, X in pairs) <= 1e-9
    assert np.ptp([X.translation() for _, X in pairs], axis=0).max() > 0.001  # and it moves


@pytest.mark.parametrize("seed", range(4))
def test_command_satisfies_tighter_constraints_of_the_next_state(seed):
    wide, narrow = (
        state(name, [ac.Cylinder("f", max_radius_m=radius), ac.KeepAbove(-0.006, "f")], to)
        for name, radius, to in (("search", 0.004, (Transition("insert", 0.006, 0.002),)), ("insert", 0.002, ()))
    )
    s = template(wide, narrow, speed=0.05)
    pairs = list(wander(s, seed))
    assert max(s.violation(number, X, F) for number, X in pairs) <= 1e-9
    assert {number for number, _ in pairs} == {0, 1}


@given(SEEDS)
def test_command_stays_inside_and_within_the_speed_limits(seed):
    """The orientation that belongs to a position may turn quickly."""
    rng = np.random.default_rng(seed)
    constraints = [
        ac.Box((-0.2, -0.2, -0.2), (0.2, 0.2, 0.2), "f"),
        ac.TiltByDistance("f", (0.0, 0.3), (80.0, -80.0), turns_along=bool(seed % 2)),
    ]
    s = template(state(constraints=constraints), speed=rng.uniform(0.05, 1), turn=rng.uniform(0.1, 3))
    last = s.project(0, pose(rng, 0.3), F)
    command = s.command(0, last, pose(rng, 0.3), F, PERIOD)
    assert 0 <= command.fraction <= 1
    assert load(s, last, command.X_WE) <= 1 + 1e-9
    assert s.violation(0, command.X_WE, F) <= 1e-9


@given(SEEDS)
def test_command_from_outside_is_led_inside_within_the_speeds(seed):
    rng = np.random.default_rng(seed)
    s = template(state(constraints=[ac.Box((-0.1,) * 3, (0.1,) * 3, "f"), ac.FixedOrientation(frame="f")]))
    last = pose(rng, 0.5)
    before = s.violation(0, last, F)
    command = s.command(0, last, last, F, PERIOD)
    assert load(s, last, command.X_WE) <= 1 + 1e-9
    assert s.violation(0, command.X_WE, F) <= before + 1e-9
    if before > 0.1:
        assert command.fraction == 0.0
        assert load(s, last, command.X_WE) == pytest.approx(1.0, rel=1e-6)


def test_command_executes_a_feasible_request_completely():
    s = template()
    last, request = RigidTransform(), RigidTransform([0.2 * PERIOD * 0.999, 0, 0])
    command = s.command(0, last, request, F, PERIOD)
    assert command == Command(command.X_WE, 1.0)
    np.testing.assert_array_equal(command.X_WE.translation(), request.translation())


def test_displace_rotates_about_the_end_effector_and_adds_up():
    s = template()
    X = RigidTransform(RotationMatrix.MakeXRotation(0.4), [1.0, 2.0, 3.0])
    d = RigidTransform(RotationMatrix.MakeZRotation(0.3), [0.1, 0.2, 0.3])
    moved = s.displace(X, d)
    np.testing.assert_allclose(moved.translation(), [1.1, 2.2, 3.3])
    expected = RotationMatrix.MakeZRotation(0.3) @ RotationMatrix.MakeXRotation(0.4)
    np.testing.assert_allclose(moved.rotation().matrix(), expected.matrix(), atol=1e-12)
    both = TemplateState(
        "b", (im.Translation((0, 1, 2), 0.5), im.Rotation((0,), 2.0, axes=((0, 0, 1),))), (), td.Height("f"), 1, 0
    )
    total = template(both).map(0, np.array([0.5, 9.0, -9.0]), X, F, 0.1)
    np.testing.assert_allclose(total.translation(), [0.025, 0.05, -0.05])
    np.testing.assert_allclose(total.rotation().matrix(), RotationMatrix.MakeZRotation(0.1).matrix(), atol=1e-12)


def test_project_applies_constraints_in_order():
    up, down = ac.HalfSpace((0.0, 0.0, 1.0), 0.5), ac.HalfSpace((0.0, 0.0, -1.0), -0.2)
    for order, height in (((up, down), 0.2), ((down, up), 0.5)):
        s = template(state(constraints=order))
        assert s.project(0, RigidTransform(), {}).translation()[2] == pytest.approx(height)
        assert s.violation(0, RigidTransform([0.0, 0.0, 0.3]), {}) == pytest.approx(0.2)
    assert template().violation(0, RigidTransform([9.0, 9.0, 9.0]), F) == 0.0
    free = template(state(constraints=(up,))).without_active_constraints()
    assert free.states[0].active_constraints == ()


def at(height):
    return RigidTransform([0.0, 0.0, height])


def test_next_state_takes_the_first_transition_with_hysteresis():
    s = template(
        state("a", to=(Transition("b", 0.5, 0.1), Transition("c", 0.7)), starts_at=1.0, ends_at=0.5),
        state("b", to=(Transition("c", 0.2, 0.05),), starts_at=0.5, ends_at=0.2),
        state("c", starts_at=0.2, ends_at=0.0),
    )
    for number, height, expected in (
        (0, 0.7, 0),
        (0, 0.69, 2),
        (0, 0.5, 2),
        (0, 0.49, 1),
        (1, 0.6, 1),
        (1, 0.61, 0),
        (1, 0.2, 1),
        (1, 0.19, 2),
        (2, 0.25, 2),
        (2, 0.26, 1),
    ):
        assert s.next_state(number, at(height), F) == expected, (number, height)
    assert s.state_at(at(0.9), F) == 0
    assert s.state_at(at(0.4), F) == 1
    assert s.state_at(at(0.1), F) == 2
    assert s.distance(1, at(0.3), F) == pytest.approx(0.3)


def test_progress_continues_from_the_end_of_the_previous_state():
    s = template(
        state("b", to=(Transition("c", 0.2),), starts_at=0.5, ends_at=0.2, weight=2.0),
        state("a", to=(Transition("b", 0.5), Transition("c", 0.1)), starts_at=1.0, ends_at=0.5, weight=3.0),
        state("c", starts_at=0.2, ends_at=0.0, weight=5.0),
        initial=1,
    )
    assert s.progress(1, at(1.0), F) == pytest.approx(0.0)
    assert s.progress(1, at(0.5), F) == s.progress(0, at(0.5), F) == pytest.approx(1.5)
    assert s.progress(0, at(0.2), F) == s.progress(2, at(0.2), F) == pytest.approx(2.1)
    assert s.progress(2, at(0.0), F) == pytest.approx(3.1)
    round_ = template(
        state("a", to=(Transition("b", 0.5),), starts_at=1.0, ends_at=0.5),
        state("b", to=(Transition("a", 0.2),), starts_at=0.5, ends_at=0.2),
    )
    assert round_.progress(1, at(0.2), F) == pytest.approx(0.8)


def test_state_needs_the_frames_of_all_its_parts():
    s = TemplateState(
        "x", (im.TiltTowards((0, 1), 1.0, "a"),), (ac.Cylinder("b"),), td.Distance("c"), starts_at=1.0, ends_at=0.0
    )
    assert s.frame_names == {"a", "b", "c"}


OUTSIDE = [
    sc.OutsideSphere(frame="f", radius_m=0.02),
    sc.OutsideCylinder(frame="f", radius_m=0.01, min_m=-0.05, max_m=0.05, margin_m=0.002),
    sc.OutsideBox(frame="f", lower_m=(-0.02, -0.01, -0.03), upper_m=(0.02, 0.02, 0.01)),
]


@pytest.mark.parametrize("constraint", OUTSIDE, ids=lambda constraint: type(constraint).__name__)
def test_path_between_commands_is_outside_of_a_shape(constraint):
    rng, s = np.random.default_rng(0), template(state(constraints=[ac.Box((-0.1,) * 3, (0.1,) * 3), constraint]))
    frames = {"f": pose(rng, 0.01)}
    last, nearest, touching, center = RigidTransform([0.0, 0.06, 0.0]), np.inf, 0, frames["f"].translation()
    for k in range(600):
        request = RigidTransform(center if k % 3 else last.translation() + 0.01 * rng.standard_normal(3))
        command = s.command(0, last, request, frames, PERIOD).X_WE
        p, q = (frames["f"].inverse() @ X for X in (last, command))
        for share in np.linspace(0.0, 1.0, 9):
            point = p.translation() + share * (q.translation() - p.translation())
            nearest = min(nearest, constraint.shape.distance(point))
        touching += constraint.shape.distance(q.translation()) < 1e-6
        last = command
    assert nearest >= 0.0
    assert touching > 50  # or the test would show nothing
    assert np.linalg.norm(last.translation() - center) < 0.1


@pytest.mark.parametrize("constraint", OUTSIDE, ids=lambda constraint: type(constraint).__name__)
def test_command_leaves_a_shape_that_moved_over_it(constraint):
    s, last = template(state(constraints=[constraint]), speed=0.05), RigidTransform([0.001, 0.002, 0.0])
    violations = [s.violation(0, last, F)]
    for _ in range(60):
        last = s.command(0, last, last, F, PERIOD).X_WE
        violations.append(s.violation(0, last, F))
    assert violations[0] > 0.005
    assert violations[-1] <= 1e-9
    assert (np.diff(violations) <= 1e-9).all()


@given(SEEDS)
def test_command_keeps_the_speeds_of_its_state(seed):
    rng = np.random.default_rng(seed)
    slow = state("slow", max_speed_m_per_s=0.05, max_speed_rad_per_s=0.3)
    s = template(state("fast"), slow, state("none", max_speed_m_per_s=9.0))
    last, request = pose(rng, 0.3), pose(rng, 1.0)
    loads = [load(s, last, s.command(number, last, request, F, PERIOD).X_WE) for number in range(3)]
    slower = replace(s, max_speed_m_per_s=0.05, max_speed_rad_per_s=0.3)
    command = s.command(1, last, request, F, PERIOD).X_WE
    assert 0.97 <= load(slower, last, command) <= 1 + 1e-9
    assert loads[0] == loads[2]  # a state cannot raise the template's speeds
    assert 0.97 <= loads[0] <= 1 + 1e-9


def test_state_is_entered_at_its_own_speed():
    plane = (ac.KeepAbove(0.003, "f"),)  # reached in one period at 0.2 m/s, and not at 0.1 m/s
    for speed, expected in ((0.2, True), (0.1, False)):
        s = template(state("fast"), state("next", plane, max_speed_m_per_s=speed))
        assert s.can_enter(1, RigidTransform(), F, PERIOD) is expected
