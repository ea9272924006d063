"""Mutated template files: each is read exactly and has finite results, or is refused with one sentence."""

import copy
import dataclasses
import math
import re
from pathlib import Path

import numpy as np
import yaml
from hypothesis import example, given
from hypothesis import strategies as st

import guiderail.models.objects
from fuzz.changes import changed_texts, changed_trees
from fuzz.tally import attempt, few_inputs
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import RigidTransform, RotationMatrix
from guiderail.models.common.yaml import parse_yaml
from guiderail.models.templates import parse_template
from guiderail.models.templates.transitions import TransitionDistance
from oracles.files import template_numbers

TEXTS = [
    (Path(__file__).parents[2] / "models" / "templates" / "reach.yaml").read_text(),
    *(file.read_text() for file in sorted(Path(guiderail.models.objects.__path__[0]).glob("*/*.yaml"))),
    """
name: every_kind
inputs: 6
frames: [a, b]
max_speed_m_per_s: 1
max_speed_rad_per_s: 1
parameters: {p: 0.5, q: 2}
states:
  one:
    input_mapping:
      - {kind: rotation, inputs: [0, 1], axes: [[0, 0, 1], [1, p, 0]], speed_rad_per_s: q, frame: tool}
      - {kind: uneven, above: 0.1, below: 1, of: {kind: translation, inputs: [2, 3, 4], speed_m_per_s: 1}}
    active_constraints:
      - {kind: half_space, frame: a, normal: [0, p, 1], offset_m: -1}
      - {kind: box, lower_m: [-1, -1, -1], upper_m: [1, q, 1]}
      - {kind: funnel, frame: b, radius_m: 0.1, height_m: 0.2, slope: 1}
      - {kind: keep_above, frame: b, height_m: -2, points_m: [[0, 0, 0.1], [0, 0, -0.1]]}
      - {kind: cylinder, frame: b, max_radius_m: p}
      - {kind: tilt_limits, frame: a, min_deg: 0, max_deg: 10 * q}
    transition_distance: {kind: tilt_to_go, until_deg: 90, frame: a}
    starts_at_deg: 90
    weight_per_deg: 0.1
    transitions: [{to: two, below_deg: 5 * q}]
  two:
    input_mapping: []
    active_constraints: []
    transition_distance: {kind: height, frame: b}
    starts_at_m: 1
    ends_at_m: -1
""",
]
TREES = [yaml.safe_load(text) for text in TEXTS]


def assert_numbers(template, text):
    """Assert that every number equals the number that an independent reader finds at the same place in the file."""
    result = template_numbers(text)
    data = parse_yaml(text)
    for name, value in template.parameters.items():
        assert value == result["parameters", name]
    assert template.inputs == result["inputs",]
    assert template.max_speed_m_per_s == result["max_speed_m_per_s",]
    assert template.max_speed_rad_per_s == result["max_speed_rad_per_s",]
    assert [state.name for state in template.states] == list(data["states"])
    for state, entry in zip(template.states, data["states"].values(), strict=True):
        place = ("states", state.name)
        unit = state.transition_distance.unit
        si = math.pi / 180 if unit == "deg" else 1.0
        assert state.starts_at == si * result[*place, f"starts_at_{unit}"]
        if f"ends_at_{unit}" in entry:
            assert state.ends_at == si * result[*place, f"ends_at_{unit}"]
        assert state.weight == result.get((*place, f"weight_per_{unit}"), 1.0 * si) / si
        for number, transition in enumerate(state.transitions):
            transition_place = (*place, "transitions", str(number))
            assert transition.below == si * result[*transition_place, f"below_{unit}"]
            assert transition.hysteresis == _scaled(si, result.get((*transition_place, f"hysteresis_{unit}")))
        for field in ("input_mapping", "active_constraints"):
            parts = getattr(state, field)
            assert len(parts) == len(entry[field])
            for number, part in enumerate(parts):
                assert_fields(part, entry[field][number], (*place, field, str(number)), result)
        assert_fields(state.transition_distance, entry["transition_distance"], (*place, "transition_distance"), result)


def _scaled(si, value):
    return None if value is None else si * value


def assert_fields(part, entry, place, found):
    """Assert the fields of a part of a template against its entry in the file and the numbers `found` by the reader."""
    assert set(entry) - {"kind"} <= {field.name for field in dataclasses.fields(part)}
    for key, value in entry.items():
        if key == "of":
            assert_fields(part.of, value, (*place, "of"), found)
        elif key != "kind":
            assert_value(getattr(part, key), value, (*place, key), found)


def assert_value(value, entry, place, found):
    """Assert a value against its entry in the file; numbers against those `found` by the independent reader."""
    if isinstance(value, tuple):
        assert len(value) == len(entry)
        for number, (inner, inner_entry) in enumerate(zip(value, entry, strict=True)):
            assert_value(inner, inner_entry, (*place, str(number)), found)
    elif isinstance(value, str | bool):
        assert value is entry or value == entry
    else:
        assert value == found[place]


def assert_laws_are_finite(template):
    """Assert that all laws of all states return finite values, at a pose near the object and at a distant pose."""
    X_WF = {
        name: RigidTransform(RotationMatrix.MakeZRotation(0.3 + i), [0.5, 0.1 * i, 0.1])
        for i, name in enumerate(template.frames)
    }
    inputs = np.linspace(-1.0, 1.5, template.inputs)
    for X_WE in (RigidTransform(RotationMatrix.MakeXRotation(0.4), [0.4, 0.0, 0.3]), RigidTransform()):
        state = template.state_at(X_WE, X_WF)
        assert 0 <= state < len(template.states)
        for number in range(len(template.states)):
            request = template.displace(X_WE, template.map(number, inputs, X_WE, X_WF, 0.01))
            command = template.command(number, X_WE, request, X_WF, 0.01)
            for X in (request, command.X_WE, template.project(number, X_WE, X_WF)):
                assert np.isfinite(X.GetAsMatrix34()).all()
            assert math.isfinite(template.violation(number, X_WE, X_WF))
            assert math.isfinite(template.progress(number, X_WE, X_WF))
            assert 0 <= template.next_state(number, X_WE, X_WF) < len(template.states)
            assert isinstance(template.states[number].transition_distance, TransitionDistance)


def assert_template_is_exact_or_refused(target, text):
    template = attempt(target, InputError, lambda: parse_template(text))
    if template is not None:
        assert_numbers(template, text)
        assert_laws_are_finite(template)


@few_inputs
@given(changed_trees(TREES))
@example(TREES[-1])
def test_template_with_changed_entries_is_exact_or_refused(tree):
    assert_template_is_exact_or_refused(
        "template, entries changed", yaml.safe_dump(tree, sort_keys=False, allow_unicode=True)
    )


@few_inputs
@given(changed_texts(TEXTS))
def test_template_with_changed_characters_is_exact_or_refused(text):
    assert_template_is_exact_or_refused("template, characters changed", text)


TOKENS = st.sampled_from(
    ["p", "q", "1", "2.5", "0", "1e3", "x", "(", ")", "+", "-", "*", "/", " ", "**", "%", "//", ".5"]
)


@few_inputs
@given(st.lists(TOKENS, max_size=12).map("".join))
def test_arithmetic_is_exact_or_refused(expression):
    tree = copy.deepcopy(TREES[-1])
    tree["max_speed_m_per_s"] = expression
    assert_template_is_exact_or_refused("template, arithmetic", yaml.safe_dump(tree, sort_keys=False))


# PyYAML writes the text "1e3" without quotes, which is a number in YAML 1.2.
WORDS = st.text(max_size=12).filter(lambda text: not re.fullmatch(r"[-+]?[0-9]+[eE][-+]?[0-9]+", text))
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | WORDS,
    lambda inside: st.lists(inside, max_size=4) | st.dictionaries(WORDS, inside, max_size=4),
    max_leaves=12,
)


@few_inputs
@given(VALUES)
def test_yaml_round_trip_is_exact(value):
    text = yaml.safe_dump(value)
    read = attempt("yaml, round trip", InputError, lambda: (parse_yaml(text),))
    if read is not None:
        assert read[0] == value
