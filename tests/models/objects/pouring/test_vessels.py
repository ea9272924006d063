"""Vessels: balls do not pass through the wall or the bottom, and leave through the opening."""

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from guiderail.models.common.errors import InputError
from guiderail.models.objects.pouring import MUG, THERMOS, Ball, Vessel, add_ball, add_vessel


def drop_ball(vessel, gravity, duration=0.4):
    """Return the position [m] of a ball in the vessel's tip frame after `duration` [s] with gravity (3,) [m/s²]."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(
        MultibodyPlantConfig(time_step=0.005, contact_model="point", discrete_contact_approximation="lagged"), builder
    )
    body = add_vessel(plant, "vessel", vessel, (1, 1, 1, 1))
    plant.WeldFrames(plant.world_frame(), body.body_frame())
    ball = add_ball(plant, "ball", Ball(), (1, 1, 1, 1))
    plant.mutable_gravity_field().set_gravity_vector(gravity)
    plant.Finalize()
    simulator = Simulator(builder.Build())
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    plant.SetFloatingBaseBodyPoseInWorldFrame(context, ball, RigidTransform([0, 0, -vessel.depth / 2]))
    simulator.AdvanceTo(duration)
    return plant.EvalBodyPoseInWorld(context, ball).translation()


@pytest.mark.parametrize("vessel", [THERMOS, MUG])
@pytest.mark.parametrize("angle", np.deg2rad([0.0, 11.25, 90.0, 200.0]))
def test_wall_contains_balls(vessel, angle):
    # 0° points at the middle of a box, 11.25° at the edge between two boxes; 30 m/s² is three times gravity.
    p = drop_ball(vessel, 30.0 * np.array([np.cos(angle), np.sin(angle), -0.1]))
    assert np.hypot(p[0], p[1]) < vessel.inner_diameter / 2
    assert vessel.contains(p)


def test_bottom_contains_balls():
    p = drop_ball(THERMOS, np.array([0.0, 0.0, -30.0]))
    assert p[2] == pytest.approx(-THERMOS.depth + 0.02, abs=2e-3)


def test_opening_releases_balls_when_gravity_points_up():
    assert drop_ball(THERMOS, np.array([0.0, 0.0, 9.81]))[2] > 0.02


def test_boxes_of_the_wall_are_between_its_radii():
    radius = THERMOS.inner_diameter / 2
    for X_TG, box in THERMOS.boxes():
        corners = [X_TG @ (np.array(s) * box.size() / 2) for s in np.ndindex(2, 2, 2) for s in [2 * np.array(s) - 1]]
        radii = [np.hypot(p[0], p[1]) for p in corners]
        assert min(radii) >= radius - 1e-12
        assert max(radii) <= THERMOS.outer_radius + 1e-12


def test_contains_is_true_inside_only():
    assert MUG.contains(np.array([0.0, 0.0, -0.01]))
    assert not MUG.contains(np.array([0.0, 0.0, 0.01]))
    assert not MUG.contains(np.array([0.041, 0.0, -0.05]))
    assert MUG.contains(np.array([0.041, 0.0, -0.05]), margin=0.002)


def test_volume_of_the_mug_exceeds_three_times_two_balls():
    volume = MUG.depth * np.pi * (MUG.inner_diameter / 2) ** 2
    assert volume > 3 * 2 * np.pi / 6 * Ball().diameter ** 3  # three times, because balls leave gaps


@pytest.mark.parametrize(
    "dimensions", [{"inner_diameter": 0.0}, {"depth": -1.0}, {"wall": float("nan")}, {"mass": np.inf}]
)
def test_vessel_refuses_invalid_dimensions(dimensions):
    with pytest.raises(InputError, match=next(iter(dimensions))):
        Vessel(**({"inner_diameter": 0.05, "depth": 0.1} | dimensions))
