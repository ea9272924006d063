"""`NutAssemblySquare` of robosuite with a Panda: a nut that lies in any orientation is put over a peg.

The outputs are the position and the yaw of the gripper, which points downwards. The yaw is 0 if the grasped handle
points along x.
"""

import itertools
import logging
from typing import Any

import gymnasium
import mujoco
import numpy as np
import robosuite
from scipy.spatial.transform import Rotation

from guiderail import find_events
from research.outside_envs.task import REWARD_SCALE, SUCCESS_REWARD, OutsideTask, Part, Recording, num_steps

logging.getLogger("robosuite_logs").setLevel(logging.ERROR)
PERIOD = 0.05  # duration of a step [s]
STEP, TURN = 0.05, 0.5  # displacement and rotation of an action of 1 [m, rad]
# Smallest and largest distance of the assumed peg from the true peg in y, on either side [m]; 0 as in robosuite's task.
OFFSETS = (0.0, 0.0)
HANDLE = 0.054  # distance of the handle from the nut's center [m]
MAX_YAW = np.radians(110.0)  # largest yaw of the gripper [rad], because of the range of the last joint
MAX_LAG = 0.03  # height of the gripper above its command that ends the first attempt: the nut lies on the peg [m]
LONGEST = 170  # steps of a recording
OPEN, CLOSED = -1.0, 1.0


def close_at_end(phase: float, is_held: bool) -> float:
    """Return the gripper's command in a segment that closes the gripper while the last point is held."""
    return CLOSED if is_held else OPEN


def is_blocked(env: Any, observation: Any) -> bool:
    """Return True if the gripper stays above its command."""
    return bool(env.position[2] - env.commanded[2] > MAX_LAG)


PARTS = {
    "reach": Part(20, "object_start", OPEN, dwell=8),  # without a pause the fingers hit the handle from the side
    "grasp": Part(14, "object_start", close_at_end, dwell=14),  # the gripper takes ten steps to close
    "lift": Part(14, "object_start", CLOSED),
    "carry": Part(26, "assumed_goal", CLOSED),
    "insert": Part(16, "assumed_goal", CLOSED, dwell=4, until=is_blocked),
    # Second attempt: retract along the insertion and insert again, with the demonstrations of the first insertion.
    "retract": Part(14, "assumed_goal", CLOSED, source="insert", is_reversed=True),
    "insert again": Part(16, "assumed_goal", CLOSED, dwell=14, source="insert"),
}
LENGTH = num_steps(PARTS)


class HiddenPeg(gymnasium.Env):
    """robosuite's environment as a Gymnasium environment whose observation has the assumed position of the peg.

    The reward is robosuite's shaped, privileged reward, scaled to be negative before success. The criterion of success
    is robosuite's.

    Args:
        seed: Seed of the scene and of the offset.
        length: Steps after which an episode is truncated.

    Attributes:
        true_goal: Position of the handle at the peg, with height 0, and yaw (4,) [m, rad].
        assumed_goal: Position of the handle at the assumed peg, with height 0, and yaw (4,) [m, rad].
        object_start: Position of the handle at reset, with height 0, and yaw (4,) [m, rad].
        commanded: Last commanded position and yaw (4,) [m, rad].
        last_blocked: y of the gripper in the frame of the assumed peg when the nut last lay on the peg [1/50 m], and 1,
            (2,); zeros if it did not lie there yet.
        side: Side of the assumed peg, −1 or 1.
        steps: Steps since the reset.
        length: Steps after which an episode is truncated.
    """

    action_space = gymnasium.spaces.Box(-1.0, 1.0, (7,), np.float32)

    def __init__(self, seed: int = 0, length: int = LENGTH):
        self._sim_env = robosuite.make(
            "NutAssemblySquare", robots="Panda", has_renderer=False, has_offscreen_renderer=False, use_camera_obs=False,
            reward_shaping=True, control_freq=round(1 / PERIOD), horizon=10**6, hard_reset=False, seed=seed,
        )  # fmt: skip
        self.length, self._rng = length, np.random.default_rng([seed, 1])
        model = self._sim_env.sim.model._model
        self._peg = {g for g in range(model.ngeom) if model.body(model.geom_bodyid[g]).name == "peg1"}
        observation, _ = self.reset(seed=seed)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, observation.shape, np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Reset the environment; the option `side` (−1 or 1) chooses the side of the offset."""
        env = self._sim_env
        if seed is not None:
            self._rng = np.random.default_rng([seed, 1])
            self._reseed(seed)
        env.reset()
        self.side = float((options or {}).get("side", self._rng.choice([-1.0, 1.0])))
        offset = self.side * self._rng.uniform(*OFFSETS)
        yaw, goal_yaw, direction = self._grasp()
        peg = env.sim.data.body_xpos[env.peg1_body_id]
        handle = self._handle()
        self.object_start = np.array([handle[0], handle[1], 0.0, yaw])
        goal = peg[:2] + HANDLE * np.array([np.cos(direction), np.sin(direction)]) + [0.0, offset]
        self.true_goal = np.array([goal[0], goal[1] - offset, 0.0, goal_yaw])
        self.assumed_goal = np.array([*goal, 0.0, goal_yaw])
        self.steps, self._peak_force, self.is_success = 0, 0.0, False
        self.commanded, self.last_blocked = self.measured(), np.zeros(2)
        return self.observe(), {}

    @property
    def hidden(self) -> np.ndarray:
        """Offset of the true peg from the assumed peg in y (1,) [1/50 m], for a privileged critic only."""
        return 50.0 * (self.true_goal - self.assumed_goal)[1:2]

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Step the environment and measure success and force."""
        action = np.clip(action, -1.0, 1.0)
        self.commanded = self.measured() + np.append(STEP * action[:3], TURN * action[5])
        _, package_reward, _, _ = self._sim_env.step(action)
        self.steps += 1
        if is_blocked(self, None):
            self.last_blocked = np.array([50.0 * (self.position - self.assumed_goal[:3])[1], 1.0])
        self.is_success = success = bool(self._sim_env._check_success())
        self._peak_force = max(self._peak_force, self._force())
        reward = SUCCESS_REWARD if success else REWARD_SCALE * (min(float(package_reward), 1.0) - 1.0)
        info = {"is_success": success, "peak_force": self._peak_force, "side": self.side}
        return self.observe(), reward, success, self.steps >= self.length and not success, info

    @property
    def position(self) -> np.ndarray:
        """Position of the gripper (3,) [m]."""
        return self._sim_env.sim.data.site_xpos[self._site].copy()

    @property
    def rotation(self) -> np.ndarray:
        """Rotation matrix of the gripper (3, 3)."""
        return self._sim_env.sim.data.site_xmat[self._site].reshape(3, 3).copy()

    def measured(self) -> np.ndarray:
        """Return the position and the yaw of the gripper (4,) [m, rad]."""
        R = self.rotation
        return np.append(self.position, np.arctan2(R[1, 1], R[0, 1]))

    def observe(self) -> np.ndarray:
        """Return the observation (19,)."""
        here = self.measured()
        nut = self._nut()
        return np.concatenate([
            10 * (here - self.assumed_goal)[:3], [here[3] - self.assumed_goal[3]], 20 * (self._handle() - here[:3]),
            10 * (nut - self.assumed_goal[:3]), 20 * (self.commanded - here), 5 * (here - self.object_start)[:3],
            self.last_blocked,
        ]).astype(np.float32)  # fmt: skip

    @property
    def _site(self) -> int:
        return int(self._sim_env.robots[0].eef_site_id["right"])

    def _reseed(self, seed: int) -> None:
        """Set one generator with this seed for the environment, its placement samplers and its robots."""
        env = self._sim_env
        env.rng = np.random.default_rng(seed)
        env.placement_initializer.rng = env.rng
        for sampler in env.placement_initializer.samplers.values():
            sampler.rng = env.rng
        for robot in env.robots:
            robot.rng = env.rng

    def _nut(self) -> np.ndarray:
        return self._sim_env.sim.data.body_xpos[self._sim_env.obj_body_id["SquareNut"]].copy()

    def _handle(self) -> np.ndarray:
        data = self._sim_env.sim.data
        return data.site_xpos[self._sim_env.sim.model.site_name2id("SquareNut_handle_site")].copy()

    def _grasp(self) -> tuple[float, float, float]:
        """Return the yaw of the grasp, the yaw at the peg, and the direction of the handle there [rad].

        The nut fits in four orientations. Orientations in which the handle points towards the robot or sideways are
        preferred, because the robot's reach ends behind the peg.
        """
        offset = (self._handle() - self._nut())[:2]
        direction = float(np.arctan2(offset[1], offset[0]))
        choices = []
        for flip, quarter in itertools.product((-np.pi, 0.0, np.pi), range(-4, 5)):
            final = quarter * np.pi / 2
            yaw, goal_yaw = direction + flip, final + flip
            if max(abs(yaw), abs(goal_yaw)) <= MAX_YAW:
                cost = abs(final - direction) + 0.5 * abs(yaw) + (np.pi if np.cos(final) > 0.5 else 0.0)
                choices.append((cost, yaw, goal_yaw, final))
        _, yaw, goal_yaw, final = min(choices)
        return yaw, goal_yaw, final

    def _force(self) -> float:
        """Return the largest contact force between the peg and other bodies [N]."""
        model, data = self._sim_env.sim.model._model, self._sim_env.sim.data._data
        wrench, largest = np.zeros(6), 0.0
        for i, (first, second) in enumerate(data.contact.geom.tolist() if data.ncon else []):
            if (first in self._peg) != (second in self._peg):
                mujoco.mj_contactForce(model, data, i, wrench)
                largest = max(largest, abs(wrench[0]))
        return largest


def pose(env: Any, observation: Any) -> np.ndarray:
    """Return the commanded position and yaw (4,) [m, rad]."""
    return env.commanded.copy()


def to_action(env: Any, observation: Any, command: np.ndarray, grip: float) -> np.ndarray:
    """Return robosuite's action: a displacement, a rotation vector and the gripper's command."""
    c, s = np.cos(command[3]), np.sin(command[3])
    goal = np.array([[-s, c, 0.0], [c, s, 0.0], [0.0, 0.0, -1.0]])
    turn = Rotation.from_matrix(goal @ env.rotation.T).as_rotvec()
    return np.concatenate([np.clip((command[:3] - env.position) / STEP, -1, 1), np.clip(turn / TURN, -1, 1), [grip]])


class Script:
    """Scripted policy, which observes the true peg and moves through waypoints."""

    # Frame, height [m], gripper command, and number of steps at each waypoint.
    WAYPOINTS = (
        ("object_start", 0.95, OPEN, 2),
        ("object_start", 0.833, OPEN, 2),
        ("object_start", 0.833, CLOSED, 8),
        ("object_start", 1.02, CLOSED, 0),
        ("true_goal", 1.02, CLOSED, 4),
        ("true_goal", 0.85, CLOSED, 8),
    )
    SPEED, TURN_RATE = 0.018, 0.12  # speed of the command between waypoints [m/step, rad/step]
    TOLERANCE, ANGLE_TOLERANCE = 0.012, 0.05  # largest errors at which a waypoint is reached [m, rad]

    def __init__(self) -> None:
        self.index = 0

    def command(self, env: HiddenPeg) -> tuple[np.ndarray, float]:
        """Return the command (4,) and the gripper's command."""
        if env.steps == 0:
            self.index, self._waited, self._at = 0, 0, env.measured()
        frame, height, grip, wait = self.WAYPOINTS[self.index]
        target = getattr(env, frame) + [0.0, 0.0, height, 0.0]
        error = target - self._at
        turn = np.clip(error[3], -self.TURN_RATE, self.TURN_RATE)
        self._at = self._at + np.append(_limit(error[:3], self.SPEED), turn)
        is_near = np.linalg.norm(env.position - target[:3]) < self.TOLERANCE
        is_turned = abs(env.measured()[3] - target[3]) < self.ANGLE_TOLERANCE
        self._waited += bool(is_near and is_turned)
        if self._waited > wait and self.index + 1 < len(self.WAYPOINTS):
            self.index, self._waited = self.index + 1, 0
        return self._at, grip

    def __call__(self, env: HiddenPeg) -> np.ndarray:
        """Return robosuite's action."""
        return to_action(env, None, *self.command(env))


def _limit(vector: np.ndarray, length: float) -> np.ndarray:
    return vector * min(1.0, length / max(float(np.linalg.norm(vector)), 1e-9))


def record_nut(count: int, seed: int, noise: float = 0.003) -> list[Recording]:
    """Return successful recordings of the scripted policy, with noise added to its commands [m], for both sides."""
    rng, env, script = np.random.default_rng(seed), HiddenPeg(seed, LONGEST), Script()
    recordings: list[Recording] = []
    while len(recordings) < count:
        env.reset(options={"side": (-1.0) ** len(recordings)})
        samples = []
        while not env.is_success and env.steps < env.length:
            command, grip = script.command(env)
            samples.append([*env.measured(), script.index])
            env.step(to_action(env, None, command + np.append(noise * rng.standard_normal(3), 0.0), grip))
        if not env.is_success:
            continue
        signal = np.array([*samples, [*env.measured(), script.index]])
        # Grasp, lift, carry and insert begin with waypoints 1, 3, 4 and 5; 2 closes the gripper.
        (events,) = find_events([signal], [lambda s, k=k: s[4] >= k for k in (1, 3, 4, 5)])
        if min(np.diff([0, *events, len(signal) - 1])) >= 3:
            origins = {"object_start": env.object_start, "assumed_goal": env.assumed_goal}
            recordings.append(Recording(signal[:, :4], events, origins))
    return recordings


TASK = OutsideTask(
    parts=PARTS,
    outputs=("x [m]", "y [m]", "z [m]", "yaw [rad]"),
    period=PERIOD,
    make_env=HiddenPeg,
    record=record_nut,
    pose=pose,
    to_action=to_action,
    scripted=Script(),
)
