"""Energy tank: an adversary that moves reference, bound and obstacle cannot extract more than the initial energy."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.models.control.wrench import WrenchBound
from guiderail.systems import EnergyTank

STIFFNESS, DAMPING = np.r_[np.full(3, 1500.0), np.full(3, 30.0)], np.r_[np.full(3, 95.0), np.full(3, 0.5)]
BOUND = WrenchBound(np.array([9.0, 9.0, 15.0, 3.0, 3.0, 3.0]), 20.0, 5.2)
PERIOD = 0.01


class Tank:
    """Energy tank with fixed inputs that is stepped without a simulator."""

    def __init__(self, capacity=0.5):
        self.system = EnergyTank(STIFFNESS, DAMPING, BOUND, capacity=capacity, period=PERIOD)
        self.context = self.system.CreateDefaultContext()
        self.set_inputs(np.zeros(6), np.zeros(6), BOUND.numbers)
        self.reset()

    def reset(self):
        """Run the initialization event."""
        events = self.system.AllocateDiscreteVariables()
        events.SetFrom(self.context.get_discrete_state())
        self.system._reset(self.context, events)
        self.context.SetDiscreteState(events)

    def set_inputs(self, desired, pose, bound):
        self.system.get_desired_pose_input_port().FixValue(self.context, desired)
        self.system.get_pose_input_port().FixValue(self.context, pose)
        self.system.get_max_wrench_input_port().FixValue(self.context, bound)

    def step(self, desired, pose, bound):
        """Run one period; return the reference (6,), the admitted bound (8,), and the energy after the update [J]."""
        self.set_inputs(desired, pose, bound)
        reference = self.system.get_reference_pose_output_port().Eval(self.context)
        wrench = self.system.get_admitted_wrench_output_port().Eval(self.context)
        self.context.SetDiscreteState(self.system.EvalUniquePeriodicDiscreteUpdate(self.context))
        return reference, wrench, self.system.get_energy_output_port().Eval(self.context)[0]


def extracted_energy(capacity, *, with_tank, seed=0):
    """Return the energy [J] that an obstacle receives along x from an adversary, and the lowest energy of the tank.

    While the obstacle moves forward, the reference is 0.1 m ahead with the full bound. While the obstacle moves
    backward, the reference is at the obstacle with a tenth of the bound.
    """
    tank, rng, x, received, energies = Tank(capacity), np.random.default_rng(seed), 0.0, 0.0, []
    for _ in range(600):
        is_forward = rng.uniform() < 0.8
        speed = rng.uniform(0.0, 0.05) * (1.0 if is_forward else -1.0)
        desired = np.r_[x + 0.1 if is_forward else x, np.zeros(5)]
        bound = BOUND.numbers * (1.0 if is_forward else 0.1)
        reference, wrench, energy = tank.step(desired, np.r_[x, np.zeros(5)], bound)
        energies.append(energy)
        if not with_tank:
            reference, wrench = desired, bound
        for _ in range(10):  # the obstacle moves within the period
            force = np.clip(STIFFNESS[0] * (reference[0] - x), -wrench[0], wrench[0]) - DAMPING[0] * speed
            received += force * speed * PERIOD / 10
            x += speed * PERIOD / 10
    return received, min(energies)


@pytest.mark.parametrize("seed", range(4))
def test_extracted_energy_is_at_most_the_initial_energy(seed):
    received, lowest_energy = extracted_energy(0.2, with_tank=True, seed=seed)
    assert -1e-9 <= lowest_energy < 0.01  # the adversary emptied the tank
    assert received <= 0.2 * 1.02
    assert extracted_energy(0.2, with_tank=False, seed=seed)[0] > 0.4


def test_full_tank_passes_reference_and_bound_unchanged():
    tank, desired, pose = Tank(5.0), np.full(6, 0.012), np.full(6, 0.01)
    reference, wrench, _ = tank.step(desired, pose, 0.5 * BOUND.numbers)
    np.testing.assert_array_equal(reference, desired)
    np.testing.assert_array_equal(wrench, 0.5 * BOUND.numbers)


def test_lower_bound_applies_at_once_when_the_tank_is_empty():
    tank, desired, pose = Tank(1e-6), np.r_[0.1, np.zeros(5)], np.zeros(6)
    tank.step(desired, pose, BOUND.numbers)
    reference, wrench, _ = tank.step(desired, pose, 0.1 * BOUND.numbers)
    np.testing.assert_array_equal(wrench[:6], 0.1 * BOUND.axes)
    assert 0.0 < reference[0] < 1e-3
    _, _, energy = tank.step(desired, pose, BOUND.numbers)
    assert energy >= 0.0


def test_reference_moves_by_a_share_when_the_energy_is_too_low():
    tank, pose = Tank(0.01), np.zeros(6)
    tank.step(np.r_[0.002, np.zeros(5)], pose, BOUND.numbers)
    reference, _, energy = tank.step(np.r_[0.1, np.zeros(5)], pose, BOUND.numbers)
    # The spring's energy ½ K r² is the initial energy.
    np.testing.assert_allclose(reference, np.r_[np.sqrt(2.0 * 0.01 / 1500.0), np.zeros(5)], rtol=1e-6)
    assert 0.0 <= energy < 1e-6
    opposite, _, _ = tank.step(np.r_[-0.1, np.zeros(5)], pose, BOUND.numbers)
    np.testing.assert_allclose(opposite, -reference, rtol=1e-3, atol=1e-9)  # has the same energy of the spring


def test_bound_rises_by_a_share_when_the_energy_is_too_low():
    tank, pose, desired = Tank(0.004), np.zeros(6), np.r_[0.003, np.zeros(5)]
    tank.step(desired, pose, 0.1 * BOUND.numbers)
    reference, wrench, energy = tank.step(desired, pose, BOUND.numbers)
    np.testing.assert_allclose(reference, desired, rtol=1e-12)
    # The energy f r − f² / 2 K of a spring that is clipped to f is the initial energy.
    limit = 1500.0 * 0.003 - np.sqrt((1500.0 * 0.003) ** 2 - 2.0 * 1500.0 * 0.004)
    share = (limit - 0.9) / (9.0 - 0.9)
    np.testing.assert_allclose(wrench[:6], (0.1 + 0.9 * share) * BOUND.axes, rtol=1e-5)
    assert 0.0 <= energy < 1e-6


def test_initialization_resets_energy_and_reference():
    tank, pose = Tank(0.01), np.full(6, 0.2)
    tank.step(np.r_[0.1, np.zeros(5)], np.zeros(6), 0.1 * BOUND.numbers)
    tank.set_inputs(pose, pose, BOUND.numbers)
    tank.reset()
    assert tank.system.get_energy_output_port().Eval(tank.context)[0] == 0.01
    reference, wrench, _ = tank.step(pose + np.r_[0.1, np.zeros(5)], pose, BOUND.numbers)
    np.testing.assert_allclose(reference - pose, np.r_[np.sqrt(2.0 * 0.01 / 1500.0), np.zeros(5)], rtol=1e-6)
    np.testing.assert_array_equal(wrench, BOUND.numbers)


def test_reference_starts_at_the_first_finite_pose():
    tank, pose = Tank(0.01), np.full(6, 0.2)
    tank.set_inputs(pose, np.full(6, np.nan), BOUND.numbers)
    tank.reset()
    tank.step(pose, np.full(6, np.nan), BOUND.numbers)
    reference, *_ = tank.step(pose + np.r_[0.1, np.zeros(5)], pose, BOUND.numbers)
    np.testing.assert_allclose(reference - pose, np.r_[np.sqrt(2.0 * 0.01 / 1500.0), np.zeros(5)], rtol=1e-6)


def test_bound_is_constant_without_an_input():
    system = EnergyTank(STIFFNESS, DAMPING, BOUND, capacity=0.5, period=PERIOD)
    context = system.CreateDefaultContext()
    system.get_desired_pose_input_port().FixValue(context, np.zeros(6))
    system.get_pose_input_port().FixValue(context, np.zeros(6))
    Simulator(system, context).Initialize()
    np.testing.assert_array_equal(system.get_admitted_wrench_output_port().Eval(context), BOUND.numbers)


@pytest.mark.parametrize("invalid", [np.nan, -1.0, -np.inf])
def test_last_valid_limit_applies_while_the_limit_is_invalid(invalid):
    tank, zero, low = Tank(), np.zeros(6), 0.5 * BOUND.numbers
    tank.step(zero, zero, low)
    for _ in range(3):
        np.testing.assert_array_equal(tank.step(zero, zero, np.full(8, invalid))[1], low)
    mixed = np.r_[1.0, np.full(7, invalid)]
    np.testing.assert_array_equal(tank.step(zero, zero, mixed)[1], np.r_[1.0, low[1:]])
    np.testing.assert_array_equal(tank.step(zero, zero, np.zeros(8))[1], np.zeros(8))  # 0 is valid
    tank.set_inputs(zero, zero, np.full(8, invalid))
    Simulator(tank.system, tank.context).Initialize()
    np.testing.assert_array_equal(tank.step(zero, zero, np.full(8, invalid))[1], np.zeros(8))


def test_motion_refills_the_tank_up_to_its_capacity():
    tank = Tank(0.02)
    _, _, energy = tank.step(np.r_[0.005, np.zeros(5)], np.zeros(6), BOUND.numbers)
    assert energy == pytest.approx(0.02 - 0.5 * 1500.0 * 0.005**2)
    pose = np.r_[0.005, np.zeros(5)]
    _, _, energy = tank.step(pose, pose, BOUND.numbers)
    assert energy == 0.02


def test_desired_pose_that_is_not_finite_uses_no_energy():
    """A controller behind the tank rejects such a pose."""
    tank, desired = Tank(), np.r_[0.001, np.zeros(5)]
    *_, before = tank.step(desired, np.zeros(6), BOUND.numbers)
    reference, _, energy = tank.step(np.full(6, np.nan), np.zeros(6), BOUND.numbers)
    assert np.isnan(reference).all()
    assert energy == before


def test_energy_is_constant_while_measured_pose_is_not_finite():
    tank, desired = Tank(), np.r_[0.05, np.zeros(5)]
    reference, wrench, before = tank.step(desired, np.zeros(6), BOUND.numbers)
    assert before < 0.1
    repeated, lowered, energy = tank.step(-desired, np.full(6, np.nan), 0.5 * BOUND.numbers)
    np.testing.assert_array_equal(repeated, reference)
    np.testing.assert_array_equal(lowered[:6], 0.5 * wrench[:6])
    assert energy == before
    reference, wrench, energy = tank.step(repeated, np.r_[0.01, np.zeros(5)], 0.5 * BOUND.numbers)
    assert np.isfinite([*reference, *wrench]).all()
    assert energy == pytest.approx(before)  # the displacement without a measurement does not count as dissipation
