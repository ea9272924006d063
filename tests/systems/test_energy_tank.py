"""Adversarial test of passivity: reference, bound and surroundings move so as to extract energy."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail.models.control.wrench import WrenchBound
from guiderail.systems import EnergyTank

STIFFNESS, DAMPING = np.r_[np.full(3, 1500.0), np.full(3, 30.0)], np.r_[np.full(3, 95.0), np.full(3, 0.5)]
BOUND = WrenchBound(np.array([9.0, 9.0, 15.0, 3.0, 3.0, 3.0]), 20.0, 5.2)
PERIOD = 0.01


class Tank:
    """Tank without a diagram: `step` runs one period and returns the force along x."""

    def __init__(self, capacity=0.5):
        self.system = EnergyTank(STIFFNESS, DAMPING, BOUND, capacity=capacity, period=PERIOD)
        self.context = self.system.CreateDefaultContext()
        self.put(np.zeros(6), np.zeros(6), BOUND.numbers)
        self.reset()

    def reset(self):
        events = self.system.AllocateDiscreteVariables()
        events.SetFrom(self.context.get_discrete_state())
        self.system._reset(self.context, events)
        self.context.SetDiscreteState(events)

    def put(self, desired, pose, bound):
        self.system.get_desired_pose_input_port().FixValue(self.context, desired)
        self.system.get_pose_input_port().FixValue(self.context, pose)
        self.system.get_max_wrench_input_port().FixValue(self.context, bound)

    def step(self, desired, pose, bound):
        """Return reference and limit of x, and the content after the update."""
        self.put(desired, pose, bound)
        reference = self.system.get_reference_pose_output_port().Eval(self.context)
        limit = self.system.get_admitted_wrench_output_port().Eval(self.context)
        self.context.SetDiscreteState(self.system.EvalUniquePeriodicDiscreteUpdate(self.context))
        return reference, limit, self.system.get_energy_output_port().Eval(self.context)[0]


def extracted(capacity, *, with_tank, seed=0):
    """Return the energy [J] that a moving obstacle gains along x, while an adversary moves the reference behind it."""
    tank, rng, x, gained, contents = Tank(capacity), np.random.default_rng(seed), 0.0, 0.0, []
    for _ in range(600):
        forward = rng.uniform() < 0.8
        speed = rng.uniform(0.0, 0.05) * (1.0 if forward else -1.0)
        desired = np.r_[x + 0.1 if forward else x, np.zeros(5)]  # pushes the obstacle along, lets it come back
        bound = BOUND.numbers * (1.0 if forward else 0.1)
        reference, limit, content = tank.step(desired, np.r_[x, np.zeros(5)], bound)
        contents.append(content)
        if not with_tank:
            reference, limit = desired, bound
        for _ in range(10):  # the obstacle moves within the period
            force = np.clip(STIFFNESS[0] * (reference[0] - x), -limit[0], limit[0]) - DAMPING[0] * speed
            gained += force * speed * PERIOD / 10
            x += speed * PERIOD / 10
    return gained, min(contents)


@pytest.mark.parametrize("seed", range(4))
def test_surroundings_extract_at_most_the_content(seed):
    gained, content = extracted(0.2, with_tank=True, seed=seed)
    assert -1e-9 <= content < 0.01  # the adversary emptied it
    assert gained <= 0.2 * 1.02
    assert extracted(0.2, with_tank=False, seed=seed)[0] > 0.4


def test_full_tank_passes_reference_and_bound_unchanged():
    tank, desired, pose = Tank(5.0), np.full(6, 0.012), np.full(6, 0.01)
    reference, wrench, _ = tank.step(desired, pose, 0.5 * BOUND.numbers)
    np.testing.assert_array_equal(reference, desired)
    np.testing.assert_array_equal(wrench, 0.5 * BOUND.numbers)


def test_lower_bound_applies_at_once_when_the_tank_is_empty():
    tank, far, pose = Tank(1e-6), np.r_[0.1, np.zeros(5)], np.zeros(6)
    tank.step(far, pose, BOUND.numbers)
    reference, wrench, _ = tank.step(far, pose, 0.1 * BOUND.numbers)
    np.testing.assert_array_equal(wrench[:6], 0.1 * BOUND.axes)
    assert 0.0 < reference[0] < 1e-3
    _, wrench, content = tank.step(far, pose, BOUND.numbers)
    assert content >= 0.0


def test_tank_that_is_too_empty_admits_the_share_of_a_motion_that_it_can_pay():
    tank, pose = Tank(0.01), np.zeros(6)
    tank.step(np.r_[0.002, np.zeros(5)], pose, BOUND.numbers)
    reference, _, content = tank.step(np.r_[0.1, np.zeros(5)], pose, BOUND.numbers)
    np.testing.assert_allclose(reference, np.r_[np.sqrt(2.0 * 0.01 / 1500.0), np.zeros(5)], rtol=1e-6)
    assert 0.0 <= content < 1e-6
    held, _, _ = tank.step(np.r_[-0.1, np.zeros(5)], pose, BOUND.numbers)
    np.testing.assert_allclose(held, -reference, rtol=1e-3, atol=1e-9)  # the spring's energy is returned on the way


def test_tank_that_is_too_empty_admits_the_share_of_a_bound_that_it_can_pay():
    tank, pose, desired = Tank(0.004), np.zeros(6), np.r_[0.003, np.zeros(5)]
    tank.step(desired, pose, 0.1 * BOUND.numbers)
    reference, wrench, content = tank.step(desired, pose, BOUND.numbers)
    np.testing.assert_allclose(reference, desired, rtol=1e-12)
    # The energy f r − f² / 2 K of a spring that is clipped to f is the content.
    limit = 1500.0 * 0.003 - np.sqrt((1500.0 * 0.003) ** 2 - 2.0 * 1500.0 * 0.004)
    share = (limit - 0.9) / (9.0 - 0.9)
    np.testing.assert_allclose(wrench[:6], (0.1 + 0.9 * share) * BOUND.axes, rtol=1e-5)
    assert 0.0 <= content < 1e-6


def test_initialization_fills_the_tank_and_restarts_at_the_measured_pose():
    tank, pose = Tank(0.01), np.full(6, 0.2)
    tank.step(np.r_[0.1, np.zeros(5)], np.zeros(6), 0.1 * BOUND.numbers)
    tank.put(pose, pose, BOUND.numbers)
    tank.reset()
    assert tank.system.get_energy_output_port().Eval(tank.context)[0] == 0.01
    reference, wrench, _ = tank.step(pose + np.r_[0.1, np.zeros(5)], pose, BOUND.numbers)
    np.testing.assert_allclose(reference - pose, np.r_[np.sqrt(2.0 * 0.01 / 1500.0), np.zeros(5)], rtol=1e-6)
    np.testing.assert_array_equal(wrench, BOUND.numbers)


def test_motion_starts_at_the_first_finite_pose():
    tank, pose = Tank(0.01), np.full(6, 0.2)
    tank.put(pose, np.full(6, np.nan), BOUND.numbers)
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
def test_last_valid_limit_remains_in_force_when_one_is_invalid(invalid):
    tank, zero, low = Tank(), np.zeros(6), 0.5 * BOUND.numbers
    tank.step(zero, zero, low)
    for _ in range(3):
        np.testing.assert_array_equal(tank.step(zero, zero, np.full(8, invalid))[1], low)
    mixed = np.r_[1.0, np.full(7, invalid)]
    np.testing.assert_array_equal(tank.step(zero, zero, mixed)[1], np.r_[1.0, low[1:]])
    np.testing.assert_array_equal(tank.step(zero, zero, np.zeros(8))[1], np.zeros(8))  # 0 is valid
    tank.put(zero, zero, np.full(8, invalid))
    Simulator(tank.system, tank.context).Initialize()
    np.testing.assert_array_equal(tank.step(zero, zero, np.full(8, invalid))[1], np.zeros(8))


def test_motion_refills_the_tank_up_to_its_capacity():
    tank = Tank(0.02)
    _, _, low = tank.step(np.r_[0.005, np.zeros(5)], np.zeros(6), BOUND.numbers)
    assert low == pytest.approx(0.02 - 0.5 * 1500.0 * 0.005**2)
    moved = np.r_[0.005, np.zeros(5)]
    _, _, content = tank.step(moved, moved, BOUND.numbers)
    assert content == 0.02


def test_pose_that_is_not_finite_costs_nothing():
    """A controller behind the tank notices it, and holds its last valid pose."""
    tank, desired = Tank(), np.r_[0.001, np.zeros(5)]
    *_, before = tank.step(desired, np.zeros(6), BOUND.numbers)
    reference, _, content = tank.step(np.full(6, np.nan), np.zeros(6), BOUND.numbers)
    assert np.isnan(reference).all()
    assert content == before


def test_content_is_kept_when_the_measured_pose_is_not_finite():
    tank, desired = Tank(), np.r_[0.05, np.zeros(5)]
    reference, limit, before = tank.step(desired, np.zeros(6), BOUND.numbers)
    assert before < 0.1
    held, lowered, content = tank.step(-desired, np.full(6, np.nan), 0.5 * BOUND.numbers)
    np.testing.assert_array_equal(held, reference)
    np.testing.assert_array_equal(lowered[:6], 0.5 * limit[:6])
    assert content == before
    reference, limit, content = tank.step(held, np.r_[0.01, np.zeros(5)], 0.5 * BOUND.numbers)
    assert np.isfinite([*reference, *limit]).all()
    assert content == pytest.approx(before)  # the motion without a measurement is not counted as dissipation


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"stiffness": np.zeros(6)}, "six positive stiffnesses"),
        ({"capacity": 0.0}, "capacity must be positive"),
        ({"capacity": np.inf}, "capacity must be positive and finite"),
        ({"bound": WrenchBound(np.r_[np.inf, np.ones(5)], 20.0, 5.2)}, "finite limits"),
        ({"period": 0.0}, "period must be positive"),
        ({"bound": None}, "bound must be a WrenchBound, not None"),
    ],
)
def test_tank_raises_when_an_argument_is_invalid(change, words):
    arguments = {"stiffness": STIFFNESS, "damping": DAMPING, "bound": BOUND, "capacity": 1.0, "period": 0.01} | change
    stiffness, damping, bound = (arguments.pop(name) for name in ("stiffness", "damping", "bound"))
    with pytest.raises(InputError, match=words):
        EnergyTank(stiffness, damping, bound, **arguments)
