"""BncConnector: insert, align and lock a bayonet connector at an uncertain position (thesis, sections 4.4.2, 5.4.2)."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field, field_validator
from pydrake.geometry import Box
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant

from guiderail.diagrams.envs.observation import Observed
from guiderail.diagrams.envs.options import Integer, Number
from guiderail.diagrams.envs.scene import ARM_VIEW, TOOL_VIEW, Scene, box_edges, front_camera, in_frame, viewpoint
from guiderail.diagrams.envs.task_diagram import Symmetry
from guiderail.diagrams.stations.station import CONTROL_PERIOD
from guiderail.diagrams.stations.workcell import MovableWorkcell
from guiderail.diagrams.tasks.contact_probe import RimContact
from guiderail.diagrams.tasks.insertion import DemonstratedInsertion, sides_of_the_rim
from guiderail.diagrams.tasks.options import (
    CENTER_OF_PRESSURE_SCALE,
    COMMAND_SCALE,
    HISTORY_VARIANCE,
    NEGLIGIBLE_OFFSET,
    REPEATABILITY_STD,
    HiddenOffsets,
    PriorStd,
    force_limit_field,
    friction_field,
    in_ring,
    length_field,
    prior_std_field,
    reference_of_file,
)
from guiderail.diagrams.tasks.registry import register_task
from guiderail.diagrams.tasks.task import Condition
from guiderail.models.common.errors import InputError
from guiderail.models.common.termination import Termination
from guiderail.models.common.transforms import DEGREE, MM, POSE_SIZE
from guiderail.models.objects.bnc_connector import (
    FRICTION,
    JACK_SDF,
    PLUG_SDF,
    TOUCHING,
    BncDimensions,
    folder_of,
)
from guiderail.models.objects.bnc_connector import demonstrations as shipped
from guiderail.models.objects.bnc_connector.demonstrations import HOLD_UNTIL, NUM_STEPS, RIM, SEARCH
from guiderail.models.primitives import Demonstrations, LinearConstraints, ReferenceTrajectory

# Smallest and largest offset of the jack [m].
OFFSET_RANGES = {
    "per_run": (1.0 * MM, 1.5 * MM),
    "per_episode": (0.0, 1.5 * MM),
    "none": (0.0, NEGLIGIBLE_OFFSET),
}
GRASP_RADIUS = 0.3 * MM  # largest offset of the plug in the tool [m]


class BncUncertainty(HiddenOffsets):
    """Sampler of the offsets of jack and plug; see `HiddenOffsets` for the options of a reset.

    - "per_run": the jack is offset by 1.0 to 1.5 mm in a random direction, sampled once per run; the plug is within
      0.3 mm of its nominal position in the tool, sampled each episode. The thesis uses this setting.
    - "per_episode": the jack is within 1.5 mm of its nominal position, sampled each episode.
    - "none": the jack is within 0.3 mm of its nominal position, sampled each episode.

    The reset option `offset` sets the jack's position; the plug is then not offset.
    """

    def __init__(self, kind: str, *, offset_range: Sequence[float] | None = None):
        """Construct the sampler.

        `offset_range` is the smallest and largest offset of the jack [m]; default: that of the kind.
        """
        super().__init__(kind)
        self.offset_range = OFFSET_RANGES[kind] if offset_range is None else tuple(offset_range)

    def _draw_run(self, rng: np.random.Generator) -> np.ndarray:
        # Every kind samples this offset, so that all kinds take the same random numbers.
        return in_ring(rng, *self.offset_range)

    def _draw_episode(self, rng: np.random.Generator, run: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self.kind == "per_run":
            jack, plug = run, in_ring(rng, 0.0, GRASP_RADIUS)
        else:
            jack, plug = in_ring(rng, *self.offset_range), np.zeros(2)
        rng.uniform(size=2)  # stored results of a seed depend on the number of samples
        return jack, plug

    def _offsets_of(self, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return offset, np.zeros(2)


ALIGNMENT = 2.0 * MM  # largest |x| and |y| of every command: equation 4.26
NOMINAL = BncDimensions()
SHIPPED = ("insert", "search", "firm_search")  # names of the demonstrations in this package


HARD: dict[str, Any] = {
    "observation": "mean_contact_point",
    "demonstrations": "search",
    "action_repeat": 5,
    "fixture_offset": "per_episode",
    "offset_range": (2.6 * MM, 3.0 * MM),
    "bound": 3.5 * MM,
    "force_limit": 20.0,
    "mouth_chamfer": 0.1 * MM,
}
"""Options of difficulty="hard": the jack's offset is sampled in every episode and is larger than the chamfer can
correct. Without `bounded_force`, pressing on the rim exceeds the force limit.

The search is short, and the jack's offset is close to the largest displacement by an action. Most random actions
displace the plug less and miss the jack. A policy can reach the jack if it observes the side of the rim on which the
contact is. The demonstrations' covariance in x and y, and so the displacement per action, is constant during the
search; otherwise a constant action would sweep the plug across the rim.
"""

# Size of the task board [m], its distance below the jack [m], and its color. It is visual only: the board that the plug
# touches belongs to the jack and is lower, because the locked plug's mouth reaches slightly below the jack's bottom.
BOARD, BOARD_CLEARANCE, BOARD_COLOR = (0.16, 0.20, 0.012), 0.001, [0.90, 0.89, 0.86, 1.0]
LOCKED_HEIGHT = 0.6e-3  # [m] largest deviation of a locked plug along the jack's axis
LOCKED_ANGLE = np.deg2rad(4.0)  # [rad] largest deviation of a locked plug about the jack's axis
LOCKED_OFFSET = 1.0e-3  # [m] largest lateral offset of a locked plug

# Signs after half a turn about the jack's axis, under which the jack is symmetric.
HALF_TURN = np.array([-1.0, -1.0, 1.0, 1.0, -1.0, -1.0])  # pose [x y z Rz Ry Rx]
HALF_TURN_OF_WRENCH = np.array([-1.0, -1.0, 1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class BncWorkcell(MovableWorkcell):
    """Jack in front of the robot's base, turned so that the target frame's axes are the world's."""

    fixture: ClassVar[str] = "jack"
    workpiece: ClassVar[str] = "plug"
    time_step = CONTROL_PERIOD / 4
    # Pairs of surfaces that cannot touch in a connector of these dimensions, or whose contact another pair models.
    filtered_pairs = tuple(
        ((name,), tuple({*itertools.chain(*TOUCHING.values())} - {*touched})) for name, touched in TOUCHING.items()
    )
    dimensions: BncDimensions = field(default_factory=BncDimensions)  # dimensions of the connector
    p_WJ: tuple[float, float, float] = (0.55, 0.0, 0.15)  # position of the jack, (3,) [m]
    friction: float = FRICTION  # friction coefficient of the connector's metal

    @property
    def X_WF(self) -> RigidTransform:
        """Pose of the nominal jack, X_WJ."""
        return RigidTransform(RotationMatrix.MakeZRotation(self.dimensions.detent_angle), np.array(self.p_WJ))

    @property
    def X_FT(self) -> RigidTransform:
        """Pose of the locked plug on the jack, X_JT."""
        return RigidTransform(
            RotationMatrix.MakeZRotation(-self.dimensions.detent_angle), [0.0, 0.0, self.dimensions.locked_height]
        )

    def sdf(self, body: str) -> Path:
        """Return the path of the SDF file of jack or plug."""
        name = JACK_SDF.name if body == self.fixture else PLUG_SDF.name
        return folder_of(self.dimensions, self.friction) / name

    def add_fixture(self, plant: MultibodyPlant) -> None:
        """Add the jack, and a visual board under it."""
        super().add_fixture(plant)
        depth, width, thickness = BOARD
        below = RigidTransform(np.array(self.p_WJ) - [0.0, 0.0, BOARD_CLEARANCE + thickness / 2])
        plant.RegisterVisualGeometry(plant.world_body(), below, Box(depth, width, thickness), "board", BOARD_COLOR)

    def locks(self, plug: np.ndarray) -> bool:
        """Return True if a plug is locked and on the jack's axis, given X_JPlug as position and rotation vector (6,).

        For an upright plug, `plug[5]` is the turn about z.
        """
        return bool(
            abs(plug[2] - self.dimensions.locked_height) < LOCKED_HEIGHT
            and abs(plug[5] + self.dimensions.detent_angle) < LOCKED_ANGLE
            and np.hypot(plug[0], plug[1]) < LOCKED_OFFSET
        )

    @staticmethod
    def is_locked(X_LockedPlug: RigidTransform) -> bool:
        """Return True if a plug is within 0.6 mm of the locked pose along its axis, and 4 degrees about it.

        `X_LockedPlug` is the pose of the plug relative to its locked pose. The lugs of a locked plug are past the apex
        of the slots, and only a torque unlocks it.
        """
        yaw = RollPitchYaw(X_LockedPlug.rotation()).yaw_angle()
        return bool(abs(X_LockedPlug.translation()[2]) < LOCKED_HEIGHT and abs(yaw) < LOCKED_ANGLE)


# The scale of torques is small, because 0.02 Nm at 4 N indicate the side of the rim on which the plug stands.
POSE_CENTER = np.array([0.0, 0.0, 5.0 * MM, 45.0 * DEGREE, 0.0, 0.0])
POSE_SCALE = np.array([2.0 * MM, 2.0 * MM, 8.0 * MM, 45.0 * DEGREE, 1.5 * DEGREE, 1.5 * DEGREE])
WRENCH_SCALE = np.array([5.0, 5.0, 8.0, 0.02, 0.02, 0.2])


COMPONENTS = 16  # components of the Gaussian mixture
FLOOR = np.array(REPEATABILITY_STD)
DEMONSTRATIONS = {"insert": shipped.PATH, "search": shipped.SEARCH_PATH, "firm_search": shipped.FIRM_SEARCH_PATH}
LOCKED_STEPS = 3  # consecutive steps with a locked plug that count as success, at the default control period


def reference_trajectory(
    demonstrations: str, count: int | None = None, prior_std: tuple[float, ...] | None = None
) -> ReferenceTrajectory:
    """Return the reference trajectory of demonstrations, fitted once per process and content of the file.

    Args:
        demonstrations: Name in `DEMONSTRATIONS`, or path of a file .npz or .csv.
        count: Number of demonstrations to use, from the first on; None: all.
        prior_std: As in `ReferenceTrajectory.from_demonstrations`.
    """
    if demonstrations not in DEMONSTRATIONS:
        return reference_of_file(Path(demonstrations), COMPONENTS, tuple(FLOOR.tolist()), count, prior_std)
    return _fit_shipped(demonstrations, count, prior_std)


@cache  # called with all arguments by position: an omitted `count` and None have the same key
def _fit_shipped(demonstrations: str, count: int | None, prior_std: tuple[float, ...] | None) -> ReferenceTrajectory:
    loaded = Demonstrations.load(DEMONSTRATIONS[demonstrations]).first(count)
    return ReferenceTrajectory.from_demonstrations(loaded, components=COMPONENTS, floor=FLOOR, prior_std=prior_std)


# Indices into the observation [time, pose, wrench, center of pressure, command, …].
TIME, Z, FORCE_Z, TORQUE_X, TORQUE_Y, CENTER_OF_PRESSURE, COMMAND = 0, 3, 9, 10, 11, slice(13, 15), slice(15, 17)

# Parameters of `scripted_torque_search`, for the demonstrations "insert".
GAIN = 1.5  # action per scaled contact torque
PRESSING = (60, 185)  # control steps between which the demonstrations press on the rim
SCALED_RIM = (RIM - 1.2 * MM - POSE_CENTER[2]) / POSE_SCALE[2]  # scaled height above which the plug is not inserted
CONTACT_FORCE = 0.2  # scaled force along z above which the plug is in contact

# Parameters of `scripted_center_of_pressure`, for the demonstrations "search".
STEP = 0.5 * MM  # largest change of the command from one action to the next [m]
REACH = 3.1 * MM  # displacement of the command at an action of 1 [m]
ON_RIM = RIM - 0.5 * MM  # height above which the plug is not inserted [m]
MAY_PRESS = SEARCH[0] - 0.2  # earliest time at which the plug may stand on the rim [s]


def scripted_torque_search(observation: np.ndarray) -> np.ndarray:
    """Return an action (2,) in x and y along (−τ_y, τ_x), for the contact torque τ, while the plug is on the rim.

    On the rim, this direction points towards the jack's axis. If the plug is not on the rim, the action is zero.
    """
    step = 0.5 * (observation[TIME] + 1.0) * NUM_STEPS
    is_on_rim = observation[Z] > SCALED_RIM and observation[FORCE_Z] > CONTACT_FORCE
    if not (PRESSING[0] < step < PRESSING[1] and is_on_rim):
        return np.zeros(2)
    return np.clip(GAIN * np.array([-observation[TORQUE_Y], observation[TORQUE_X]]), -1.0, 1.0)


def scripted_center_of_pressure(observation: np.ndarray) -> np.ndarray:
    """Return an action (2,) that moves the command by at most `STEP` towards the center of pressure, and so the jack.

    Once the plug has dropped into the jack, the command is constant until the search ends. Before and after the search,
    the action is zero. The last command is read from the observation, so that the policy has no state.

    Raises:
        InputError: If the observation has no center of pressure.
    """
    if len(observation) < COMMAND.stop:
        raise InputError('this policy needs the center of pressure: choose observation="center_of_pressure"')
    time = 0.5 * (observation[TIME] + 1.0) * NUM_STEPS * CONTROL_PERIOD
    if not MAY_PRESS < time < HOLD_UNTIL:
        return np.zeros(2)
    command, lever = observation[COMMAND] * COMMAND_SCALE, observation[CENTER_OF_PRESSURE] * CENTER_OF_PRESSURE_SCALE
    height, length = observation[Z] * POSE_SCALE[2] + POSE_CENTER[2], float(np.linalg.norm(lever))
    if height > ON_RIM and length > 0.0:
        command = command + STEP * lever / max(length, MM)
    return np.clip(command / REACH, -1.0, 1.0)


@register_task("BncConnector")
class BncConnector(DemonstratedInsertion):
    """Insert, align and lock the connector.

    Rewards: "sparse" is the thesis's reward (equations 4.27, 4.28); "shaped" and "aligned" add terms to it.
    """

    workpiece, fixture = "plug", "jack"
    simulated_rewards = ("aligned",)
    presets = {"hard": HARD}
    scripted_policies = (scripted_torque_search, scripted_center_of_pressure)
    scripted_defaults = {"hard": scripted_center_of_pressure}
    defaults = {"guidance": "skgrl", "action_repeat": 10, "action_dims": (0, 1), "history.variance": HISTORY_VARIANCE}

    reward: Literal["sparse", "shaped", "aligned"] = Field("sparse", description="name of the reward")
    observation: Literal["state", "center_of_pressure", "mean_contact_point", "image", "image_and_state"] = Field(
        "state", description="name of the observation"
    )

    start_offset_max: Number = length_field(0.0, 0.0, ALIGNMENT, "largest sampled offset of the start along x and y")
    bound: Number = length_field(ALIGNMENT, 0.5 * MM, 6.0 * MM, "bound of a command's |x| and |y|")
    force_limit: Number = force_limit_field(5)
    mouth_chamfer: Number = length_field(
        NOMINAL.mouth_chamfer, 0.05 * MM, 0.6 * MM, "chamfer of the plug's mouth and slots"
    )
    bore_clearance: Number = length_field(
        NOMINAL.bore_clearance, 0.05 * MM, 0.2 * MM, "clearance between barrel and bore on each side"
    )
    friction: Number = friction_field(FRICTION, "the connector's metal")
    demonstrations: str = Field(
        "insert", description="demonstrations: insert, search, firm_search, or the path of a file"
    )
    num_demonstrations: Integer | None = Field(
        None, ge=1, description="number of demonstrations to use, from the first on; a single one needs prior_std"
    )

    prior_std: PriorStd | None = prior_std_field()

    @field_validator("demonstrations")
    @classmethod
    def _check_file(cls, value: str) -> str:
        if value in SHIPPED:
            return value
        path = Path(value)
        if not path.is_file():
            raise ValueError(f"must be {', '.join(SHIPPED)}, or the path of an existing file, .npz or .csv")
        return str(path.resolve())  # so that a run can be resumed from another folder

    @property
    def insertion_length(self) -> float:
        """Length of the insertion [m]."""
        return 12.0 * MM

    @property
    def offsets(self) -> BncUncertainty:
        """Sampler of the offsets."""
        return BncUncertainty(self.fixture_offset, offset_range=self.offset_range)

    @property
    def duration(self) -> float:
        """Duration of the demonstrations [s]; that of the shipped ones is known without a fit, which takes seconds."""
        is_shipped = self.demonstrations in DEMONSTRATIONS
        return (NUM_STEPS if is_shipped else self.reference().num_steps) * CONTROL_PERIOD

    def workcell(self) -> BncWorkcell:
        """Return the jack in the world and the plug in the tool."""
        dimensions = replace(NOMINAL.with_bore_clearance(self.bore_clearance), mouth_chamfer=self.mouth_chamfer)
        return BncWorkcell(dimensions, friction=self.friction)

    def reference(self) -> ReferenceTrajectory:
        """Return the reference trajectory of the demonstrations in the options."""
        return reference_trajectory(self.demonstrations, self.num_demonstrations, self.prior_std)

    def constraints(self, num_steps: int = 0) -> LinearConstraints:
        """Return |x|, |y| ≤ `bound`: 2 mm in equation 4.26."""
        bound = np.array([self.bound, self.bound, np.inf, np.inf, np.inf, np.inf])
        return LinearConstraints.box(-bound, bound)

    def rim_contact(self) -> RimContact:
        """Return the place on the barrel's rim, with the lugs above the entries of the slots."""
        return RimContact(RIM, 3.0 * MM, self.friction, self.workcell().dimensions.detent_angle)

    def observable_success(self) -> tuple[np.ndarray, np.ndarray]:
        """Return D and y0 that estimate height and turn; a pull confirms the lock instead of the lateral offset."""
        size = self.workcell().dimensions
        D, y0 = np.zeros((POSE_SIZE, POSE_SIZE)), np.zeros(POSE_SIZE)
        D[2, 2] = D[5, 3] = 1.0
        y0[[2, 5]] = size.locked_height, -size.detent_angle
        return D, y0

    def observe(self) -> Observed:
        """Return time, pose and wrench, with further terms by the observation's name, or the wrist camera."""
        return self.observed(POSE_CENTER, POSE_SCALE, WRENCH_SCALE)

    def done(self) -> Mapping[str, Callable[..., bool] | Condition]:
        """Return success of a locked plug, and collision above the force limit."""
        locked = Condition(self.workcell().locks, seconds=LOCKED_STEPS * CONTROL_PERIOD)
        return {Termination.SUCCESS: locked, Termination.COLLISION: self.exceeds_force_limit()}

    def symmetries(self) -> tuple[Symmetry | None, Symmetry | None]:
        """Return half a turn about the jack's axis, and the quarter turns and reflections of a plug on the rim.

        An observation with an image has none, because the image is not transformed.
        """
        if self.has_image:
            return None, None
        across = (-1.0,) * {"state": 0, "mean_contact_point": 6}.get(self.observation, 4)
        observation = (1.0, *HALF_TURN, *HALF_TURN_OF_WRENCH, *across)
        half = Symmetry.of_signs(observation, HALF_TURN, (-1.0, -1.0, 1.0, *HALF_TURN_OF_WRENCH))
        more = len(self.force_limit_terms())
        return half.pad(more), Symmetry(*sides_of_the_rim(self.observation)).pad(more)

    def scene(self) -> Scene:
        """Return the demonstrations, the box of the alignment constraint and a camera that looks down at the jack."""
        workcell = self.workcell()
        to_world = in_frame(workcell.X_WT)
        near = viewpoint(*to_world(np.array([[0.021, -0.029, 0.029], [0.0, 0.0, 0.017]])))
        bound, name = self.bound, self.demonstrations
        demonstrations = Demonstrations.load(DEMONSTRATIONS.get(name, Path(name)))
        return Scene(
            to_world=to_world,
            camera=front_camera(np.array(workcell.p_WJ) + [0.0, 0.0, 0.022], distance=0.085, height=0.04),
            demonstrations=tuple(demonstrations.first(self.num_demonstrations).outputs),
            constraint=tuple(to_world(edge) for edge in box_edges((-bound, -bound, 0.0), (bound, bound, 0.015))),
            viewpoint=near,
            arm_views={"the tool": TOOL_VIEW, "the connector": near, "the arm": ARM_VIEW},
            line_radius=0.0001,
        )
