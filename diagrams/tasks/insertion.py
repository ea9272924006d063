"""Base class of insertion tasks: a workpiece in the tool and a fixture at an uncertain position."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from pydantic import Field, field_validator
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort

from guiderail.diagrams.envs.cameras import Camera, look_at
from guiderail.diagrams.envs.observation import ObservationTerm, affine
from guiderail.diagrams.envs.options import Numbers, ResetOptions
from guiderail.diagrams.stations.station import Impedance, Station, max_wrench
from guiderail.diagrams.tasks.offsets import HiddenOffsets, in_ring
from guiderail.diagrams.tasks.options import MIN_CONTACT_FORCE
from guiderail.diagrams.tasks.task import EpisodeConstant, Task
from guiderail.models.common.transforms import MM, POSE_SIZE
from guiderail.models.control.keep_out import KeepOut
from guiderail.models.control.wrench import MAX_WRENCH_SIZE
from guiderail.models.primitives import LinearConstraints
from guiderail.systems.center_of_pressure import CenterOfPressure
from guiderail.systems.episode_monitor import TerminationTerm
from guiderail.systems.relative_poses import RelativePoses

MAX_GIVEN_OFFSET = 0.3  # [m] largest coordinate of a given offset; a larger one was probably meant in millimeters


# Center and scale of an observed force limit [N]; they do not depend on `force_limit_range`, so that a policy can be
# evaluated with another range.
LIMIT_CENTER, LIMIT_SCALE = 20.0, 10.0


HIDDEN_OFFSET_SCALE = (2.0 * MM, 2.0 * MM, 0.1)
EXACT_WRENCH_SCALE = (5.0, 5.0, 8.0, 0.02, 0.02, 0.2)
"""Scales of a privileged critic's observation: x, y and turn of the fixture, force and torque."""


class InsertionReset(ResetOptions):
    """Options of a reset of an insertion task."""

    new_run: bool = Field(False, description="sample the hidden values of a run again")
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
            raise ValueError(f"give x and y in meters, from {-MAX_GIVEN_OFFSET} to {MAX_GIVEN_OFFSET}")
        return value


class InsertionTask(Task):
    """Insertion of a workpiece in the tool into a fixture, with sampled offsets of both and a force limit.

    Attributes:
        workpiece: Name of the workpiece's body, and of the signal of its pose in the fixture.
        fixture: Name of the fixture's body.
        simulated_rewards: Rewards that use components of the workpiece's pose that a robot cannot measure.
        offsets: Sampler of the offsets; it stores the hidden values of a run.
    """

    Reset: ClassVar[type[ResetOptions]] = InsertionReset
    has_held_out_distribution = True
    workpiece: ClassVar[str]
    fixture: ClassVar[str]
    simulated_rewards: ClassVar[tuple[str, ...]] = ()

    offsets: HiddenOffsets

    def signals(self, builder: DiagramBuilder, station: Station) -> Mapping[str, OutputPort]:
        """Return the workpiece's actual pose in the fixture, (6,): position and rotation vector, offsets included.

        On hardware the pose is estimated from the robot's own pose, if the task defines `observable_success`. A sampled
        force limit is the signal `force_limit`, and the signal `max_wrench` bounds the station's force by it.
        """
        return self._add_force_limit(builder, station) | self._add_workpiece_pose(builder, station)

    def _add_force_limit(self, builder: DiagramBuilder, station: Station) -> dict[str, OutputPort]:
        sampled = self._force_limit_range
        if sampled is None:
            return {}
        # The smallest force limit applies until a reset samples another one.
        limit = EpisodeConstant(builder, "force_limit", 1, np.array(sampled[:1]))
        self.episode_constants["force_limit"] = limit
        if not station.HasInputPort("max_wrench"):
            return {"force_limit": limit.port}
        bound = EpisodeConstant(builder, "max_wrench", MAX_WRENCH_SIZE, max_wrench(sampled[0]))
        self.episode_constants["max_wrench"] = bound
        return {"force_limit": limit.port, "max_wrench": bound.port}

    @property
    def _force_limit_range(self) -> tuple[float, ...] | None:
        return getattr(self.options, "force_limit_range", None)

    def force_limit_terms(self) -> tuple[ObservationTerm, ...]:
        """Return the term of a sampled force limit, or no term; symmetry transformations leave the limit unchanged."""
        return () if self._force_limit_range is None else (ObservationTerm("force_limit", LIMIT_CENTER, LIMIT_SCALE),)

    def _add_workpiece_pose(self, builder: DiagramBuilder, station: Station) -> dict[str, OutputPort]:
        if not station.HasOutputPort("body_poses"):
            observable = self.observable_success()
            if observable is None:
                return {}
            estimate = builder.AddNamedSystem(f"{self.workpiece}_estimate", affine(*observable))
            builder.Connect(station.get_pose_output_port(), estimate.get_input_port())
            return {self.workpiece: estimate.get_output_port()}
        self.episode_constants["hidden_offset"] = EpisodeConstant(builder, "hidden_offset", 3)
        plant = station.plant
        relative = RelativePoses(plant, [plant.GetBodyByName(self.workpiece)], plant.GetBodyByName(self.fixture))
        builder.AddNamedSystem(f"{self.workpiece}_in_{self.fixture}", relative)
        builder.Connect(station.GetOutputPort("body_poses"), relative.get_body_poses_input_port())
        return {
            self.workpiece: relative.get_relative_poses_output_port(),
            "hidden_offset": self.episode_constants["hidden_offset"].port,
        }

    def observable_success(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return D (6, 6) and y0 (6,) of the estimate D X_TP + y0 of the workpiece's pose from the robot's pose X_TP.

        If it returns None, the default, the task cannot be learned on hardware.
        """
        return None

    def impedance(self) -> Impedance | None:
        """Return an impedance with a force below the force limit; None if the option `bounded_force` is false."""
        if not getattr(self.options, "bounded_force", True):
            return None
        return Impedance().with_max_force(self.collision.above)

    def privileged_terms(self) -> Sequence[ObservationTerm]:
        """Return the fixture's actual offset and the exact wrench."""
        return (
            ObservationTerm("hidden_offset", 0.0, HIDDEN_OFFSET_SCALE),
            ObservationTerm("exact_wrench", 0.0, EXACT_WRENCH_SCALE),
        )

    def force_limit(self) -> TerminationTerm:
        """Return the term that ends an episode as a collision above `collision.above` [N], or above a sampled limit."""
        if self._force_limit_range is not None:
            return TerminationTerm(
                "collision",
                {"contact_force": 1, "force_limit": 1},
                lambda contact_force, force_limit: contact_force[0] > force_limit[0],
            )
        limit = self.collision.above
        return TerminationTerm("collision", {"contact_force": 1}, lambda contact_force: contact_force[0] > limit)

    def reset(
        self, station: Station, guidance: Diagram, context: Context, rng: np.random.Generator, options: Any
    ) -> dict[str, Any]:
        """Sample the offsets, move fixture and workpiece, and put the tool at its start pose."""
        fixture, workpiece = self.offsets.draw(rng, options)
        self.set_part_offsets(station, context, fixture, workpiece)
        station.set_pose(context, self.start_pose(rng))
        if "hidden_offset" in self.episode_constants:
            self.episode_constants["hidden_offset"].set(context, np.resize([*fixture, 0.0], 3))
        sampled: dict[str, Any] = {f"{self.fixture}_offset": fixture.copy(), "grasp_offset": workpiece.copy()}
        if self._force_limit_range is not None:
            lowest, highest = self._force_limit_range
            limit = float(rng.uniform(lowest, highest))
            self.episode_constants["force_limit"].set(context, np.array([limit]))
            if "max_wrench" in self.episode_constants:
                self.episode_constants["max_wrench"].set(context, max_wrench(limit))
            sampled["force_limit"] = limit
        return sampled

    def set_part_offsets(self, station: Station, context: Context, fixture: np.ndarray, workpiece: np.ndarray) -> None:
        """Move fixture and workpiece of a `MovableWorkcell` by their offsets, in the root context.

        The offsets of the fixture are (2,) or (3,), those of the workpiece (2,) or (4,), as in `part_poses`.
        """
        plant, workcell = station.plant, self.workcell()
        own = plant.GetMyMutableContextFromRoot(context)
        X_TTactual, X_PWorkpiece = part_poses(fixture, workpiece)
        workcell.set_fixture_offset(plant, own, X_TTactual)
        workcell.set_grasp_offset(plant, own, X_PWorkpiece)

    @abstractmethod
    def start_pose(self, rng: np.random.Generator) -> np.ndarray:
        """Return the pose at which an episode starts, (6,)."""


def part_poses(fixture: np.ndarray, workpiece: np.ndarray) -> tuple[RigidTransform, RigidTransform]:
    """Return the actual target frame in the nominal one, and the workpiece in the tool, of a task's sampled offsets.

    Args:
        fixture: (x, y) of the fixture [m], and its turn about z [rad] if it has one.
        workpiece: (x, y) of the workpiece in the tool [m], and its tilt about x and y [rad] if it has one.
    """
    turn = RotationMatrix.MakeZRotation(fixture[2]) if len(fixture) > 2 else RotationMatrix()
    tilt = RotationMatrix(RollPitchYaw(*workpiece[2:], 0.0)) if len(workpiece) > 2 else RotationMatrix()
    return RigidTransform(turn, [*fixture[:2], 0.0]), RigidTransform(tilt, [*workpiece[:2], 0.0])


WRIST_IMAGE_SIZE = (48, 48)  # width and height of the wrist camera's image [pixels]


class DemonstratedInsertion(InsertionTask):
    """Insertion with demonstrations and box constraints, and with the center of pressure as a signal.

    The observation "center_of_pressure" adds the center of pressure and the commanded x and y to the state. "image" is
    the wrist camera's image alone; "image_and_state" adds it to the state.

    Attributes:
        insertion_length: Length of the insertion, which scales the distance of the wrist camera [m].
    """

    isotropic_groups = ((0, 1, 2), (3, 4, 5))
    insertion_length: float
    options: Any  # must have `start_offset_max`

    @abstractmethod
    def constraints(self) -> LinearConstraints:
        """Return the bounds of every commanded pose."""

    def keep_out(self) -> KeepOut:
        """Return no walls: safe residual learning is limited by the constraints alone."""
        return KeepOut(np.empty((0, POSE_SIZE)), np.empty((0, POSE_SIZE)), self.constraints(), margin=0.0)

    def signals(self, builder: DiagramBuilder, station: Station) -> Mapping[str, OutputPort]:
        """Return the workpiece's pose in the fixture and the center of pressure."""
        system = builder.AddNamedSystem("center_of_pressure", CenterOfPressure(MIN_CONTACT_FORCE))
        builder.Connect(station.get_wrench_output_port(), system.get_wrench_input_port())
        return {**super().signals(builder, station), "center_of_pressure": system.get_center_of_pressure_output_port()}

    @property
    def has_image(self) -> bool:
        """True if the observation is or contains the image of the wrist camera."""
        return self.config.observation.startswith("image")

    def observation_camera(self) -> Camera | None:
        """Return the wrist camera of the observation "image_and_state"."""
        return self.wrist_camera() if self.config.observation == "image_and_state" else None

    def wrist_camera(self) -> Camera:
        """Return a camera on the tool that looks at the workpiece's lower end and the fixture below it.

        Its distance from the tool center is about 3.5 times `insertion_length`.
        """
        eye, target = (self.insertion_length * np.array(place) for place in ([2.4, 0.0, 2.4], [0.0, 0.0, -0.3]))
        return Camera(WRIST_IMAGE_SIZE, np.deg2rad(40.0), look_at(eye, target), frame="grasp")

    def start_pose(self, rng: np.random.Generator) -> np.ndarray:
        """Return the demonstrations' start plus a sampled offset, inside the constraints."""
        start = self.reference().means[0].copy()
        if self.options.start_offset_max > 0.0:
            start[:2] += in_ring(rng, 0.0, self.options.start_offset_max)
        return self.constraints().nearest(start)

    def action_dims(self) -> list[int]:
        """Return the indices of the outputs that an action moves."""
        chosen = self.config.options["action_dims"]
        return list(range(POSE_SIZE) if chosen is None else chosen)
