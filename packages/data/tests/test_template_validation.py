"""Validation of templates: faults that parsing does not find, and drawings."""

from pathlib import Path

import pytest
import yaml

from guiderail.models.common.errors import InputError
from guiderail.models.templates import load_template, parse_template
from guiderail_data.template_drawing import draw, state_lines, to_dot
from guiderail_data.template_validation import validate

TEMPLATE = (Path(__file__).parents[3] / "tests/models/templates/reach.yaml").read_text()


def parse_changed(change=None, text=TEMPLATE):
    """Return a template after a function has changed its data in place."""
    data = yaml.safe_load(text)
    if change:
        change(data)
    return parse_template(yaml.safe_dump(data, sort_keys=False))


def validate_changed(change=None):
    return validate(parse_changed(change))


def errors(change):
    return [finding.message for finding in validate_changed(change) if finding.is_error]


@pytest.mark.parametrize(
    "name", ["pouring", "pouring_aimed", "pouring_shielded", "grid_clamp", "end_effector_velocity"]
)
def test_validate_finds_no_errors_in_shipped_templates(name):
    assert [f.message for f in validate(load_template(name)) if f.is_error] == []


def test_validate_returns_nothing_for_a_valid_template():
    assert validate_changed() == []


def test_validate_finds_an_unreachable_state():
    def change(data):
        data["states"]["unreachable"] = dict(data["states"]["near"])

    (message,) = errors(change)
    assert "unreachable" in message


def test_validate_finds_a_transition_blocked_by_constraints():
    def change(data):
        data["states"]["far"]["transitions"][0]["below_m"] = 0.05  # [m]; the cylinder's smallest radius is 0.06 m

    assert any("never fires" in message and "constraints" in message for message in errors(change))


def test_validate_finds_a_transition_that_no_input_reaches():
    def change(data):
        data["states"]["near"]["input_mapping"] = [{"kind": "translation", "inputs": [0, 1, 2], "speed_m_per_s": 0.1}]
        data["inputs"] = 3
        data["states"]["near"]["active_constraints"] = [
            {"kind": "tilt_limits", "frame": "cup", "min_deg": -20, "max_deg": 80}
        ]

    assert any("near: the end never fires" in message for message in errors(change))


def test_validate_finds_contradictory_constraints():
    def change(data):
        data["states"]["far"]["active_constraints"] += [
            {"kind": "keep_above", "frame": "cup", "height_m": 0.2},
            {"kind": "half_space", "frame": "cup", "normal": [0, 0, -1], "offset_m": -0.1},
        ]

    assert any("contradicts" in message and "KeepAbove" in message for message in errors(change))


def test_validate_finds_constraints_in_the_wrong_order():
    def change(data):
        # The orientation depends on the position, which the next constraint changes.
        data["states"]["far"]["active_constraints"].insert(
            0, {"kind": "tilt_by_distance", "frame": "cup", "distance_m": [0.1, 0.5], "tilt_deg": [60, 0]}
        )

    assert any("undone by a constraint after it" in message for message in errors(change))


def test_validate_warns_of_unused_inputs_and_frames():
    def change(data):
        data["inputs"] = 4
        data["frames"].append("saucer")

    messages = [finding.message for finding in validate_changed(change)]
    assert any("input 2" in message for message in messages)
    assert any("saucer" in message for message in messages)


@pytest.mark.parametrize("name", ['a "b" \\', "$x", "$\\frac{1", "ψ"])
def test_draw_quotes_names_of_states(tmp_path, name):
    def change(data):
        data["states"][name] = data["states"].pop("near")
        data["states"]["far"]["transitions"][0]["to"] = name

    template = parse_changed(change)
    draw(template, tmp_path / "a.png")
    # Quotes inside a quoted name are escaped, so the number of other quotes is even.
    for line in to_dot(template).splitlines():
        assert line.replace("\\\\", "").replace('\\"', "").count('"') % 2 == 0


def test_draw_shows_every_state_and_transition(tmp_path):
    template = load_template("pouring")
    dot = to_dot(template)
    assert all(f'"{state.name}"' in dot for state in template.states)
    assert dot.count("->") == 3  # two forward, and one back from tilt
    for suffix in (".dot", ".png"):
        draw(template, tmp_path / f"pouring{suffix}")
        assert (tmp_path / f"pouring{suffix}").stat().st_size > 100


def test_drawing_has_the_limits_of_a_state():
    limits = {"max_force_n": 10, "max_torque_nm": 0.5, "max_speed_m_per_s": 0.2, "max_speed_rad_per_s": 1.0}
    far, near = parse_changed(lambda data: data["states"]["far"].update(limits)).states
    assert state_lines(far)[-5:-1] == ["|f| ≤ 10 N", "|τ| ≤ 0.5 Nm", "|v| ≤ 0.2 m/s", "|ω| ≤ 1 rad/s"]
    assert not any("≤" in line for line in state_lines(near))


@pytest.mark.parametrize("ending", ["dot", "png", "svg"])
def test_draw_replaces_a_file_or_leaves_it_unchanged(ending, tmp_path, monkeypatch):
    template = load_template("pouring")
    draw(template, tmp_path / "new" / f"a.{ending}")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        draw(template, tmp_path / "file" / f"a.{ending}")

    def fail(*_):
        raise OSError(28, "No space left on device")

    before = (tmp_path / "new" / f"a.{ending}").read_bytes()
    monkeypatch.setattr("os.fsync", fail)
    with pytest.raises(InputError, match="No space left"):
        draw(load_template("grid_clamp"), tmp_path / "new" / f"a.{ending}")
    assert (tmp_path / "new" / f"a.{ending}").read_bytes() == before


def test_validate_warns_of_a_transition_that_waits():
    def change(data):
        data["states"]["near"]["active_constraints"].insert(
            0, {"kind": "cylinder", "frame": "cup", "max_radius_m": 0.01}
        )

    assert any("waits in" in finding.message and not finding.is_error for finding in validate_changed(change))


SLIDE_AND_LIFT = """
name: slide_lift
inputs: 3
frames: [edge]
max_speed_m_per_s: 0.2
max_speed_rad_per_s: 1.0
states:
  slide:
    input_mapping:
      - {kind: translation, inputs: [0, 1, 2], speed_m_per_s: 0.08, frame: edge}
    active_constraints:
      - {kind: box, frame: edge, lower_m: [-0.11, -0.004, 0], upper_m: [0.02, 0.004, 0.01]}
      - {kind: fixed_orientation, frame: edge}
    transition_distance: {kind: distance, frame: edge}
    starts_at_m: 0.1
    transitions:
      - {to: lift, below_m: 0.012}
  lift:
    input_mapping:
      - {kind: translation, inputs: [2], axes: [[0, 0, 1]], speed_m_per_s: 0.05, frame: edge}
    active_constraints:
      - {kind: cylinder, frame: edge, max_radius_m: 0.025}
      - {kind: half_space, frame: edge, normal: [0, 0, -1], offset_m: -0.09}
      - {kind: keep_above, frame: edge, height_m: 0}
      - {kind: fixed_orientation, frame: edge}
    transition_distance: {kind: distance, frame: edge, point_m: [0, 0, 0.08]}
    starts_at_m: 0.08
    ends_at_m: 0.014
"""


def validate_slide_and_lift(change=lambda slide: None):
    return validate(parse_changed(lambda data: change(data["states"]["slide"]), SLIDE_AND_LIFT))


def test_validate_searches_from_poses_of_the_previous_transition():
    # No input leads to the end of lift from poses farther from the axis than those at which slide ends.
    assert validate_slide_and_lift() == []


def test_validate_warns_of_inputs_that_reach_no_transition():
    def change(slide):
        slide["input_mapping"][0]["speed_m_per_s"] = 1e-9

    (finding,) = validate_slide_and_lift(change)
    assert "slide: the transition to lift was not reached" in finding.message
    assert not finding.is_error


def test_validate_warns_of_a_state_without_a_mapping():
    findings = validate_slide_and_lift(lambda slide: slide.update(input_mapping=[]))
    assert any("slide: the transition to lift was not reached" in finding.message for finding in findings)
    assert not any(finding.is_error for finding in findings)


def test_validate_warns_of_constraints_without_an_interior():
    def change(slide):
        slide["active_constraints"] = [
            {"kind": "box", "frame": "edge", "lower_m": [0.005, -0.05, 0], "upper_m": [0.02, 0.05, 0.01]},
            {"kind": "cylinder", "frame": "edge", "max_radius_m": 0.005},
        ]

    findings = validate_slide_and_lift(change)
    assert any("Box" in finding.message and "in all sampled poses" in finding.message for finding in findings)
    assert not any(finding.is_error for finding in findings)
