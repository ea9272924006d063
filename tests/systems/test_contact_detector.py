"""A ball that is dropped on a plate, and one that is dropped beside it."""

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

from guiderail.models.common.errors import InputError
from guiderail.systems.contact_detector import ContactDetector

STEP = 2.0**-9
RADIUS = 0.02


def properties(compliant=False, hydroelastic=False):
    made = ProximityProperties()
    AddContactMaterial(dissipation=0.1, point_stiffness=1e4, friction=CoulombFriction(0.5, 0.5), properties=made)
    if hydroelastic and compliant:
        AddCompliantHydroelasticProperties(0.01, 1e6, made)
    elif hydroelastic:
        AddRigidHydroelasticProperties(0.01, made)
    return made


def drop(x, height=0.05, sampled=False, hydroelastic=False, duration=0.3):
    """The watch's outputs over time, of a ball dropped at `x`; the plate reaches to x = 0.1, the floor is lower."""
    builder = DiagramBuilder()
    model = "hydroelastic_with_fallback" if hydroelastic else "point"
    config = MultibodyPlantConfig(
        time_step=STEP,
        contact_model=model,
        discrete_contact_approximation="lagged",
        use_sampled_output_ports=sampled,
    )
    plant, _ = AddMultibodyPlant(config, builder)
    ball = plant.AddRigidBody("ball", SpatialInertia.SolidSphereWithMass(0.1, RADIUS))
    plant.RegisterCollisionGeometry(ball, RigidTransform(), Sphere(RADIUS), "ball", properties(True, hydroelastic))
    plate = plant.AddRigidBody("plate", SpatialInertia.SolidBoxWithMass(1.0, 0.2, 0.2, 0.02))
    plant.RegisterCollisionGeometry(
        plate, RigidTransform([0, 0, -0.01]), Box(0.2, 0.2, 0.02), "plate", properties(False, hydroelastic)
    )
    plant.WeldFrames(plant.world_frame(), plate.body_frame())
    floor = RigidTransform([0, 0, -0.1])
    plant.RegisterCollisionGeometry(plant.world_body(), floor, Box(2, 2, 0.02), "floor", properties())
    plant.Finalize()
    watch = builder.AddSystem(ContactDetector(plant, [ball], [plate], STEP))
    builder.Connect(plant.get_contact_results_output_port(), watch.get_contact_results_input_port())
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    plant_context = plant.GetMyMutableContextFromRoot(context)
    plant.SetFloatingBaseBodyPoseInWorldFrame(plant_context, ball, RigidTransform([x, 0, RADIUS + height]))
    simulator.Initialize()
    ports = (
        watch.get_collision_output_port(),
        watch.get_has_collided_output_port(),
        watch.get_contact_force_output_port(),
    )
    seen = []
    for k in range(1, round(duration / STEP)):
        simulator.AdvanceTo(k * STEP)
        seen.append([port.Eval(watch.GetMyContextFromRoot(context))[0] for port in ports])
    return np.array(seen)


@pytest.mark.parametrize("sampled", [False, True])
def test_sees_a_collision_when_it_happens_and_remembers_it(sampled):
    collision, touched, force = drop(x=0.0, sampled=sampled).T
    first = int(np.flatnonzero(touched)[0])
    fall = np.sqrt(2 * 0.05 / 9.81)
    assert first * STEP == pytest.approx(fall, abs=3 * STEP)
    assert touched[first:].all()
    assert collision[first:].any()
    assert force.max() > 1.0
    assert not force[: first - 1].any()


def test_what_touches_something_else_is_no_collision():
    collision, touched, force = drop(x=0.3).T
    assert not collision.any()
    assert not touched.any()
    assert not force.any()


def test_remembers_a_touch_that_is_over():
    # It bounces off the plate's edge and falls to the floor.
    collision, touched, _ = drop(x=0.115, duration=0.5).T
    assert touched[-1] == 1.0
    assert collision[-1] == 0.0


def test_hydroelastic_contact_counts_too():
    _, touched, force = drop(x=0.0, hydroelastic=True, duration=1.5).T
    assert touched[-1] == 1.0
    # At rest in the end, on a plate that carries its weight.
    assert force[-1] == pytest.approx(0.1 * 9.81, rel=0.1)


def test_refuses_what_makes_no_sense():
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(MultibodyPlantConfig(time_step=STEP), builder)
    body = plant.AddRigidBody("ball", SpatialInertia.SolidSphereWithMass(0.1, RADIUS))
    plant.Finalize()
    with pytest.raises(InputError, match="overlap"):
        ContactDetector(plant, [body], [body], STEP)
    with pytest.raises(InputError, match="period"):
        ContactDetector(plant, [body], [plant.world_body()], 0.0)
