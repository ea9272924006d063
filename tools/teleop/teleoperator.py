"""`guiderail drive`: the diagram that a policy learns on, with a person in the policy's place."""

from __future__ import annotations

import gc
import select
import signal
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, cast

import gymnasium

from guiderail.models.common.errors import InputError
from guiderail.systems.meshcat_device import MeshcatDevice
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.rollout import EnvCallback, PolicyFn, Transition, rollout

PAUSE = "p"


class Keys:
    """Listens without waiting: Enter or Ctrl-C stops the arm, p and Enter pauses it where an episode ends.

    Attributes:
        wants_pause: whether somebody asked for one; who pauses takes it back.
    """

    def __init__(self) -> None:
        self.wants_pause = False
        self._is_stopped = False

    def stops(self) -> bool:
        """Whether somebody wants the arm to stop, since this was last taken back."""
        if not self._is_stopped and sys.stdin.isatty() and select.select([sys.stdin], [], [], 0.0)[0]:
            if sys.stdin.readline().strip().lower() == PAUSE:
                self.wants_pause = True
            else:
                self._is_stopped = True
        return self._is_stopped

    def words(self, *, pauses: bool = False) -> str:
        """What a person is told of them: where nobody can type, Ctrl-C alone; `pauses` where there are episodes."""
        if not sys.stdin.isatty():
            return "Ctrl-C stops the arm"
        return "Enter or Ctrl-C stops the arm" + pauses * ", p and Enter pauses it at the end of an episode"

    def press(self) -> None:
        """As if Enter had been pressed."""
        self._is_stopped = True

    def take_back(self) -> None:
        """Somebody said to go on."""
        self._is_stopped = False


@contextmanager
def listening() -> Iterator[Keys]:
    """Keys, and Ctrl-C as one of them; the second Ctrl-C in a row ends the process."""
    keys = Keys()

    def press(number: int, frame: object) -> None:
        if keys.stops():
            raise KeyboardInterrupt
        keys.press()

    before = signal.signal(signal.SIGINT, press)
    try:
        yield keys
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def no_pauses() -> Iterator[None]:
    """A garbage collection takes longer than a robot waits for a command."""
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()


# For each input the gamepad's axis with its sign, and the keys that lower and raise it.
AXES = ((0, 1.0), (1, -1.0), (3, -1.0), (2, 1.0), (4, 1.0), (5, 1.0))
KEYS = (("KeyA", "KeyD"), ("KeyS", "KeyW"), ("KeyF", "KeyR"), ("KeyJ", "KeyL"), ("KeyK", "KeyI"), ("KeyH", "KeyY"))


class Live(EnvCallback):
    """Shows every decision while it happens."""

    def on_step(self, decision: Transition) -> None:
        """Shows it."""
        self.env.render()


def drive(env: gymnasium.Env, driver: PolicyFn, episodes: int) -> list[str]:
    """Runs episodes with whoever drives; returns how they ended. A policy is a driver, and so is a person's device."""
    return [rollout(env, driver, Live(env), index=i)["termination"] for i in range(episodes)]


def drive_by_hand(task: str, environment: Mapping[str, Any]) -> None:
    """Opens a browser view and follows its gamepad, sliders and keys, episode after episode, until it is interrupted.

    Raises:
        InputError: for a task or an argument that there isn't, or an action of more numbers than a device has.
    """
    env = make_environment(task, environment, render_mode="human")
    base, size = cast(Any, env.unwrapped), int(env.action_space.shape[0])  # type: ignore[index]
    if size > len(AXES):
        raise InputError(f"an action of {task} has {size} numbers and a device {len(AXES)}: choose another --guidance")
    device = MeshcatDevice(base.task.meshcat, AXES[:size], KEYS[:size], base.task.control_period)
    print(f"Drive at {base.task.meshcat.web_url()} with a gamepad, the sliders, or the keys:")
    print(", ".join(f"{lower[-1]} and {higher[-1]}" for lower, higher in KEYS[:size]) + ". Ctrl-C ends.", flush=True)
    while True:
        print(*drive(env, lambda observation: device.read(), episodes=1), flush=True)
