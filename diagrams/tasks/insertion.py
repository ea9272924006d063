"""What tasks share in which a robot puts one thing into another, by contact, without knowing exactly where it is."""

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

FARTHEST = 0.3  # [m] along x or y: out of the way of every tool; what is more was meant in millimetres


class InsertionReset(ResetOptions):
    """Of a reset of an insertion."""

    new_run: bool = Field(False, description="draw anew what is hidden and constant in a run")
    offset: Numbers | None = Field(
        None,
        min_length=2,
        max_length=2,
        description="(x, y) [m] of the fixture or the workpiece, instead of drawing it",
    )

    @field_validator("offset")
    @classmethod
    def _is_near(cls, value: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if value is not None and max(map(abs, value)) > FARTHEST:
            raise ValueError(f"give x and y in metres, from {-FARTHEST} to {FARTHEST}")
        return value


class InsertionTask(Task):
    """A workpiece in the tool and a fixture in the world, whose offsets a reset draws; too much force ends an episode.

    Attributes:
        workpiece, fixture: names of their bodies; where the one is in the other is the signal named as the workpiece.
        simulated_rewards: that ask for more of that signal than a robot can tell.
    """

    Reset: ClassVar[type[ResetOptions]] = InsertionReset
    has_held_out_distribution = True
    workpiece: ClassVar[str]
    fixture: ClassVar[str]
    simulated_rewards: ClassVar[tuple[str, ...]] = ()

    offsets: HiddenOffsets
    """What a reset draws; made once, as it remembers what is hidden in a run."""

    def signals(self, builder: DiagramBuilder, station: Station) -> Mapping[str, OutputPort]:
        """Where the workpiece really is in the fixture, (6,): position and rotation vector, offsets included.

        Only a simulation knows that; a robot has what it can tell from its own pose, where somebody wrote that down.
        """
        if not station.HasOutputPort("body_poses"):
            seen = self.observable_success()
            if seen is None:
                return {}
            told = builder.AddNamedSystem(f"{self.workpiece}_as_seen", affine(*seen))
            builder.Connect(station.get_pose_output_port(), told.get_input_port())
            return {self.workpiece: told.get_output_port()}
        plant = station.plant
        relative = RelativePoses(plant, [plant.GetBodyByName(self.workpiece)], plant.GetBodyByName(self.fixture))
        builder.AddNamedSystem(f"{self.workpiece}_in_{self.fixture}", relative)
        builder.Connect(station.GetOutputPort("body_poses"), relative.get_body_poses_input_port())
        return {self.workpiece: relative.get_relative_poses_output_port()}

    def observable_success(self) -> tuple[np.ndarray, np.ndarray] | None:
        """D (6, 6) and y0 (6,) of D X_TP + y0: where a robot without eyes would say that the workpiece is.

        None where nobody wrote it down: then the task can't be learned on a robot.
        """
        return None

    def force_limit(self) -> TerminationTerm:
        """Ends an episode as a collision where the impedance pushes harder than `collision.above` [N]."""
        limit = self.collision.above
        return TerminationTerm("collision", {"contact_force": 1}, lambda contact_force: contact_force[0] > limit)

    def reset(
        self, station: Station, guidance: Diagram, context: Context, rng: np.random.Generator, options: Any
    ) -> dict[str, Any]:
        """Draws the offsets, moves fixture and workpiece, and puts the tool to where an episode starts."""
        fixture, workpiece = self.offsets.draw(rng, options)
        self.set_part_offsets(station, context, fixture, workpiece)
        station.set_pose(context, self.start_pose(rng))
        return {f"{self.fixture}_offset": fixture.copy(), "grasp_offset": workpiece.copy()}

    @abstractmethod
    def set_part_offsets(self, station: Station, context: Context, fixture: np.ndarray, workpiece: np.ndarray) -> None:
        """Moves fixture and workpiece by their offsets, as this task draws them; `context` is the root context.

        Args:
            station: whose context it is in.
            context: the root context.
            fixture, workpiece: their offsets (n,), in the units of this task's ranges.
        """

    @abstractmethod
    def start_pose(self, rng: np.random.Generator) -> np.ndarray:
        """The pose at which an episode starts, (6,)."""
