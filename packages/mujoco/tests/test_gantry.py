"""MuJoCo gantry as a system; `packages/mujoco/tests/test_station.py` tests the physics."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

pytest.importorskip("mujoco")

from guiderail.diagrams.stations.station import PLANT_PERIOD, Impedance
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.diagrams.tasks.grid_clamp import GridClampWorkcell
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import MM
from guiderail_mujoco.gantry import EngineGantry, MovedBodies
from guiderail_mujoco.station import MujocoStation

FREE = np.array([0.0, 0.0, 0.05, 0.3, 0.0, 0.0])  # pose 50 mm above the jack


@pytest.fixture(scope="module")
def station():
    return MujocoStation(BncWorkcell())


def simulate(station, desired, steps):
    """Return the context after plant steps with a desired pose, from the pose `FREE`."""
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    station.set_pose(context, FREE)
    station.get_desired_pose_input_port().FixValue(context, desired)
    simulator.Initialize()
    simulator.AdvanceTo(steps * PLANT_PERIOD)
    return context


def test_tool_reaches_a_pose_in_free_space_without_wrench(station):
    desired = FREE + [0.01, -0.005, 0.01, 0.2, 0.05, -0.05]
    context = simulate(station, desired, 60)
    np.testing.assert_allclose(station.get_pose_output_port().Eval(context), desired, atol=1e-5)
    np.testing.assert_allclose(station.get_wrench_output_port().Eval(context), 0.0, atol=1e-9)


def test_motor_forces_are_within_their_limits(station):
    context = simulate(station, FREE + [1.0, 0.0, 0.0, 0.0, 0.0, 0.0], 1)
    wrench = station.gantry.get_impedance_wrench_output_port().Eval(station.gantry.GetMyContextFromRoot(context))
    assert wrench[0] == pytest.approx(Impedance().limits[0])


def test_simulation_is_bitwise_equal_after_restoring_its_state(station):
    context = simulate(station, FREE - [0.0, 0.0, 0.04, 0.0, 0.0, 0.0], 20)
    copy = station.CreateDefaultContext()
    station.get_desired_pose_input_port().FixValue(copy, FREE)
    station.get_desired_pose_input_port().FixValue(context, FREE)
    copy.SetTimeStateAndParametersFrom(context)
    simulate(station, FREE, 5)  # another simulation in between
    poses = []
    for root in (context, copy):
        simulator = Simulator(station, root)
        simulator.reset_context(root)
        simulator.AdvanceTo(root.get_time() + 10 * PLANT_PERIOD)
        poses.append(station.get_pose_output_port().Eval(root))
    np.testing.assert_array_equal(*poses)


def penetration(workcell, modulus):
    """Return the penetration [m] into the table of a clamp next to its holes under 19.5 N.

    Args:
        workcell: Workcell of the clamp.
        modulus: Factor of the contact stiffness.
    """
    station = MujocoStation(workcell)
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    top = np.array([2.0 * MM, 1.5 * MM, 12.0 * MM, 0.0, 0.0, 0.0])
    desired = top - [0.0, 0.0, 19.5 / Impedance().stiffness[2], 0.0, 0.0, 0.0]
    station.set_pose(context, top)
    station.set_contact(context, 1.0, modulus)
    station.get_desired_pose_input_port().FixValue(context, desired)
    simulator.Initialize()
    simulator.AdvanceTo(1.0)
    assert station.get_wrench_output_port().Eval(context)[2] == pytest.approx(19.5, abs=0.01)
    return top[2] - station.get_pose_output_port().Eval(context)[2]


def test_contact_stiffness_scales_with_the_modulus():
    workcell = GridClampWorkcell()
    nominal = penetration(workcell, 1.0)
    for modulus in (0.1, 3.0, 10.0, 30.0):
        assert penetration(workcell, modulus) * modulus == pytest.approx(nominal, rel=1e-2)


def test_model_is_unchanged_by_an_earlier_higher_modulus(station):
    model = station.gantry.engine.model
    names = ("jnt_stiffness", "dof_damping", "geom_solref", "geom_friction")
    before = {name: getattr(model, name).copy() for name in names} | {"timestep": model.opt.timestep}
    for factors in ((0.5, 7.0), (1.0, 1.0)):
        simulator = Simulator(station)
        context = simulator.get_mutable_context()
        station.set_pose(context, FREE)
        station.set_contact(context, *factors)
        station.get_desired_pose_input_port().FixValue(context, FREE)
        simulator.Initialize()
        simulator.AdvanceTo(PLANT_PERIOD)
    after = {name: getattr(model, name) for name in names} | {"timestep": model.opt.timestep}
    for name, value in before.items():
        np.testing.assert_array_equal(after[name], value)


@pytest.mark.parametrize(
    ("factors", "words"),
    [
        *(((factor, 1.0), "friction must be finite and not negative") for factor in (-0.1, np.nan, np.inf)),
        *(((1.0, factor), "stiffness must be finite and positive") for factor in (0.0, -1.0, np.nan, np.inf)),
    ],
)
def test_contact_factors_are_refused_out_of_range(station, factors, words):
    context = station.CreateDefaultContext()
    with pytest.raises(InputError, match=words):
        station.set_contact(context, *factors)
    station.set_contact(context, 0.0, 1e-3)


@pytest.mark.parametrize(("period", "constant"), [(PLANT_PERIOD * 1.0001, 0.0), (PLANT_PERIOD, -1.0), (0.0, 0.0)])
def test_constructor_refuses_arguments_out_of_range(station, period, constant):
    plant = station.plant
    moved = MovedBodies(*(plant.GetBodyByName(name) for name in ("jack", "tool_center", "plug")))
    with pytest.raises(InputError):
        EngineGantry(station.gantry.engine, Impedance(), plant, moved, BncWorkcell().X_WT, period, constant)
