"""Insertion task of two meshes, with all parameters declared in `task.yaml`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import ClassVar, Literal, Self, cast

import numpy as np
from pydantic import Field, model_validator
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder, OutputPort
from pydrake.systems.primitives import Multiplexer
from scipy.linalg import block_diag

from guiderail.diagrams.envs.observation import ObservationTerm, Observed, affine
from guiderail.diagrams.envs.options import Number
from guiderail.diagrams.envs.scene import ARM_VIEW, Scene, box_edges, front_camera, in_frame, viewpoint
from guiderail.diagrams.envs.task_diagram import Symmetry
from guiderail.diagrams.guidance.prior import Prior
from guiderail.diagrams.stations.station import CONTROL_PERIOD, Station
from guiderail.diagrams.stations.workcell import Hull, MovableWorkcell, Surface
from guiderail.diagrams.tasks.bnc_connector import BncUncertainty
from guiderail.diagrams.tasks.contact_probe import RimContact
from guiderail.diagrams.tasks.insertion import (
    HOLD_DISTANCE,
    MAX_HOLD_MOTION,
    PRIVILEGED,
    DemonstratedInsertion,
    HoldTest,
    sides_of_the_rim,
)
from guiderail.diagrams.tasks.options import (
    CENTER_OF_PRESSURE_SCALE,
    COMMAND_SCALE,
    HISTORY_VARIANCE,
    MIN_CONTACT_FORCE,
    length_field,
)
from guiderail.diagrams.tasks.task import Condition
from guiderail.diagrams.wiring import add_system
from guiderail.models.common.errors import InputError
from guiderail.models.common.files import write_atomically
from guiderail.models.common.parsing import add_models
from guiderail.models.common.termination import Termination
from guiderail.models.common.transforms import DEGREE, MM, POSE_NAMES, POSE_SIZE
from guiderail.models.primitives import Demonstrations, LinearConstraints, ReferenceTrajectory
from guiderail.systems.movement_primitive import HistoryBuffer
from guiderail.tools.learning.learner_config import resolve_preset
from guiderail_parts.contact_map import ContactMap
from guiderail_parts.geometry.assembly_check import SYMMETRIES
from guiderail_parts.geometry.mesh_file import part_sdf
from guiderail_parts.geometry.obj_file import read_obj
from guiderail_parts.socket_estimator import SocketEstimator
from guiderail_parts.task_file import (
    AUTOMATE,
    FILE_NAME,
    IN_SOCKET,
    Bounds,
    PartTaskFile,
    read_task_file,
    task_folder_digest,
)

PLUG, SOCKET = "plug", "socket"
"""Names of the bodies, and of their SDF files without the suffix."""


@dataclass(frozen=True)
class PartWorkcell(MovableWorkcell):
    """Socket in the world and plug in the tool; the coordinates of both meshes are those of the assembly, in T."""

    fixture: ClassVar[str] = SOCKET
    workpiece: ClassVar[str] = PLUG
    folder: Path  # folder with the SDF files of plug and socket
    place: tuple[float, float, float] = (0.55, 0.0, 0.15)  # position of the target in the world, (3,) [m]
    stiction_tolerance: float = 1e-5  # largest creep of a sticking contact [m/s]
    scenario: Sequence[str] = ()  # paths of Drake model directives (.dmd.yaml) of further objects
    # Names of the files of the convex pieces of plug and socket, for MuJoCo.
    convex: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())
    friction: float = 0.2  # friction coefficient of the convex pieces

    @property
    def X_WF(self) -> RigidTransform:
        """Pose of the nominal socket, equal to that of the target."""
        return RigidTransform(np.array(self.place))

    @property
    def X_FT(self) -> RigidTransform:
        """Pose of the target on the socket, the identity."""
        return RigidTransform()

    def sdf(self, body: str) -> Path:
        """Return the path of the SDF file of plug or socket."""
        return self.folder / f"{body}.sdf"

    def add_fixture(self, plant: MultibodyPlant) -> None:
        """Add the socket and the objects of the scenario."""
        plant.set_stiction_tolerance(self.stiction_tolerance)
        super().add_fixture(plant)
        for file in self.scenario:
            add_models(plant, file)

    def fixture_surfaces(self) -> list[Surface]:
        """Return the convex pieces of the socket.

        Raises:
            InputError: If the socket has no convex pieces, so that the plug would touch nothing.
        """
        return self._surfaces(SOCKET, self.convex[1])

    def workpiece_surfaces(self) -> list[Surface]:
        """Return the convex pieces of the plug.

        Raises:
            InputError: If the plug has no convex pieces.
        """
        return self._surfaces(PLUG, self.convex[0])

    def _surfaces(self, body: str, files: Sequence[str]) -> list[Surface]:
        if not files:
            raise InputError(
                f"the {body} in {self.folder} has no convex pieces, which this engine needs: choose station='gantry'"
            )
        return [
            Surface(f"{body}_{number}", "parts", Hull(read_obj(self.folder / file).vertices), self.friction)
            for number, file in enumerate(files)
        ]


COLORS = {PLUG: "0.85 0.65 0.25 1", SOCKET: "0.62 0.64 0.68 1"}

# Indices into the observation [time, pose, wrench, center of pressure, command].
TIME, POSITION, Z, CENTER_OF_PRESSURE, COMMAND = 0, slice(1, 3), 3, slice(13, 15), slice(15, 17)
BLOCKED = 1.5 * MM  # height above the demonstrated command from which a plug in the socket is blocked [m]
MIN_PUSH = 1.5 * MM  # smallest displacement of the command by a push on a seated plug, in addition to the play [m]
FOLLOWING = 3.0  # rate of change of the action per 2 mm of distance between the command and a plug in the socket [1/s]
# Largest distance from the demonstrations' start to the bounds, inside which an episode starts [m], [rad].
MAX_START_SHIFT = np.array([*[1.0 * MM] * 3, *[2.0 * DEGREE] * 3])
WRENCH_SCALE = np.array([5.0, 5.0, 8.0, 0.05, 0.05, 0.2])


# Observation "shared": scales of heights and distances [m], and delays of the progress [s].
NEAR, SLIDING, PROGRESS, UNCERTAINTY = 5.0 * MM, 1.0 * MM, 1.0 * MM, 2.0 * MM
DELAYS = (0.2, 0.6)
COMMON_FORCE_LIMIT = 15.0  # force limit at which the wrench has the same scale as in the other observations [N]
FORCES = (0, 1, 2, 5)  # entries of the wrench in "shared"; torques across the axis are those of the center of pressure
SOCKET_OFFSET, LAG = slice(11, 13), slice(16, 18)  # indices into "shared", both across the axis


class PartUncertainty(BncUncertainty):
    """Sampler of the socket's offset: as for BncConnector, or in each episode uniformly in a square.

    With the option `fixture_turn`, the socket is also rotated about its axis, and its offset is [x, y, angle]. With the
    reset option `offset`, it is not rotated.
    """

    def __init__(self, options: PartInsertion):
        super().__init__(options.fixture_offset, offset_range=options.offset_range)
        self.is_square, self.turn = options.offset_shape == "square", options.fixture_turn * DEGREE

    def _draw_run(self, rng: np.random.Generator) -> np.ndarray:
        return self._append_turn(super()._draw_run(rng), rng)

    def _draw_episode(self, rng: np.random.Generator, run: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self.is_square:
            side = self.offset_range[1]
            return self._append_turn(rng.uniform(-side, side, 2), rng), np.zeros(2)
        socket, plug = super()._draw_episode(rng, run)
        return (socket if self.kind == "per_run" else self._append_turn(socket, rng)), plug

    def _offsets_of(self, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.append(offset, 0.0) if self.turn > 0.0 else offset, np.zeros(2)

    def _append_turn(self, socket: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return np.append(socket, rng.uniform(-self.turn, self.turn)) if self.turn > 0.0 else socket


class ScriptedSearch:
    """Search by contact: while the plug is blocked, the action moves steadily towards the socket's axis.

    The center of pressure indicates the direction, in the observation "shared" the estimated socket.

    A plug on the rim is blocked. While a plug below the rim is not blocked, the command follows the plug's lateral
    position, so that the plug is not pushed against a wall. If the task has a `search_turn`, a third entry of the
    action turns a blocked plug back and forth.

    If the observed time does not increase, a new episode has begun, and the search starts from an action of zero. The
    search integrates the action and not the displacement, because the displacement per action depends on the guidance
    and changes during the motion.
    """

    __name__ = "scripted_search"

    def __init__(self, file: PartTaskFile, duration: Callable[[], float]):
        """Construct the policy.

        Args:
            file: Content of `task.yaml`.
            duration: Function that returns the duration of the reference trajectory [s]; called at each observation.
        """
        self._file, self._duration = file, duration
        self._times, poses = file.motion.plan_search()
        # If the task has an `advance`, the thread keeps the plug above the command by `push`.
        self._heights = poses[:, 2] + (file.motion.push if file.motion.advance else 0.0)
        self._time, self._size, self._direction = np.inf, 3 if file.motion.search_turn else 2, 1.0
        self._action = np.zeros(self._size)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return an action, (2,) or (3,) with a `search_turn`, for "center_of_pressure" or "shared".

        Raises:
            InputError: If the observation has no center of pressure.
        """
        if len(observation) < COMMAND.stop:
            raise InputError('this policy needs the center of pressure: choose observation="center_of_pressure"')
        time = 0.5 * (float(observation[TIME]) + 1.0) * self._duration()
        passed = time - self._time
        if passed <= 0.0:
            self._action, self._direction, passed = np.zeros(self._size), 1.0, 0.0
        self._time = time
        if len(observation) >= SHARED_SIZE:
            towards = observation[SOCKET_OFFSET] * COMMAND_SCALE
            distance = observation[LAG] * (SLIDING + self._file.clearance) / COMMAND_SCALE
        else:
            towards = self._file.search.lever_sign * observation[CENTER_OF_PRESSURE] * CENTER_OF_PRESSURE_SCALE
            distance = observation[POSITION] - observation[COMMAND]
        height, length = 0.5 * self._file.motion.travel * (observation[Z] + 1.0), float(np.linalg.norm(towards))
        on_rim, search = height > self._file.motion.first_contact - IN_SOCKET, self._file.search
        change = np.zeros(self._size)
        if length > 0.0 and (on_rim or height - np.interp(time, self._times, self._heights) > BLOCKED):
            change[:2] = search.speed * towards / max(length, MM)
            if abs(self._action[-1]) >= 1.0:
                self._direction = -np.sign(self._action[-1])
            change[2:] = self._direction * search.turn_speed
        elif not on_rim:
            change[:2] = FOLLOWING * distance
        self._action = np.clip(self._action + passed * change, -1.0, 1.0)
        return self._action.copy()


class PartInsertion(DemonstratedInsertion):
    """Insert a plug into a socket.

    Observations and rewards: see `DemonstratedInsertion`. The observation "shared" has units that all parts share, for
    a policy of many parts: forces relative to the force limit, and lateral positions relative to the reach of an
    action. The direction from the center of pressure to the socket's axis depends on the part: it has the center with
    the part's sign, relative to its distance in the contact map, and the axis that `SocketEstimator` estimates with
    this map, with the covariance of the estimate. Further entries are the height above the measured first contact, the
    distance of the plug from the command (laterally relative to the clearance), and the plug's progress in the last 0.2
    and 0.6 s, which shows whether anything moves.
    """

    workpiece, fixture = PLUG, SOCKET
    simulated_rewards = ("aligned",)
    folder: ClassVar[Path]
    file: ClassVar[PartTaskFile]  # content of `task.yaml`

    reward: Literal["sparse", "shaped", "aligned"] = Field("sparse", description="name of the reward")
    observation: Literal["state", "center_of_pressure", "image", "image_and_state", "shared"] = Field(
        "state", description="name of the observation"
    )

    offset_shape: Literal["ring", "square"] = Field(
        "ring",
        description="region of the fixture's offset: the ring with the radii offset_range, or the square in which |x| "
        "and |y| are at most the larger radius; square needs fixture_offset=per_episode",
    )
    fixture_turn: Number = Field(
        0.0, ge=0, le=10, description="largest sampled turn of the fixture about its axis [degrees]"
    )
    bound: Number | None = Field(
        None,
        ge=0.5 * MM,
        le=6.0 * MM,
        description="bound of a command's |x| and |y| [m]; it replaces the bounds of task.yaml, which must be constant",
    )
    start_offset_max: Number = length_field(0.0, 0.0, 2.0 * MM, "largest sampled offset of the start along x and y")

    @model_validator(mode="after")
    def _check_options(self) -> Self:
        """Refuse a square of offsets that are not sampled in every episode, and a `task.yaml` without success."""
        if self.offset_shape == "square" and self.fixture_offset != "per_episode":
            raise InputError(
                "offset_shape=square samples the fixture's offset in every episode: choose fixture_offset=per_episode, "
                "or offset_shape=ring"
            )
        self._check_length_and_start()
        return self

    @property
    def offsets(self) -> PartUncertainty:
        """Sampler of the offsets."""
        return PartUncertainty(self)

    @property
    def insertion_length(self) -> float:
        """Length of the insertion [m]."""
        return self.file.motion.travel

    @property
    def duration(self) -> float:
        """Duration of the demonstrations [s]."""
        return self.reference().num_steps * CONTROL_PERIOD

    def _check_length_and_start(self) -> None:
        """Raise an InputError if `task.yaml` excludes every success, or the start of the demonstrations."""
        steps, start = self.file.tolerance.steps, self.reference().means[0]
        if steps * CONTROL_PERIOD > self.duration:
            raise InputError(
                f"tolerance.steps in {self.folder / FILE_NAME} is {steps}, longer than an episode of "
                f"{self.duration:.3g} s: give fewer steps"
            )
        shift = np.abs(self.file.bounds.nearest(start, 0) - start)
        if (shift > MAX_START_SHIFT).any():
            output = int((shift / MAX_START_SHIFT).argmax())
            raise InputError(
                f"bounds in {self.folder / FILE_NAME} exclude the demonstrations' start, {POSE_NAMES[output]} = "
                f"{start[output]:.4g}: let them include it at the beginning of the motion"
            )

    def workcell(self) -> PartWorkcell:
        """Return the socket in the world and the plug in the tool."""
        return self._workcell

    @cached_property
    def _workcell(self) -> PartWorkcell:
        return write_workcell(self.folder, self.file)

    def reference(self) -> ReferenceTrajectory:
        """Return the reference trajectory of the folder's demonstrations."""
        return self.file.demonstrations.reference(self.folder)

    def constraints(self, num_steps: int = 0) -> LinearConstraints:
        """Return the bounds of `task.yaml`; the option `bound`, if given, replaces the bounds of x and y.

        Raises:
            InputError: If `bound` is given, and the bounds of `task.yaml` change between phases.
        """
        return self._bounds().constraints(num_steps or self.reference().num_steps)

    def prior(self) -> Prior:
        """Return the demonstrations and the bounds, which may change between phases."""
        return replace(super().prior(), constraints=self.constraints)

    def _bounds(self) -> Bounds:
        bounds, limit = self.file.bounds, self.bound
        if limit is None:
            return bounds
        if bounds.phases is not None:
            is_set = any(preset.get("bound") == limit for preset in self.presets.values())
            remedy = "give bound=None (--env bound=null) with this difficulty" if is_set else "leave it out"
            raise InputError(f"bound replaces constant bounds, and those of task.yaml change between phases: {remedy}")
        return Bounds(lower=(-limit, -limit, *bounds.lower[2:]), upper=(limit, limit, *bounds.upper[2:]), phases=None)

    def rim_contact(self) -> RimContact:
        """Return the place on the socket's rim."""
        return rim_contact(self.file)

    def observable_success(self) -> tuple[np.ndarray, np.ndarray]:
        """Return D and y0 of an estimate D x + y0 of height and turn; pushes check the lateral offset instead."""
        D = np.zeros((POSE_SIZE, POSE_SIZE))
        D[2, 2] = D[5, 3] = 1.0
        return D, np.zeros(POSE_SIZE)

    def hold_tests(self, pose: np.ndarray) -> Sequence[HoldTest]:
        """Return pushes along ±x and ±y, as far as the bounds allow; the walls of the socket stop a seated plug.

        A direction is omitted if the bounds allow less than `MIN_PUSH` plus the play, which is twice the clearance. A
        plug that was turned at the bottom is locked, and is pulled upwards instead.
        """
        if self.file.turn:
            return super().hold_tests(pose)
        play, constraints = min(2.0 * self.file.clearance, HOLD_DISTANCE), self.constraints()
        tests = []
        for direction in ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)):
            target = pose + (play + HOLD_DISTANCE) * np.array([*direction, 0.0, 0.0, 0.0, 0.0])
            x, y = (constraints.nearest(target, self.reference().num_steps) - pose)[:2].tolist()
            if direction[0] * x + direction[1] * y >= play + MIN_PUSH:
                tests.append(HoldTest((x, y, 0.0), play + MAX_HOLD_MOTION))
        return tests

    def observe(self) -> Observed:
        """Return time, pose and wrench, with further terms by the observation's name, or the wrist camera."""
        height, turn = 0.5 * self.file.motion.travel, 0.5 * self.file.turn
        center = np.array([0.0, 0.0, height, -turn, 0.0, 0.0])
        scale_of_turn = max(abs(turn), 3 * DEGREE, self.file.motion.search_turn * DEGREE)
        scale = np.array([2 * MM, 2 * MM, height, scale_of_turn, 1.5 * DEGREE, 1.5 * DEGREE])
        if self.observation != "shared":
            return self.observed(center, scale, WRENCH_SCALE)
        half, reach, file = 0.5 * self.duration, self._reach, self.file
        scale[:2] = reach
        lag, forces = np.array([*[SLIDING + file.clearance] * 2, NEAR]), WRENCH_SCALE[list(FORCES)]
        lever = CENTER_OF_PRESSURE_SCALE if self._contact_map is None else self._contact_map.lever
        terms = (
            ObservationTerm("time", half, half),
            ObservationTerm("pose", center, scale),
            ObservationTerm("wrench", 0.0, forces * self.largest_force_limit / COMMON_FORCE_LIMIT, FORCES),
            ObservationTerm("socket_offset", 0.0, reach, (0, 1)),
            ObservationTerm("desired_pose", 0.0, reach, (0, 1)),
            ObservationTerm("pose", file.motion.first_contact, NEAR, (2,)),
            ObservationTerm("lag", 0.0, lag),
            ObservationTerm("progress", 0.0, PROGRESS),
            ObservationTerm("socket_offset", 0.0, UNCERTAINTY**2, (2, 3, 4)),
            ObservationTerm("center_of_pressure", 0.0, file.search.lever_sign * lever),
            *self.force_limit_terms(),
        )
        return Observed(terms, privileged=PRIVILEGED)

    @cached_property
    def _reach(self) -> float:
        """Mean lateral displacement of the command by an action of 1, at the task's own `action_scale` [m]."""
        lateral = self.reference().standard_deviations[:, :2]
        return float(np.sqrt(3.0) * self.defaults.get("action_scale", 1.0) * np.sqrt((lateral**2).mean()))

    def signals(self, builder: DiagramBuilder, station: Station) -> Mapping[str, OutputPort]:
        """Return the signals of `DemonstratedInsertion`; for "shared" also `lag`, `progress` and `socket_offset` [m].

        `lag` (3,) is the position of the plug minus that of the command. `progress` (6,) is the displacement since each
        of `DELAYS`. `socket_offset` (5,) is the output of `SocketEstimator`.
        """
        signals = super().signals(builder, station)
        if self.observation != "shared":
            return signals
        pose = station.get_pose_output_port()
        command = builder.GetSubsystemByName("guidance").GetOutputPort("desired_pose")
        position = np.eye(3, POSE_SIZE)
        both = add_system(builder, "pose_and_command", Multiplexer([POSE_SIZE, POSE_SIZE]), pose, command)
        lag = affine(np.hstack([position, -position]), np.zeros(3))
        add_system(builder, "lag", lag, both.get_output_port())
        selected = add_system(builder, "position", affine(position, np.zeros(3)), pose).get_output_port()
        steps = [max(round(delay / station.control_period), 1) for delay in DELAYS]
        history = HistoryBuffer(3, max(steps), station.control_period)
        add_system(builder, "positions", history, output=selected, initial_output=selected)
        joined = add_system(
            builder, "position_and_history", Multiplexer([3, 3 * max(steps)]), selected,
            history.get_history_output_port(),
        )  # fmt: skip
        D = np.zeros((3 * len(steps), 3 + 3 * max(steps)))
        for row, delay in enumerate(steps):
            D[3 * row : 3 * row + 3, :3] = np.eye(3)
            oldest = 3 + 3 * (max(steps) - delay)
            D[3 * row : 3 * row + 3, oldest : oldest + 3] = -np.eye(3)
        progress = add_system(builder, "progress", affine(D, np.zeros(len(D))), joined.get_output_port())
        estimator = SocketEstimator(
            self._contact_map,
            min_force=MIN_CONTACT_FORCE,
            period=station.control_period,
        )
        wrench = station.GetOutputPort("wrench")
        offset = add_system(builder, "socket_estimator", estimator, pose, wrench).get_socket_offset_output_port()
        added = {"lag": lag.get_output_port(), "progress": progress.get_output_port(), "socket_offset": offset}
        return {**signals, **added}

    @cached_property
    def _contact_map(self) -> ContactMap | None:
        name = self.file.search.contact_map
        return None if name is None else ContactMap.load(self.folder / name)

    def done(self) -> Mapping[str, Callable[..., bool] | Condition]:
        """Return success at the target, and collision above the force limit."""
        tolerance = self.file.tolerance
        seated = Condition(tolerance.accepts, seconds=tolerance.steps * CONTROL_PERIOD)
        return {Termination.SUCCESS: seated, Termination.COLLISION: self.exceeds_force_limit()}

    def symmetries(self) -> tuple[Symmetry | None, Symmetry | None]:
        """Return the symmetries of both parts, and those that nearly hold on the rim as well; None if none applies."""
        sides = self.file.sides
        return self._select_symmetries(sides), self._select_symmetries((*sides, *self.file.rim_sides))

    def _select_symmetries(self, names: Sequence[str]) -> Symmetry | None:
        selected = [index for index, name in enumerate(SYMMETRIES) if name in names]
        if not selected or self.has_image:
            return None
        symmetries = sides_of_the_rim("state" if self.observation == "shared" else self.observation)
        if self.observation == "shared":
            symmetries = (np.array([_shared_side(pose) for pose in symmetries[1]]), *symmetries[1:])
        return Symmetry(*(matrices[selected] for matrices in symmetries)).pad(len(self.force_limit_terms()))

    def scene(self) -> Scene:
        """Return the demonstrations and the box of the bounds of each phase in `task.yaml`, or of `bound`."""
        to_world, size = in_frame(self.workcell().X_WT), self.file.motion.travel
        near = viewpoint(*to_world(np.array([[1.8 * size, -2.6 * size, 2.6 * size], [0.0, 0.0, 0.5 * size]])))
        lower, upper = (np.atleast_2d(bound)[:, :3] for bound in self._bounds().arrays())
        lower[:, 2], upper[:, 2] = np.maximum(lower[:, 2], 0.0), np.minimum(upper[:, 2], size)
        boxes = [corners for corners in zip(lower, upper, strict=True) if np.isfinite(corners).all()]
        target = np.array(self.file.place) + [0.0, 0.0, 0.5 * size]
        return Scene(
            to_world=to_world,
            camera=front_camera(target, distance=6 * size, height=3 * size),
            demonstrations=tuple(Demonstrations.load(self.folder / self.file.demonstrations.file).outputs),
            constraint=tuple(to_world(edge) for corners in boxes for edge in box_edges(*corners)),
            viewpoint=near,
            arm_views={"the parts": near, "the arm": ARM_VIEW},
            line_radius=0.0001,
        )


def _shared_side(pose: np.ndarray) -> np.ndarray:
    """Return the matrix of the observation "shared" for the symmetry whose matrix of poses is `pose` (6, 6)."""
    across = pose[:2, :2]
    moved = block_diag(across, np.eye(1))
    (a, b), (c, d) = across
    covariance = np.array([[a * a, 2 * a * b, b * b], [a * c, a * d + b * c, b * d], [c * c, 2 * c * d, d * d]])
    force = block_diag(across, np.eye(2))
    progress = [moved] * len(DELAYS)
    blocks = [np.eye(1), pose, force, across, across, np.eye(1), moved, *progress, covariance, across]
    return np.asarray(block_diag(*blocks))


SHARED_SIZE = len(_shared_side(np.eye(POSE_SIZE)))


RIM_OFFSET = 1.5 * MM  # displacement at which a plug is pressed on the rim [m]


def rim_contact(file: PartTaskFile) -> RimContact:
    """Return the place on the rim of a task file's socket, with the turn that the plug has during a search."""
    turn = float(file.motion.plan_search()[1][0, 3])  # Rz of the first pose
    return RimContact(file.motion.first_contact, RIM_OFFSET, file.plug.pieces[0].friction, turn, all_round=False)


def write_workcell(folder: Path, file: PartTaskFile) -> PartWorkcell:
    """Write the SDF files of a task folder next to its meshes, and return its workcell.

    Raises:
        InputError: If the SDF files cannot be written.
    """
    for name, part in ((PLUG, file.plug), (SOCKET, file.socket)):
        text = part_sdf(
            name,
            part.visual,
            part.pieces,
            mass=part.mass,
            center=part.center,
            gyration=part.gyration,
            color=COLORS[name],
        )
        path, content = folder / f"{name}.sdf", text.encode()
        if not path.is_file() or path.read_bytes() != content:
            write_atomically(path, content)  # another process may read the file at the same time
    return PartWorkcell(
        folder,
        cast(tuple[float, float, float], file.place),
        file.stiction_tolerance,
        tuple(str(folder / name) for name in file.scenario),
        (file.plug.convex, file.socket.convex),
        file.plug.pieces[0].friction,
    )


def load_task_folder(folder: Path) -> type[PartInsertion]:
    """Return the task class of a folder.

    Raises:
        InputError: As `read_task_file`, or if the recommended learner is unknown.
    """
    folder = folder.resolve()
    task = _task_class(folder, task_folder_digest(folder))
    try:
        resolve_preset(**{"preset": None, **task.learner})
    except InputError as error:
        raise InputError(f"recommended.learner in {folder / FILE_NAME} is invalid: {error}") from None
    return task


@cache
def _task_class(folder: Path, content: str) -> type[PartInsertion]:
    """Return the task class of a folder with a digest `content`; cached, so that environments can share diagrams."""
    file = read_task_file(folder)
    defaults = {
        "guidance": "skgrl",
        "action_repeat": 10,
        "action_dims": file.action_dims,
        "history.variance": HISTORY_VARIANCE,
        "force_limit": file.force_limit,
        "time_step": file.time_step,
        **file.recommended.environment,
    }
    reference = partial(file.demonstrations.reference, folder)
    members = {
        "name": file.name,
        "scripted_policies": (ScriptedSearch(file, lambda: reference().num_steps * CONTROL_PERIOD),),
        "unsupported_stations": () if file.is_convex else ("mujoco", "pybullet", "sapien"),  # these need convex pieces
        "presets": {"hard": file.hard, "automate": AUTOMATE},
        "folder": folder,
        "digest": content,
        "file": file,
        "defaults": defaults,
        "learner": file.recommended.learner,
        "__module__": __name__,
    }
    task = type(f"PartInsertion({folder})", (PartInsertion,), members)
    task.__doc__ = f"Insert {file.plug.source or 'a plug'} into {file.socket.source or 'a socket'}."
    return cast(type[PartInsertion], task)
