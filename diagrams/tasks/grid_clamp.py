"""GridClamp: push five pegs into five holes at once until they snap, with forces as small as they can be (3.4.2)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

from guiderail.diagrams.cameras import Camera, look_from_front
from guiderail.diagrams.guidance.known import Approach, Template
from guiderail.diagrams.observation import Observed
from guiderail.diagrams.options import STANDARD
from guiderail.diagrams.scene import ARM_VIEW, Scene, box_edges, in_frame, viewpoint
from guiderail.diagrams.stations.grid_clamp_workcell import GridClampWorkcell
from guiderail.diagrams.stations.station import CONTROL_PERIOD, Station
from guiderail.diagrams.tasks.grid_clamp_options import HARD, GridClampOptions
from guiderail.diagrams.tasks.grid_clamp_rewards import REWARDS, reward_terms
from guiderail.diagrams.tasks.grid_clamp_uncertainty import GridClampUncertainty
from guiderail.diagrams.tasks.insertion import InsertionTask
from guiderail.diagrams.tasks.registry import register_task
from guiderail.diagrams.tasks.task import Choice, Threshold
from guiderail.models.pose_coordinates import POSE_SIZE
from guiderail.models.skills import Skill, load_skill
from guiderail.models.units import MM
from guiderail.systems.episode_monitor import Condition
from guiderail.systems.reward_system import RewardTerm

SEATED_STEPS = 3  # control steps for which it must be seated before that counts

# The command waits while the clamp is farther than this from it: 12 N, twice what the snap asks for.
LEASH = 8.0 * MM

START_BESIDE = 0.2 * MM  # along x and along y, where a clamp is handed over

# What a policy sees, [position, force], is centred and scaled by these.
CENTRE = np.array([0.0, 0.0, 12.0 * MM, 0.0, 0.0, 0.0])
SCALE = np.array([2.0 * MM, 2.0 * MM, 10.0 * MM, 2.0, 2.0, 5.0])


def make_skill() -> Skill:
    """The template of section 3.4.2."""
    return load_skill("grid_clamp")


@register_task("GridClamp")
class GridClamp(InsertionTask):
    """Insert the clamp: "shaped" is the thesis's reward (3.11, 3.12), "no_force" the same without the cost of force,
    "sparse" without the distance gained, "aligned" with nearness to the holes' axis. Without `active_constraints` only
    the impedance's own limits of force hold a policy back."""

    Options = GridClampOptions
    options: GridClampOptions
    workpiece, fixture = "clamp", "table"
    rewards = REWARDS
    difficulties: ClassVar[Mapping[str, Mapping[str, Any]]] = {STANDARD: {}, "hard": HARD}
    defaults = {"guidance": "sct", "station": "rails", "hold": 5, "active_constraints": True}
    learner = {"algorithm": "sac", "preset": "clamp"}

    def __init__(self, options: GridClampOptions, choice: Choice):
        super().__init__(options, choice)
        self.offsets = GridClampUncertainty(options.uncertainty)
        self.collision = Threshold("contact_force", options.force_limit)
        # 100 decisions at 10 Hz unless given; the thesis's episodes take 140 on average.
        self.num_steps = round(options.seconds / CONTROL_PERIOD)
        self._workcell = options.workcell()

    def world(self) -> GridClampWorkcell:
        """A table with holes, a clamp in the tool."""
        return self._workcell

    def template(self) -> Template:
        """One phase: a cuboid above the hole, upright."""
        active = self.choice.values["active_constraints"]
        return Template(make_skill(), {"hole": RigidTransform()}, active_constraints=active, leash=LEASH)

    def approach(self) -> Approach:
        """Straight down into the hole."""
        parameters = make_skill().parameters
        heights = (max(self.options.start_height), -parameters["push_m"])
        return Approach(heights, speed=parameters["speed_m_per_s"], reach=parameters["width_m"] / 2)

    def observed(self) -> Sequence[Observed]:
        """Position of the clamp in the hole's frame, and force."""
        first_three = (0, 1, 2)
        return Observed("pose", CENTRE[:3], SCALE[:3], first_three), Observed("wrench", 0.0, SCALE[3:], first_three)

    def reward_terms(self, num_actions: int) -> list[RewardTerm]:
        """Equations 3.11 and 3.12."""
        return reward_terms(self.choice.reward, num_actions, self.choice.hold)

    def conditions(self) -> list[Condition]:
        """Seated for a while, or pushed too hard."""
        seated = Condition("success", {"clamp": POSE_SIZE}, self._workcell.is_seated, steps=SEATED_STEPS)
        return [seated, self.force_limit()]

    def move(self, station: Station, context: Context, fixture: np.ndarray, workpiece: np.ndarray) -> None:
        """Moves the table, and the clamp in the tool, by (x, y)."""
        plant_context = station.plant.GetMyMutableContextFromRoot(context)
        self._workcell.set_table_offset(station.plant, plant_context, RigidTransform([*fixture, 0.0]))
        self._workcell.set_grasp_offset(station.plant, plant_context, RigidTransform([*workpiece, 0.0]))

    def start(self, rng: np.random.Generator) -> np.ndarray:
        """About where the skill before hands over."""
        start, (lowest, highest) = np.zeros(POSE_SIZE), self.options.start_height
        start[:3] = *rng.uniform(-START_BESIDE, START_BESIDE, 2), rng.uniform(lowest, highest)
        return start

    def camera(self) -> Camera:
        """Looks slightly down at the holes."""
        target = np.array(self._workcell.p_WG) + [0.0, 0.0, 0.01]
        return Camera((640, 480), np.deg2rad(30.0), look_from_front(target, distance=0.17, height=0.075))

    def scene(self) -> Scene:
        """The cuboid that commands stay in, as high as the clamp begins."""
        to_world, parameters = in_frame(self._workcell.X_WT), make_skill().parameters
        half = 0.5 * parameters["width_m"]
        edges = box_edges((-half, -half, -parameters["push_m"]), (half, half, 0.025))
        near = viewpoint(*to_world(np.array([[0.045, -0.065, 0.045], [0.0, 0.0, 0.008]])))
        return Scene(
            to_world=to_world,
            constraint=tuple(to_world(edge) for edge in edges),
            viewpoint=near,
            arm_views={"the clamp": near, "the arm": ARM_VIEW},
            line_radius=0.0001,
        )
