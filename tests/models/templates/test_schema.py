"""Template files: parsed values, and the error messages for invalid files."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import yaml

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import RigidTransform
from guiderail.models.templates import load_template, parse_template
from guiderail.models.templates.active_constraints import ActiveConstraint, Cylinder
from guiderail.models.templates.parts import ACTIVE_CONSTRAINTS, TRANSITION_DISTANCES, register
from guiderail.models.templates.transitions import TransitionDistance

TEMPLATE = (Path(__file__).parent / "reach.yaml").read_text()
FAR = ("states", "far")


def edit_template(change):
    """Return the text of the template after a function has changed its data in place."""
    data = yaml.safe_load(TEMPLATE)
    change(data)
    return yaml.safe_dump(data, sort_keys=False)


def set_value(*path, value):
    """Return a function that sets the value at a path of keys."""

    def change(data):
        for key in path[:-1]:
            data = data[key]
        data[path[-1]] = value

    return change


def remove(*path):
    """Return a function that removes the value at a path of keys."""

    def change(data):
        for key in path[:-1]:
            data = data[key]
        del data[path[-1]]

    return change


def test_parse_returns_states_in_order_in_si_units():
    template = parse_template(TEMPLATE)
    assert [state.name for state in template.states] == ["far", "near"]
    assert template.initial_state == 0
    assert template.states[1].starts_at == pytest.approx(np.pi / 2)
    assert template.states[0].ends_at == 0.1


def test_parse_evaluates_expressions_of_parameters():
    cylinder = parse_template(TEMPLATE).states[0].active_constraints[0]
    assert isinstance(cylinder, Cylinder)
    assert (cylinder.min_radius_m, cylinder.max_radius_m) == pytest.approx((0.06, 0.3))
    larger = parse_template(TEMPLATE, rim_m=0.06).states[0].active_constraints[0]
    assert isinstance(larger, Cylinder)
    assert (larger.min_radius_m, larger.max_radius_m) == pytest.approx((0.07, 0.36))


def test_parse_returns_limits_of_a_state():
    assert [state.limits_wrench for state in parse_template(TEMPLATE).states] == [False, False]
    limits = {"max_force_n": "200 * rim_m", "max_torque_nm": 0.5, "max_speed_m_per_s": 0.2, "max_speed_rad_per_s": 1.0}
    far, near = parse_template(edit_template(lambda data: data["states"]["far"].update(limits))).states
    assert (far.max_force_n, far.max_torque_nm) == (10.0, 0.5)
    assert (far.max_speed_m_per_s, far.max_speed_rad_per_s) == (0.2, 1.0)
    assert far.limits_wrench
    assert (near.max_force_n, near.max_speed_m_per_s) == (None, None)


def test_register_adds_a_kind():
    @register(ACTIVE_CONSTRAINTS, "at_origin")
    @dataclass(frozen=True)
    class AtOrigin(ActiveConstraint):
        frame: str
        height_m: float = 0.0

        def project(self, X_WE, frames):
            return RigidTransform(X_WE.rotation(), frames[self.frame] @ np.array([0.0, 0.0, self.height_m]))

    constraint = {"kind": "at_origin", "frame": "cup", "height_m": "2 * rim_m"}
    try:
        template = parse_template(edit_template(set_value(*FAR, "active_constraints", value=[constraint])))
        X_WP = template.project(0, RigidTransform(), {"cup": RigidTransform([1.0, 0.0, 0.0])})
        np.testing.assert_allclose(X_WP.translation(), [1.0, 0.0, 0.1])
        register(ACTIVE_CONSTRAINTS, "at_origin")(AtOrigin)  # as when a file is imported twice
        with pytest.raises(InputError, match="there is a kind 'at_origin' already, AtOrigin: choose another name"):
            register(ACTIVE_CONSTRAINTS, "at_origin")(next(iter(TRANSITION_DISTANCES.values())))
    finally:
        del ACTIVE_CONSTRAINTS["at_origin"]


@dataclass(frozen=True)
class Abstract(TransitionDistance):
    frame: str


@pytest.mark.parametrize(
    ("name", "kind", "sentence"),
    [
        ("local", type("NoDataclass", (), {}), "the kind 'local' must be a dataclass"),
        ("local", 3, "the kind 'local' must be a dataclass, not 3"),
        ("local", Abstract, "the kind 'local' lacks value"),
        (3, Abstract, "a kind is registered by a name, not 3"),
    ],
)
def test_register_refuses_invalid_kinds_and_names(name, kind, sentence):
    with pytest.raises(InputError, match=sentence):
        register(TRANSITION_DISTANCES, name)(kind)
    assert name not in TRANSITION_DISTANCES


TRANSLATION = {"kind": "translation", "inputs": [0, 1], "speed_m_per_s": 0.1}
TILT_TOWARDS = {"kind": "tilt_towards", "inputs": [0, 1], "speed_rad_per_s": 0.1}
HALF_SPACE = {"kind": "half_space", "offset_m": 0}
FIXED_ORIENTATION = {"kind": "fixed_orientation"}
TILT_LIMITS = {"kind": "tilt_limits", "frame": "cup", "min_deg": 0, "max_deg": 1}
TILT_BY_DISTANCE = {"kind": "tilt_by_distance", "frame": "cup", "distance_m": [0], "tilt_deg": [0]}
FINAL_STATE = {
    "input_mapping": [],
    "active_constraints": [],
    "transition_distance": {"kind": "height", "frame": "cup"},
    "starts_at_m": 1,
    "ends_at_m": 0,
}
TILT_TO_GO = {"kind": "tilt_to_go", "frame": "cup", "until_deg": 9}
CONSTRAINT, MAPPING = (*FAR, "active_constraints", 0), (*FAR, "input_mapping", 0)
RADIUS = (*CONSTRAINT, "min_radius_m")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (set_value("inptus", value=3), "did you mean inputs"),
        (remove("max_speed_m_per_s"), "max_speed_m_per_s is missing"),
        (set_value("inputs", value=7), "inputs should be less than or equal to 6"),
        (set_value("initial_state", value="fra"), "did you mean far"),
        (set_value(*CONSTRAINT, "kind", value="cylindre"), "did you mean cylinder"),
        (set_value(*CONSTRAINT, "min_radius_mm", value=1), "did you mean min_radius_m"),
        (set_value(*CONSTRAINT, "frame", value="cpu"), "did you mean cup"),
        (set_value(*RADIUS, value="rmi_m"), "did you mean rim_m"),
        (set_value(*RADIUS, value="().__class__"), "is not a number"),
        (set_value(*RADIUS, value="1 / 0"), "not arithmetic"),
        (set_value(*RADIUS, value=float("nan")), "finite"),
        (set_value(*RADIUS, value=True), "must be a number"),
        (set_value(*RADIUS, value=2.0), "0 ≤ min_radius_m ≤ max_radius_m"),
        (remove(*MAPPING, "speed_m_per_s"), "speed_m_per_s is missing"),
        (set_value(*MAPPING, "inputs", value=[0, 2]), "no input 2"),
        (set_value(*FAR, "transitions", 0, "to", value="naer"), "did you mean near"),
        (set_value(*FAR, "transitions", 0, "below_deg", value=5), "below_"),
        (set_value(*FAR, "transitions", 0, "hysteresis_m", value=-0.1), "hysteresis_m should be greater than 0"),
        (set_value(*FAR, "starts_at_m", value=0.05), "distances decrease"),
        (set_value(*FAR, "max_force_n", value=0), "max_force_n should be greater than 0"),
        (set_value(*FAR, "max_torque_nm", value=-1), "max_torque_nm should be greater than 0"),
        (set_value(*FAR, "max_force_n", value=None), "max_force_n: must be a number"),
        (set_value(*FAR, "max_force", value=5), "did you mean max_force_n"),
        (set_value(*FAR, "max_speed_m_per_s", value=0.21), "must be at most the template's, 0.2, not 0.21"),
        (set_value(*FAR, "max_speed_rad_per_s", value="30 * rim_m"), "must be at most the template's, 1, not 1.5"),
        (remove("states", "near", "ends_at_deg"), "ends_at_deg is missing"),
        (set_value("states", "near", "starts_at_m", value=1.0), "did you mean starts_at_deg"),
        (set_value("states", value={}), "at least 1"),
        (set_value("frames", value=["cup", "cup"]), "different names"),
        (set_value("frames", value=["cup", "world"]), "world and tool exist already"),
        (set_value("frames", value=["cup", "tool"]), "world and tool exist already"),
        (set_value("frames", value=[["cup"]]), "frames[0] should be a valid string"),
        (set_value("inputs", value=True), "inputs should be a valid integer"),
        (set_value("name", value={"a": 1}), "name should be a valid string"),
        (set_value("name", value="two\nlines"), "short text"),
        (set_value("initial_state", value=["far"]), "initial_state should be a valid string"),
        (set_value("states", "a\tb", value={}), "can't name anything"),
        (set_value("states", value={f"s{i}": FINAL_STATE for i in range(31)}), "at most 30"),
        (set_value(*FAR, "active_constraints", value=[{**HALF_SPACE, "normal": [0, 0, 1]}] * 31), "at most 30"),
        (set_value(*CONSTRAINT, "kind", value=["cylinder"]), "unknown kind"),
        (set_value(*RADIUS, value=int("9" * 400)), "not arithmetic"),
        (set_value(*RADIUS, value="9" * 199), "at most a million"),
        (set_value(*RADIUS, value="1e309"), "finite"),
        (set_value(*RADIUS, value=2e6), "at most a million"),
        (set_value(*RADIUS, value="2001-99-99x"), "not arithmetic"),
        (set_value(*RADIUS, value="(" * 150), "not arithmetic"),
        (set_value(*RADIUS, value="1+" * 20_000 + "1"), "too long"),
        (set_value(*RADIUS, value="True"), "is not a number"),
        (set_value(*RADIUS, value="1j"), "is not a number"),
        (set_value(*RADIUS, value="2 ** 9999"), "is not a number"),
        (set_value(*RADIUS, value="a\0b"), "not arithmetic"),
        (set_value(*RADIUS, value=[[[["x"] * 99] * 9] * 9]), "must be a number"),
        (set_value(*MAPPING, "inputs", value=[True, False]), "valid integer"),
        (set_value(*MAPPING, value={**TRANSLATION, "inputs": [], "axes": []}), "at least one"),
        (set_value(*MAPPING, value={**TRANSLATION, "axes": [[1, 0], [0, 1]]}), "three numbers"),
        (set_value(*MAPPING, value={**TILT_TOWARDS, "frame": "tool"}), "or world, not tool"),
        (set_value(*CONSTRAINT, value={**HALF_SPACE, "normal": [1e-9, 0, 0]}), "must not be zero"),
        (set_value(*CONSTRAINT, value={**HALF_SPACE, "normal": [0.1] * 3000}), "three numbers"),
        (set_value(*CONSTRAINT, value={**FIXED_ORIENTATION, "rpy_deg": [0, 0]}), "three numbers"),
        (set_value(*CONSTRAINT, value={**TILT_LIMITS, "rpy_deg": [0]}), "three numbers"),
        (set_value(*CONSTRAINT, value={**TILT_BY_DISTANCE, "rpy_deg": []}), "three numbers"),
        (set_value(*FAR, "transition_distance", value={"kind": "distance", "frame": "cup", "point_m": [0]}), "three"),
        (set_value(*FAR, "transition_distance", value={**TILT_TO_GO, "rpy_deg": [0]}), "three"),
        (set_value(*FAR, "transitions", 0, "to", value=["near"]), "to should be a valid string"),
        (set_value(*FAR, "transitions", value=[]), "ends_at_m is missing"),
        (set_value(*FAR, "transitions", value=None), "transitions should be a valid list"),
        (set_value("parameters", "rim m", value=1), "parameters: 'rim m' can't name a parameter; use letters"),
        (set_value("parameters", "ﬁ", value=1), "parameters: 'ﬁ' can't name a parameter"),
        (set_value("states", "", value={}), "states: '' can't name anything"),
        (set_value(*CONSTRAINT, "kind", value=None), "active_constraints[0] has no kind; give it one"),
        (set_value(*FAR, "transitions", 0, "below_m", value=-0.012), "below_m must be positive"),
        (set_value(*FAR, "transitions", 0, "below_m", value=0), "below_m must be positive"),
        (set_value(*FAR, "transitions", 0, "to", value="far"), "must lead to another state, not to far itself"),
    ],
)
def test_parse_names_the_invalid_field_in_one_line(change, message):
    with pytest.raises(InputError) as error:
        parse_template(edit_template(change))
    assert message in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 500


def test_parse_refuses_parameters_that_are_not_numbers():
    for value in (None, [0.04], True, float("nan"), 1e300, 10**400):
        with pytest.raises(InputError, match="rim_m"):
            parse_template(TEMPLATE, rim_m=value)
    assert parse_template(TEMPLATE, rim_m=np.float32(0.25)).parameters["rim_m"] == 0.25


def test_parse_refuses_ambiguous_or_large_yaml():
    for text in ("inputs: 010", "inputs: 2001-99-99", "inputs: 2\ninputs: 3", "inputs: !!int 2", "inputs: 1:30"):
        with pytest.raises(InputError):
            parse_template(TEMPLATE.replace("inputs: 2", text, 1))
    with pytest.raises(InputError, match="more than 10000"):
        parse_template(f"{TEMPLATE}\nentries: [{'x, ' * 10_001}]")


def test_load_refuses_unknown_names_and_invalid_files(tmp_path):
    with pytest.raises(InputError, match="did you mean pouring"):
        load_template("puoring")
    with pytest.raises(InputError, match="there is no template"):
        load_template(tmp_path / "missing.yaml")
    with pytest.raises(InputError, match="no parameter"):
        load_template("pouring", mug_size_m=0.1)
    broken = tmp_path / "broken.yaml"
    broken.write_text("name: [")
    with pytest.raises(InputError, match="not YAML"):
        load_template(broken)


def test_parse_refuses_a_parameter_that_depends_on_another():
    with pytest.raises(InputError, match=r"parameters.near: 'far' is not a number, and a parameter can't be computed"):
        parse_template(
            "{name: x, inputs: 1, parameters: {near: far, far: 1}, max_speed_m_per_s: 1, "
            "max_speed_rad_per_s: 1, states: {}}"
        )
