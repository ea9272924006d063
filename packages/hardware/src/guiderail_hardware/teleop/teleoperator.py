"""Input devices of an operator (sliders, keys and buttons of a Meshcat page, a gamepad), and supervision with them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import gymnasium
import numpy as np

from guiderail.diagrams.envs.scene import View, Viewpoint, open_meshcat
from guiderail.models.common.errors import InputError
from guiderail.tools.learning.episodes import Supervise
from guiderail_hardware.teleop.interventions import SupervisedTraining, Supervisor

DEAD_ZONE = 0.15  # largest deflection of a gamepad's axis that moves no slider
CAMERA_NEAR = 1e-3  # near clipping distance of the page's camera [m]

# Pair of keys that lower and raise each input (JavaScript codes), and gamepad axis of each input with its sign.
KEY_PAIRS = (("KeyA", "KeyD"), ("KeyS", "KeyW"), ("KeyF", "KeyR"), ("KeyJ", "KeyL"), ("KeyK", "KeyI"), ("KeyH", "KeyY"))
GAMEPAD_AXES = ((0, 1.0), (1, -1.0), (3, -1.0), (2, 1.0), (4, 1.0), (5, 1.0))


@dataclass(frozen=True)
class Slider:
    """Slider of a page."""

    limit: float  # largest magnitude of the value
    step: float  # change by one key press
    keys: tuple[str, str]  # keys that lower and raise the value, as JavaScript codes
    scale: float = 1.0  # factor from the slider's unit to the input's unit
    speed: float = 0.0  # change of the value per second at full deflection of its gamepad axis; 0: no axis moves it


class MeshcatPanel:
    """Sliders and buttons of a Meshcat page, each with keys; a gamepad moves the sliders.

    A value of a slider that is not finite is ignored: the slider returns to its last finite value.
    """

    def __init__(self, meshcat: Any, sliders: Mapping[str, Slider], buttons: Mapping[str, str]):
        """Add sliders, and buttons with their keys, to a page."""
        self.meshcat = meshcat
        self._sliders: dict[str, Slider] = {}
        self._values: dict[str, float] = {}  # last finite value of each slider
        self._clicks: dict[str, int] = {}
        for name, slider in sliders.items():
            self.add_slider(name, slider)
        for name, key in buttons.items():
            meshcat.AddButton(name, key)

    def add_slider(self, name: str, slider: Slider) -> None:
        """Add a slider at zero; an existing slider is left as it is."""
        if name not in self._sliders:
            self._sliders[name], self._values[name] = slider, 0.0
            self.meshcat.AddSlider(name, -slider.limit, slider.limit, slider.step, 0.0, *slider.keys)

    def read(self) -> np.ndarray:
        """Return the sliders' values in the units of the inputs, (n,)."""
        scales = np.array([slider.scale for slider in self._sliders.values()])
        return scales * [self._value(name) for name in self._sliders]

    def _value(self, name: str) -> float:
        value = float(self.meshcat.GetSliderValue(name))
        if math.isfinite(value):
            self._values[name] = value
        else:
            self.meshcat.SetSliderValue(name, self._values[name])
        return self._values[name]

    def set(self, values: np.ndarray | Sequence[float]) -> None:
        """Set the sliders to values in the units of the inputs, (n,)."""
        for (name, slider), value in zip(self._sliders.items(), values, strict=True):
            self.meshcat.SetSliderValue(name, float(value / slider.scale))

    def reset(self) -> None:
        """Set all sliders to zero."""
        self.set(np.zeros(len(self._sliders)))

    def apply_gamepad(self, period: float) -> None:
        """Move the sliders for `period` [s] at speeds proportional to the deflection of a connected gamepad."""
        gamepad = self.meshcat.GetGamepad()
        if gamepad.index is None:
            return
        for (axis, sign), (name, slider) in zip(GAMEPAD_AXES, self._sliders.items(), strict=False):
            deflection = gamepad.axes[axis] if axis < len(gamepad.axes) else 0.0
            if slider.speed and abs(deflection) > DEAD_ZONE:
                value = self._value(name) + sign * deflection * slider.speed * period
                self.meshcat.SetSliderValue(name, float(np.clip(value, -slider.limit, slider.limit)))

    def take_clicks(self, button: str) -> int:
        """Return the number of clicks on a button since the last call."""
        clicks, taken = self.meshcat.GetButtonClicks(button), self._clicks.get(button, 0)
        self._clicks[button] = clicks
        return int(clicks - taken)


def set_camera(meshcat: Any, task: Any) -> Viewpoint | None:
    """Set the page's camera to the viewpoint of a task's scene, and return the viewpoint; None if there is none."""
    viewpoint = task.scene().viewpoint
    if viewpoint is not None:
        meshcat.SetProperty("/Cameras/default/rotated/<object>", "near", CAMERA_NEAR)
        meshcat.SetCameraPose(*(np.array(point) for point in viewpoint))
    return viewpoint


def page_address(meshcat: Any) -> str:
    """Return the address of a page, with the command that forwards its port to another machine."""
    port = meshcat.port()
    return f"{meshcat.web_url()} (from another machine: ssh -L {port}:localhost:{port} HOST)"


# Labels of an episode by button, and the buttons' keys.
LABELS = {"success (Enter)": "success", "failure (Backspace)": "failure", "stop (Escape)": "stop"}
LABEL_KEYS = {"success (Enter)": "Enter", "failure (Backspace)": "Backspace", "stop (Escape)": "Escape"}
RELEASE, RELEASE_KEY = "let go (Space)", "Space"
LIMIT, STEP = 4.0, 0.25  # limit and step of a slider, in units of a full action


class MeshcatSupervisor(Supervisor):
    """Supervisor at a Meshcat page: sliders correct the policy, buttons label an episode.

    An episode runs in real time while it is supervised.
    """

    def __init__(self, log: Callable[[str], None], meshcat: Any = None):
        """Add the controls to the page `meshcat`, by default to a new page on this machine."""
        meshcat = open_meshcat()[0] if meshcat is None else meshcat
        self.panel = MeshcatPanel(meshcat, {}, {**LABEL_KEYS, RELEASE: RELEASE_KEY})
        self._log = log
        self._has_camera = self._is_stop_pending = False

    def wait(self) -> None:
        """Show the page's address and block until a browser connects."""
        self._log(f"Watch at {page_address(self.panel.meshcat)}.")
        self._log("Sliders, each with two keys, correct the motion; Space sets them to zero.")
        self._log("Enter ends the episode as a success, Backspace as a failure, Escape without a label.")
        while self.panel.meshcat.GetNumActiveConnections() == 0:
            time.sleep(0.1)

    def on_episode_start(self, env: gymnasium.Env) -> None:
        """Show an episode of `env` with all sliders at zero; drop earlier clicks, except on the stop button.

        Raises:
            InputError: If an action has more numbers than there are sliders with keys.
        """
        base = cast(Any, env.unwrapped)
        self._add_sliders(base)
        if base.diagram.query is not None:
            view = View(base.diagram.query, self.panel.meshcat)
            if not self._has_camera and base.diagram.task is not None:
                set_camera(self.panel.meshcat, base.diagram.task)
                self._has_camera = True  # set once, because the supervisor may move the camera
            base.simulator.set_monitor(view.follow)
            base.simulator.set_target_realtime_rate(1.0)
        self.panel.reset()
        self._is_stop_pending = self.label() == "stop"

    def correction(self, observation: np.ndarray) -> np.ndarray | None:
        """Return the sliders' values, (A,) in units of a full action; None while all are zero."""
        if self.panel.take_clicks(RELEASE):
            self.panel.reset()
        values = self.panel.read()
        return values if values.any() else None

    def label(self) -> str | None:
        """Return the label clicked since the last call, or None; if several were clicked, the last one in `LABELS`."""
        labels = [label for button, label in LABELS.items() if self.panel.take_clicks(button)]
        labels += ["stop"] * self._is_stop_pending
        self._is_stop_pending = False
        return labels[-1] if labels else None

    def _add_sliders(self, base: Any) -> None:
        size = int(base.action_space.shape[0])
        if size > len(KEY_PAIRS):
            raise InputError(
                f"an action of {size} numbers needs more than the {len(KEY_PAIRS)} sliders: give fewer action_dims"
            )
        for number in range(size):
            self.panel.add_slider(f"push {number + 1}", Slider(LIMIT, STEP, KEY_PAIRS[number]))


def browser_supervision(log: Callable[[str], None]) -> Supervise:
    """Block until a browser connects; return the start of episodes that its user supervises. `log` shows a message."""
    supervisor = MeshcatSupervisor(log)
    supervisor.wait()
    return lambda config: SupervisedTraining(config, supervisor)
