from dataclasses import replace

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.stations.arm import controller_model
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail.models.robots.catalog import IIWA14
from guiderail.systems import ExternalTorqueSensor, JointTorqueErrors

HOME = np.array(IIWA14.home)
CONTACT = np.linspace(-2.0, 3.0, 7)
PERIOD = 0.01


@pytest.fixture(scope="module")
def arm():
    return controller_model(BncWorkcell())


def no_errors(sensor):
    bodies = len(sensor.bodies)
    return JointTorqueErrors(np.zeros(7), np.zeros(7), np.zeros(7), np.zeros(bodies), np.zeros((bodies, 3)))


def measure(arm, *, noise=0.0, drift=0.0, seconds=0.005, velocity=0.0, payload=0.0, seed=1, **errors):
    """Return the measured torques (7,) [Nm] at the home posture after `seconds`, and the sensor.

    Args:
        arm: Plant and arm.
        noise: Noise of each joint.
        drift: Drift of each joint.
        seconds: Time of the measurement [s].
        velocity: Velocity of each joint [rad/s].
        payload: Unmodeled mass at the tool [kg].
        seed: Seed of noise and drift.
        **errors: Fields of `JointTorqueErrors` that are not zero.
    """
    plant, model = arm
    sensor = ExternalTorqueSensor(plant, model.tool[0], np.full(7, noise), np.full(7, drift), period=PERIOD)
    simulator = Simulator(sensor)
    context = simulator.get_mutable_context()
    sensor.get_state_input_port().FixValue(context, np.concatenate([HOME, np.full(7, velocity)]))
    sensor.get_contact_torque_input_port().FixValue(context, CONTACT)
    sensor.set_errors(context, replace(no_errors(sensor), **errors), seed)
    sensor.add_payload(context, payload)
    simulator.AdvanceTo(seconds)
    return sensor.get_external_torque_output_port().Eval(context).copy(), sensor


def gravity(arm, payload=0.0):
    """Return the gravity torques (7,) [Nm] at the home posture."""
    plant, model = arm
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, HOME)
    model.tool[0].SetMass(context, model.tool[0].default_mass() + payload)
    return plant.CalcGravityGeneralizedForces(context)


def test_measurement_is_the_contact_torque_without_errors(arm):
    np.testing.assert_allclose(measure(arm)[0], CONTACT, atol=1e-12)


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_position_that_is_not_finite_is_refused(arm, number, monkeypatch):
    monkeypatch.setattr(f"{__name__}.HOME", [*HOME[:6], number])
    with pytest.raises(InputError, match="joint positions and velocities must be finite"):
        measure(arm)


def test_gain_error_includes_the_gravity_torque(arm):
    """A sensor measures the total torque of its joint, which includes the weight of the arm."""
    gain = 0.01 * np.arange(7)
    np.testing.assert_allclose(measure(arm, gain=gain)[0], CONTACT + gain * (CONTACT + gravity(arm)), atol=1e-9)


def test_payload_adds_its_gravity_torque(arm):
    expected = CONTACT + gravity(arm, 0.5) - gravity(arm)
    np.testing.assert_allclose(measure(arm, payload=0.5)[0], expected, atol=1e-9)
    assert np.abs(expected - CONTACT).max() > 1.0


def test_mass_and_center_errors_change_the_gravity_torque(arm):
    sensor = measure(arm)[1]
    mass = np.array([0.02 * body.default_mass() for body in sensor.bodies])
    np.testing.assert_allclose(measure(arm, mass=mass)[0], CONTACT + 0.02 * gravity(arm), atol=1e-9)
    center = np.full((len(sensor.bodies), 3), 0.002)
    assert np.abs(measure(arm, center=center)[0] - CONTACT).max() > 0.05


def test_friction_opposes_the_motion(arm):
    friction = np.full(7, 0.1)
    np.testing.assert_allclose(measure(arm, friction=friction, velocity=0.0)[0], CONTACT)
    np.testing.assert_allclose(measure(arm, friction=friction, velocity=0.5)[0], CONTACT - 0.1)
    np.testing.assert_allclose(measure(arm, friction=friction, velocity=-0.5)[0], CONTACT + 0.1)


def test_noise_and_drift_repeat_with_their_seed(arm):
    first, repeated, other = (measure(arm, noise=0.1, drift=0.1, seconds=0.5, seed=seed)[0] for seed in (3, 3, 4))
    np.testing.assert_array_equal(repeated, first)
    assert not np.allclose(other, first)


def test_noise_and_drift_are_computed_from_the_seed(arm):
    """A recorded episode is repeated with the same numbers."""
    measured = measure(arm, noise=0.1, drift=0.2, seconds=1.5 * PERIOD, seed=3)[0]
    samples = np.array([np.random.default_rng([3, count]).standard_normal((2, 7)) for count in (1, 2)])
    walk = 0.2 * np.sqrt(PERIOD / 10.0) * samples[:, 1].sum(axis=0)
    np.testing.assert_allclose(measured, CONTACT + 0.1 * samples[1, 0] + walk, atol=1e-12)


def test_drift_is_a_random_walk_with_its_deviation(arm):
    ends = np.array([measure(arm, drift=1.0, seconds=0.995, seed=seed)[0] - CONTACT for seed in range(20)])
    assert ends.std() == pytest.approx(np.sqrt(0.1), rel=0.25)  # drift is the deviation after 10 s; here 1 s
