"""Gantry station with both impedances: springs in the joints, and a Cartesian controller."""

import numpy as np
import pytest
from pushed_station import PushedStation

from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.stations import gantry
from guiderail.diagrams.stations.gantry import GantryStation, max_stable_time_step
from guiderail.diagrams.stations.station import CONTROL_PERIOD, INPUTS, PLANT_PERIOD, Impedance
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.errors import InputError
from research.benchmarks.impedance import step_response

WORKCELL = BncWorkcell()
CONTROLS = ("joint", "cartesian")
STIFFNESS = np.array(Impedance().stiffness)


class PushedGantry(PushedStation):
    """Gantry station that holds a pose while a wrench acts on its tool."""

    def __init__(self, pose, control, impedance=None, time_step=None):
        station = GantryStation(
            WORKCELL,
            impedance or Impedance(),
            time_step,
            impedance_control=control,
            control_period=2 * time_step if time_step else CONTROL_PERIOD,
        )
        super().__init__(station, WORKCELL, pose)

    def read(self, port):
        return self.station.GetOutputPort(port).Eval(self.context)


@pytest.mark.parametrize("control", CONTROLS)
def test_static_displacement_equals_compliance_times_wrench(control):
    gantry_station = PushedGantry(np.array([0.01, -0.02, 0.05, 0.0, 0.0, 0.0]), control)
    before = gantry_station.read("pose").copy()
    wrench = np.array([6.0, -4.0, 8.0, 0.3, -0.2, 0.4])
    gantry_station.push(wrench)
    gantry_station.advance(1.5)
    expected = wrench[[0, 1, 2, 5, 4, 3]] / STIFFNESS  # angles about z, y, x
    np.testing.assert_allclose(gantry_station.read("pose") - before, expected, rtol=0.02)
    assert gantry_station.read("impedance_force")[0] == pytest.approx(np.linalg.norm(wrench[:3]), rel=0.01)
    assert gantry_station.read("saturation")[0] == 0.0


def test_step_responses_of_both_impedances_agree():
    """At a time step of 1 ms, responses relative to the step differ by little."""
    joint, cartesian = (np.array(step_response(control, 0.001)["response"]) for control in CONTROLS)
    difference = np.abs(joint - cartesian)
    assert difference.max() < 0.05
    assert difference[:, :3].max() < 0.02  # positions
    assert difference[4:].max() < 0.01  # from 0.1 s on
    assert cartesian.max() < 1.001  # no overshoot at critical damping


def test_force_is_limited():
    gantry_station = PushedGantry(np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.0]), "cartesian")
    gantry_station.push([60.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    gantry_station.advance(0.2)
    assert gantry_station.read("saturation")[0] == 1.0
    assert gantry_station.read("impedance_force")[0] == pytest.approx(40.0)


def test_stations_with_both_impedances_have_equal_ports():
    joint, cartesian = (GantryStation(WORKCELL, impedance_control=control) for control in CONTROLS)
    for count, get in (("num_input_ports", "get_input_port"), ("num_output_ports", "get_output_port")):
        names = [[getattr(s, get)(i).get_name() for i in range(getattr(s, count)())] for s in (joint, cartesian)]
        assert names[0] == names[1]
    assert cartesian.num_input_ports() == len(INPUTS)
    assert cartesian.HasSubsystemNamed("controller")
    assert not joint.HasSubsystemNamed("controller")


def speed_after_push(impedance, time_step):
    """Return the largest joint speed [m/s] or [rad/s] 120 time steps after a push of 20 time steps."""
    gantry_station = PushedGantry(np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.0]), "cartesian", impedance, time_step)
    gantry_station.push([2.0, 1.0, -1.0, 0.2, 0.1, 0.3])
    gantry_station.advance(20 * time_step)
    gantry_station.push(np.zeros(6))
    gantry_station.advance(120 * time_step)
    return gantry_station.max_speed


@pytest.mark.parametrize("impedance", [Impedance(), Impedance(damping_ratio=0.4)])
def test_station_raises_when_the_time_step_is_unstable(impedance, monkeypatch):
    longest = max_stable_time_step(impedance)
    with pytest.raises(InputError, match="too long for impedance_control='cartesian'"):
        GantryStation(WORKCELL, impedance, longest, impedance_control="cartesian", control_period=2 * longest)
    assert speed_after_push(impedance, 0.95 * longest) < 0.01
    monkeypatch.setattr(gantry, "_check_time_step", lambda impedance, time_step: None)
    assert speed_after_push(impedance, 1.1 * longest) > 1.0  # unstable: growing oscillation


def test_environment_selects_the_impedance_control():
    env = make_env("BncConnector", impedance_control="cartesian")
    station = env.diagram.diagram.GetSubsystemByName("station")
    assert station.HasSubsystemNamed("controller")
    assert station.plant.time_step() == PLANT_PERIOD / 2
    with pytest.raises(InputError, match="did you mean cartesian"):
        make_env("BncConnector", impedance_control="cartesan")
    with pytest.raises(InputError, match="is too long for impedance_control"):
        make_env("BncConnector", impedance_control="cartesian", time_step=0.02)
    with pytest.raises(InputError, match="it is an option of station='gantry'"):
        make_env("BncConnector", station="arm", impedance_control="cartesian")
