"""Behavior of the gantry station with joint springs and with a Cartesian controller."""

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.stations import gantry
from guiderail.diagrams.stations.gantry import GantryStation, max_stable_time_step
from guiderail.diagrams.stations.station import CONTROL_PERIOD, INPUTS, PLANT_PERIOD, Impedance
from guiderail.diagrams.tasks.bnc_connector.task import BncWorkcell
from guiderail.models.common.errors import InputError
from research.benchmarks.impedance import step_response

WORKCELL = BncWorkcell()
CONTROLS = ("joint", "cartesian")
STIFFNESS = np.array(Impedance().stiffness)


class Held:
    """Gantry with its jack far away, which holds a pose while a wrench acts on its tool."""

    def __init__(self, pose, control, impedance=None, time_step=None):
        self.station = GantryStation(
            WORKCELL,
            impedance or Impedance(),
            time_step,
            impedance_control=control,
            control_period=2 * time_step if time_step else CONTROL_PERIOD,
        )
        self.plant = self.station.plant
        self.simulator = Simulator(self.station)
        self.context = self.simulator.get_mutable_context()
        self.plant_context = self.plant.GetMyMutableContextFromRoot(self.context)
        WORKCELL.set_fixture_offset(self.plant, self.plant_context, RigidTransform([0.0, 0.0, -0.5]))
        self.push(np.zeros(6))
        self.station.get_desired_pose_input_port().FixValue(self.context, pose)
        self.station.set_pose(self.context, pose)
        self.simulator.Initialize()

    def push(self, wrench):
        applied = ExternallyAppliedSpatialForce()
        applied.body_index = self.plant.GetBodyByName("tool_center").index()
        applied.p_BoBq_B = np.zeros(3)
        applied.F_Bq_W = SpatialForce(tau=np.array(wrench[3:], dtype=float), f=np.array(wrench[:3], dtype=float))
        self.plant.get_applied_spatial_force_input_port().FixValue(self.plant_context, Value([applied]))

    def advance(self, seconds):
        self.simulator.AdvanceTo(self.context.get_time() + seconds)

    def out(self, name):
        return self.station.GetOutputPort(name).Eval(self.context)

    @property
    def speeds(self):
        return np.abs(self.plant.GetVelocities(self.plant_context))


@pytest.mark.parametrize("control", CONTROLS)
def test_static_displacement_equals_compliance_times_wrench(control):
    held = Held(np.array([0.01, -0.02, 0.05, 0.0, 0.0, 0.0]), control)
    before = held.out("pose").copy()
    wrench = np.array([6.0, -4.0, 8.0, 0.3, -0.2, 0.4])
    held.push(wrench)
    held.advance(1.5)
    moved = held.out("pose") - before
    expected = wrench[[0, 1, 2, 5, 4, 3]] / STIFFNESS
    np.testing.assert_allclose(moved, expected, rtol=0.02)
    assert held.out("contact_force")[0] == pytest.approx(np.linalg.norm(wrench[:3]), rel=0.01)
    assert held.out("saturation")[0] == 0.0


def test_step_responses_of_both_controls_agree():
    """At a fine time step: angles within 5 % of the step, positions within 2 %, and all within 1 % after 0.1 s."""
    own, controlled = (np.array(step_response(control, 0.00125)["response"]) for control in CONTROLS)
    assert np.abs(own - controlled).max() < 0.05
    assert np.abs(own - controlled)[:, :3].max() < 0.02
    assert np.abs(own - controlled)[4:].max() < 0.01
    assert controlled.max() < 1.001  # critically damped: no overshoot


def test_force_is_limited():
    held = Held(np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.0]), "cartesian")
    held.push([60.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    held.advance(0.2)
    assert held.out("saturation")[0] == 1.0
    assert held.out("contact_force")[0] == pytest.approx(40.0)


def test_ports_are_equal_for_both_controls():
    own, controlled = (GantryStation(WORKCELL, impedance_control=control) for control in CONTROLS)
    for count, get in (("num_input_ports", "get_input_port"), ("num_output_ports", "get_output_port")):
        names = [[getattr(s, get)(i).get_name() for i in range(getattr(s, count)())] for s in (own, controlled)]
        assert names[0] == names[1]
    assert controlled.num_input_ports() == len(INPUTS)
    assert controlled.HasSubsystemNamed("controller")
    assert not own.HasSubsystemNamed("controller")


def fastest_after_a_push(impedance, time_step):
    held = Held(np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.0]), "cartesian", impedance, time_step)
    held.push([2.0, 1.0, -1.0, 0.2, 0.1, 0.3])
    held.advance(20 * time_step)
    held.push(np.zeros(6))
    held.advance(120 * time_step)
    return held.speeds.max()


@pytest.mark.parametrize("impedance", [Impedance(), Impedance(damping_ratio=0.4)])
def test_station_raises_when_the_time_step_is_unstable(impedance, monkeypatch):
    longest = max_stable_time_step(impedance)
    with pytest.raises(InputError, match="too long for impedance_control='cartesian'"):
        GantryStation(WORKCELL, impedance, longest, impedance_control="cartesian", control_period=2 * longest)
    assert fastest_after_a_push(impedance, 0.95 * longest) < 0.01
    monkeypatch.setattr(gantry, "_check_time_step", lambda impedance, time_step: None)
    assert fastest_after_a_push(impedance, 1.1 * longest) > 1.0  # unstable up to the limits


def test_environment_selects_the_impedance_control():
    env = make_env("BncConnector", impedance_control="cartesian")
    station = env.task.diagram.GetSubsystemByName("station")
    assert station.HasSubsystemNamed("controller")
    assert station.plant.time_step() == PLANT_PERIOD / 2
    with pytest.raises(InputError, match="did you mean cartesian"):
        make_env("BncConnector", impedance_control="cartesan")
    with pytest.raises(InputError, match="is too long for impedance_control"):
        make_env("BncConnector", impedance_control="cartesian", time_step=0.02)
    with pytest.raises(InputError, match="it is an option of station='gantry'"):
        make_env("BncConnector", station="arm", impedance_control="cartesian")


def test_unknown_impedance_control_is_refused():
    with pytest.raises(InputError, match="impedance_control must be joint or cartesian, not 'force'"):
        GantryStation(WORKCELL, impedance_control="force")
