"""Supervision of a training in the browser: `guiderail train --human-in-the-loop`."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, cast

import gymnasium
import numpy as np

from guiderail.diagrams.envs.cameras import open_meshcat
from guiderail.diagrams.envs.scene import View
from guiderail.models.common.errors import InputError
from guiderail.tools.learning.interventions import Supervisor
from guiderail.tools.teleop.teleoperator import KEY_PAIRS, MeshcatPanel, Slider, page_address, set_camera

# Labels of an episode by button, and the buttons' keys.
LABELS = {"success (Enter)": "success", "failure (Backspace)": "failure", "stop (Escape)": "stop"}
LABEL_KEYS = {"success (Enter)": "Enter", "failure (Backspace)": "Backspace", "stop (Escape)": "Escape"}
RELEASE, RELEASE_KEY = "let go (Space)", "Space"
LIMIT, STEP = 4.0, 0.25  # of a slider, in units of a full action


class MeshcatSupervisor(Supervisor):
    """Supervisor at a Meshcat page: sliders correct the policy, buttons label an episode.

    An episode runs in real time while it is supervised.

    Attributes:
        panel: The page's controls.
    """

    def __init__(self, log: Callable[[str], None], meshcat: Any = None):
        """Open the page, a new one on this machine by default."""
        meshcat = open_meshcat()[0] if meshcat is None else meshcat
        self.panel = MeshcatPanel(meshcat, {}, {**LABEL_KEYS, RELEASE: RELEASE_KEY})
        self._log = log
        self._view: View | None = None
        self._has_camera = self._is_stop_pending = False

    def wait(self) -> None:
        """Show the page's address and block until a browser connects."""
        self._log(f"Watch at {page_address(self.panel.meshcat)}.")
        self._log("Sliders push, each with two keys; Space lets go; Enter: success, Backspace: failure, Escape: stop.")
        while self.panel.meshcat.GetNumActiveConnections() == 0:
            time.sleep(0.1)

    def on_episode_start(self, env: gymnasium.Env) -> None:
        """Show an episode of `env` with all sliders at zero; of earlier clicks only a stop is kept."""
        base = cast(Any, env.unwrapped)
        self._add_sliders(base)
        if base.task.query is not None:
            self._view = View(base.task.query, self.panel.meshcat)
            if not self._has_camera and base.task.declaration is not None:
                set_camera(self.panel.meshcat, base.task.declaration)
                self._has_camera = True  # set once, because the supervisor may move the camera
            base.simulator.set_monitor(self._view.follow)
            base.simulator.set_target_realtime_rate(1.0)
        self.panel.reset()
        self._is_stop_pending = self.label() == "stop"

    def correction(self, observation: np.ndarray) -> np.ndarray | None:
        """Return the sliders' values, (A,); None while all are zero."""
        if self.panel.take_clicks(RELEASE):
            self.panel.reset()
        values = self.panel.read()
        return values if values.any() else None

    def label(self) -> str | None:
        """Return the last label that was clicked since the last call."""
        label, self._is_stop_pending = "stop" if self._is_stop_pending else None, False
        for button, clicked in LABELS.items():
            if self.panel.take_clicks(button):
                label = clicked
        return label

    def _add_sliders(self, base: Any) -> None:
        size = int(base.action_space.shape[0])
        if size > len(KEY_PAIRS):
            raise InputError(
                f"an action of {size} numbers can't be pushed by {len(KEY_PAIRS)} sliders: give fewer action_dims"
            )
        for number in range(size):
            self.panel.add_slider(f"push {number + 1}", Slider(LIMIT, STEP, KEY_PAIRS[number]))
