"""Base class of insertion tasks: a workpiece in the tool and a fixture at an uncertain position.

`InsertionTask` is general; the clamp derives from it. `DemonstratedInsertion` and its rewards, tuned for the connector,
are shared with parts: a change alters both.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, ValidationInfo, field_validator
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.framework import Context, DiagramBuilder, OutputPort
from scipy.linalg import block_diag

from guiderail.diagrams.envs.observation import ObservationTerm, Observed, affine
from guiderail.diagrams.envs.options import Number, Pair, ResetOptions, satisfies
from guiderail.diagrams.envs.scene import Camera, look_at
from guiderail.diagrams.guidance.prior import Prior
from guiderail.diagrams.stations.gantry import GantryStation
from guiderail.diagrams.stations.station import Impedance, Station, max_wrench
from guiderail.diagrams.stations.workcell import contact_lever
from guiderail.diagrams.tasks.contact_probe import RimContact
from guiderail.diagrams.tasks.options import (
    CENTER_OF_PRESSURE_SCALE,
    COMMAND_SCALE,
    CONTACT_MEMORY,
    FORCE_LIMITS,
    MIN_CONTACT_FORCE,
    NEGLIGIBLE_OFFSET,
    ForceRange,
    HiddenOffsets,
    OffsetRange,
    force_limit_field,
    in_ring,
)
from guiderail.diagrams.tasks.task import Task, Threshold, World, add_constant, terminal_reward
from guiderail.diagrams.wiring import add_system
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.transforms import MM, POSE_SIZE
from guiderail.models.control.command_filters import KeepOut
from guiderail.models.primitives import LinearConstraints, ReferenceTrajectory
from guiderail.systems.poses import RelativePoses
from guiderail.systems.wrench_signals import CenterOfPressure, MeanContactPoint

MAX_GIVEN_OFFSET = 0.3  # [m] largest coordinate of a given offset; a larger one is probably in millimeters


# Center and scale of an observed force limit [N]. They do not depend on `force_limit_range`, so that a policy can be
# evaluated with a different range.
LIMIT_CENTER, LIMIT_SCALE = 20.0, 10.0


HIDDEN_OFFSET_SCALE = (2.0 * MM, 2.0 * MM, 0.1)
EXACT_WRENCH_SCALE = (5.0, 5.0, 8.0, 0.02, 0.02, 0.2)
"""Scales of a privileged critic's observation: x, y [m] and turn [rad] of the fixture, force [N] and torque [Nm]."""
PRIVILEGED = (
    ObservationTerm("hidden_offset", 0.0, HIDDEN_OFFSET_SCALE),
    ObservationTerm("exact_wrench", 0.0, EXACT_WRENCH_SCALE),
)


GivenOffset = Annotated[
    Pair,
    satisfies(
        lambda offset: max(map(abs, offset)) <= MAX_GIVEN_OFFSET,
        f"give x and y in meters, from {-MAX_GIVEN_OFFSET} to {MAX_GIVEN_OFFSET}",
    ),
]


class InsertionReset(ResetOptions):
    """Options of a reset of an insertion task."""

    new_run: bool = Field(False, description="sample the hidden values of a run again")
    offset: GivenOffset | None = Field(None, description="(x, y) of the fixture or the workpiece [m]; default: sampled")


@dataclass(frozen=True)
class HoldTest:
    """Push on an inserted workpiece, to confirm a success on hardware, where the workpiece's pose is not measured."""

    displacement: tuple[float, float, float]  # displacement of the command, (3,) [m]
    max_motion: float  # largest measured motion in the direction of the displacement [m]


# Displacement of the command in a hold test, and largest motion of a workpiece that resists it [m].
HOLD_DISTANCE, MAX_HOLD_MOTION = 3.0 * MM, 1.0 * MM


class InsertionTask(Task):
    """Insertion of a workpiece in the tool into a fixture, with sampled offsets of both and a force limit.

    Held-out offsets are sampled from the same range as training offsets, with random numbers that training never uses.

    Attributes:
        workpiece: Name of the workpiece's body, and of the signal of its pose in the fixture.
        fixture: Name of the fixture's body.
        simulated_rewards: Rewards that use components of the workpiece's pose that cannot be measured on hardware.
        snaps_in: True if the bounded force cannot pull out an inserted workpiece. On hardware, the operator releases
            such a workpiece after a success.
    """

    station = GantryStation
    Reset = InsertionReset
    has_held_out_distribution = True
    workpiece: ClassVar[str]
    fixture: ClassVar[str]
    simulated_rewards: ClassVar[tuple[str, ...]] = ()
    snaps_in: ClassVar[bool] = False

    force_limit: Number = force_limit_field(FORCE_LIMITS[0])
    force_limit_range: ForceRange | None = Field(
        None,
        description="range from which the force limit of every episode is sampled [N]; the policy observes the limit, "
        "except with observation=image; default: force_limit",
    )
    bounded_force: bool = Field(
        True,
        description="limit the force of the impedance so that it stays below force_limit; if false: to 40 N per axis",
    )

    @property
    def largest_force_limit(self) -> float:
        """Largest force limit of an episode [N]."""
        return self.force_limit if self.force_limit_range is None else self.force_limit_range[1]

    @property
    @abstractmethod
    def offsets(self) -> HiddenOffsets:
        """Sampler of the offsets."""

    @property
    def collision(self) -> Threshold:
        """Limit of the impedance's force [N]."""
        return Threshold("impedance_force", self.largest_force_limit)

    def signals(self, builder: DiagramBuilder, station: Station) -> Mapping[str, OutputPort]:
        """Return the workpiece's actual pose in the fixture, (6,): position [m] and rotation vector [rad].

        In simulation, the signal `hidden_offset` (3,) is the fixture's offset: x, y [m] and turn [rad]. On hardware,
        the workpiece's pose is estimated from the robot's pose, if the task defines `observable_success`. A sampled
        force limit is the signal `force_limit` [N], and the signal `max_wrench` limits the station's force.

        Raises:
            InputError: If the force limit is sampled, and the station has a bounded impedance without the input
                `max_wrench`.
        """
        return self._add_force_limit(builder, station) | self._add_workpiece_pose(builder, station)

    def _add_force_limit(self, builder: DiagramBuilder, station: Station) -> dict[str, OutputPort]:
        """Add the constants of a sampled force limit and return their ports."""
        sampled = self.force_limit_range
        if sampled is None:
            return {}
        # The smallest force limit applies until a reset samples another one.
        limit = add_constant(builder, "force_limit", sampled[:1])
        if not station.HasInputPort("max_wrench"):
            if self.bounded_force and sampled[0] < sampled[1]:
                raise InputError(
                    "force_limit_range changes the largest force, and this station has no input 'max_wrench' for it: "
                    f"give two equal forces or force_limit, not {brief(sampled)}"
                )
            return {"force_limit": limit}
        return {"force_limit": limit, "max_wrench": add_constant(builder, "max_wrench", max_wrench(sampled[0]))}

    def force_limit_terms(self) -> tuple[ObservationTerm, ...]:
        """Return the term of a sampled force limit, or no term; symmetry transformations leave the limit unchanged."""
        return () if self.force_limit_range is None else (ObservationTerm("force_limit", LIMIT_CENTER, LIMIT_SCALE),)

    def _add_workpiece_pose(self, builder: DiagramBuilder, station: Station) -> dict[str, OutputPort]:
        """Add the workpiece's pose in the fixture, actual or estimated, and return its port."""
        if not station.HasOutputPort("body_poses"):
            observable = self.observable_success()
            if observable is None:
                return {}
            name, pose = f"{self.workpiece}_estimate", station.get_pose_output_port()
            return {self.workpiece: add_system(builder, name, affine(*observable), pose).get_output_port()}
        plant = station.plant
        relative = RelativePoses(plant, [plant.GetBodyByName(self.workpiece)], plant.GetBodyByName(self.fixture))
        name, body_poses = f"{self.workpiece}_in_{self.fixture}", station.GetOutputPort("body_poses")
        add_system(builder, name, relative, body_poses=body_poses)
        return {
            self.workpiece: relative.get_relative_poses_output_port(),
            "hidden_offset": add_constant(builder, "hidden_offset", np.zeros(3)),
        }

    def observable_success(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return D (6, 6) and y0 (6,) of the estimate D X_TP + y0 of the workpiece's pose from the robot's pose X_TP.

        The default is None: the task then cannot be learned on hardware.
        """
        return None

    def rim_contact(self) -> RimContact | None:
        """Return the place on the rim at which `probe_contact` measures the contact; None if there is none."""
        return None

    def hold_tests(self, pose: np.ndarray) -> Sequence[HoldTest]:
        """Return pushes that an inserted workpiece resists, for the pose X_TP (6,) of a success; default: a pull."""
        return [HoldTest((0.0, 0.0, HOLD_DISTANCE), MAX_HOLD_MOTION)]

    def impedance(self) -> Impedance | None:
        """Return an impedance with a force below the force limit; None if the option `bounded_force` is false."""
        return Impedance().with_max_force(self.largest_force_limit, self._contact_lever) if self.bounded_force else None

    @cached_property
    def _contact_lever(self) -> float:
        return contact_lever(self.workcell())

    def exceeds_force_limit(self) -> Callable[..., bool]:
        """Return the condition of a collision: a force above `force_limit` [N], or above a sampled limit."""
        if self.force_limit_range is not None:
            return lambda impedance_force, force_limit: impedance_force[0] > force_limit[0]
        limit = self.largest_force_limit
        return lambda impedance_force: impedance_force[0] > limit

    def reset(self, world: World, rng: np.random.Generator, given: Any) -> dict[str, Any]:
        """Sample the offsets, move fixture and workpiece, and put the tool at its start pose."""
        fixture, workpiece = self.offsets.draw(rng, given, world.run)
        self.set_part_offsets(world.station, world.context, fixture, workpiece)
        world.set_pose(self.start_pose(rng))
        if world.has("hidden_offset"):
            world.set("hidden_offset", np.resize([*fixture, 0.0], 3))
        sampled: dict[str, Any] = {f"{self.fixture}_offset": fixture.copy(), "grasp_offset": workpiece.copy()}
        if self.force_limit_range is not None:
            lowest, highest = self.force_limit_range
            limit = float(rng.uniform(lowest, highest))
            world.set("force_limit", [limit])
            if world.has("max_wrench"):
                world.set("max_wrench", max_wrench(limit))
            sampled["force_limit"] = limit
        return sampled

    def set_part_offsets(self, station: Station, context: Context, fixture: np.ndarray, workpiece: np.ndarray) -> None:
        """Move fixture and workpiece of a `MovableWorkcell` by their offsets, in the root context.

        The offsets of the fixture are (2,) or (3,), those of the workpiece (2,) or (4,), as in `part_poses`.
        """
        plant, workcell = station.plant, self.workcell()
        plant_context = plant.GetMyMutableContextFromRoot(context)
        X_TTactual, X_PWorkpiece = part_poses(fixture, workpiece)
        workcell.set_fixture_offset(plant, plant_context, X_TTactual)
        workcell.set_grasp_offset(plant, plant_context, X_PWorkpiece)

    @abstractmethod
    def start_pose(self, rng: np.random.Generator) -> np.ndarray:
        """Return the pose at which an episode starts, (6,)."""


def part_poses(fixture: np.ndarray, workpiece: np.ndarray) -> tuple[RigidTransform, RigidTransform]:
    """Convert offsets to two poses: actual target frame in the nominal target frame, and workpiece in the tool.

    Args:
        fixture: Offset of the fixture, (2,) or (3,): x, y [m], and optionally its turn about z [rad].
        workpiece: Offset of the workpiece in the tool, (2,) or (4,): x, y [m], and optionally its tilt about x and y
            [rad].
    """
    turn = RotationMatrix.MakeZRotation(fixture[2]) if len(fixture) > 2 else RotationMatrix()
    tilt = RotationMatrix(RollPitchYaw(*workpiece[2:], 0.0)) if len(workpiece) > 2 else RotationMatrix()
    return RigidTransform(turn, [*fixture[:2], 0.0]), RigidTransform(tilt, [*workpiece[:2], 0.0])


# The thesis does not state the units of the wrench f in the reward; here they are 10 N and 0.5 Nm.
ACTION_WEIGHT = FORCE_WEIGHT = 0.01
REWARD_WRENCH = np.array([10.0, 10.0, 10.0, 0.5, 0.5, 0.5])
TERMINAL = {"success": 60.0, "collision": -50.0}
# Reward per depth gained [1/mm]. The connector locks at the end of the demonstrations, even if the plug drops into the
# jack early. With a terminal reward alone, a success by random motion would therefore earn as much as a success by use
# of the contact, although random motion succeeds less reliably. The path from start to lock is 15.6 mm long, and its
# last 10.5 mm are in the jack.
DEPTH_REWARD = 5.0
# Reward per distance gained towards the jack's axis [1/mm]; on the rim, the depth does not indicate the direction.
ALIGNMENT_REWARD = 5.0


def _force_cost(wrench: np.ndarray) -> float:
    scaled = wrench / REWARD_WRENCH
    return -FORCE_WEIGHT * float(scaled @ scaled)


def _depth_gained(plug: np.ndarray, last_plug: np.ndarray) -> float:
    return DEPTH_REWARD * float(last_plug[2] - plug[2]) / MM


def _alignment_gained(plug: np.ndarray, last_plug: np.ndarray) -> float:
    nearer = np.hypot(*last_plug[:2]) - np.hypot(*plug[:2])
    return ALIGNMENT_REWARD * float(nearer) / MM


def sides_of_the_rim(observation: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the seven symmetries of a plug on the rim: three turns about the axis, and four reflections.

    Vectors across the axis are rotated or reflected. Torques and tilts are axial vectors, so that a reflection also
    changes their sign. Components of pose and wrench along and about the axis are unchanged; a reflection changes the
    sign of the fixture's turn in a privileged observation.

    Args:
        observation: Name of the observation.

    Returns:
        Matrices of observations (7, n, n), of outputs (7, 6, 6) and of privileged observations (7, 9, 9).
    """
    quarter, mirror = np.array([[0.0, -1.0], [1.0, 0.0]]), np.diag([1.0, -1.0])
    turns = [np.linalg.matrix_power(quarter, k) for k in range(4)]
    observations, poses, privileged = [], [], []
    for across in [*turns[1:], *(turn @ mirror for turn in turns)]:
        axial = np.linalg.det(across).round() * across
        # In a pose, Ry comes before Rx.
        pose = block_diag(across, np.eye(2), axial[::-1, ::-1])
        wrench = block_diag(across, np.eye(1), axial, np.eye(1))
        # center of pressure, commanded x and y, and mean contact point
        contact_terms = (across,) * {"state": 0, "mean_contact_point": 3}.get(observation, 2)
        observations.append(block_diag(np.eye(1), pose, wrench, *contact_terms))
        poses.append(pose)
        privileged.append(block_diag(across, np.linalg.det(across).round(), wrench))
    return np.array(observations), np.array(poses), np.array(privileged)


WRIST_IMAGE_SIZE = (48, 48)  # width and height of the wrist camera's image [pixels]


class DemonstratedInsertion(InsertionTask):
    """Insertion with demonstrations and box constraints, and with the center of pressure as a signal.

    Observations: "state" is time, pose and wrench. "center_of_pressure" adds the center of pressure and the commanded x
    and y, and "mean_contact_point" also the mean of the points of contact in the last second. "image" is the wrist
    camera's image alone; "image_and_state" adds it to the state.

    Rewards: "sparse" is the thesis's reward (equations 4.27, 4.28): costs of actions and forces, and a terminal reward.
    "shaped" adds the depth gained. "aligned" adds the depth gained and the distance gained towards the fixture's axis.
    This distance is privileged: it is computed from simulation state that the policy does not observe. Depth gained and
    distance gained are differences of potentials.

    The name of the workpiece must be "plug". A subclass has the option `start_offset_max` [m] and
    declares the names of rewards and observations.
    """

    start_offset_max: Number
    fixture_offset: Literal["per_run", "per_episode", "none"] = Field(
        "per_run",
        description="offset of the fixture: sampled per run or per episode; none: at most 0.3 mm, sampled per episode",
    )
    offset_range: OffsetRange | None = Field(
        None, description="smallest and largest offset of the fixture [m]; default: depends on fixture_offset"
    )

    @field_validator("offset_range")
    @classmethod
    def _check_offset_range(cls, value: OffsetRange | None, info: ValidationInfo) -> OffsetRange | None:
        if value is not None and value[1] > NEGLIGIBLE_OFFSET and info.data.get("fixture_offset") == "none":
            raise ValueError(
                f"fixture_offset=none allows offsets up to {NEGLIGIBLE_OFFSET:g} m: choose fixture_offset=per_episode"
            )
        return value

    @property
    @abstractmethod
    def duration(self) -> float:
        """Duration of an episode [s]."""

    @property
    @abstractmethod
    def insertion_length(self) -> float:
        """Length of the insertion [m]."""

    @abstractmethod
    def reference(self) -> ReferenceTrajectory:
        """Return the reference trajectory of the demonstrations, in steps of the default control period."""

    @abstractmethod
    def constraints(self, num_steps: int = 0) -> LinearConstraints:
        """Return the bounds of every commanded pose in an episode of `num_steps` control steps."""

    def prior(self) -> Prior:
        """Return the demonstrations and the constraints; in safe residual RL, only the constraints limit commands."""
        constraints, nothing = self.constraints(), np.empty((0, POSE_SIZE))
        return Prior(
            reference=self.reference,
            constraints=constraints,
            keep_out=KeepOut(nothing, nothing, constraints, margin=0.0) if constraints.num_steps is None else None,
            isotropic_groups=((0, 1, 2), (3, 4, 5)),
            start_within=self.start_offset_max,
        )

    def signals(self, builder: DiagramBuilder, station: Station) -> Mapping[str, OutputPort]:
        """Return the workpiece's pose in the fixture and the center of pressure."""
        system = CenterOfPressure(MIN_CONTACT_FORCE)
        add_system(builder, "center_of_pressure", system, wrench=station.get_wrench_output_port())
        mean = MeanContactPoint(MIN_CONTACT_FORCE, period=station.control_period, time_constant=CONTACT_MEMORY)
        pose, wrench = station.get_pose_output_port(), station.get_wrench_output_port()
        add_system(builder, "mean_contact_point", mean, pose=pose, wrench=wrench)
        return {
            **super().signals(builder, station),
            "center_of_pressure": system.get_center_of_pressure_output_port(),
            "mean_contact_point": mean.get_mean_contact_point_output_port(),
        }

    def observed(self, center: np.ndarray, scale: np.ndarray, wrench_scale: np.ndarray) -> Observed:
        """Return the observation, for center and scale of the pose (6,) and scale of the wrench (6,)."""
        camera = self.wrist_camera() if self.has_image else None
        if self.observation == "image":
            return Observed((), camera, PRIVILEGED)
        half = 0.5 * self.duration
        terms = [
            ObservationTerm("time", half, half),
            ObservationTerm("pose", center, scale),
            ObservationTerm("wrench", 0.0, wrench_scale),
        ]
        if self.observation in ("center_of_pressure", "mean_contact_point"):
            terms.append(ObservationTerm("center_of_pressure", 0.0, CENTER_OF_PRESSURE_SCALE))
            terms.append(ObservationTerm("desired_pose", 0.0, COMMAND_SCALE, (0, 1)))
        if self.observation == "mean_contact_point":
            terms.append(ObservationTerm("mean_contact_point", 0.0, CENTER_OF_PRESSURE_SCALE))
        return Observed((*terms, *self.force_limit_terms()), camera, PRIVILEGED)

    def rewards(self) -> dict[str, Callable[..., float]]:
        """Return costs of actions and forces, the terminal reward, and the additions of "shaped" and "aligned"."""
        terms: dict[str, Callable[..., float]] = {
            "action_cost": lambda action: -ACTION_WEIGHT * float(action @ action),
            "force_cost": _force_cost,
            "terminal_reward": terminal_reward(TERMINAL),
        }
        if self.reward in ("shaped", "aligned"):
            terms["depth"] = _depth_gained
        if self.reward == "aligned":
            terms["alignment"] = _alignment_gained
        return terms

    @property
    def has_image(self) -> bool:
        """True if the observation is or contains the image of the wrist camera."""
        return self.observation.startswith("image")

    def wrist_camera(self) -> Camera:
        """Return a camera on the tool that looks at the workpiece's lower end and the fixture below it.

        Its distance from the tool center is about 3.4 times `insertion_length`.
        """
        eye, target = (self.insertion_length * np.array(place) for place in ([2.4, 0.0, 2.4], [0.0, 0.0, -0.3]))
        return Camera(WRIST_IMAGE_SIZE, np.deg2rad(40.0), look_at(eye, target), frame="grasp")

    @cached_property
    def _demonstrated_start(self) -> np.ndarray:
        """First pose of the demonstrations' mean, (6,); a reset must not read the demonstrations' file again."""
        return self.reference().means[0]

    def start_pose(self, rng: np.random.Generator) -> np.ndarray:
        """Return the demonstrations' start plus a sampled offset, inside the constraints."""
        start = self._demonstrated_start.copy()
        if self.start_offset_max > 0.0:
            start[:2] += in_ring(rng, 0.0, self.start_offset_max)
        return self.constraints().nearest(start)
