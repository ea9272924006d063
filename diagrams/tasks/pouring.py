"""Pouring: an arm pours two balls from a thermos into a mug (thesis, section 3.4.1)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import Annotated, Any, Literal, Self

import numpy as np
from annotated_types import Len
from pydantic import Field, model_validator
from pydrake.math import RigidTransform
from pydrake.systems.framework import DiagramBuilder, OutputPort
from scipy.spatial.transform import Rotation

from guiderail.diagrams.envs.observation import ObservationTerm
from guiderail.diagrams.envs.options import Integer, Number, Numbers, Pair, ResetOptions
from guiderail.diagrams.envs.scene import Camera, Scene, in_frame, look_at, viewpoint
from guiderail.diagrams.guidance.guidance import Guidance
from guiderail.diagrams.guidance.prior import PlacedTemplate, Prior
from guiderail.diagrams.stations.pouring import PouringConfig, PouringStation, make_mug
from guiderail.diagrams.stations.station import Station
from guiderail.diagrams.tasks.options import episode_stream, in_ring
from guiderail.diagrams.tasks.registry import register_task
from guiderail.diagrams.tasks.task import (
    Condition,
    Task,
    Threshold,
    World,
    add_constant,
    terminal_reward,
)
from guiderail.models.common.errors import InputError
from guiderail.models.common.termination import Termination
from guiderail.models.common.transforms import transform_to_pose
from guiderail.models.objects.pouring import MUG, Ball
from guiderail.models.templates import SharedControlTemplate, load_template

FULL_SPEED = 0.15  # speed at an input of 1 along one axis [m/s]
FULL_TILT = 0.8  # tilting speed at an input of 1 [rad/s]
NO_FUNNEL = 0.24  # height of a funnel that has no effect, that of the template's ceiling [m]
# Default input_speed with the sparse reward, at which random inputs sometimes succeed.
SPARSE_INPUT_SPEED = 1.7


def make_template(
    config: PouringConfig,
    input_speed: float = 1.0,
    *,
    aim: bool = False,
    shield: bool = False,
    pour_distance: float | None = None,
    funnel: bool = True,
) -> SharedControlTemplate:
    """Return the template for the vessels of `config`, with all speeds multiplied by `input_speed`.

    With `aim`, inputs can aim the tip: in the state Pour, or with `shield` in a state before it. `pour_distance` (at
    which the state Pour begins, [m]) and `funnel` are those of the template without aiming.
    """
    changes = {} if pour_distance is None else {"near_m": pour_distance - config.mug.outer_radius}
    changes |= {} if funnel else {"funnel_m": NO_FUNNEL}
    return load_template(
        ("pouring_shielded" if shield else "pouring_aimed") if aim else "pouring",
        **({} if aim else changes),
        full_speed_m_per_s=input_speed * FULL_SPEED,
        full_tilt_rad_per_s=input_speed * FULL_TILT,
        mug_radius_m=config.mug.outer_radius,
        thermos_radius_m=config.thermos.outer_radius,
    )


def frames_of(
    template: SharedControlTemplate, X_TMug: RigidTransform, X_TObserved: RigidTransform | None = None
) -> dict[str, RigidTransform]:
    """Return the poses of a template's objects for an actual or estimated pose X_TMug of the mug.

    X_TObserved is the pose of the mug that the policy observes, on which the shield depends; X_TMug by default.
    """
    if "behind_mug" not in template.frames:
        return {"mug_tip": X_TMug}
    frames = {"behind_mug": X_TMug @ RigidTransform([0.0, template.parameters["behind_m"], 0.0])}
    if "pour_line" in template.frames:
        frames["pour_line"] = (X_TMug if X_TObserved is None else X_TObserved) @ RigidTransform([*POUR_LINE, 0.0])
    return frames


POUR_LINE = (0.0, -0.035)  # [m] position of the tip in the mug's frame around which both balls fall into the mug
MAX_MUG_OFFSET = 0.04  # [m] largest mug offset along x and y; beyond it the arm reaches few of the starts
POSITION_SCALE = 5.0  # [1/m] scale of observed positions, which are then as large as observed angles near the mug
MAX_MUG_ERROR = 0.06  # [m] largest distance from the estimated mug position that aiming can reach

HARD: Mapping[str, Any] = {
    "aim": True,
    "mug_error_least": 0.035,
    "mug_error_most": 0.05,
    "mug_inner_diameter": 0.07,
    "time_limit": 6.0,
    "shield": True,
}
"""Options of difficulty="hard": the template uses an estimated mug position, whose error is sampled and observed.

Without the shield 26 % of the training episodes spill, and the policies pour in 87 to 99 % of the held-out episodes.
"""

THESIS: Mapping[str, Any] = {"input_speed": 0.25, "time_limit": 20.0, "pour_distance": 0.09, "funnel": False}
"""Options of difficulty="thesis": the pace of the thesis, and a template that does not lead to where pouring succeeds.

With SAC, ten successes in a row begin after 5 episodes if the template pours from 75 or 87.5 mm, after 76 from 90 mm,
and not within 150 from 92.5, 95 or 100 mm (one run each). The thesis has 65 on its robot and 250 in simulation.

The 65 episodes of the thesis had 149 actions each on average.
At the standard speed, the scripted policy pours within 28 actions; at this speed within about 90. Uncorrelated random
inputs then move the thermos four times less, and a success needs four times as many actions in the right direction.
"""

MOST_BALLS = 8  # largest number of balls


class PouringReset(ResetOptions):
    """Options of a reset of Pouring."""

    start: Annotated[Numbers, Len(3, 3)] | None = Field(
        None, description="(x, y, z) of the upright thermos's tip in the frame of the estimated mug [m]"
    )
    mug_position: Pair | None = Field(
        None, description="(x, y) of the estimated mug position relative to its nominal position [m]"
    )
    mug_error: Pair | None = Field(None, description="(x, y) from the actual to the estimated mug position [m]")


TERMINAL = {"success": 200.0, "collision": -10.0}  # equation 3.5
SHAPING = 200.0  # reward per progress of the template, equation 3.7
APPROACH = 15.0  # reward per distance gained [1/m], equation 3.9
NEAR_BONUS = 0.2  # bonus per action within `NEAR`
TILT = 20.0  # reward per tilt [1/rad], equation 3.10
NEAR = 0.07  # [m] distance of the tips at which pouring begins; the rims prevent the thesis's distance of 0.04 m
POUR = 2  # index of the template's state Pour
AIM = np.array([0.0, -0.045])  # [m] position of the tip in the mug's frame from which both balls fall into the mug
AIMING = 2000.0  # reward per distance gained towards `AIM` [1/m]: 50 mm earn half as much as the whole tilt


def _progress_gained(progress: np.ndarray, last_progress: np.ndarray) -> float:
    return SHAPING * float(progress[0] - last_progress[0])


def _aiming(tip_in_mug: np.ndarray, last_tip_in_mug: np.ndarray, state: np.ndarray) -> float:
    """Return the reward for the distance gained towards `AIM` in the state Pour."""
    if state[0] != POUR:
        return 0.0
    before, after = (float(np.linalg.norm(tip[:2] - AIM)) for tip in (last_tip_in_mug, tip_in_mug))
    return AIMING * (before - after)


def _approach(tip_in_mug: np.ndarray, last_tip_in_mug: np.ndarray, action_repeat: np.ndarray) -> float:
    """Return the reward of equation 3.9."""
    distance = np.linalg.norm(tip_in_mug[:3])
    bonus = NEAR_BONUS / action_repeat[0] if distance <= NEAR else 0.0
    return float(APPROACH * (np.linalg.norm(last_tip_in_mug[:3]) - distance) + bonus)


def _tilting(tip_in_mug: np.ndarray, last_tip_in_mug: np.ndarray) -> float:
    """Return a quarter of the reward of equation 3.10, as in equation 3.8.

    The thermos is on the mug's −y side, so that a change of the roll angle in the negative direction pours.
    """
    change = _euler(tip_in_mug) - _euler(last_tip_in_mug)
    change -= 2 * np.pi * np.round(change / (2 * np.pi))
    if np.linalg.norm(tip_in_mug[:3]) > NEAR:
        return -float(np.abs(change).sum()) / 4
    return float(-TILT * change[0] - abs(change[1]) - abs(change[2])) / 4


def _euler(tip: np.ndarray) -> np.ndarray:
    """Return roll, pitch and yaw (3,) [rad] of a pose (6,) with a rotation vector."""
    return Rotation.from_rotvec(tip[3:]).as_euler("xyz")


def sample_mug_error(episode: np.random.Generator, options: Pouring, reset: PouringReset) -> np.ndarray:
    """Return (x, y) [m] from the actual to the estimated mug position: sampled, or the reset option `mug_error`.

    Raises:
        InputError: If the reset option is longer than `MAX_MUG_ERROR`.
    """
    error = in_ring(episode, options.mug_error_least, options.mug_error_most)
    if reset.mug_error is None:
        return error
    if np.linalg.norm(reset.mug_error) > MAX_MUG_ERROR:
        raise InputError(f"the reset option 'mug_error' is at most {MAX_MUG_ERROR:g} m long, not {reset.mug_error}")
    return np.array(reset.mug_error)


MAX_TRACKING_ERROR = 0.05  # largest distance between robot and command [m]
POURED_TIME = 10 * PouringConfig().control_period  # time with the balls in the mug that counts as success [s]
# Range of the thermos's start in the frame of the mug's tip, inside the template's workspace.
START_AZIMUTH_DEG = (-120.0, -75.0)
START_RADIUS = (0.24, 0.30)  # [m]
START_HEIGHT = (0.08, 0.19)  # [m]
START_TOLERANCE = 1e-6  # largest distance of a given start from the workspace, along an axis [m]
MAX_START_SAMPLES = 20  # number of unreachable samples after which the reset fails


# Indices into the observation [tip in the mug's frame, error of the estimated mug pose, template's state].
ERROR, STATE = slice(6, 8), 8

OVER_THE_RIM = (0.045, 0.055)  # [m] goal of the tip: distance from the mug's axis, height above its rim
POURING_DISTANCE = 0.078  # [m] distance from the mug's opening below which the inputs are only horizontal
SOFTNESS = 0.03  # [m] distance from the goal below which the inputs are proportional to this distance


# [m] goal of the tip until the state Pour begins: distance from the axis of the estimated mug, height above its rim
AIM_OVER_THE_RIM = (0.03, 0.045)
AIM_SOFTNESS = 0.02  # [m] distance from the aim below which the inputs are proportional to this distance
AIM_TOLERANCE = 0.008  # [m] distance from the aim below which the policy tilts the thermos
POURING_TILT = 95.0  # [degrees] tilt above which the policy always tilts further, because the balls already roll


def scripted_pour(observation: np.ndarray) -> np.ndarray:
    """Return inputs (3,) that move the thermos's tip over the mug's rim and then towards the mug's axis."""
    p_MP = observation[:3] / POSITION_SCALE
    horizontal = np.hypot(p_MP[0], p_MP[1])
    to_axis = -p_MP[:2] / max(horizontal, 1e-9)
    if np.linalg.norm(p_MP) < POURING_DISTANCE:
        return np.array([*to_axis, 0.0])
    distance, height = OVER_THE_RIM
    return np.clip((np.array([*(-distance * to_axis), height]) - p_MP) / SOFTNESS, -1.0, 1.0)


def scripted_pour_aimed(observation: np.ndarray) -> np.ndarray:
    """Return inputs (3,) that move the tip until the state Pour begins, then aim at the mug, then tilt the thermos."""
    p_MP = observation[:3] / POSITION_SCALE
    if observation[STATE] < 0.5:
        p_BP = p_MP - np.array([*(MAX_MUG_ERROR * observation[ERROR]), 0.0])
        distance, height = AIM_OVER_THE_RIM
        goal = np.array([*(distance * p_BP[:2] / max(np.hypot(p_BP[0], p_BP[1]), 1e-9)), height])
        return np.clip((goal - p_BP) / SOFTNESS, -1.0, 1.0)
    to_aim = AIM - p_MP[:2]
    is_shielded = observation[STATE] > 1.5  # in the state Pour of the shielded template, which moves nowhere else
    is_tilting = is_shielded or np.linalg.norm(to_aim) < AIM_TOLERANCE or _tilt(observation) > POURING_TILT
    return np.array([*np.clip(to_aim / AIM_SOFTNESS, -1.0, 1.0), float(is_tilting)])


def scripted_pour_blind(observation: np.ndarray) -> np.ndarray:
    """Return the inputs (3,) of `scripted_pour_aimed` for the estimated instead of the actual mug position."""
    estimated = np.array(observation, dtype=float)
    estimated[:2] -= POSITION_SCALE * MAX_MUG_ERROR * estimated[ERROR]
    estimated[ERROR] = 0.0
    return scripted_pour_aimed(estimated)


def _tilt(observation: np.ndarray) -> float:
    """Return the angle between the thermos's axis and the vertical [degrees]."""
    axis = Rotation.from_rotvec(observation[3:6]).as_matrix()[:, 2]
    return float(np.rad2deg(np.arccos(np.clip(axis[2], -1.0, 1.0))))


@register_task("Pouring")
class Pouring(Task):
    """Pour both balls into the mug.

    Rewards: "sparse" follows equations 3.5 and 3.6, "shaped" adds the template's transition distances (3.7), and
    "hand_shaped" follows 3.8 to 3.10. With the standard template, a constant action pours the balls into the mug. With
    difficulty="hard", the mug is not at the position that the template assumes. With difficulty="thesis", the
    template's inputs are as slow as in the thesis, and its state Pour begins so early that a constant action spills.
    """

    station = PouringStation
    Reset = PouringReset
    has_held_out_distribution = True
    defaults = {"guidance": "sct", "action_repeat": 10}
    presets = {"hard": HARD, "thesis": THESIS}
    scripted_policies = (scripted_pour, scripted_pour_aimed, scripted_pour_blind)
    scripted_defaults = {"hard": scripted_pour_aimed}
    learner = {"algorithm": "sac", "preset": "pouring"}
    clip = 10.0

    reward: Literal["shaped", "sparse", "hand_shaped"] = Field("shaped", description="name of the reward")
    balls: Integer = Field(2, ge=2, le=MOST_BALLS, description="number of balls")
    balls_in: Integer | None = Field(
        None, ge=1, le=MOST_BALLS, description="balls that have to be in the mug; default: all"
    )
    ball_diameter: Number = Field(Ball().diameter, ge=0.02, le=0.045, description="diameter of a ball [m]")
    input_speed: Number | None = Field(
        None,
        ge=0.2,
        le=2.0,
        description="factor of the template's input speed; default: 1, or 1.7 with the sparse reward",
    )
    mug_inner_diameter: Number = Field(MUG.inner_diameter, description="inner diameter of the mug [m]")
    mug_depth: Number = Field(MUG.depth, description="inner depth of the mug [m]")
    mug_offset: Number = Field(
        0.0, ge=0, le=MAX_MUG_OFFSET, description="largest sampled offset of the mug along x and y [m]"
    )
    mug_error_least: Number = Field(
        0.0,
        ge=0,
        le=MAX_MUG_ERROR,
        description="smallest sampled distance between actual and estimated mug position [m]",
    )
    mug_error_most: Number = Field(
        0.0,
        ge=0,
        le=MAX_MUG_ERROR,
        description="largest sampled distance between actual and estimated mug position [m]",
    )
    time_limit: Number = Field(15.0, ge=3.0, le=30.0, description="duration of an episode [s]")
    aim: bool = Field(
        False, description="let inputs aim the tip in the state Pour; observe the mug error and the template's state"
    )

    pour_distance: Number | None = Field(
        None, ge=0.06, le=0.2, description="distance of the tips at which the template pours, without aim [m]"
    )
    funnel: bool = Field(True, description="lead the tip down to the mug's rim by a funnel, without aim")
    shield: bool = Field(False, description="allow to tilt only where the balls fall into the observed mug; needs aim")

    @property
    def needed(self) -> int:
        """Number of balls that have to be in the mug."""
        return self.balls if self.balls_in is None else self.balls_in

    @property
    def ball(self) -> Ball:
        """Ball: a shell with a mass proportional to its surface."""
        default = Ball()
        return replace(
            default, diameter=self.ball_diameter, mass=default.mass * (self.ball_diameter / default.diameter) ** 2
        )

    @model_validator(mode="after")
    def _check_options(self) -> Self:
        """Check that the options are compatible.

        Raises:
            InputError: If `mug_error_least` is larger than `mug_error_most`, `balls_in` is larger than `balls`, the
                balls do not fit into the thermos, or `shield` is set without `aim`.
        """
        if self.shield and not self.aim:
            raise InputError("the option shield needs the option aim: give aim=true too")
        if self.needed > self.balls:
            raise InputError(f"balls_in must be at most balls, which is {self.balls}, not {self.needed}: give both")
        top = PouringConfig(ball=self.ball, num_balls=self.balls).stack()[-1, 2] + 0.5 * self.ball_diameter
        if top > 0.0:
            raise InputError(
                f"{self.balls} balls of {self.ball_diameter:g} m do not fit into the thermos: choose fewer balls, or "
                "smaller balls, such as ball_diameter=0.026"
            )
        if self.mug_error_least > self.mug_error_most:
            raise InputError(
                f"mug_error_least must be at most mug_error_most, which is {self.mug_error_most:g} m, "
                f"not {self.mug_error_least:g} m: give both"
            )
        return self

    @property
    def duration(self) -> float:
        """Duration of an episode [s]; by default 150 actions at 10 Hz, about as many as in the thesis."""
        return self.time_limit

    @property
    def collision(self) -> Threshold:
        """Any contact since the start of the episode."""
        return Threshold("touched")

    def workcell(self) -> PouringConfig:
        """Return the vessels and their poses."""
        mug = make_mug(self.mug_inner_diameter, self.mug_depth, self.ball)
        return PouringConfig(mug=mug, ball=self.ball, num_balls=self.balls)

    @cached_property
    def template(self) -> SharedControlTemplate:
        """Template of the thesis (figure 2.2, table 3.3), or the template with aiming in the state Pour."""
        speed = self.input_speed or (SPARSE_INPUT_SPEED if self.reward == "sparse" else 1.0)
        return make_template(
            self.workcell(),
            speed,
            aim=self.aim,
            shield=self.shield,
            pour_distance=self.pour_distance,
            funnel=self.funnel,
        )

    def prior(self) -> Prior:
        """Return the template, whose objects are at their nominal poses."""
        frames = partial(frames_of, X_TMug=RigidTransform())
        return Prior(
            template=lambda: PlacedTemplate(self.template, frames(self.template), max_tracking_error=MAX_TRACKING_ERROR)
        )

    def signals(self, builder: DiagramBuilder, station: Station) -> Mapping[str, OutputPort]:
        """Return the error of the estimated mug position, if the option `aim` is set."""
        return {"mug_error": add_constant(builder, "mug_error", np.zeros(2))} if self.aim else {}

    def observe(self) -> Sequence[ObservationTerm]:
        """Return the tip's pose in the frame of the mug's tip: position in units of 0.2 m, then rotation vector.

        With the option `aim`, the error of the estimated mug position and the template's state, from −1 to 1, follow.
        """
        tip = ObservationTerm("tip_in_mug", 0.0, [1.0 / POSITION_SCALE] * 3 + [1.0] * 3)
        more = ObservationTerm("mug_error", 0.0, MAX_MUG_ERROR), ObservationTerm("state", 1.0)
        return (tip, *more) if self.aim else (tip,)

    def rewards(self) -> Mapping[str, Callable[..., float]]:
        """Return the terms of the reward.

        The reward of an action is the sum over its control steps. Values that the thesis defines per action are
        therefore divided by `action_repeat`. With the option `aim`, "shaped" includes the distance gained towards `AIM`
        in the state Pour; the progress of the shielded template includes the distance gained in its state aim.
        """
        terms: dict[str, Callable[..., float]] = {
            "terminal_reward": terminal_reward(TERMINAL),
            "action_cost": lambda action, action_repeat: -float(action @ action) / action_repeat[0],
        }
        if self.reward == "shaped":
            terms["shaping"] = _progress_gained
            if self.aim and not self.shield:
                terms["aiming"] = _aiming
        if self.reward == "hand_shaped":
            terms |= {"approach": _approach, "tilting": _tilting}
        return terms

    def done(self) -> Mapping[str, Callable[..., bool] | Condition]:
        """Return collision, success and spill; a collision takes precedence over a success.

        An episode ends as a spill if so many balls have fallen that fewer than `needed` balls can be in the mug. It is
        a success after `needed` balls have been in the mug for `POURED_TIME`, because a ball can bounce out again.
        """
        config, needed = self.workcell(), self.needed
        mug, thermos, radius = config.mug, config.thermos, config.ball.diameter / 2
        fall = config.mug.height + config.stand_height

        def positions(balls: np.ndarray) -> np.ndarray:
            return balls.reshape(-1, 6)[:, :3]

        def is_poured(balls_in_mug: np.ndarray) -> bool:
            return sum(mug.contains(p_MB) for p_MB in positions(balls_in_mug)) >= needed

        def is_spilled(balls_in_mug: np.ndarray, balls_in_thermos: np.ndarray) -> bool:
            # A ball has fallen if it is in neither vessel, and as low as a ball on the table or lower.
            fallen = sum(
                p_MB[2] < radius - fall + 0.01 and not mug.contains(p_MB) and not thermos.contains(p_PB, 0.01)
                for p_MB, p_PB in zip(positions(balls_in_mug), positions(balls_in_thermos), strict=True)
            )
            return bool(fallen > config.num_balls - needed)

        return {
            Termination.COLLISION: lambda touched: touched[0] > 0,
            Termination.SUCCESS: Condition(is_poured, seconds=POURED_TIME),
            Termination.SPILL: is_spilled,
        }

    def reset(self, world: World, rng: np.random.Generator, given: Any) -> dict[str, Any]:
        """Place the mug, the upright thermos and the balls at sampled poses; an unreachable start is sampled again.

        Values that a reset option replaces are also sampled. The start is inside the constraints of the template's
        first state. The returned `mug_position` is the actual position of the mug; the reset option of this name is
        the estimated position.

        Raises:
            InputError: If a reset option is too large, the option `start` is outside the constraints, or the arm
                reaches no sampled start.
        """
        template, episode = self.template, episode_stream(rng, given.held_out)
        for _ in range(MAX_START_SAMPLES):
            azimuth = np.deg2rad(episode.uniform(*START_AZIMUTH_DEG))
            radius, height = episode.uniform(*START_RADIUS), episode.uniform(*START_HEIGHT)
            p_MP = np.array([radius * np.cos(azimuth), radius * np.sin(azimuth), height])
            p_TMug = self.mug_offset * episode.uniform(-1.0, 1.0, 2)
            p_MP = p_MP if given.start is None else np.array(given.start)
            p_TMug = p_TMug if given.mug_position is None else np.array(given.mug_position)
            if np.abs(p_TMug).max() > MAX_MUG_OFFSET:
                raise InputError(f"the mug can be moved by at most {MAX_MUG_OFFSET} m along x and y")
            error = sample_mug_error(episode, self, given)
            # The error moves the actual mug, so that the estimated mug position stays within reach.
            estimated, p_TMug = RigidTransform([*p_TMug, 0.0]), p_TMug - error
            frames = frames_of(template, estimated, RigidTransform([*p_TMug, 0.0]))
            # The thermos is oriented as in the template's first state, so that all guidance has the same start pose.
            X_TP = template.project(template.initial_state, RigidTransform(estimated @ p_MP), frames)
            nearest = estimated.inverse() @ X_TP.translation()
            if np.abs(nearest - p_MP).max() > START_TOLERANCE:
                raise InputError(
                    "the reset option 'start' must be inside the workspace of the template's first state, not "
                    f"{p_MP.tolist()}: the nearest start is {nearest.round(4).tolist()}"
                )
            try:
                world.set_pose(transform_to_pose(X_TP))
                break
            except InputError as error_of_reach:
                unreachable = error_of_reach
        else:
            raise unreachable
        world.station.set_mug(world.context, RigidTransform([*p_TMug, 0.0]))
        if isinstance(world.guidance, Guidance):
            world.guidance.set_frames(world.context, frames)
        if self.aim:
            world.set("mug_error", error)
        return {"start": p_MP, "mug_position": p_TMug} | ({"mug_error": error} if error.any() else {})

    def scene(self) -> Scene:
        """Return the frame, viewpoint and line width in which the tip's paths are drawn, and a camera at the mug."""
        X_WT = self.workcell().X_WT
        center = X_WT.translation()
        forward = np.array([-0.55, 0.75, -0.35]) / np.linalg.norm([-0.55, 0.75, -0.35])
        target = center + [0.0, -0.05, 0.08]
        camera = Camera((480, 360), np.deg2rad(40), look_at(target - forward, target))
        near = viewpoint(center + [0.25, -0.5, 0.25], center)
        return Scene(in_frame(X_WT), camera=camera, viewpoint=near, line_radius=0.001)
