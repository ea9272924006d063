"""Pouring: an arm with a thermos, two balls in it, and a mug to pour them into (thesis, section 3.4.1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort

from guiderail.diagrams.envs.cameras import Camera, look_at
from guiderail.diagrams.envs.observation import ObservationTerm
from guiderail.diagrams.envs.options import STANDARD
from guiderail.diagrams.envs.scene import Scene, in_frame, viewpoint
from guiderail.diagrams.guidance.guidance import Guidance
from guiderail.diagrams.guidance.prior import PlacedTemplate
from guiderail.diagrams.stations.pouring import PouringConfig, PouringStation, make_mug
from guiderail.diagrams.stations.station import Station
from guiderail.diagrams.tasks.offsets import episode_stream, in_ring
from guiderail.diagrams.tasks.pouring.options import (
    HARD,
    MAX_MUG_ERROR,
    MAX_MUG_OFFSET,
    POSITION_SCALE,
    SPARSE_INPUT_SPEED,
    PouringOptions,
    PouringReset,
    frames_of,
    make_aimed_template,
    make_template,
)
from guiderail.diagrams.tasks.pouring.rewards import reward_terms
from guiderail.diagrams.tasks.pouring.scripted import scripted_pour, scripted_pour_aimed, scripted_pour_blind
from guiderail.diagrams.tasks.registry import register_task
from guiderail.diagrams.tasks.task import EpisodeConstant, ScriptedPolicy, Task, Threshold
from guiderail.models.common.errors import InputError
from guiderail.models.common.poses import transform_to_pose
from guiderail.systems.episode_monitor import TerminationTerm
from guiderail.systems.reward_system import RewardTerm

if TYPE_CHECKING:
    from guiderail.diagrams.envs.config import EnvConfig


def draw_error(episode: np.random.Generator, options: PouringOptions, reset: PouringReset) -> np.ndarray:
    """(x, y) [m] from the mug to where it is believed to be; drawn whether or not a reset's option replaces it.

    Raises:
        InputError: if the reset's option is farther than an aimed Pour leads.
    """
    error = in_ring(episode, options.mug_error_least, options.mug_error_most)
    if reset.mug_error is None:
        return error
    if np.linalg.norm(reset.mug_error) > MAX_MUG_ERROR:
        raise InputError(f"the reset option 'mug_error' is at most {MAX_MUG_ERROR:g} m long, not {reset.mug_error}")
    return np.array(reset.mug_error)


def conditions(config: PouringConfig, needed: int) -> list[TerminationTerm]:
    """How an episode ends. A collision comes first: nothing that touched the mug on its way is a success.

    Args:
        config: of the scene.
        needed: how many balls have to be in the mug; when so many have fallen that this can't be, they are spilled.
    """
    mug, thermos, radius = config.mug, config.thermos, config.ball.diameter / 2
    fall = config.mug.height + config.stand_height

    def positions(balls: np.ndarray) -> np.ndarray:
        return balls.reshape(-1, 6)[:, :3]

    def poured(balls_in_mug: np.ndarray) -> bool:
        return sum(mug.contains(p_MB) for p_MB in positions(balls_in_mug)) >= needed

    def spilled(balls_in_mug: np.ndarray, balls_in_thermos: np.ndarray) -> bool:
        # A ball that is in neither of them and has fallen to the table, or past it.
        fallen = sum(
            p_MB[2] < radius - fall + 0.01 and not mug.contains(p_MB) and not thermos.contains(p_PB, 0.01)
            for p_MB, p_PB in zip(positions(balls_in_mug), positions(balls_in_thermos), strict=True)
        )
        return bool(fallen > config.num_balls - needed)

    balls = {"balls_in_mug": 6 * config.num_balls, "balls_in_thermos": 6 * config.num_balls}
    return [
        TerminationTerm("collision", {"touched": 1}, lambda touched: touched[0] > 0),
        # For a tenth of a second: a ball can bounce out again.
        TerminationTerm("success", {"balls_in_mug": 6 * config.num_balls}, poured, steps=10),
        TerminationTerm("spill", balls, spilled),
    ]


LEASH = 0.05  # [m] farther from its command than this the arm is waited for
# Where the thermos starts, in the frame of the mug's tip: inside the template's own workspace.
START_AZIMUTH_DEG = (-120.0, -75.0)
START_RADIUS = (0.24, 0.30)  # [m]
START_HEIGHT = (0.08, 0.19)  # [m]
DRAWS = 20  # of a start, before it is said that the arm can't reach it


@register_task("Pouring")
class Pouring(Task):
    """Pour both balls: "sparse" is rewarded as in (3.5-3.6), "shaped" by the template's transition distances too
    (3.7), "hand_shaped" as in (3.8-3.10). With the standard template a constant action pours; "hard" is a mug that the
    template believes elsewhere."""

    workcell_kind = "pouring"
    Options = PouringOptions
    Reset = PouringReset
    has_held_out_distribution = True
    options: PouringOptions
    rewards = ("shaped", "sparse", "hand_shaped")
    defaults = {"guidance": "sct", "action_repeat": 10}
    difficulties = {STANDARD: {}, "hard": HARD}
    learner = {"algorithm": "sac", "preset": "pouring"}
    num_steps: int  # 1500 unless said otherwise: 150 decisions at 10 Hz, about as many as in the thesis
    clip = 10.0
    collision = Threshold("touched")
    pushable = False  # what is in a thermos does not move along with an arm that is put elsewhere

    def __init__(self, config: EnvConfig):
        super().__init__(config)
        self.options.check()
        self._config = PouringConfig(
            mug=make_mug(self.options.mug_inner_diameter, self.options.mug_depth, self.options.ball),
            ball=self.options.ball,
            num_balls=self.options.balls,
        )
        self.num_steps = round(self.options.time_limit / self._config.control_period)
        speed = self._input_speed()
        self._template = make_template(self._config, speed)
        if self.options.aim:
            self._template = make_aimed_template(self._config, speed, self.options.aim_speed, self.options.pour_speed)

    def _input_speed(self) -> float:
        if self.options.input_speed is not None:
            return self.options.input_speed
        return SPARSE_INPUT_SPEED if (self.config.guidance, self.config.reward) == ("sct", "sparse") else 1.0

    def workcell(self) -> PouringConfig:
        """The vessels, and where they stand."""
        return self._config

    def signals(self, builder: DiagramBuilder, station: Station) -> Mapping[str, OutputPort]:
        """Where the mug is believed to be, from where it is, if that is to be seen."""
        if not self.options.aim:
            return {}
        self.drawn["mug_error"] = EpisodeConstant(builder, "mug_error", 2)
        return {"mug_error": self.drawn["mug_error"].port}

    def template(self) -> PlacedTemplate:
        """Of figure 2.2 and table 3.3, or the one that can be aimed."""
        active = self.config.options["active_constraints"]
        return PlacedTemplate(
            self._template,
            frames_of(self._template, RigidTransform()),
            active_constraints=active,
            max_tracking_error=LEASH,
        )

    def observation_terms(self) -> Sequence[ObservationTerm]:
        """The tip's pose in the frame of the mug's tip, position in units of 0.2 m and a rotation vector; where Pour
        can be aimed, the error of the template's belief and its state, from -1 to 1, too."""
        tip = ObservationTerm("tip_in_mug", 0.0, [1.0 / POSITION_SCALE] * 3 + [1.0] * 3)
        return (
            (tip, ObservationTerm("mug_error", 0.0, MAX_MUG_ERROR), ObservationTerm("state", 1.0))
            if self.options.aim
            else (tip,)
        )

    def reward_terms(self, num_actions: int) -> list[RewardTerm]:
        """Equations 3.5 to 3.10, and aiming."""
        return reward_terms(self.config.reward, num_actions, self.config.action_repeat, self.options.aim)

    def termination_terms(self) -> list[TerminationTerm]:
        """Poured, spilled, or touched."""
        return conditions(self._config, self.options.needed)

    def reset(
        self, station: Station, guidance: Diagram, context: Context, rng: np.random.Generator, options: Any
    ) -> dict[str, Any]:
        """Places the mug, the upright thermos and the balls; everything is drawn, even what an option replaces.

        What was drawn where the arm can't reach is drawn again.
        """
        assert isinstance(station, PouringStation)
        episode = episode_stream(rng, options.held_out)
        for _ in range(DRAWS):
            azimuth = np.deg2rad(episode.uniform(*START_AZIMUTH_DEG))
            radius, height = episode.uniform(*START_RADIUS), episode.uniform(*START_HEIGHT)
            p_MP = np.array([radius * np.cos(azimuth), radius * np.sin(azimuth), height])
            p_TMug = self.options.mug_offset * episode.uniform(-1.0, 1.0, 2)
            p_MP = p_MP if options.start is None else np.array(options.start)
            p_TMug = p_TMug if options.mug_position is None else np.array(options.mug_position)
            if np.abs(p_TMug).max() > MAX_MUG_OFFSET:
                raise InputError(f"the mug can be moved by {MAX_MUG_OFFSET} m along x and y: not more")
            error = draw_error(episode, self.options, options)
            # Where it is believed to be stays where the arm reaches; it is the mug that stands elsewhere.
            believed, p_TMug = RigidTransform([*p_TMug, 0.0]), p_TMug - error
            frames = frames_of(self._template, believed)
            # Turned as the template wants it, whether or not that guides: all kinds of guidance start alike.
            X_TP = self._template.project(self._template.initial_state, RigidTransform(believed @ p_MP), frames)
            try:
                station.set_pose(context, transform_to_pose(X_TP))
                break
            except InputError as error_of_reach:
                unreachable = error_of_reach
        else:
            raise unreachable
        station.set_mug(context, RigidTransform([*p_TMug, 0.0]))
        if isinstance(guidance, Guidance):
            guidance.set_frames(context, frames)
        if self.options.aim:
            self.drawn["mug_error"].set(context, error)
        return {"start": p_MP, "mug_position": p_TMug} | ({"mug_error": error} if error.any() else {})

    @classmethod
    def scripted_policies(cls, difficulty: str = STANDARD) -> Mapping[str, ScriptedPolicy]:
        """Return the scripted policies by name; the first one is the default for `difficulty`."""
        policies = (scripted_pour, scripted_pour_aimed, scripted_pour_blind)
        default = scripted_pour_aimed if difficulty == "hard" else scripted_pour
        ordered = sorted(policies, key=lambda policy: policy is not default)
        return {policy.__name__: policy for policy in ordered}

    def camera(self) -> Camera:
        """From before the mug and a little above it."""
        forward = np.array([-0.55, 0.75, -0.35]) / np.linalg.norm([-0.55, 0.75, -0.35])
        target = self._config.X_WT.translation() + [0.0, -0.05, 0.08]
        return Camera((480, 360), np.deg2rad(40), look_at(target - forward, target))

    def scene(self) -> Scene:
        """The paths of the thermos's tip."""
        centre = self._config.X_WT.translation()
        to_world = in_frame(self._config.X_WT)
        return Scene(to_world, viewpoint=viewpoint(centre + [0.25, -0.5, 0.25], centre), line_radius=0.001)
