"""`guiderail train --with-person`: whoever sits before the page in the browser."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, cast

import gymnasium
import numpy as np
from pydrake.geometry import Meshcat

from guiderail.diagrams.envs.cameras import open_meshcat
from guiderail.diagrams.envs.scene import View
from guiderail.models.common.errors import InputError
from guiderail.tools.learning.interventions import Supervisor
from guiderail.tools.teleop.teach import look_at

SAYS = {
    "success (Enter)": ("Enter", "success"),
    "failure (Backspace)": ("Backspace", "failure"),
    "stop (Escape)": ("Escape", "stop"),
}
KEYS = (("KeyA", "KeyD"), ("KeyS", "KeyW"), ("KeyF", "KeyR"), ("KeyJ", "KeyL"), ("KeyK", "KeyI"), ("KeyH", "KeyY"))
LET_GO, LET_GO_KEY = "let go (Space)", "Space"
FARTHEST, STEP = 4.0, 0.25  # of a slider, in what a full action reaches


class MeshcatSupervisor(Supervisor):
    """Sliders push, buttons speak, each with keys; an episode goes on in real time while somebody looks.

    Attributes:
        meshcat: the page.
    """

    def __init__(self, say: Callable[[str], None], meshcat: Any = None):
        """
        Args:
            say: is told where the page is, and what its keys are.
            meshcat: the page; a new one on this machine unless given.
        """
        self.meshcat: Meshcat = open_meshcat()[0] if meshcat is None else meshcat
        self._say, self._sliders = say, list[str]()
        self._clicks: dict[str, int] = {}
        self._view: View | None = None
        self._looks = self._is_stopped = False
        for name, (key, _) in SAYS.items():
            self.meshcat.AddButton(name, key)
        self.meshcat.AddButton(LET_GO, LET_GO_KEY)

    def wait(self) -> None:
        """Says where the page is and waits until somebody opens it."""
        port = self.meshcat.port()
        self._say(f"Watch at {self.meshcat.web_url()} (from elsewhere: ssh -L {port}:localhost:{port}).")
        self._say("Sliders push, each with two keys; Space lets go; Enter: success, Backspace: failure, Escape: stop.")
        while self.meshcat.GetNumActiveConnections() == 0:
            time.sleep(0.1)

    def on_episode_start(self, env: gymnasium.Env) -> None:
        """Shows the episode from here on, with all sliders let go; of what was said before it, a stop alone counts."""
        base = cast(Any, env.unwrapped)
        self._name_sliders(base)
        if base.task.query is not None:
            self._view = View(base.task.query, self.meshcat)
            if not self._looks and base.task.declaration is not None:
                look_at(self.meshcat, base.task.declaration)
                self._looks = True  # from where the person moves it to, from now on
            base.simulator.set_monitor(self._view.follow)
            base.simulator.set_target_realtime_rate(1.0)
        self._let_go()
        self._is_stopped = self.label() == "stop"

    def correction(self, observation: np.ndarray) -> np.ndarray | None:
        """Where the sliders are; None while all are let go."""
        if self._clicked(LET_GO):
            self._let_go()
        values = np.array([self.meshcat.GetSliderValue(name) for name in self._sliders])
        return values if values.any() else None

    def label(self) -> str | None:
        """What was clicked last."""
        said, self._is_stopped = "stop" if self._is_stopped else None, False
        for name, (_, word) in SAYS.items():
            if self._clicked(name):
                said = word
        return said

    def _name_sliders(self, base: Any) -> None:
        size = int(base.action_space.shape[0])
        if size > len(KEYS):
            raise InputError(f"an action of {size} numbers can't be pushed by {len(KEYS)} sliders: name fewer explored")
        for number in range(len(self._sliders), size):
            name = f"push {number + 1}"
            self.meshcat.AddSlider(name, -FARTHEST, FARTHEST, STEP, 0.0, *KEYS[number])
            self._sliders.append(name)

    def _let_go(self) -> None:
        for name in self._sliders:
            self.meshcat.SetSliderValue(name, 0.0)

    def _clicked(self, name: str) -> bool:
        clicks = self.meshcat.GetButtonClicks(name)
        known, self._clicks[name] = self._clicks.get(name, 0), clicks
        return clicks > known
