"""GridClamp: push five pegs into five holes until they snap in, with small forces (thesis, section 3.4.2)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant

from guiderail.diagrams.envs.observation import ObservationTerm, Observed
from guiderail.diagrams.envs.options import Number
from guiderail.diagrams.envs.scene import ARM_VIEW, Scene, box_edges, front_camera, in_frame, viewpoint
from guiderail.diagrams.guidance.prior import PlacedTemplate, Prior, ScriptedApproach
from guiderail.diagrams.stations.station import CONTROL_PERIOD, Impedance
from guiderail.diagrams.stations.workcell import MovableWorkcell
from guiderail.diagrams.tasks.contact_probe import RimContact
from guiderail.diagrams.tasks.insertion import PRIVILEGED, InsertionTask
from guiderail.diagrams.tasks.options import HiddenOffsets, force_limit_field, friction_field, in_ring, length_field
from guiderail.diagrams.tasks.registry import register_task
from guiderail.diagrams.tasks.task import Condition, terminal_reward
from guiderail.models.common.termination import Termination
from guiderail.models.common.transforms import MM, POSE_SIZE
from guiderail.models.objects.grid_clamp import (
    CLAMP_SDF,
    FRICTION,
    TABLE_SDF,
    GridClampDimensions,
    folder_of,
)
from guiderail.models.templates import load_template

# Smallest and largest start height [m]: the preceding skill ends with the pegs' tips 3 to 6 mm above the table.
START_HEIGHT = (0.015, 0.018)
NOMINAL = GridClampDimensions()


HARD: dict[str, Any] = {"force_limit": 10.0, "seconds": 3.0}
"""Options of difficulty="hard": a short time limit, and a force limit of 10 N; snapping in needs 6 N.

The impedance's force is bounded below the limit, so that an untrained policy fails by the time limit and not by a
collision. On the gantry with exact sensors, random inputs of the template succeed in 18 of 100 episodes and
`scripted_fast_search` in 100. The time limit does not make residuals fail: random actions that are added to the
straight descent succeed in most episodes (research/experiments.md).
"""

HARD_6S: dict[str, Any] = HARD | {"seconds": 6.0}
"""Options of difficulty="hard_6s", of which most results are stored: random actions succeed in half of the episodes."""

STICTION_TOLERANCE = 1e-5
"""Largest creep of a sticking contact [m/s].

Example: a clamp next to its holes is pressed down with 27 N and sideways with 2 N, a third of the friction limit. It
drifts at 0.18 mm/s with Drake's default of 1e-3, and at 0.004 mm/s with this value. During an episode of 10 s, the
drift determines whether the clamp slides into the holes or stands still.
"""
SEATED_HEIGHT = 0.5e-3  # [m] largest deviation of a seated clamp along z
SEATED_OFFSET = 1.0e-3  # [m] largest lateral offset of a seated clamp
HOLES = tuple(f"hole_{number}" for number in range(5))
PEGS = tuple(f"peg_{number}" for number in range(5))


@dataclass(frozen=True)
class GridClampWorkcell(MovableWorkcell):
    """Table in front of the robot's base; the target frame's axes are the world's."""

    fixture: ClassVar[str] = "table"
    workpiece: ClassVar[str] = "clamp"
    # All pairs of surfaces except each peg and its own hole, bead and lip, and pad and slab.
    filtered_pairs = (
        *(((hole,), tuple(peg for peg in PEGS if peg[-1] != hole[-1])) for hole in HOLES),
        (HOLES, ("bead", "pad")),
        (("lip",), (*PEGS, "pad")),
        (("slab",), (*PEGS, "bead")),
    )
    dimensions: GridClampDimensions = field(default_factory=GridClampDimensions)  # dimensions of clamp and table
    p_WG: tuple[float, float, float] = (0.55, 0.0, 0.15)  # center of the middle hole in the table's face, (3,) [m]
    friction: float = FRICTION  # friction coefficient of pegs, holes and the table's face

    @property
    def X_WF(self) -> RigidTransform:
        """Pose of the nominal table, X_WG."""
        return RigidTransform(np.array(self.p_WG))

    @property
    def X_FT(self) -> RigidTransform:
        """Pose of the seated clamp on the table, X_GT."""
        return RigidTransform([0.0, 0.0, -self.dimensions.peg_length])

    def sdf(self, body: str) -> Path:
        """Return the path of the SDF file of table or clamp."""
        return folder_of(self.dimensions, self.friction) / (TABLE_SDF if body == self.fixture else CLAMP_SDF).name

    def add_fixture(self, plant: MultibodyPlant) -> None:
        """Add the table, and set the plant's stiction tolerance."""
        plant.set_stiction_tolerance(STICTION_TOLERANCE)
        super().add_fixture(plant)

    def is_seated(self, clamp: np.ndarray) -> bool:
        """Return True if a clamp has snapped in, given X_GClamp as position and rotation vector (6,)."""
        return bool(
            abs(clamp[2] - self.X_FT.translation()[2]) < SEATED_HEIGHT and np.hypot(clamp[0], clamp[1]) < SEATED_OFFSET
        )


SUCCESS_REWARD = 50.0
SHAPING, FORCE_WEIGHT = 300.0, 1.0 / 12.0  # reward per distance descended [1/m], cost per squared force [1/N²]
ALIGNMENT = 3000.0  # reward per distance gained towards the holes' axis [1/m]; steps are fractions of a millimeter
COLLISION_REWARD = -25.0  # terminal reward; an early collision costs more than an episode of gentle pressing


def _force_cost(wrench: np.ndarray) -> float:
    return -FORCE_WEIGHT * float(wrench[:3] @ wrench[:3])


def _distance_gained(pose: np.ndarray, last_pose: np.ndarray) -> float:
    return SHAPING * float(last_pose[2] - pose[2])


def _alignment_gained(clamp: np.ndarray, last_clamp: np.ndarray) -> float:
    return ALIGNMENT * float(np.hypot(*last_clamp[:2]) - np.hypot(*clamp[:2]))


NUM_PLACES = 6  # pick-up places of clamps
# Parallel jaws center the clamp across the jaws (y), and not along them (x).
ALONG_JAWS = 1.0 * MM  # largest grasp offset of a place along the jaws [m]
ACROSS_JAWS = 0.2 * MM  # largest grasp offset of a place across the jaws [m]
CALIBRATION = (1.8 * MM, 2.2 * MM)  # smallest and largest offset of the table [m]
REPEATABILITY = 0.1 * MM  # largest deviation of a pick-up from the grasp offset of its place [m]
KNOWN_RADIUS = 0.15 * MM  # largest offset of the clamp with fixture_offset "none" [m]


class GridClampUncertainty(HiddenOffsets):
    """Sampler of the offsets of table and clamp; see `HiddenOffsets` for the options of a reset.

    - "per_run": the table is offset by 1.8 to 2.2 mm in a random direction, and each of six pick-up places has a grasp
      offset. All these offsets are hidden and constant during a run. In each episode, the clamp is picked up at a
      sampled place, with a repeatability of 0.1 mm. The thesis uses this setting.
    - "per_episode": the offsets of the table and of the six places are sampled each episode.
    - "none": the clamp is within 0.15 mm of its nominal position in the tool.

    The option `offset` sets the clamp's position in the tool, with the table at its nominal position.
    """

    def _draw_run(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Sample the table's offset (2,) [m] and the places' grasp offsets (6, 2) [m]."""
        step = 2 * ALONG_JAWS / NUM_PLACES
        along = -ALONG_JAWS + step * (np.arange(NUM_PLACES) + rng.uniform(0.0, 1.0, NUM_PLACES))
        across = rng.uniform(-ACROSS_JAWS, ACROSS_JAWS, NUM_PLACES)
        return in_ring(rng, *CALIBRATION), np.column_stack([along, across])

    def _draw_episode(
        self, rng: np.random.Generator, run: tuple[np.ndarray, np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        if self.kind == "none":
            return np.zeros(2), in_ring(rng, 0.0, KNOWN_RADIUS)
        table, grasps = self._draw_run(rng) if self.kind == "per_episode" else run
        return table, grasps[rng.integers(NUM_PLACES)] + in_ring(rng, 0.0, REPEATABILITY)

    def _offsets_of(self, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros(2), offset


SEATED_STEPS = 3  # consecutive steps with a seated clamp that count as success, at the default control period

# Largest distance between robot and command [m]. At this distance the impedance pushes with 12 N, twice the force that
# snapping in needs.
MAX_TRACKING_ERROR = 8.0 * MM

START_OFFSET = 0.2 * MM  # largest offset of the start along x and y [m]

# Center and scale of the observation [position [m], force [N]].
CENTER = np.array([0.0, 0.0, 12.0 * MM, 0.0, 0.0, 0.0])
SCALE = np.array([2.0 * MM, 2.0 * MM, 10.0 * MM, 2.0, 2.0, 5.0])

ON_TABLE = GridClampDimensions().peg_length  # height of the clamp while the pegs stand on the table [m]
NEAR = 1.5 * MM  # height above the table below which the clamp descends slowly and searches [m]
IN_HOLE = 0.5 * MM  # depth below the table at which a peg is in its hole [m]
PRESS = 4.0  # force of the search [N]
YIELD_GAIN = 2.0 * MM  # lateral speed per force in a hole [m/s/N]


@dataclass(frozen=True)
class LaneSearch:
    """Parameters of `scripted_search`."""

    lanes: tuple[float, ...] = (-1.1 * MM, 0.0, 1.1 * MM)  # y of the lanes [m]; the pegs drop in from at least one lane
    lane_ends: float = 3.7 * MM  # |x| of the ends of a lane [m], larger than the largest offset
    past_lanes: float = 0.3 * MM  # overshoot along y from lane to lane [m]; a clamp beyond the last lane starts again
    speed: float = 8.0 * MM  # speed along the lanes [m/s]
    snap_force: float = 12.0  # largest force while the clamp snaps in [N]
    lane_gain: float = 4.0  # speed per distance from a lane [1/s]
    height_gain: float = 1.2 * MM  # vertical speed per force error [m/s/N]
    caught_force: float = np.inf  # lateral force above which a peg is in a hole's chamfer [N]


SEARCH = LaneSearch()
GENTLE_SEARCH = LaneSearch(snap_force=8.5)
FAST_SEARCH = LaneSearch(
    lanes=(-1.5 * MM, 0.0, 1.5 * MM),
    lane_ends=3.0 * MM,
    past_lanes=0.6 * MM,
    speed=20.0 * MM,
    snap_force=8.5,
    lane_gain=6.0,
    height_gain=3.0 * MM,
    caught_force=2.0,
)
TEMPLATE = load_template("grid_clamp")  # template of the thesis, section 3.4.2
SPEED = TEMPLATE.parameters["speed_m_per_s"]  # speed at an input of 1 [m/s]
LIFT = TEMPLATE.parameters["lift"]  # fraction of `SPEED` at an upward input of 1
STIFFNESS = Impedance().stiffness[0]  # translational stiffness [N/m]


def scripted_search(observation: np.ndarray, search: LaneSearch = SEARCH) -> np.ndarray:
    """Return the inputs (3,) in [−1, 1] of a memoryless search.

    The observation begins with the scaled position (3,) and force (3,). Above the table the clamp moves to the start of
    the first lane. On the table it presses lightly and follows the lanes in alternating directions. In a hole, or if a
    lateral force shows that pegs are caught in the chamfers, it yields to lateral forces, and pushes down with at most
    `search.snap_force` [N] until it snaps in.
    """
    position, force = observation[:3] * SCALE[:3] + CENTER[:3], observation[3:6] * SCALE[3:]
    command = position - force / STIFFNESS  # the impedance's spring separates command and position
    is_on_table = position[2] > ON_TABLE - IN_HOLE and np.hypot(*force[:2]) < search.caught_force
    start = np.array([-search.lane_ends, search.lanes[0]])
    if position[2] > ON_TABLE + NEAR:
        velocity = np.array([*(search.lane_gain * (start - position[:2])), -SPEED])
        if position[2] < ON_TABLE + 3 * NEAR and np.hypot(*(position[:2] - start)) > 0.5 * MM:
            velocity[2] = 0.0  # no descent before the clamp is at the start of the first lane
    elif is_on_table and command[1] > search.lanes[-1] + 0.5 * search.past_lanes:
        velocity = np.array([0.0, 0.0, SPEED])  # lift, and begin at the first lane again
    elif is_on_table:
        velocity = np.array([*_lane_velocity(command[:2], search), search.height_gain * (force[2] - PRESS)])
    else:
        velocity = np.array([*(YIELD_GAIN * force[:2]), search.height_gain * (force[2] - search.snap_force)])
    speeds = np.array([SPEED, SPEED, LIFT * SPEED if velocity[2] > 0.0 else SPEED])
    return np.clip(velocity / speeds, -1.0, 1.0)


def _lane_velocity(xy: np.ndarray, search: LaneSearch) -> np.ndarray:
    """Return the velocity (2,) [m/s] along the lanes at the position `xy` (2,) [m]."""
    lanes = np.array(search.lanes)
    lane = int(np.argmin(np.abs(lanes - xy[1])))
    forward = 1.0 if lane % 2 == 0 else -1.0
    if forward * xy[0] < search.lane_ends - 0.1 * MM:
        return np.array([forward * search.speed, search.lane_gain * (lanes[lane] - xy[1])])
    # The speed falls towards the next lane. Otherwise the clamp would overshoot it, because the force is delayed.
    return np.array([0.0, search.lane_gain * (lanes[min(lane + 1, len(lanes) - 1)] + search.past_lanes - xy[1])])


def scripted_gentle_search(observation: np.ndarray) -> np.ndarray:
    """Return the inputs (3,) of `scripted_search` for a force limit of 10 N."""
    return scripted_search(observation, GENTLE_SEARCH)


def scripted_fast_search(observation: np.ndarray) -> np.ndarray:
    """Return the inputs (3,) of `scripted_search` for a force limit of 10 N and a short time limit."""
    return scripted_search(observation, FAST_SEARCH)


def straight_descent(observation: np.ndarray) -> np.ndarray:
    """Return the inputs (3,) of the fastest straight descent."""
    return np.array([0.0, 0.0, -1.0])


@register_task("GridClamp")
class GridClamp(InsertionTask):
    """Insert the clamp.

    Rewards: "shaped" is the thesis's reward (3.11, 3.12). "no_force" is "shaped" without the cost of force, and
    "sparse" is "shaped" without the reward for descending. "aligned" is "shaped" with a cost of collisions and a reward
    for the distance gained towards the holes' axis. This distance is privileged: the policy does not observe it.

    Without `active_constraints`, only the impedance limits the forces.
    """

    workpiece, fixture = "clamp", "table"
    simulated_rewards = ("aligned",)
    snaps_in = True
    presets = {"hard": HARD, "hard_6s": HARD_6S}
    scripted_policies = (scripted_search, scripted_gentle_search, scripted_fast_search, straight_descent)
    scripted_defaults = {"hard": scripted_fast_search, "hard_6s": scripted_gentle_search}
    defaults = {"guidance": "sct", "action_repeat": 5, "active_constraints": True}
    learner = {"algorithm": "sac", "preset": "sac_gridclamp"}

    reward: Literal["shaped", "no_force", "sparse", "aligned"] = Field("shaped", description="name of the reward")
    fixture_offset: Literal["per_run", "per_episode", "none"] = Field(
        "per_run", description="offsets of table and clamp: sampled per run or per episode; none: clamp within 0.15 mm"
    )
    force_limit: Number = force_limit_field(8)
    seconds: Number = Field(10.0, ge=2, le=30, description="duration of an episode [s]")
    hole_chamfer: Number = length_field(NOMINAL.hole_chamfer, 0.1 * MM, 0.8 * MM, "chamfer of the holes")
    peg_chamfer: Number = length_field(NOMINAL.peg_chamfer, 0.1 * MM, 0.8 * MM, "chamfer of the pegs' tips")
    clearance: Number = length_field(
        NOMINAL.clearance, 0.05 * MM, 0.15 * MM, "clearance between a peg and its hole on each side"
    )
    friction: Number = friction_field(FRICTION, "pegs, holes and table")

    @property
    def offsets(self) -> GridClampUncertainty:
        """Sampler of the offsets."""
        return GridClampUncertainty(self.fixture_offset)

    @property
    def duration(self) -> float:
        """Duration of an episode [s]; 100 actions at 10 Hz by default, and 140 on average in the thesis."""
        return self.seconds

    def workcell(self) -> GridClampWorkcell:
        """Return the table with holes and the clamp in the tool."""
        dimensions = NOMINAL.with_clearance(self.clearance)
        dimensions = replace(dimensions, hole_chamfer=self.hole_chamfer, peg_chamfer=self.peg_chamfer)
        return GridClampWorkcell(dimensions, friction=self.friction)

    def prior(self) -> Prior:
        """Return a template with one state, an upright clamp in a cuboid around the middle hole, and a descent."""
        heights = (max(START_HEIGHT), -TEMPLATE.parameters["push_m"])
        return Prior(
            template=PlacedTemplate(TEMPLATE, {"hole": RigidTransform()}, max_tracking_error=MAX_TRACKING_ERROR),
            approach=ScriptedApproach(heights, speed=SPEED, reach=TEMPLATE.parameters["width_m"] / 2),
        )

    def rim_contact(self) -> RimContact:
        """Return the place at which the pegs stand on the faces around their holes."""
        # At 2.5 mm a clamp that lags behind 40 mm/s circles at 0.6 mm, and drags its pegs in the chamfers.
        return RimContact(self.workcell().dimensions.peg_length, 3.5 * MM, self.friction)

    def observable_success(self) -> tuple[np.ndarray, np.ndarray]:
        """Return D (6, 6) and y0 (6,) of an estimate of the height; a pull checks the lateral offset instead."""
        D, y0 = np.zeros((POSE_SIZE, POSE_SIZE)), np.zeros(POSE_SIZE)
        D[2, 2] = 1.0
        y0[2] = self.workcell().X_FT.translation()[2]
        return D, y0

    def observe(self) -> Observed:
        """Return the terms of the tool's position (3,) in the target frame, the force (3,) and a sampled limit."""
        terms = (
            ObservationTerm("pose", CENTER[:3], SCALE[:3], (0, 1, 2)),
            ObservationTerm("wrench", 0.0, SCALE[3:], (0, 1, 2)),
            *self.force_limit_terms(),
        )
        return Observed(terms, privileged=PRIVILEGED)

    def rewards(self) -> Mapping[str, Callable[..., float]]:
        """Return the terms of the reward; values per action in the thesis are divided among the control steps."""
        terms: dict[str, Callable[..., float]] = {
            "terminal_reward": terminal_reward({"success": SUCCESS_REWARD}),
            "action_cost": lambda action, action_repeat: -float(action @ action) / action_repeat[0],
        }
        if self.reward != "no_force":
            terms["force_cost"] = lambda wrench, action_repeat: _force_cost(wrench[:3]) / action_repeat[0]
        if self.reward != "sparse":
            terms["shaping"] = _distance_gained
        if self.reward == "aligned":
            terms["alignment"] = _alignment_gained
            terms["collision_cost"] = terminal_reward({"collision": COLLISION_REWARD})
        return terms

    def done(self) -> Mapping[str, Callable[..., bool] | Condition]:
        """Return success of a seated clamp, and collision above the force limit."""
        seated = Condition(self.workcell().is_seated, seconds=SEATED_STEPS * CONTROL_PERIOD)
        return {Termination.SUCCESS: seated, Termination.COLLISION: self.exceeds_force_limit()}

    def start_pose(self, rng: np.random.Generator) -> np.ndarray:
        """Return a sampled start pose (6,) [m, rad], at which the preceding skill ends."""
        start = np.zeros(POSE_SIZE)
        start[:3] = *rng.uniform(-START_OFFSET, START_OFFSET, 2), rng.uniform(*START_HEIGHT)
        return start

    def scene(self) -> Scene:
        """Return the cuboid that bounds commands, up to 25 mm above the target, and a camera at the holes."""
        workcell, parameters = self.workcell(), TEMPLATE.parameters
        to_world = in_frame(workcell.X_WT)
        half = 0.5 * parameters["width_m"]
        edges = box_edges((-half, -half, -parameters["push_m"]), (half, half, 0.025))
        near = viewpoint(*to_world(np.array([[0.045, -0.065, 0.045], [0.0, 0.0, 0.008]])))
        return Scene(
            to_world=to_world,
            camera=front_camera(np.array(workcell.p_WG) + [0.0, 0.0, 0.01], distance=0.17, height=0.075),
            constraint=tuple(to_world(edge) for edge in edges),
            viewpoint=near,
            arm_views={"the clamp": near, "the arm": ARM_VIEW},
            line_radius=0.0001,
        )
