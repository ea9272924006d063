"""Base class of insertion tasks: a workpiece in the tool and a fixture at an uncertain position.

`InsertionTask` is general. `DemonstratedInsertion` and the rewards, tuned for the connector, are shared with the clamp
and parts: a change alters all of them.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort
from scipy.linalg import block_diag

from guiderail.diagrams.envs.observation import ObservationTerm, affine
from guiderail.diagrams.envs.options import Pair, ResetOptions, satisfies
from guiderail.diagrams.envs.scene import Camera, look_at
from guiderail.diagrams.stations.station import Impedance, Station, max_wrench
from guiderail.diagrams.tasks.contact_probe import RimContact
from guiderail.diagrams.tasks.offsets import HiddenOffsets, in_ring
from guiderail.diagrams.tasks.options import CENTER_OF_PRESSURE_SCALE, COMMAND_SCALE, MIN_CONTACT_FORCE
from guiderail.diagrams.tasks.task import EpisodeConstant, Task, terminal_reward
from guiderail.diagrams.wiring import add_system
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.transforms import MM, POSE_SIZE
from guiderail.models.control.keep_out import KeepOut
from guiderail.models.control.wrench import MAX_WRENCH_SIZE
from guiderail.models.primitives import LinearConstraints
from guiderail.systems.body_poses import RelativePoses
from guiderail.systems.episode_monitor import TerminationTerm
from guiderail.systems.reward_system import RewardTerm
from guiderail.systems.wrench_signals import CenterOfPressure

MAX_GIVEN_OFFSET = 0.3  # [m] largest coordinate of a given offset; a larger one is probably in millimeters


# Center and scale of an observed force limit [N]. They do not depend on `force_limit_range`, so that a policy can be
# evaluated with a different range.
LIMIT_CENTER, LIMIT_SCALE = 20.0, 10.0


HIDDEN_OFFSET_SCALE = (2.0 * MM, 2.0 * MM, 0.1)
EXACT_WRENCH_SCALE = (5.0, 5.0, 8.0, 0.02, 0.02, 0.2)
"""Scales of a privileged critic's observation: x, y [m] and turn [rad] of the fixture, force [N] and torque [Nm]."""


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
        offsets: Sampler of the offsets; it stores the hidden values of a run. A subclass sets it.
        collision: Signal and limit of the contact force [N]. A subclass sets it.
    """

    Reset: ClassVar[type[ResetOptions]] = InsertionReset
    has_held_out_distribution = True
    workpiece: ClassVar[str]
    fixture: ClassVar[str]
    simulated_rewards: ClassVar[tuple[str, ...]] = ()
    snaps_in: ClassVar[bool] = False

    offsets: HiddenOffsets

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
        sampled = self._force_limit_range
        if sampled is None:
            return {}
        # The smallest force limit applies until a reset samples another one.
        limit = EpisodeConstant(builder, "force_limit", 1, np.array(sampled[:1]))
        self.episode_constants["force_limit"] = limit
        if not station.HasInputPort("max_wrench"):
            impedance = self.impedance()
            if impedance is not None and impedance.bound is not None and sampled[0] < sampled[1]:
                raise InputError(
                    f"force_limit_range changes the largest force, and station={self.config.station!r} has no input "
                    f"'max_wrench' for it: give two equal forces or force_limit, not {brief(sampled)}"
                )
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
            name, pose = f"{self.workpiece}_estimate", station.get_pose_output_port()
            return {self.workpiece: add_system(builder, name, affine(*observable), pose).get_output_port()}
        self.episode_constants["hidden_offset"] = EpisodeConstant(builder, "hidden_offset", 3)
        plant = station.plant
        relative = RelativePoses(plant, [plant.GetBodyByName(self.workpiece)], plant.GetBodyByName(self.fixture))
        name, body_poses = f"{self.workpiece}_in_{self.fixture}", station.GetOutputPort("body_poses")
        add_system(builder, name, relative, body_poses=body_poses)
        return {
            self.workpiece: relative.get_relative_poses_output_port(),
            "hidden_offset": self.episode_constants["hidden_offset"].port,
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
        """Return an impedance with a force below the force limit; None if the option `bounded_force` is false.

        Raises:
            InputError: If the subclass sets no positive force limit, `collision`.
        """
        if not getattr(self.options, "bounded_force", True):
            return None
        if not self.collision.above > 0.0:
            raise InputError(
                f"the force limit of {self.name} must be positive, not {brief(self.collision.above)}: let its "
                'constructor set collision to Threshold("impedance_force", limit)'
            )
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
                {"impedance_force": 1, "force_limit": 1},
                lambda impedance_force, force_limit: impedance_force[0] > force_limit[0],
            )
        limit = self.collision.above
        return TerminationTerm("collision", {"impedance_force": 1}, lambda impedance_force: impedance_force[0] > limit)

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


def sides_of_the_rim(
    observation: str,
    action_dims: Iterable[int],
    more: Callable[[np.ndarray], Iterable[np.ndarray]] = lambda across: (),
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return the seven symmetries of a plug on the rim: three turns about the axis, and four reflections.

    Vectors across the axis are rotated or reflected. Torques and tilts are axial vectors, so that a reflection also
    changes their sign. Components of pose and wrench along and about the axis are unchanged; a reflection changes the
    sign of the fixture's turn in a privileged observation.

    Args:
        observation: Name of the observation.
        action_dims: Indices of the outputs that an action moves.
        more: Function from the transformation of vectors across the axis (2, 2) to the matrices of further entries of
            the observation.

    Returns:
        Matrices of observations (7, n, n), of actions (7, A, A) and of privileged observations (7, 9, 9); None if
        actions move only one of x and y, or only one of the tilts.
    """
    quarter, mirror = np.array([[0.0, -1.0], [1.0, 0.0]]), np.diag([1.0, -1.0])
    turns = [np.linalg.matrix_power(quarter, k) for k in range(4)]
    observations, actions, privileged, outputs = [], [], [], list(action_dims)
    for across in [*turns[1:], *(turn @ mirror for turn in turns)]:
        axial = np.linalg.det(across).round() * across
        # In a pose, Ry comes before Rx.
        pose = block_diag(across, np.eye(2), axial[::-1, ::-1])
        wrench = block_diag(across, np.eye(1), axial, np.eye(1))
        contact_terms = () if observation == "state" else (across, across)  # center of pressure, and commanded x and y
        observations.append(block_diag(np.eye(1), pose, wrench, *contact_terms, *more(across)))
        actions.append(pose[np.ix_(outputs, outputs)])
        privileged.append(block_diag(across, np.linalg.det(across).round(), wrench))
    if any((np.abs(action).sum(0) != 1).any() for action in actions):
        return None
    return np.array(observations), np.array(actions), np.array(privileged)


WRIST_IMAGE_SIZE = (48, 48)  # width and height of the wrist camera's image [pixels]


class DemonstratedInsertion(InsertionTask):
    """Insertion with demonstrations and box constraints, and with the center of pressure as a signal.

    Observations: "state" is time, pose and wrench. "center_of_pressure" adds the center of pressure and the commanded x
    and y. "image" is the wrist camera's image alone; "image_and_state" adds it to the state.

    Rewards: "sparse" is the thesis's reward (equations 4.27, 4.28): costs of actions and forces, and a terminal reward.
    "shaped" adds the depth gained. "aligned" adds the depth gained and the distance gained towards the fixture's axis.
    This distance is privileged: it is computed from simulation state that the policy does not observe. Depth gained and
    distance gained are differences of potentials.

    The name of the workpiece must be "plug".

    Attributes:
        insertion_length: Length of the insertion [m]; the distance of the wrist camera is proportional to it.
    """

    isotropic_groups = ((0, 1, 2), (3, 4, 5))
    insertion_length: float
    options: Any  # must have `start_offset_max`

    @abstractmethod
    def constraints(self) -> LinearConstraints:
        """Return the bounds of every commanded pose."""

    def keep_out(self) -> KeepOut:
        """Return no walls: in safe residual RL, only the constraints limit commands."""
        return KeepOut(np.empty((0, POSE_SIZE)), np.empty((0, POSE_SIZE)), self.constraints(), margin=0.0)

    def signals(self, builder: DiagramBuilder, station: Station) -> Mapping[str, OutputPort]:
        """Return the workpiece's pose in the fixture and the center of pressure."""
        system = CenterOfPressure(MIN_CONTACT_FORCE)
        add_system(builder, "center_of_pressure", system, wrench=station.get_wrench_output_port())
        return {**super().signals(builder, station), "center_of_pressure": system.get_center_of_pressure_output_port()}

    def scaled_terms(
        self, center: np.ndarray, scale: np.ndarray, wrench_scale: np.ndarray
    ) -> Sequence[ObservationTerm] | Camera:
        """Return the terms of the observation, for center and scale of the pose (6,) and scale of the wrench (6,)."""
        if self.config.observation == "image":
            return self.wrist_camera()
        half = 0.5 * self.num_steps * self.control_period
        terms = [
            ObservationTerm("time", half, half),
            ObservationTerm("pose", center, scale),
            ObservationTerm("wrench", 0.0, wrench_scale),
        ]
        if self.config.observation == "center_of_pressure":
            terms.append(ObservationTerm("center_of_pressure", 0.0, CENTER_OF_PRESSURE_SCALE))
            terms.append(ObservationTerm("desired_pose", 0.0, COMMAND_SCALE, (0, 1)))
        return *terms, *self.force_limit_terms()

    def reward_terms(self, num_actions: int) -> list[RewardTerm]:
        """Return costs of actions and forces, the terminal reward, and the additions of "shaped" and "aligned"."""
        plug = {"plug": POSE_SIZE, "last_plug": POSE_SIZE}
        terms = [
            RewardTerm("action_cost", {"action": num_actions}, lambda action: -ACTION_WEIGHT * float(action @ action)),
            RewardTerm("force_cost", {"wrench": 6}, _force_cost),
            terminal_reward(TERMINAL),
        ]
        if self.config.reward in ("shaped", "aligned"):
            terms.append(RewardTerm("depth", plug, _depth_gained))
        if self.config.reward == "aligned":
            terms.append(RewardTerm("alignment", plug, _alignment_gained))
        return terms

    @property
    def has_image(self) -> bool:
        """True if the observation is or contains the image of the wrist camera."""
        return self.config.observation.startswith("image")

    def observation_camera(self) -> Camera | None:
        """Return the wrist camera of the observation "image_and_state"."""
        return self.wrist_camera() if self.config.observation == "image_and_state" else None

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
        if self.options.start_offset_max > 0.0:
            start[:2] += in_ring(rng, 0.0, self.options.start_offset_max)
        return self.constraints().nearest(start)

    def action_dims(self) -> list[int]:
        """Return the indices of the outputs that an action moves."""
        chosen = self.config.options["action_dims"]
        return list(range(POSE_SIZE) if chosen is None else chosen)
