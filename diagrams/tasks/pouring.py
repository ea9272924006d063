"""Pouring: an arm with a thermos, two balls in it, and a mug to pour them into (thesis, section 3.4.1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort

from guiderail.diagrams.cameras import Camera, look_at
from guiderail.diagrams.guidance.guidance import Guidance
from guiderail.diagrams.guidance.known import Template
from guiderail.diagrams.observation import Observed
from guiderail.diagrams.options import STANDARD
from guiderail.diagrams.scene import Scene, in_frame, viewpoint
from guiderail.diagrams.stations.pouring import PouringConfig, PouringStation, vessel_or_refuse
from guiderail.diagrams.stations.station import Station
from guiderail.diagrams.tasks.drawn import Drawn
from guiderail.diagrams.tasks.offsets import episode_stream
from guiderail.diagrams.tasks.pouring_belief import draw_error
from guiderail.diagrams.tasks.pouring_conditions import conditions
from guiderail.diagrams.tasks.pouring_options import HARD, MAX_MUG_ERROR, MAX_MUG_OFFSET, PouringOptions, PouringReset
from guiderail.diagrams.tasks.pouring_rewards import reward_terms
from guiderail.diagrams.tasks.pouring_template import SPARSE_INPUT_SPEED, frames_of, make_aimed_skill, make_skill
from guiderail.diagrams.tasks.registry import register_task
from guiderail.diagrams.tasks.task import Choice, Task, Threshold
from guiderail.models.errors import InputError
from guiderail.models.pose_coordinates import transform_to_pose
from guiderail.systems.episode_monitor import Condition
from guiderail.systems.reward_system import RewardTerm

LEASH = 0.05  # [m] farther from its command than this the arm is waited for
POSITION_SCALE = 5.0  # [1/m] makes positions near the mug as large as angles in the observation
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

    world_kind = "pouring"
    Options = PouringOptions
    Reset = PouringReset
    draws_held_out = True
    options: PouringOptions
    rewards = ("shaped", "sparse", "hand_shaped")
    defaults = {"guidance": "sct", "hold": 10}
    difficulties = {STANDARD: {}, "hard": HARD}
    learner = {"algorithm": "sac", "preset": "pouring"}
    num_steps: int  # 1500 unless said otherwise: 150 decisions at 10 Hz, about as many as in the thesis
    clip = 10.0
    collision = Threshold("touched")
    pushable = False  # what is in a thermos does not move along with an arm that is put elsewhere

    def __init__(self, options: PouringOptions, choice: Choice):
        super().__init__(options, choice)
        options.check()
        self._config = PouringConfig(
            mug=vessel_or_refuse(options.mug_inner_diameter, options.mug_depth, options.ball),
            ball=options.ball,
            num_balls=options.balls,
        )
        self.num_steps = round(options.time_limit / self._config.control_period)
        speed = self._input_speed()
        self._skill = make_skill(self._config, speed)
        if options.aim:
            self._skill = make_aimed_skill(self._config, speed, options.aim_speed, options.pour_speed)

    def _input_speed(self) -> float:
        if self.options.input_speed is not None:
            return self.options.input_speed
        return SPARSE_INPUT_SPEED if (self.choice.guidance, self.choice.reward) == ("sct", "sparse") else 1.0

    def world(self) -> PouringConfig:
        """The vessels, and where they stand."""
        return self._config

    def signals(self, builder: DiagramBuilder, station: Station) -> Mapping[str, OutputPort]:
        """Where the mug is believed to be, from where it is, if that is to be seen."""
        if not self.options.aim:
            return {}
        self.drawn["mug_error"] = Drawn(builder, "mug_error", 2)
        return {"mug_error": self.drawn["mug_error"].port}

    def template(self) -> Template:
        """Of figure 2.2 and table 3.3, or the one that can be aimed."""
        active = self.choice.values["active_constraints"]
        return Template(self._skill, frames_of(self._skill, RigidTransform()), active_constraints=active, leash=LEASH)

    def observed(self) -> Sequence[Observed]:
        """The tip's pose in the frame of the mug's tip, position in units of 0.2 m and a rotation vector; where Pour
        can be aimed, the error of the template's belief and its state, from -1 to 1, too."""
        tip = Observed("tip_in_mug", 0.0, [1.0 / POSITION_SCALE] * 3 + [1.0] * 3)
        return (tip, Observed("mug_error", 0.0, MAX_MUG_ERROR), Observed("state", 1.0)) if self.options.aim else (tip,)

    def reward_terms(self, num_actions: int) -> list[RewardTerm]:
        """Equations 3.5 to 3.10, and aiming."""
        return reward_terms(self.choice.reward, num_actions, self.choice.hold, self.options.aim)

    def conditions(self) -> list[Condition]:
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
            frames = frames_of(self._skill, believed)
            # Turned as the template wants it, whether or not that guides: all kinds of guidance start alike.
            X_TP = self._skill.project(self._skill.initial_state, RigidTransform(believed @ p_MP), frames)
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
