"""BncConnector: insert, align and lock a bayonet connector at a position that is not exactly known (4.4.2, 5.4.2)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.framework import Context, DiagramBuilder, OutputPort

from guiderail.diagrams.envs.cameras import Camera, look_from_front
from guiderail.diagrams.envs.observation import ObservationTerm
from guiderail.diagrams.envs.options import STANDARD
from guiderail.diagrams.envs.scene import ARM_VIEW, Scene, box_edges, in_frame, viewpoint
from guiderail.diagrams.envs.task_diagram import Symmetry
from guiderail.diagrams.stations.station import Station
from guiderail.diagrams.tasks.bnc_connector.options import HARD, BncOptions, BncUncertainty
from guiderail.diagrams.tasks.bnc_connector.rewards import (
    OBSERVATIONS,
    REWARDS,
    half_turn,
    observation_terms,
    reward_terms,
    sides_of_the_rim,
)
from guiderail.diagrams.tasks.bnc_connector.scripted import scripted_center_of_pressure, scripted_torque_search
from guiderail.diagrams.tasks.bnc_connector.workcell import HALF_TURN, BncWorkcell
from guiderail.diagrams.tasks.insertion import InsertionTask
from guiderail.diagrams.tasks.offsets import in_ring, reference_of_file
from guiderail.diagrams.tasks.registry import register_task
from guiderail.diagrams.tasks.task import ScriptedPolicy, Threshold
from guiderail.models.common.poses import POSE_SIZE
from guiderail.models.control.keep_out import KeepOut
from guiderail.models.objects.bnc_connector import demonstrations as inserting
from guiderail.models.objects.bnc_connector import search_demonstrations as searching
from guiderail.models.objects.insertion import HISTORY_VARIANCE, MIN_CONTACT_FORCE, REPEATABILITY_STD
from guiderail.models.primitives import Demonstrations, LinearConstraints, ReferenceTrajectory
from guiderail.systems.center_of_pressure import CenterOfPressure
from guiderail.systems.episode_monitor import TerminationTerm
from guiderail.systems.reward_system import RewardTerm

if TYPE_CHECKING:
    from guiderail.diagrams.envs.config import EnvConfig

NUM_STEPS, COMPONENTS = inserting.NUM_STEPS, 16
FLOOR = np.array(REPEATABILITY_STD)
DEMONSTRATIONS = {"insert": inserting, "search": searching}
TOOL_VIEW = ((0.62, -0.085, 0.19), (0.55, 0.0, 0.172))
LOCKED_STEPS = 3  # consecutive control steps that count as locked


@cache
def reference_trajectory(demonstrations: str) -> ReferenceTrajectory:
    """Return the Gaussian mixture regression of demonstrations, fitted once a process.

    Args:
        demonstrations: Name of shipped demonstrations, or path of a file.
    """
    if demonstrations not in DEMONSTRATIONS:
        return reference_of_file(Path(demonstrations), COMPONENTS, tuple(FLOOR.tolist()))
    loaded = DEMONSTRATIONS[demonstrations].load()
    return ReferenceTrajectory.from_demonstrations(loaded, components=COMPONENTS, floor=FLOOR)


@register_task("BncConnector")
class BncConnector(InsertionTask):
    """Insert, align and lock the connector.

    Rewards: "sparse" is the thesis's (4.27, 4.28); "shaped" and "aligned" add to it.
    """

    Options = BncOptions
    options: BncOptions
    workpiece, fixture = "plug", "jack"
    simulated_rewards = ("aligned",)
    rewards = REWARDS
    observations = OBSERVATIONS
    difficulties: ClassVar[Mapping[str, Mapping[str, Any]]] = {STANDARD: {}, "hard": HARD}
    defaults = {
        "guidance": "skgrl",
        "station": "gantry",
        "action_repeat": 10,
        "action_dims": (0, 1),
        "history_variance": HISTORY_VARIANCE,
    }
    isotropic_groups = ((0, 1, 2), (3, 4, 5))

    def __init__(self, config: EnvConfig):
        super().__init__(config)
        o = self.options
        self.offsets = BncUncertainty(
            o.fixture_offset, o.grasp_angle, offset_range=o.offset_range, jack_turn=o.jack_turn
        )
        self.collision = Threshold("contact_force", o.force_limit)
        self._workcell = o.workcell()
        self.num_steps = NUM_STEPS if o.demonstrations in DEMONSTRATIONS else self.reference().num_steps

    def workcell(self) -> BncWorkcell:
        """Return the jack in the world and the plug in the tool."""
        return self._workcell

    def reference(self) -> ReferenceTrajectory:
        """Return the reference trajectory of the chosen demonstrations."""
        return reference_trajectory(self.options.demonstrations)

    def constraints(self) -> LinearConstraints:
        """Return |x|, |y| ≤ `bound`: 2 mm in equation 4.26."""
        bound = np.array([self.options.bound, self.options.bound, np.inf, np.inf, np.inf, np.inf])
        return LinearConstraints.box(-bound, bound)

    def keep_out(self) -> KeepOut:
        """Return no walls: safe residual learning is projected to the alignment constraint alone."""
        return KeepOut(np.empty((0, POSE_SIZE)), np.empty((0, POSE_SIZE)), self.constraints(), margin=0.0)

    def signals(self, builder: DiagramBuilder, station: Station) -> Mapping[str, OutputPort]:
        """Return the plug's pose in the jack and the center of pressure."""
        lever = builder.AddNamedSystem("center_of_pressure", CenterOfPressure(MIN_CONTACT_FORCE))
        builder.Connect(station.get_wrench_output_port(), lever.get_wrench_input_port())
        return {**super().signals(builder, station), "center_of_pressure": lever.get_center_of_pressure_output_port()}

    def observable_success(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the estimate of height and turn; lateral offset cannot be measured, and is checked by pulling."""
        size = self._workcell.dimensions
        D, y0 = np.zeros((POSE_SIZE, POSE_SIZE)), np.zeros(POSE_SIZE)
        D[2, 2] = D[5, 3] = 1.0
        y0[[2, 5]] = size.locked_height, -size.detent_angle
        return D, y0

    def observation_terms(self) -> Sequence[ObservationTerm]:
        """Return time, pose and wrench, and with "center_of_pressure" that and the commanded x and y."""
        return observation_terms(self.config.observation, self.num_steps)

    def reward_terms(self, num_actions: int) -> list[RewardTerm]:
        """Return costs of actions and forces, the terminal reward, and the additions of "shaped" and "aligned"."""
        return reward_terms(self.config.reward, num_actions)

    def termination_terms(self) -> list[TerminationTerm]:
        """Return success when locked, and collision above the force limit."""
        return [TerminationTerm("success", {"plug": 6}, self._workcell.locks, steps=LOCKED_STEPS), self.force_limit()]

    def symmetry(self) -> Symmetry:
        """Return half a turn about the jack's axis."""
        action_dims = self.config.options["action_dims"]
        action = HALF_TURN if action_dims is None else HALF_TURN[list(action_dims)]
        return Symmetry.of_signs(half_turn(self.config.observation), action)

    def near_symmetry(self) -> Symmetry:
        """Return quarter turns and reflections too, which hold while the plug stands on the rim."""
        action_dims = self.config.options["action_dims"]
        sides = sides_of_the_rim(self.config.observation, range(POSE_SIZE) if action_dims is None else action_dims)
        return self.symmetry() if sides is None else Symmetry(*sides)

    def set_part_offsets(self, station: Station, context: Context, fixture: np.ndarray, workpiece: np.ndarray) -> None:
        """Move the jack by (x, y) and its turn, and the plug by (x, y) and its tilt about x and y, if they have any."""
        plant_context = station.plant.GetMyMutableContextFromRoot(context)
        tilt = RotationMatrix(RollPitchYaw(*workpiece[2:], 0.0)) if len(workpiece) > 2 else RotationMatrix()
        turn = RotationMatrix.MakeZRotation(fixture[2]) if len(fixture) > 2 else RotationMatrix()
        self._workcell.set_jack_offset(station.plant, plant_context, RigidTransform(turn, [*fixture[:2], 0.0]))
        self._workcell.set_grasp_offset(station.plant, plant_context, RigidTransform(tilt, [*workpiece[:2], 0.0]))

    def start_pose(self, rng: np.random.Generator) -> np.ndarray:
        """Return the demonstrations' start plus a sampled offset, inside the constraints."""
        start = self.reference().means[0].copy()
        if self.options.start_offset_max > 0.0:
            start[:2] += in_ring(rng, 0.0, self.options.start_offset_max)
        return self.constraints().nearest(start)

    @classmethod
    def scripted_policies(cls, difficulty: str = STANDARD) -> Mapping[str, ScriptedPolicy]:
        """Return the scripted policies by name; the first one is the default for `difficulty`."""
        policies = (scripted_torque_search, scripted_center_of_pressure)
        default = scripted_center_of_pressure if difficulty == "hard" else scripted_torque_search
        ordered = sorted(policies, key=lambda policy: policy is not default)
        return {policy.__name__: policy for policy in ordered}

    def camera(self) -> Camera:
        """Return a camera that looks slightly down at the jack."""
        X_WC = look_from_front(np.array(self._workcell.p_WJ) + [0.0, 0.0, 0.022], distance=0.085, height=0.04)
        return Camera((640, 480), np.deg2rad(30.0), X_WC)

    def scene(self) -> Scene:
        """Return the demonstrations and the box of the alignment constraint."""
        to_world = in_frame(self._workcell.X_WT)
        near = viewpoint(*to_world(np.array([[0.021, -0.029, 0.029], [0.0, 0.0, 0.017]])))
        bound = self.options.bound
        return Scene(
            to_world=to_world,
            demonstrations=tuple(_load_demonstrations(self.options.demonstrations).outputs),
            constraint=tuple(to_world(edge) for edge in box_edges((-bound, -bound, 0.0), (bound, bound, 0.015))),
            viewpoint=near,
            arm_views={"the tool": TOOL_VIEW, "the connector": near, "the arm": ARM_VIEW},
            line_radius=0.0001,
        )


def _load_demonstrations(demonstrations: str) -> Demonstrations:
    known = DEMONSTRATIONS.get(demonstrations)
    return Demonstrations.load(Path(demonstrations)) if known is None else known.load()
