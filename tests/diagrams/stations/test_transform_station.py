"""Abstract ports of a station: equal motion, transforms and forces."""

import numpy as np
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.stations.gantry import GantryStation
from guiderail.diagrams.stations.wrapped_stations import TransformStation
from guiderail.diagrams.tasks.grid_clamp import GridClampWorkcell
from guiderail.systems.support.drake_multibody import pose_to_transform

START, GOAL = np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.0]), np.array([0.01, 0.0, 0.04, 0.2, 0.1, -0.1])


def test_station_with_abstract_ports_moves_equally():
    station = GantryStation(GridClampWorkcell())
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    station.set_pose(context, START)
    station.get_desired_pose_input_port().FixValue(context, GOAL)
    simulator.AdvanceTo(0.3)
    pose = station.get_pose_output_port().Eval(context)
    wrench = station.get_wrench_output_port().Eval(context)

    wrapped = TransformStation(GantryStation(GridClampWorkcell()))
    simulator = Simulator(wrapped)
    context = simulator.get_mutable_context()
    wrapped.set_pose(context, START)
    wrapped.get_desired_transform_input_port().FixValue(context, pose_to_transform(GOAL))
    simulator.AdvanceTo(0.3)
    np.testing.assert_allclose(wrapped.get_pose_output_port().Eval(context), pose, atol=1e-9)
    assert wrapped.get_transform_output_port().Eval(context).IsNearlyEqualTo(pose_to_transform(pose), 1e-9)
    force = wrapped.get_spatial_force_output_port().Eval(context)
    np.testing.assert_allclose(np.r_[force.translational(), force.rotational()], wrench, atol=1e-9)
    assert not wrapped.HasInputPort("desired_pose")
