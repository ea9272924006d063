"""Offsets of fixture and workpiece for a simulated driver, sampled as by a reset in simulation."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydrake.lcm import DrakeLcmInterface
from pydrake.systems.framework import Context

from guiderail.diagrams.envs.options import validate_options
from guiderail.diagrams.hardware.lcm.driver import LcmDriver
from guiderail.diagrams.hardware.lcm.simulated import SimulatedIiwa
from guiderail.diagrams.tasks.insertion import InsertionTask

CHANNEL = "GUIDERAIL_PART_OFFSETS"


class PartRandomizer:
    """Sampler of the offsets of a task's parts, which sends them to the simulated driver."""

    def __init__(self, task: InsertionTask, driver: LcmDriver, seed: int):
        """Sample the offset of the run; it is the same as in simulation with this seed."""
        self._task, self._driver = task, driver
        task.offsets.draw(np.random.default_rng(seed), validate_options(task.Reset, {}, "a simulated driver"))

    def __call__(self, rng: np.random.Generator, options: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """Move the parts to offsets sampled with the options of a reset in simulation; return the offsets by name."""
        reset = validate_options(self._task.Reset, options, "a simulated driver")
        fixture, workpiece = self._task.offsets.draw(rng, reset)
        self._driver.lcm.Publish(CHANNEL, json.dumps([fixture.tolist(), workpiece.tolist()]).encode())
        return {f"{self._task.fixture}_offset": fixture.copy(), "grasp_offset": workpiece.copy()}


def subscribe_part_offsets(lcm: DrakeLcmInterface, task: InsertionTask, robot: SimulatedIiwa, context: Context) -> None:
    """Let a simulated robot apply the offsets that a `PartRandomizer` sends; `context` is the root context."""

    def apply(message: bytes) -> None:
        fixture, workpiece = json.loads(message)
        task.set_part_offsets(robot, context, np.array(fixture), np.array(workpiece))

    lcm.Subscribe(CHANNEL, apply)
