"""Where fixture and workpiece are in a rehearsal: what a reset draws in a simulation, and at a robot a person does."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydrake.lcm import DrakeLcmInterface
from pydrake.systems.framework import Context

from guiderail.diagrams.envs.options import validate_options
from guiderail.diagrams.hardware.driver import Driver
from guiderail.diagrams.hardware.lcm.simulated import SimulatedIiwa
from guiderail.diagrams.tasks.insertion import InsertionTask


def _channel(driver: Driver) -> str:
    return driver.status_channel + "_PLACES"


class PartRandomizer:
    """Draws where the parts of a task are, and tells a simulated robot, which puts them there."""

    def __init__(self, task: InsertionTask, lcm: DrakeLcmInterface, driver: Driver, seed: int):
        """
        Args:
            task: whose parts.
            lcm: the robot's bus.
            driver: of the robot.
            seed: of what is hidden for the whole run: the same as in a simulation with this seed.
        """
        self._task, self._lcm, self._driver = task, lcm, driver
        task.offsets.draw(np.random.default_rng(seed), validate_options(task.Reset, {}, "a rehearsal"))

    def __call__(self, rng: np.random.Generator, options: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """Puts them anew; returns what was drawn. `options` are those of a reset in a simulation."""
        fixture, workpiece = self._task.offsets.draw(rng, validate_options(self._task.Reset, options, "a rehearsal"))
        self._lcm.Publish(_channel(self._driver), json.dumps([fixture.tolist(), workpiece.tolist()]).encode())
        return {f"{self._task.fixture}_offset": fixture.copy(), "grasp_offset": workpiece.copy()}


def put(lcm: DrakeLcmInterface, driver: Driver, task: InsertionTask, robot: SimulatedIiwa, context: Context) -> None:
    """Has a simulated robot do what `PartRandomizer` say, whenever its bus is heard; `context` is the root context."""

    def move(message: bytes) -> None:
        fixture, workpiece = json.loads(message)
        task.set_part_offsets(robot, context, np.array(fixture), np.array(workpiece))

    lcm.Subscribe(_channel(driver), move)
