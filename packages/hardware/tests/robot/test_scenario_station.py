"""Stations from scenario files: motion, wrench, and refused files."""

from pathlib import Path

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail_hardware.scenario_station import load_station

EXAMPLE = Path(__file__).parents[4] / "examples" / "press.station.yaml"
ABOVE = np.array([0.0, 0.0, 0.03, 0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def station():
    return load_station(EXAMPLE)


def run(station, desired, seconds):
    """Return the context of a simulation that began at `ABOVE` with a desired pose."""
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    station.set_pose(context, ABOVE)
    station.get_desired_pose_input_port().FixValue(context, desired)
    simulator.AdvanceTo(seconds)
    return context


def test_arm_reaches_a_pose_in_free_space(station):
    desired = ABOVE + [0.01, -0.01, 0.02, 0.1, 0.05, 0.0]
    context = run(station, desired, 2.0)
    np.testing.assert_allclose(station.get_pose_output_port().Eval(context), desired, atol=2e-3)
    np.testing.assert_allclose(station.get_wrench_output_port().Eval(context), 0.0, atol=0.2)


def test_wrench_of_a_pressed_tool_is_the_force_of_its_spring(station):
    context = run(station, ABOVE - [0.0, 0.0, 0.04, 0.0, 0.0, 0.0], 2.0)
    pose = station.get_pose_output_port().Eval(context)
    spring = 1000.0 * (pose[2] + 0.01)  # stiffness times distance to the desired height
    assert 3.0 < spring < 30.0
    assert station.get_wrench_output_port().Eval(context)[2] == pytest.approx(spring, rel=0.1)
    results = station.GetOutputPort("contact_results").Eval(context)
    assert results.num_hydroelastic_contacts() + results.num_point_pair_contacts() > 0


def test_periods_are_those_of_the_file(station):
    assert station.plant.time_step() == pytest.approx(0.002)
    assert station.control_period == pytest.approx(0.02)
    assert station.control_period == 10 * station.plant.time_step()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("model: iiwa", "model: panda", "no model 'panda', only"),
        ("tool_center: tool::tool_center", "tool_center: tool::tip", "no frame 'tool::tip', which arm.tool_center"),
        ("target: target", "target: tool::tool_center", "can move"),
        ("time_step: 0.002", "time_step: 0.0", "time_step above 0"),
        ("time_step: 0.002", "time_step: 0.003", "whole multiple of 0.003 s"),
        ("damping_ratio: 1.0", "damping_ratio: -1.0", "damping_ratio must be positive"),
        ("arm:", "arms:", "is no scenario of a station"),
        ("iiwa14.urdf", "iiwa99.urdf", "directives can't be processed"),
        ("tool: [tool, stamp]", "tool: [plate]", "'plate' is not welded to the model 'iiwa'"),
    ],
)
def test_wrong_file_is_refused(tmp_path, old, new, message):
    text = EXAMPLE.read_text()
    assert old in text
    file = tmp_path / "station.yaml"
    (tmp_path / "press").mkdir()
    for each in (EXAMPLE.parent / "press").iterdir():
        (tmp_path / "press" / each.name).write_bytes(each.read_bytes())
    file.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=message):
        load_station(file)
