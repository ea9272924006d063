"""`guiderail drive`: the diagram that a policy learns on, with a person in the policy's place."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import gymnasium

from guiderail.models.common.errors import InputError
from guiderail.systems.meshcat_device import MeshcatDevice
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.rollout import EnvCallback, PolicyFn, Transition, rollout

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
