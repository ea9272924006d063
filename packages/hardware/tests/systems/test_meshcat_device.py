import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail_hardware.systems.meshcat_device import MeshcatDevice

AXES = [(0, 1.0), (1, -1.0)]
KEYS = [("KeyA", "KeyD"), ("KeyS", "KeyW")]


class Gamepad:
    """Stub of the state of a gamepad that is not connected."""

    index = None
    axes: tuple[float, ...] = ()


class Browser:
    """Stub of Meshcat, because a real instance opens a port and needs an operator that moves the sliders."""

    def __init__(self):
        self.sliders, self.gamepad = {}, Gamepad()

    def AddSlider(self, name, lowest, highest, step, value, decrement, increment):
        self.sliders[name] = value

    def GetSliderValue(self, name):
        return self.sliders[name]

    def GetGamepad(self):
        return self.gamepad


@pytest.fixture
def browser():
    return Browser()


def test_action_follows_the_sliders_once_per_period(browser):
    system = MeshcatDevice(browser, AXES, KEYS, 0.125)
    simulator = Simulator(system)
    simulator.Initialize()
    action = system.get_action_output_port()
    browser.sliders["input 2"] = 0.75
    simulator.AdvanceTo(0.05)
    simulator.AdvanceTo(0.1)
    np.testing.assert_array_equal(action.Eval(simulator.get_context()), [0.0, 0.75])
    browser.sliders["input 1"] = -0.5
    simulator.AdvanceTo(0.12)
    np.testing.assert_array_equal(action.Eval(simulator.get_context()), [0.0, 0.75])
    simulator.AdvanceTo(0.13)
    np.testing.assert_array_equal(action.Eval(simulator.get_context()), [-0.5, 0.75])


def test_action_is_the_present_input_at_each_initialization(browser):
    system = MeshcatDevice(browser, AXES, KEYS, 0.125)
    simulator = Simulator(system)
    for value in (0.5, -0.25):
        browser.sliders["input 1"] = value
        simulator.Initialize()
        np.testing.assert_array_equal(system.get_action_output_port().Eval(simulator.get_context()), [value, 0.0])


def test_gamepad_axis_overrides_the_slider_when_deflected(browser):
    system = MeshcatDevice(browser, AXES, KEYS, 0.1)
    browser.sliders["input 1"] = 0.5
    browser.gamepad.index, browser.gamepad.axes = 0, (0.02, 0.9)
    np.testing.assert_array_equal(system.read(), [0.5, -0.9])


def test_gamepad_with_fewer_axes_is_accepted(browser):
    system = MeshcatDevice(browser, AXES, KEYS, 0.1)
    browser.gamepad.index, browser.gamepad.axes = 0, (-1.0,)
    np.testing.assert_array_equal(system.read(), [-1.0, 0.0])


@pytest.mark.parametrize(("axes", "keys", "period"), [(AXES, KEYS, 0.0), (AXES, KEYS[:1], 0.1), ([], [], 0.1)])
def test_constructor_refuses_invalid_arguments(browser, axes, keys, period):
    with pytest.raises(InputError, match=r"device|period"):
        MeshcatDevice(browser, axes, keys, period)
