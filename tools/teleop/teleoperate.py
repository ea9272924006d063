"""Teleoperation of a task in the browser: `guiderail teleoperate`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

import gymnasium

from guiderail.models.common.errors import InputError
from guiderail.systems.meshcat_device import MeshcatDevice
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.rollout import EnvCallback, PolicyFn, Transition, rollout
from guiderail.tools.teleop.recorder import record_demonstrations
from guiderail.tools.teleop.teleoperator import GAMEPAD_AXES, KEY_PAIRS, page_address


class LiveView(EnvCallback):
    """Renders every transition while it happens."""

    def on_step(self, transition: Transition) -> None:
        """Render the transition."""
        self.env.render()


def teleoperate(
    task: str,
    environment: Mapping[str, Any],
    *,
    record: Path | None = None,
    log: Callable[[str], None] = print,
) -> dict[str, Any] | None:
    """Let the operator act in place of the policy until Ctrl-C, or record demonstrations and return their statistics.

    The operator gives the action of the task's guidance. With `record`, a file .npz or .csv which must not exist, the
    operator moves the desired pose instead.

    Raises:
        InputError: If the task cannot be teleoperated, or the demonstrations cannot be written.
    """
    if record is not None:
        return record_demonstrations(task, environment, record, log)
    env = make_environment(task, environment, render_mode="human")
    base, size = cast(Any, env.unwrapped), int(env.action_space.shape[0])  # type: ignore[index]
    if size > len(GAMEPAD_AXES):
        raise InputError(
            f"an action of {task} has {size} numbers and a device {len(GAMEPAD_AXES)}: choose another --guidance"
        )
    device = MeshcatDevice(base.task.meshcat, GAMEPAD_AXES[:size], KEY_PAIRS[:size], base.task.control_period)
    log(f"Teleoperate at {page_address(base.task.meshcat)} with a gamepad, the sliders, or the keys:")
    log(", ".join(f"{lower[-1]} and {higher[-1]}" for lower, higher in KEY_PAIRS[:size]) + ". Ctrl-C ends.")
    while True:
        log(run_episode(env, lambda observation: device.read()))


def run_episode(env: gymnasium.Env, act: PolicyFn, index: int = 0) -> str:
    """Run and render an episode of a policy or an operator; return its termination."""
    return rollout(env, act, LiveView(env), index=index)["termination"]
