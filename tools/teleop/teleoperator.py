"""Input devices of an operator: sliders, keys and buttons of a Meshcat page, and a gamepad."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from guiderail.diagrams.envs.scene import Viewpoint

DEAD_ZONE = 0.15  # of a gamepad's axis that moves a slider
CAMERA_NEAR = 1e-3  # near clipping distance of the page's camera [m]

# Keys that lower and raise each input, by JavaScript's codes, and its gamepad axis with a sign.
KEY_PAIRS = (("KeyA", "KeyD"), ("KeyS", "KeyW"), ("KeyF", "KeyR"), ("KeyJ", "KeyL"), ("KeyK", "KeyI"), ("KeyH", "KeyY"))
GAMEPAD_AXES = ((0, 1.0), (1, -1.0), (3, -1.0), (2, 1.0), (4, 1.0), (5, 1.0))


class Teleoperator(Protocol):
    """Source of an operator's inputs; `MeshcatDevice` and `MeshcatPanel` are two."""

    def read(self) -> np.ndarray:
        """Return the present inputs, (n,)."""


@dataclass(frozen=True)
class Slider:
    """Slider of a page.

    Attributes:
        limit: Largest value, and smallest value with the opposite sign.
        step: Change by one key press.
        keys: Keys that lower and raise the value, by JavaScript's codes.
        scale: Factor from the slider's unit to that of the input.
        speed: Change of the value per second at full deflection of its gamepad axis; 0 without one.
    """

    limit: float
    step: float
    keys: tuple[str, str]
    scale: float = 1.0
    speed: float = 0.0


class MeshcatPanel(Teleoperator):
    """Sliders and buttons of a Meshcat page, each with keys; a gamepad moves the sliders.

    Attributes:
        meshcat: The page.
    """

    def __init__(self, meshcat: Any, sliders: Mapping[str, Slider], buttons: Mapping[str, str]):
        """Add sliders, and buttons with their keys, to a page."""
        self.meshcat = meshcat
        self._sliders: dict[str, Slider] = {}
        self._clicks: dict[str, int] = {}
        for name, slider in sliders.items():
            self.add_slider(name, slider)
        for name, key in buttons.items():
            meshcat.AddButton(name, key)

    def add_slider(self, name: str, slider: Slider) -> None:
        """Add a slider at zero; one that exists is left as it is."""
        if name not in self._sliders:
            self._sliders[name] = slider
            self.meshcat.AddSlider(name, -slider.limit, slider.limit, slider.step, 0.0, *slider.keys)

    def read(self) -> np.ndarray:
        """Return the sliders' values in the units of the inputs, (n,)."""
        scales = np.array([slider.scale for slider in self._sliders.values()])
        return scales * [self.meshcat.GetSliderValue(name) for name in self._sliders]

    def set(self, values: np.ndarray | Sequence[float]) -> None:
        """Set the sliders to values in the units of the inputs, (n,)."""
        for (name, slider), value in zip(self._sliders.items(), values, strict=True):
            self.meshcat.SetSliderValue(name, float(value / slider.scale))

    def reset(self) -> None:
        """Set all sliders to zero."""
        self.set(np.zeros(len(self._sliders)))

    def apply_gamepad(self, period: float) -> None:
        """Move the sliders by the gamepad, if one is connected, for a time `period` [s]."""
        gamepad = self.meshcat.GetGamepad()
        if gamepad.index is None:
            return
        for (axis, sign), (name, slider) in zip(GAMEPAD_AXES, self._sliders.items(), strict=False):
            deflection = gamepad.axes[axis] if axis < len(gamepad.axes) else 0.0
            if slider.speed and abs(deflection) > DEAD_ZONE:
                value = self.meshcat.GetSliderValue(name) + sign * deflection * slider.speed * period
                self.meshcat.SetSliderValue(name, float(np.clip(value, -slider.limit, slider.limit)))

    def take_click(self, button: str) -> bool:
        """Return True once for each click on a button since the last call."""
        clicks, taken = self.meshcat.GetButtonClicks(button), self._clicks.get(button, 0)
        self._clicks[button] = min(taken + 1, clicks)
        return clicks > taken

    def take_clicks(self, button: str) -> bool:
        """Return True if a button was clicked since the last call, however often."""
        clicks, taken = self.meshcat.GetButtonClicks(button), self._clicks.get(button, 0)
        self._clicks[button] = clicks
        return clicks > taken


def set_camera(meshcat: Any, task: Any) -> Viewpoint | None:
    """Set the page's camera to the viewpoint of a task's scene, and return it; None if the scene has none."""
    viewpoint = task.scene().viewpoint
    if viewpoint is not None:
        meshcat.SetProperty("/Cameras/default/rotated/<object>", "near", CAMERA_NEAR)
        meshcat.SetCameraPose(*(np.array(point) for point in viewpoint))
    return viewpoint


def page_address(meshcat: Any) -> str:
    """Return the address of a page, with the command that forwards its port to another machine."""
    port = meshcat.port()
    return f"{meshcat.web_url()} (from another machine: ssh -L {port}:localhost:{port})"
