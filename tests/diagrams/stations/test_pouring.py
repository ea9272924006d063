"""Pouring station with an arm of six joints."""

import numpy as np
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.stations.pouring import MID_POURING_POSE, PouringConfig, PouringStation

UPRIGHT = np.array([-0.15, -0.20, 0.15, 0.0, 0.0, 0.0])
TILTED = MID_POURING_POSE + [0.0, 0.0, 0.0, 0.0, 0.0, -1.2]


def test_six_joint_arm_tilts_the_thermos_over_the_mug():
    """The drives track a straight line from the start of an episode to a pouring tilt."""
    station = PouringStation(PouringConfig(robot="ur5e"))
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    station.set_pose(context, UPRIGHT)
    desired = station.GetInputPort("desired_pose").FixValue(context, UPRIGHT)
    simulator.Initialize()
    pose, balls = station.GetOutputPort("pose"), station.GetOutputPort("balls_in_thermos")
    np.testing.assert_allclose(pose.Eval(context), UPRIGHT, atol=1e-9)
    errors = []
    for step in range(1, 401):
        command = UPRIGHT + min(1.0, step / 300) * (TILTED - UPRIGHT)
        desired.GetMutableData().set_value(command)
        simulator.AdvanceTo(0.01 * step)
        errors.append(np.abs(pose.Eval(context) - command)[:3].max())
        assert station.GetOutputPort("saturation").Eval(context)[0] == 0.0
        assert station.GetOutputPort("touched").Eval(context)[0] == 0.0
    assert max(errors) < 0.008  # tracking error of the position [m]
    np.testing.assert_allclose(pose.Eval(context), TILTED, atol=2e-3)
    assert balls.Eval(context)[2] > 0.0  # a ball has left the thermos through the tip
