"""Input mappings, commands, transitions and progress of a template."""

from dataclasses import replace

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import RigidTransform, RotationMatrix
from guiderail.models.templates import Command, SharedControlTemplate, TemplateState, Transition, load_template
from guiderail.models.templates import active_constraints as ac
from guiderail.models.templates import mappings as im
from guiderail.models.templates import transitions as td
from guiderail.models.templates.parts import angle_between

PERIOD = 0.01
MUG = {"mug_tip": RigidTransform(RotationMatrix.MakeZRotation(0.3), [0.7, 0.1, 0.1])}


@pytest.fixture(scope="module")
def pouring():
    return load_template("pouring")


def in_mug(p):
    """Return the pose of an end effector at a position [m] in the mug's frame, with the mug's orientation."""
    return RigidTransform(MUG["mug_tip"].rotation(), MUG["mug_tip"] @ np.array(p))


def test_translation_moves_at_its_speed_along_its_frame():
    mapping = im.Translation(inputs=(1,), axes=((0.0, 0.0, 1.0),), speed_m_per_s=0.2, frame="tool")
    X_WE = RigidTransform(RotationMatrix.MakeYRotation(np.pi / 2), np.zeros(3))
    moved = mapping.displacement(np.array([9.0, 0.5]), X_WE, {}, 0.1)
    np.testing.assert_allclose(moved.translation(), [0.01, 0.0, 0.0], atol=1e-15)


def test_rotation_turns_about_the_end_effectors_origin(pouring):
    mapping = im.Rotation(inputs=(0, 1, 2), speed_rad_per_s=2.0)
    X_WE = RigidTransform([1.0, 2.0, 3.0])
    turned = pouring.displace(X_WE, mapping.displacement(np.array([0.0, 0.0, 1.0]), X_WE, {}, 0.1))
    np.testing.assert_allclose(turned.translation(), X_WE.translation())
    assert angle_between(turned.rotation(), RotationMatrix.MakeZRotation(0.2)) < 1e-12


def test_tilt_towards_uses_only_the_input_along_the_bearing():
    mapping = im.TiltTowards(inputs=(0, 1), speed_rad_per_s=1.0, frame="mug_tip")
    X_WE = in_mug([0.0, -0.05, 0.05])
    across = mapping.displacement(np.array([1.0, 0.0]), X_WE, MUG, 0.1)
    along = mapping.displacement(np.array([0.3, 0.5]), X_WE, MUG, 0.1)
    assert angle_between(across.rotation(), RotationMatrix()) < 1e-12
    # The tool's z axis tilts towards the mug, along y of the mug's frame.
    z_axis = along.rotation().matrix()[:, 2]
    np.testing.assert_allclose(
        z_axis, MUG["mug_tip"].rotation() @ np.array([0, np.sin(0.05), np.cos(0.05)]), atol=1e-12
    )


def test_uneven_scales_positive_and_negative_inputs_differently():
    mapping = im.Uneven(above=0.4, below=1.0, of=im.Translation((0,), 1.0, axes=((0.0, 0.0, 1.0),)))
    speeds = [mapping.displacement(np.array([u]), RigidTransform(), {}, 1.0).translation()[2] for u in (-1, 0, 0.5, 1)]
    np.testing.assert_allclose(speeds, [-1.0, 0.0, 0.2, 0.4])


def test_map_returns_no_displacement_without_a_mapping(pouring):
    unmapped = replace(pouring, states=tuple(replace(state, input_mapping=()) for state in pouring.states))
    moved = unmapped.map(0, np.ones(3), in_mug([0.2, 0.0, 0.2]), {"mug_tip": RigidTransform()}, 0.01)
    np.testing.assert_array_equal(moved.GetAsMatrix34(), RigidTransform().GetAsMatrix34())


def test_command_slows_translation_when_the_tilt_is_limited(pouring):
    full = np.array([0.0, 1.0, 0.0])
    X_WE = pouring.project(1, in_mug([0.0, -0.15, 0.06]), MUG)
    request = pouring.displace(X_WE, pouring.map(1, full, X_WE, MUG, 0.1))
    slow = pouring.command(1, X_WE, request, MUG, PERIOD)
    assert 0.0 < slow.fraction < 1.0
    assert pouring.violation(1, slow.X_WE, MUG) <= 1e-9


def test_next_state_has_hysteresis(pouring):
    def after(state, distance):
        return pouring.next_state(state, in_mug([0.0, -distance, 0.0]), MUG)

    assert [after(0, d) for d in (0.251, 0.249)] == [0, 1]
    assert [after(1, d) for d in (0.269, 0.271)] == [1, 0]
    assert [after(1, d) for d in (0.076, 0.074)] == [1, 2]
    assert after(2, 0.5) == 2  # pour has no transition back


def test_load_adapts_the_template_to_the_object():
    wide = load_template("pouring", mug_radius_m=0.06)
    narrow = load_template("pouring", mug_radius_m=0.04)
    assert wide.states[1].ends_at - narrow.states[1].ends_at == pytest.approx(0.02)


def test_translation_scales_with_the_length_of_an_axis():
    moved = [
        im.Translation((0,), 0.1, axes=((0.0, 0.0, length),)).displacement(np.ones(1), RigidTransform(), {}, 0.5)
        for length in (1.0, 2.0)
    ]
    np.testing.assert_allclose(moved[1].translation(), 2 * moved[0].translation())


REACH = 0.125  # largest displacement [m] in a period of 1 s; a binary fraction, so that products are exact


class UpperBoundOnX(ac.ActiveConstraint):
    """Upper bound on x [m] whose projection changes nothing, so that only shorter displacements satisfy the bound."""

    frame_names = ()

    def __init__(self, limit):
        self.limit = limit

    def project(self, X_WE, frames):
        return RigidTransform(X_WE)

    def violation(self, X_WE, frames):
        return max(0.0, X_WE.translation()[0] - self.limit)


def make_state(*constraints, name="only", **numbers):
    numbers = {"starts_at": 1.0, "ends_at": 0.0, **numbers}
    return TemplateState(name, (im.Translation((0, 1, 2), 1.0),), constraints, td.Height("world"), **numbers)


def make_template(*constraints):
    return SharedControlTemplate("one", 3, (), (make_state(*constraints),), 0, REACH, 1.0)


def at_x(x):
    return RigidTransform([x, 0.0, 0.0])


def make_floor_and_ceiling(floor, ceiling):
    return make_template(ac.HalfSpace((0.0, 0.0, 1.0), floor), ac.HalfSpace((0.0, 0.0, -1.0), -ceiling))


def test_pose_is_inside_when_the_violation_is_a_nanometer():
    """A pose at a ceiling below a floor violates the floor by the distance of floor and ceiling."""
    X = RigidTransform()
    for floor, fraction in ((1e-9, 1.0), (1.5e-9, 0.0)):
        assert make_floor_and_ceiling(floor, 0.0).command(0, X, X, {}, 1.0).fraction == fraction
        assert make_floor_and_ceiling(floor, 0.0).can_enter(0, X, {}, 1.0) == (fraction == 1.0)


@pytest.mark.parametrize("halvings", range(9))
def test_command_halves_a_displacement_at_most_seven_times(halvings):
    template = make_template(UpperBoundOnX(0.75 * 0.5 ** (halvings - 1) * 0.0625))
    command = template.command(0, RigidTransform(), at_x(0.0625), {}, 1.0)
    fraction = 0.5**halvings if halvings < 8 else 0.0
    assert command.fraction == fraction
    assert command.X_WE.translation()[0] == pytest.approx(0.0625 * fraction, abs=1e-15)


def test_command_reaches_exactly_the_speed_limit():
    target = at_x(REACH)
    assert make_template().command(0, RigidTransform(), target, {}, 1.0) == Command(target, 1.0)
    assert make_template(UpperBoundOnX(0.75 * REACH)).command(0, RigidTransform(), target, {}, 1.0).fraction == 0.5
    beyond = make_template(ac.HalfSpace((1.0, 0.0, 0.0), REACH))
    assert beyond.can_enter(0, RigidTransform(), {}, 1.0)
    assert beyond.can_enter(0, at_x(0.5 * REACH), {}, 1.0)
    assert not beyond.can_enter(0, at_x(-1e-6), {}, 1.0)


def test_command_is_the_last_command_when_no_motion_is_allowed():
    X_WLast = at_x(0.0)
    command = make_template(UpperBoundOnX(0.0)).command(0, X_WLast, at_x(0.1), {}, 1.0)
    assert command.X_WE is X_WLast
    assert command.fraction == 0.0


def test_command_from_outside_stops_at_the_projection():
    command = make_floor_and_ceiling(0.0, -0.02).command(0, RigidTransform([0.0, 0.0, 0.04]), RigidTransform(), {}, 1.0)
    assert command == Command(command.X_WE, 0.0)
    np.testing.assert_allclose(command.X_WE.translation(), [0.0, 0.0, -0.02], atol=1e-15)


def test_command_slides_along_a_wall_for_a_distant_request():
    """A request is limited to the reach of one step before its projection, so the command slides by a full step."""
    template = make_template(ac.Box((-1.0, -1.0, -1.0), (0.0, 1e9, 1.0), "world"))
    for distance in (1.0, 1e4, 1e8):
        command = template.command(0, RigidTransform(), RigidTransform([distance, distance, 0.0]), {}, 1.0)
        np.testing.assert_allclose(command.X_WE.translation(), [0.0, REACH / np.sqrt(2), 0.0], rtol=1e-7, atol=1e-9)


def test_template_has_defaults_and_refuses_unknown_states():
    template = make_template()
    assert template.parameters == {}
    assert template.states[0].weight == 1.0
    with pytest.raises(InputError, match=r"one has no state 'onyl'.*did you mean only"):
        template.index("onyl")


def test_progress_is_finite_for_cyclic_states():
    a, b, c = (
        make_state(name=name, transitions=(Transition(to, 0.5),)) for name, to in (("a", "b"), ("b", "c"), ("c", "b"))
    )
    template = SharedControlTemplate("round", 3, (), (a, b, c), 0, REACH, 1.0)
    assert [template.progress(number, RigidTransform(), {}) for number in range(3)] == [1.0, 2.0, 3.0]
