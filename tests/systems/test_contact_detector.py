"""Contact detection for a ball that falls onto a plate or next to the plate."""

import numpy as np
import pytest
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    Box,
    ProximityProperties,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlantConfig
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from guiderail.systems.wrench_signals import ContactDetector

STEP = 2.0**-9  # of the plant and of the detector [s]
RADIUS = 0.02  # of the ball [m]


def properties(compliant=False, hydroelastic=False):
    """Return the proximity properties of a body."""
    material = ProximityProperties()
    AddContactMaterial(dissipation=0.1, point_stiffness=1e4, friction=CoulombFriction(0.5, 0.5), properties=material)
    if hydroelastic and compliant:
        AddCompliantHydroelasticProperties(0.01, 1e6, material)
    elif hydroelastic:
        AddRigidHydroelasticProperties(0.01, material)
    return material


def drop(
    x, height=0.05, sampled=False, hydroelastic=False, duration=0.3, mass=0.1, bodies=("ball",), obstacles=("plate",)
):
    """Return collision, has_collided and contact force [N] at each step, (n, 3), for a ball dropped at `x` [m].

    The plate ends at x = 0.1 m, and the floor is 0.09 m below the top of the plate.
    """
    builder = DiagramBuilder()
    model = "hydroelastic_with_fallback" if hydroelastic else "point"
    config = MultibodyPlantConfig(
        time_step=STEP, contact_model=model, discrete_contact_approximation="lagged", use_sampled_output_ports=sampled
    )
    plant, _ = AddMultibodyPlant(config, builder)
    ball = plant.AddRigidBody("ball", SpatialInertia.SolidSphereWithMass(mass, RADIUS))
    plant.RegisterCollisionGeometry(ball, RigidTransform(), Sphere(RADIUS), "ball", properties(True, hydroelastic))
    plate = plant.AddRigidBody("plate", SpatialInertia.SolidBoxWithMass(1.0, 0.2, 0.2, 0.02))
    plant.RegisterCollisionGeometry(
        plate, RigidTransform([0, 0, -0.01]), Box(0.2, 0.2, 0.02), "plate", properties(False, hydroelastic)
    )
    plant.WeldFrames(plant.world_frame(), plate.body_frame())
    floor = RigidTransform([0, 0, -0.1])
    plant.RegisterCollisionGeometry(plant.world_body(), floor, Box(2, 2, 0.02), "floor", properties())
    plant.Finalize()
    body_by_name = {"ball": ball, "plate": plate, "world": plant.world_body()}
    pairs = [[body_by_name[name] for name in names] for names in (bodies, obstacles)]
    detector = builder.AddSystem(ContactDetector(plant, *pairs, STEP))
    builder.Connect(plant.get_contact_results_output_port(), detector.get_contact_results_input_port())
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    plant_context = plant.GetMyMutableContextFromRoot(context)
    plant.SetFloatingBaseBodyPoseInWorldFrame(plant_context, ball, RigidTransform([x, 0, RADIUS + height]))
    simulator.Initialize()
    ports = (
        detector.get_collision_output_port(),
        detector.get_has_collided_output_port(),
        detector.get_contact_force_output_port(),
    )
    outputs = []
    for k in range(1, round(duration / STEP)):
        simulator.AdvanceTo(k * STEP)
        outputs.append([port.Eval(detector.GetMyContextFromRoot(context))[0] for port in ports])
    return np.array(outputs)


@pytest.mark.parametrize("sampled", [False, True])
def test_collision_is_detected_at_the_impact_and_stored(sampled):
    collision, has_collided, force = drop(x=0.0, sampled=sampled).T
    first = int(np.flatnonzero(has_collided)[0])
    fall_time = np.sqrt(2 * 0.05 / 9.81)
    assert first * STEP == pytest.approx(fall_time, abs=3 * STEP)
    assert has_collided[first:].all()
    assert collision[first:].any()
    assert force.max() > 1.0
    assert not force[: first - 1].any()


def test_contact_with_another_body_is_no_collision():
    collision, has_collided, force = drop(x=0.3).T
    assert not collision.any()
    assert not has_collided.any()
    assert not force.any()


def test_collision_remains_stored_after_the_contact():
    """The ball hits the edge of the plate and falls to the floor."""
    collision, has_collided, _ = drop(x=0.115, duration=0.5).T
    assert has_collided[-1] == 1.0
    assert collision[-1] == 0.0


@pytest.mark.parametrize("hydroelastic", [False, True])
@pytest.mark.parametrize("mass", [0.01, 0.3])
@pytest.mark.parametrize(("body", "obstacle"), [("ball", "plate"), ("plate", "ball")])
def test_force_is_the_weight_of_a_ball_at_rest(hydroelastic, mass, body, obstacle):
    outputs = drop(0.0, 0.0, False, hydroelastic, 1.0, mass, [body], [obstacle])
    np.testing.assert_allclose(outputs[-1], [1.0, 1.0, mass * 9.81], rtol=1e-4)


@pytest.mark.parametrize("hydroelastic", [False, True])
@pytest.mark.parametrize(
    ("body", "obstacle"), [("ball", "world"), ("world", "ball"), ("plate", "world"), ("world", "plate")]
)
def test_contact_with_a_body_in_neither_set_is_no_collision(hydroelastic, body, obstacle):
    outputs = drop(0.0, 0.0, hydroelastic=hydroelastic, duration=0.05, bodies=[body], obstacles=[obstacle])
    np.testing.assert_array_equal(outputs, 0.0)
