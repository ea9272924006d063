"""Base class of insertion tasks: a workpiece in the tool and a fixture at an uncertain position."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from pydantic import Field, field_validator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort

from guiderail.diagrams.envs.observation import affine
from guiderail.diagrams.envs.options import Numbers, ResetOptions
from guiderail.diagrams.stations.station import Station
from guiderail.diagrams.tasks.offsets import HiddenOffsets
from guiderail.diagrams.tasks.task import Task
from guiderail.systems.episode_monitor import TerminationTerm
from guiderail.systems.relative_poses import RelativePoses

MAX_GIVEN_OFFSET = 0.3  # [m] largest coordinate of a given offset; a larger one was probably meant in millimetres


class InsertionReset(ResetOptions):
    """Options of a reset of an insertion task."""

    new_run: bool = Field(False, description="sample again what is hidden for a run")
    offset: Numbers | None = Field(
        None,
        min_length=2,
        max_length=2,
        description="(x, y) of the fixture or the workpiece [m]; default: sampled",
    )

    @field_validator("offset")
    @classmethod
    def _is_near(cls, value: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if value is not None and max(map(abs, value)) > MAX_GIVEN_OFFSET:
            raise ValueError(f"give x and y in metres, from {-MAX_GIVEN_OFFSET} to {MAX_GIVEN_OFFSET}")
        return value


class InsertionTask(Task):
    """Insertion of a workpiece in the tool into a fixture, with sampled offsets of both and a force limit.

    Attributes:
        workpiece: Name of the workpiece's body, and of the signal of its pose in the fixture.
        fixture: Name of the fixture's body.
        simulated_rewards: Rewards that need more of that signal than a robot can measure.
        offsets: Sampler of the offsets; it holds what is hidden for a run.
    """

    Reset: ClassVar[type[ResetOptions]] = InsertionReset
    has_held_out_distribution = True
    workpiece: ClassVar[str]
    fixture: ClassVar[str]
    simulated_rewards: ClassVar[tuple[str, ...]] = ()

    offsets: HiddenOffsets

    def signals(self, builder: DiagramBuilder, station: Station) -> Mapping[str, OutputPort]:
        """Return the workpiece's actual pose in the fixture, (6,): position and rotation vector, offsets included.

        On hardware it is what `observable_success` computes from the robot's own pose, if the task defines that.
        """
        if not station.HasOutputPort("body_poses"):
            observable = self.observable_success()
            if observable is None:
                return {}
            estimate = builder.AddNamedSystem(f"{self.workpiece}_as_seen", affine(*observable))
            builder.Connect(station.get_pose_output_port(), estimate.get_input_port())
            return {self.workpiece: estimate.get_output_port()}
        plant = station.plant
        relative = RelativePoses(plant, [plant.GetBodyByName(self.workpiece)], plant.GetBodyByName(self.fixture))
        builder.AddNamedSystem(f"{self.workpiece}_in_{self.fixture}", relative)
        builder.Connect(station.GetOutputPort("body_poses"), relative.get_body_poses_input_port())
        return {self.workpiece: relative.get_relative_poses_output_port()}

    def observable_success(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return D (6, 6) and y0 (6,) of the estimate D X_TP + y0 of the workpiece's pose from the robot's pose X_TP.

        With None, the default, the task cannot be learned on hardware.
        """
        return None

    def force_limit(self) -> TerminationTerm:
        """Return the term that ends an episode as a collision above the force `collision.above` [N]."""
        limit = self.collision.above
        return TerminationTerm("collision", {"contact_force": 1}, lambda contact_force: contact_force[0] > limit)

    def reset(
        self, station: Station, guidance: Diagram, context: Context, rng: np.random.Generator, options: Any
    ) -> dict[str, Any]:
        """Sample the offsets, move fixture and workpiece, and put the tool at its start pose."""
        fixture, workpiece = self.offsets.draw(rng, options)
        self.set_part_offsets(station, context, fixture, workpiece)
        station.set_pose(context, self.start_pose(rng))
        return {f"{self.fixture}_offset": fixture.copy(), "grasp_offset": workpiece.copy()}

    @abstractmethod
    def set_part_offsets(self, station: Station, context: Context, fixture: np.ndarray, workpiece: np.ndarray) -> None:
        """Move fixture and workpiece by their offsets.

        Args:
            station: Station.
            context: Root context.
            fixture: Offset of the fixture, (n,), as this task samples it.
            workpiece: Offset of the workpiece, (n,).
        """

    @abstractmethod
    def start_pose(self, rng: np.random.Generator) -> np.ndarray:
        """Return the pose at which an episode starts, (6,)."""
