import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail.systems.meshcat_device import MeshcatDevice

AXES = [(0, 1.0), (1, -1.0)]
KEYS = [("KeyA", "KeyD"), ("KeyS", "KeyW")]


class Gamepad:
    index = None
    axes: tuple[float, ...] = ()


class Browser:
    """What the device asks of a Meshcat; a real one opens a port, and has nobody to move its sliders."""

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


def test_follows_the_sliders_at_its_period(browser):
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


def test_a_stick_that_is_moved_comes_before_its_slider(browser):
    system = MeshcatDevice(browser, AXES, KEYS, 0.1)
    browser.sliders["input 1"] = 0.5
    browser.gamepad.index, browser.gamepad.axes = 0, (0.02, 0.9)
    np.testing.assert_array_equal(system.read(), [0.5, -0.9])


def test_a_gamepad_with_fewer_axes_is_no_error(browser):
    system = MeshcatDevice(browser, AXES, KEYS, 0.1)
    browser.gamepad.index, browser.gamepad.axes = 0, (-1.0,)
    np.testing.assert_array_equal(system.read(), [-1.0, 0.0])


@pytest.mark.parametrize(("axes", "keys", "period"), [(AXES, KEYS, 0.0), (AXES, KEYS[:1], 0.1), ([], [], 0.1)])
def test_refuses_what_makes_no_sense(browser, axes, keys, period):
    with pytest.raises(InputError, match=r"device|period"):
        MeshcatDevice(browser, axes, keys, period)
