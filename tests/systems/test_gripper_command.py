import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail.systems.gripper_command import GripperCommand

LOWER, UPPER, OPENING = np.array([0.0, -1.0]), np.array([0.04, 1.0]), np.array([0.03, 0.5])


class Commanded:
    def __init__(self):
        self.system = GripperCommand(LOWER, UPPER, OPENING, period=0.01)
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()

    def command(self, position):
        self.system.get_position_input_port().FixValue(self.context, position)

    def advance(self, seconds):
        self.simulator.AdvanceTo(self.context.get_time() + seconds)

    @property
    def desired(self):
        return self.system.get_desired_state_output_port().Eval(self.context)


def test_initial_opening_is_output_when_not_connected():
    commanded = Commanded()
    commanded.advance(0.1)
    np.testing.assert_array_equal(commanded.desired, [0.03, 0.5, 0.0, 0.0])


def test_command_is_output_at_once_within_limits():
    commanded = Commanded()
    commanded.command([0.01, 0.2])
    np.testing.assert_array_equal(commanded.desired, [0.01, 0.2, 0.0, 0.0])
    commanded.command([-5.0, 5.0])
    np.testing.assert_array_equal(commanded.desired, [0.0, 1.0, 0.0, 0.0])


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_last_position_is_output_when_a_command_is_not_finite(bad):
    commanded = Commanded()
    commanded.command([0.01, 0.2])
    commanded.advance(0.05)
    commanded.command([bad, 0.4])
    for _ in range(3):
        np.testing.assert_array_equal(commanded.desired, [0.01, 0.4, 0.0, 0.0])
        commanded.advance(0.05)


@pytest.mark.parametrize("is_initialized", [False, True])
def test_reset_restores_the_initial_opening(is_initialized):
    commanded = Commanded()
    commanded.command([0.01, 0.2])
    commanded.advance(0.05)
    commanded.command([np.nan, np.nan])
    if is_initialized:
        commanded.context.SetTime(0.0)
        commanded.simulator.Initialize()
    else:
        commanded.system.SetDefaultContext(commanded.context)
    np.testing.assert_array_equal(commanded.desired, [0.03, 0.5, 0.0, 0.0])


@pytest.mark.parametrize(
    "wrong",
    [
        {"lower": np.zeros(1)},
        {"opening": np.array([0.05, 0.0])},
        {"opening": np.array([np.nan, 0.0])},
        {"upper": np.array([[0.04, 1.0]]), "lower": LOWER[None], "opening": OPENING[None]},
        {"period": 0.0},
    ],
)
def test_constructor_refuses_arguments_out_of_range(wrong):
    valid = {"lower": LOWER, "upper": UPPER, "opening": OPENING, "period": 0.01} | wrong
    with pytest.raises(InputError):
        GripperCommand(valid.pop("lower"), valid.pop("upper"), valid.pop("opening"), **valid)


@pytest.mark.parametrize(("limit", "outside"), [(LOWER, -np.inf), (UPPER, np.inf)])
@pytest.mark.parametrize("joint", [0, 1])
def test_opening_may_be_at_a_limit_but_not_beyond(limit, outside, joint):
    opening = OPENING.copy()
    opening[joint] = limit[joint]
    GripperCommand(LOWER, UPPER, opening, period=0.01)
    opening[joint] = np.nextafter(limit[joint], outside)
    with pytest.raises(InputError, match="opening must be within"):
        GripperCommand(LOWER, UPPER, opening, period=0.01)


def test_arguments_are_copied_and_may_be_lists():
    GripperCommand(LOWER.tolist(), UPPER.tolist(), OPENING.tolist(), period=0.01)
    lower, upper = LOWER.copy(), UPPER.copy()
    system = GripperCommand(lower, upper, OPENING, period=0.01)
    lower[:], upper[:] = 0.0, 0.0
    context = system.CreateDefaultContext()
    system.get_position_input_port().FixValue(context, [-5.0, 5.0])
    np.testing.assert_array_equal(system.get_desired_state_output_port().Eval(context), [0.0, 1.0, 0.0, 0.0])


def test_ports():
    system = GripperCommand(LOWER, UPPER, OPENING, period=0.01)
    assert system.get_position_input_port().get_name() == "position"
    assert system.get_desired_state_output_port().get_name() == "desired_state"
    assert system.get_desired_state_output_port().size() == 4
