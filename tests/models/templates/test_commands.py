"""Commands for arbitrary requests: inside the constraints, within the speed limits, and close to the request."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from guiderail.models.common.transforms import RigidTransform, RotationMatrix
from guiderail.models.templates import SharedControlTemplate, TemplateState, Transition
from guiderail.models.templates import active_constraints as ac
from guiderail.models.templates import mappings as im
from guiderail.models.templates import transitions as td
from guiderail.models.templates.parts import angle_between, between

SEEDS = st.integers(0, 2**32 - 1)
PERIOD = 0.02


def make_state(name="only", constraints=(), transitions=(), **changes):
    """Return a state that translates along three inputs; its transition distance is the height."""
    numbers = {"starts_at": 1.0, "ends_at": 0.0, **changes}
    distance = td.Height("f")
    return TemplateState(
        name, (im.Translation((0, 1, 2), 0.5),), tuple(constraints), distance, transitions=transitions, **numbers
    )


def make_template(*states, speed=0.2, angular_speed=1.0, initial=0):
    """Return a template with speed limits [m/s, rad/s] and with the given states, or with one state."""
    return SharedControlTemplate("test", 3, ("f",), states or (make_state(),), initial, speed, angular_speed)


def random_pose(rng, spread):
    R = Rotation.from_rotvec(spread * rng.standard_normal(3))
    return RigidTransform(RotationMatrix(R.as_matrix()), spread * rng.standard_normal(3))


FRAMES = {"f": RigidTransform()}


def speed_ratio(template, A, B):
    """Return the speed from pose A to B in one period relative to the limit, the larger of linear and angular speed."""
    distance = np.linalg.norm(B.translation() - A.translation()) / (template.max_speed_m_per_s * PERIOD)
    return max(distance, angle_between(A.rotation(), B.rotation()) / (template.max_speed_rad_per_s * PERIOD))


@given(SEEDS, st.sampled_from([1e-4, 1e-3, 1e-2, 1.0]))
def test_command_reaches_the_speed_limit_without_constraints(seed, spread):
    rng = np.random.default_rng(seed)
    template = make_template(speed=rng.uniform(0.01, 1), angular_speed=rng.uniform(0.1, 3))
    last, request = random_pose(rng, 0.3), random_pose(rng, spread)
    request = RigidTransform(request.rotation() @ last.rotation(), last.translation() + request.translation())
    command = template.command(0, last, request, FRAMES, PERIOD)
    largest = min(1.0, 1.0 / speed_ratio(template, last, request))
    # If rounding exceeds a speed limit, the fraction is reduced to 0.98 of the largest.
    assert 0.979 * largest <= command.fraction <= largest * (1 + 1e-12)
    expected = between(last, request, command.fraction)
    np.testing.assert_allclose(command.X_WE.GetAsMatrix34(), expected.GetAsMatrix34(), atol=1e-7)
    assert speed_ratio(template, last, command.X_WE) <= 1 + 1e-9


# The projection to a constraint can violate an earlier constraint.
CONFLICTING = [ac.Cylinder("f", max_radius_m=0.002), ac.KeepAbove(0.0, "f"), ac.Funnel("f", 0.001, 0.006, 1.0)]


def wander(template, seed, height=0.02, climb=(-1e-3, 4e-4), steps=300):
    """Yield the number of the state and the command at each step, for random requests that start above the object.

    Args:
        template: Template of the commands.
        seed: Seed of the requests.
        height: Height of the start above the object [m].
        climb: Range of the vertical displacement of a request [m].
        steps: Number of steps.
    """
    rng = np.random.default_rng(seed)
    number, last = 0, RigidTransform([0.0, 0.0, height])
    for _ in range(steps):
        position = last.translation() + [*rng.choice([-1e-3, 1e-3], 2), rng.uniform(*climb)]
        last = template.command(number, last, RigidTransform(position), FRAMES, PERIOD).X_WE
        yield number, last
        number = template.next_state(number, last, FRAMES, PERIOD)


@pytest.mark.parametrize("seed", range(4))
def test_command_is_inside_when_one_constraint_undoes_another(seed):
    template = make_template(make_state(constraints=CONFLICTING[::-1]), speed=0.05)
    assert template.violation(0, template.project(0, RigidTransform([0.003, 0.0, 0.009]), FRAMES), FRAMES) > 5e-4
    pairs = list(wander(template, seed, height=0.006, climb=(-4e-4, 1e-3)))
    assert max(template.violation(number, X, FRAMES) for number, X in pairs) <= 1e-9
    assert np.ptp([X.translation() for _, X in pairs], axis=0).max() > 0.001  # [m], the commands move


@pytest.mark.parametrize("seed", range(4))
def test_command_satisfies_tighter_constraints_of_the_next_state(seed):
    insert = Transition("insert", 0.006, 0.002)
    wide, narrow = (
        make_state(name, [ac.Cylinder("f", max_radius_m=radius), ac.KeepAbove(-0.006, "f")], transitions)
        for name, radius, transitions in (("search", 0.004, (insert,)), ("insert", 0.002, ()))
    )
    template = make_template(wide, narrow, speed=0.05)
    pairs = list(wander(template, seed))
    assert max(template.violation(number, X, FRAMES) for number, X in pairs) <= 1e-9
    assert {number for number, _ in pairs} == {0, 1}


@given(SEEDS)
def test_command_stays_inside_and_within_the_speed_limits(seed):
    """The orientation that `TiltByDistance` assigns to a position changes quickly near the object."""
    rng = np.random.default_rng(seed)
    constraints = [
        ac.Box((-0.2, -0.2, -0.2), (0.2, 0.2, 0.2), "f"),
        ac.TiltByDistance("f", (0.0, 0.3), (80.0, -80.0), turns_along=bool(seed % 2)),
    ]
    template = make_template(
        make_state(constraints=constraints), speed=rng.uniform(0.05, 1), angular_speed=rng.uniform(0.1, 3)
    )
    last = template.project(0, random_pose(rng, 0.3), FRAMES)
    command = template.command(0, last, random_pose(rng, 0.3), FRAMES, PERIOD)
    assert 0 <= command.fraction <= 1
    assert speed_ratio(template, last, command.X_WE) <= 1 + 1e-9
    assert template.violation(0, command.X_WE, FRAMES) <= 1e-9


@given(SEEDS)
def test_command_moves_inside_within_the_speed_limits(seed):
    rng = np.random.default_rng(seed)
    constraints = [ac.Box((-0.1,) * 3, (0.1,) * 3, "f"), ac.FixedOrientation(frame="f")]
    template = make_template(make_state(constraints=constraints))
    last = random_pose(rng, 0.5)
    before = template.violation(0, last, FRAMES)
    command = template.command(0, last, last, FRAMES, PERIOD)
    assert speed_ratio(template, last, command.X_WE) <= 1 + 1e-9
    assert template.violation(0, command.X_WE, FRAMES) <= before + 1e-9
    if before > 0.1:
        assert command.fraction == 0.0
        assert speed_ratio(template, last, command.X_WE) == pytest.approx(1.0, rel=1e-6)


def test_displace_and_map_add_translations_and_rotations():
    template = make_template()
    X = RigidTransform(RotationMatrix.MakeXRotation(0.4), [1.0, 2.0, 3.0])
    d = RigidTransform(RotationMatrix.MakeZRotation(0.3), [0.1, 0.2, 0.3])
    moved = template.displace(X, d)
    np.testing.assert_allclose(moved.translation(), [1.1, 2.2, 3.3])
    expected = RotationMatrix.MakeZRotation(0.3) @ RotationMatrix.MakeXRotation(0.4)
    np.testing.assert_allclose(moved.rotation().matrix(), expected.matrix(), atol=1e-12)
    state = TemplateState(
        "both", (im.Translation((0, 1, 2), 0.5), im.Rotation((0,), 2.0, axes=((0, 0, 1),))), (), td.Height("f"), 1, 0
    )
    total = make_template(state).map(0, np.array([0.5, 9.0, -9.0]), X, FRAMES, 0.1)
    np.testing.assert_allclose(total.translation(), [0.025, 0.05, -0.05])
    np.testing.assert_allclose(total.rotation().matrix(), RotationMatrix.MakeZRotation(0.1).matrix(), atol=1e-12)


def test_project_applies_constraints_in_order():
    up, down = ac.HalfSpace((0.0, 0.0, 1.0), 0.5), ac.HalfSpace((0.0, 0.0, -1.0), -0.2)
    for order, height in (((up, down), 0.2), ((down, up), 0.5)):
        template = make_template(make_state(constraints=order))
        assert template.project(0, RigidTransform(), {}).translation()[2] == pytest.approx(height)
        assert template.violation(0, RigidTransform([0.0, 0.0, 0.3]), {}) == pytest.approx(0.2)
    assert make_template().violation(0, RigidTransform([9.0, 9.0, 9.0]), FRAMES) == 0.0
    free = make_template(make_state(constraints=(up,))).without_active_constraints()
    assert free.states[0].active_constraints == ()


def at(height):
    return RigidTransform([0.0, 0.0, height])


def test_next_state_follows_the_first_transition_that_fires():
    template = make_template(
        make_state("a", transitions=(Transition("b", 0.5, 0.1), Transition("c", 0.7)), starts_at=1.0, ends_at=0.5),
        make_state("b", transitions=(Transition("c", 0.2, 0.05),), starts_at=0.5, ends_at=0.2),
        make_state("c", starts_at=0.2, ends_at=0.0),
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
        assert template.next_state(number, at(height), FRAMES) == expected, (number, height)
    assert template.state_at(at(0.9), FRAMES) == 0
    assert template.state_at(at(0.4), FRAMES) == 1
    assert template.state_at(at(0.1), FRAMES) == 2
    assert template.distance(1, at(0.3), FRAMES) == pytest.approx(0.3)


def test_progress_continues_from_the_end_of_the_previous_state():
    template = make_template(
        make_state("b", transitions=(Transition("c", 0.2),), starts_at=0.5, ends_at=0.2, weight=2.0),
        make_state(
            "a", transitions=(Transition("b", 0.5), Transition("c", 0.1)), starts_at=1.0, ends_at=0.5, weight=3.0
        ),
        make_state("c", starts_at=0.2, ends_at=0.0, weight=5.0),
        initial=1,
    )
    assert template.progress(1, at(1.0), FRAMES) == pytest.approx(0.0)
    assert template.progress(1, at(0.5), FRAMES) == template.progress(0, at(0.5), FRAMES) == pytest.approx(1.5)
    assert template.progress(0, at(0.2), FRAMES) == template.progress(2, at(0.2), FRAMES) == pytest.approx(2.1)
    assert template.progress(2, at(0.0), FRAMES) == pytest.approx(3.1)
    cyclic = make_template(
        make_state("a", transitions=(Transition("b", 0.5),), starts_at=1.0, ends_at=0.5),
        make_state("b", transitions=(Transition("a", 0.2),), starts_at=0.5, ends_at=0.2),
    )
    assert cyclic.progress(1, at(0.2), FRAMES) == pytest.approx(0.8)


def test_frame_names_are_those_of_all_parts_of_a_state():
    template = TemplateState(
        "x", (im.TiltTowards((0, 1), 1.0, "a"),), (ac.Cylinder("b"),), td.Distance("c"), starts_at=1.0, ends_at=0.0
    )
    assert template.frame_names == {"a", "b", "c"}


OUTSIDE = [
    ac.OutsideSphere(frame="f", radius_m=0.02),
    ac.OutsideCylinder(frame="f", radius_m=0.01, min_m=-0.05, max_m=0.05, margin_m=0.002),
    ac.OutsideBox(frame="f", lower_m=(-0.02, -0.01, -0.03), upper_m=(0.02, 0.02, 0.01)),
]


@pytest.mark.parametrize("constraint", OUTSIDE, ids=lambda constraint: type(constraint).__name__)
def test_path_between_commands_is_outside_of_a_shape(constraint):
    rng = np.random.default_rng(0)
    template = make_template(make_state(constraints=[ac.Box((-0.1,) * 3, (0.1,) * 3), constraint]))
    frames = {"f": random_pose(rng, 0.01)}
    last, nearest, num_contacts, center = RigidTransform([0.0, 0.06, 0.0]), np.inf, 0, frames["f"].translation()
    for k in range(600):
        request = RigidTransform(center if k % 3 else last.translation() + 0.01 * rng.standard_normal(3))
        command = template.command(0, last, request, frames, PERIOD).X_WE
        p, q = (frames["f"].inverse() @ X for X in (last, command))
        for fraction in np.linspace(0.0, 1.0, 9):
            point = p.translation() + fraction * (q.translation() - p.translation())
            nearest = min(nearest, constraint.shape.distance(point))
        num_contacts += constraint.shape.distance(q.translation()) < 1e-6
        last = command
    assert nearest >= 0.0
    assert num_contacts > 50  # otherwise the constraint would not be tested
    assert np.linalg.norm(last.translation() - center) < 0.1


@pytest.mark.parametrize("constraint", OUTSIDE, ids=lambda constraint: type(constraint).__name__)
def test_command_leaves_a_shape_that_contains_the_last_command(constraint):
    template = make_template(make_state(constraints=[constraint]), speed=0.05)
    last = RigidTransform([0.001, 0.002, 0.0])
    violations = [template.violation(0, last, FRAMES)]
    for _ in range(60):
        last = template.command(0, last, last, FRAMES, PERIOD).X_WE
        violations.append(template.violation(0, last, FRAMES))
    assert violations[0] > 0.005
    assert violations[-1] <= 1e-9
    assert (np.diff(violations) <= 1e-9).all()


@given(SEEDS)
def test_command_obeys_the_speed_limits_of_its_state(seed):
    rng = np.random.default_rng(seed)
    slow = make_state("slow", max_speed_m_per_s=0.05, max_speed_rad_per_s=0.3)
    template = make_template(make_state("fast"), slow, make_state("limit above the template", max_speed_m_per_s=9.0))
    last, request = random_pose(rng, 0.3), random_pose(rng, 1.0)
    ratios = [
        speed_ratio(template, last, template.command(number, last, request, FRAMES, PERIOD).X_WE) for number in range(3)
    ]
    slower = replace(template, max_speed_m_per_s=0.05, max_speed_rad_per_s=0.3)
    command = template.command(1, last, request, FRAMES, PERIOD).X_WE
    assert 0.97 <= speed_ratio(slower, last, command) <= 1 + 1e-9
    assert ratios[0] == ratios[2]  # a state cannot raise the limits of the template
    assert 0.97 <= ratios[0] <= 1 + 1e-9


def test_can_enter_uses_the_speed_limit_of_the_next_state():
    plane = (ac.KeepAbove(0.003, "f"),)  # 3 mm are reached in one period at 0.2 m/s, but not at 0.1 m/s
    for speed, expected in ((0.2, True), (0.1, False)):
        template = make_template(make_state("fast"), make_state("next", plane, max_speed_m_per_s=speed))
        assert template.can_enter(1, RigidTransform(), FRAMES, PERIOD) is expected
