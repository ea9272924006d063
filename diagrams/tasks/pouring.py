"""Pouring: an arm with a thermos, two balls in it, and a mug to pour them into (thesis, section 3.4.1)."""

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, MatrixGain, ZeroOrderHold

from guiderail.diagrams.cameras import add_camera, add_meshcat
from guiderail.diagrams.env import GuidedEnv
from guiderail.diagrams.guidance import check_guidance
from guiderail.diagrams.guidance.sct import WRENCH_SIZE, SctGuidance
from guiderail.diagrams.ledger import add_ledger
from guiderail.diagrams.stations.pouring import PouringConfig, PouringStation, vessel_or_refuse
from guiderail.diagrams.task import TaskDiagram
from guiderail.diagrams.tasks.held_out import episode_stream
from guiderail.diagrams.tasks.pouring_rewards import REWARDS, reward_terms
from guiderail.models.errors import InputError
from guiderail.models.objects.vessels import MUG, Ball
from guiderail.models.pose_coordinates import transform_to_pose
from guiderail.models.skills import Skill, load_skill
from guiderail.systems.episode_monitor import Condition, EpisodeMonitor
from guiderail.systems.reward_system import RewardSystem
from guiderail.systems.safety_ledger import SafetyLedger

GUIDANCE = ("sct", "none")
OPTIONS = ("start", "mug_position", "held_out")
NUM_STEPS = 1500
"""After so many control steps an episode is over: 150 decisions at 10 Hz, about as many as in the thesis."""

LEASH = 0.05
"""m: farther from its command than this the arm is waited for."""

POSITION_SCALE = 5.0
"""1/m: makes positions near the mug as large as angles in the observation."""

# Where the thermos starts, in the frame of the mug's tip: inside the template's own workspace.
START_AZIMUTH_DEG = (-120.0, -75.0)
START_RADIUS = (0.24, 0.30)  # [m]
START_HEIGHT = (0.08, 0.19)  # [m]
MAX_MUG_OFFSET = 0.04  # [m] along x and y: as far as the arm reaches around the mug


FULL_SPEED = 0.15  # [m/s] of a full input, along one axis
FULL_TILT = 0.8  # [rad/s]
SPARSE_INPUT_SPEED = 1.7


def make_skill(config: PouringConfig, input_speed: float = 1.0) -> Skill:
    """The pouring template for this scene's vessels; `input_speed` times as fast as it is meant."""
    return load_skill(
        "pouring",
        full_speed_m_per_s=input_speed * FULL_SPEED,
        full_tilt_rad_per_s=input_speed * FULL_TILT,
        mug_radius_m=config.mug.outer_radius,
        thermos_radius_m=config.thermos.outer_radius,
    )


def make_guidance(
    kind: str, config: PouringConfig, active_constraints: bool | None = None, input_speed: float = 1.0
) -> SctGuidance:
    """The guidance of a kind: `sct`, three inputs through the template, or `none`, six as a velocity.

    Its `action` port is a policy's or a person's device's, which is all that the two differ in.
    """
    check_guidance(kind, GUIDANCE, "Pouring")
    constrained = kind == "sct" if active_constraints is None else active_constraints
    return SctGuidance(
        make_skill(config, input_speed),
        {"mug_tip": RigidTransform()},
        config.control_period,
        input_mapping=None if kind == "sct" else load_skill("end_effector_velocity"),
        active_constraints=constrained,
        leash=LEASH if constrained else np.inf,
    )


def make_env(
    guidance: str = "sct",
    reward: str = "shaped",
    observation: str = "state",
    render_mode: str | None = None,
    hold: int = 10,
    active_constraints: bool | None = None,
    input_speed: float | None = None,
    mug_inner_diameter: float = MUG.inner_diameter,
    mug_depth: float = MUG.depth,
    mug_offset: float = 0.0,
) -> GuidedEnv:
    """`gymnasium.make("guiderail/Pouring-v0", ...)`.

    Args:
        guidance: "sct" (three inputs through the template) or "none" (a 6D end-effector velocity).
        reward: "sparse" (3.5-3.6), "shaped" (3.7, from the template's transition distances) or "hand_shaped"
            (3.8-3.10).
        observation: "state": the tip's pose in the frame of the mug's tip, position in units of 0.2 m and a rotation
            vector.
        render_mode: None, "human" (a browser view) or "rgb_array".
        hold: control steps per decision.
        active_constraints: the template's; by default with "sct" only. With "none" they are a safety filter.
        input_speed: how much faster than meant the template's inputs are, 0.2 to 2. Unless given it is 1, and 1.7 for a
            sparse reward through the template: what is rewarded only once it is done is found only if random inputs
            sometimes do it. Then also let an action last longer, such as hold=40.
        mug_inner_diameter: m, of the mug that stands there.
        mug_depth: m.
        mug_offset: m, up to which the mug is moved along x and y, drawn at every reset.

    A reset takes the options `start`, (x, y, z) of the upright thermos's tip in the mug's frame, and `mug_position`,
    (x, y) of the mug from where it nominally stands, in metres; they are drawn where they aren't given, and with
    `held_out` from a stream that training never draws from.
    """
    check_guidance(guidance, GUIDANCE, "Pouring")
    if reward not in REWARDS:
        raise InputError(f"there is no reward '{reward}': use {', '.join(REWARDS)}")
    if observation != "state":
        raise InputError(f"there is no observation '{observation}' of Pouring: use 'state'")
    if not 0.0 <= mug_offset <= MAX_MUG_OFFSET:
        raise InputError(f"mug_offset is between 0 and {MAX_MUG_OFFSET} m, where the arm reaches, not {mug_offset}")
    if input_speed is None:
        input_speed = SPARSE_INPUT_SPEED if (guidance, reward) == ("sct", "sparse") else 1.0
    if not 0.2 <= input_speed <= 2.0:
        raise InputError(f"input_speed is between 0.2 and 2, where the arm still follows, not {input_speed}")
    config = PouringConfig(mug=vessel_or_refuse(mug_inner_diameter, mug_depth, Ball()))
    task = build_task(
        config,
        make_guidance(guidance, config, active_constraints, input_speed),
        reward=reward,
        hold=hold,
        mug_offset=mug_offset,
        render_mode=render_mode,
    )
    return GuidedEnv(task, hold=hold, render_mode=render_mode)


def build_task(
    config: PouringConfig,
    guidance: SctGuidance,
    *,
    reward: str = "shaped",
    hold: int = 10,
    mug_offset: float = 0.0,
    render_mode: str | None = None,
) -> TaskDiagram:
    """Wires the station, the guidance, reward, monitor and ledger."""
    builder = DiagramBuilder()
    station = PouringStation(config)
    builder.AddNamedSystem("station", station)
    builder.AddNamedSystem("guidance", guidance)
    pose, desired_pose = station.GetOutputPort("pose"), guidance.GetOutputPort("desired_pose")
    no_wrench = builder.AddNamedSystem("no_wrench", ConstantVectorSource(np.zeros(WRENCH_SIZE)))
    builder.Connect(pose, guidance.GetInputPort("pose"))
    builder.Connect(no_wrench.get_output_port(), guidance.GetInputPort("wrench"))
    builder.Connect(desired_pose, station.GetInputPort("desired_pose"))

    monitor = EpisodeMonitor(_conditions(config), config.control_period)
    builder.AddNamedSystem("monitor", monitor)
    for name in ("balls_in_mug", "balls_in_thermos", "touched"):
        builder.Connect(station.GetOutputPort(name), monitor.get_signal_input_port(name))
    termination = monitor.get_termination_output_port()

    terms = reward_terms(reward, guidance.GetInputPort("action").size(), hold)
    rewards = RewardSystem(terms)
    builder.AddNamedSystem("reward", rewards)
    signals = {
        "termination": termination,
        "action": guidance.GetOutputPort("held_action"),
        "progress": guidance.GetOutputPort("progress"),
        "tip_in_mug": station.GetOutputPort("tip_in_mug"),
    }
    for name in dict.fromkeys(name for term in terms for name in term.inputs):
        if name.startswith("last_"):
            # Held from the last control step: a change is the difference.
            port = signals[name.removeprefix("last_")]
            held = ZeroOrderHold(config.control_period, port.size())
            builder.AddNamedSystem(name, held)
            builder.Connect(port, held.get_input_port())
            signals[name] = held.get_output_port()
        builder.Connect(signals[name], rewards.get_signal_input_port(name))

    violations = {name: guidance.GetOutputPort(name) for name in ("commanded_violation", "measured_violation")}
    ledger = add_ledger(
        builder,
        config.control_period,
        **violations,
        contact_force=station.GetOutputPort("contact_force"),
        collision=station.GetOutputPort("touched"),
        saturation=station.GetOutputPort("saturation"),
        fallback=guidance.GetOutputPort("fallback"),
    )

    scale = np.diag([POSITION_SCALE] * 3 + [1.0] * 3)
    observation = builder.AddNamedSystem("observation", MatrixGain(scale))
    builder.Connect(station.GetOutputPort("tip_in_mug"), observation.get_input_port())
    builder.ExportInput(guidance.GetInputPort("action"), "action")
    exported = {
        **violations,
        "observation": observation.get_output_port(),
        "reward": rewards.get_reward_output_port(),
        **{name: rewards.get_term_output_port(name) for name in rewards.term_names},
        "termination": termination,
        "contact_force": station.GetOutputPort("contact_force"),
        "ledger": ledger,
        "desired_pose": desired_pose,
        "pose": pose,
        "state": guidance.GetOutputPort("state"),
        "transition_distance": guidance.GetOutputPort("transition_distance"),
    }
    for name, port in exported.items():
        builder.ExportOutput(port, name)
    meshcat = _add_view(builder, station, render_mode)

    skill = make_skill(config)

    def randomize(context: Context, rng: np.random.Generator, options: Mapping[str, Any]) -> dict[str, Any]:
        return _start_episode(context, rng, options, station, guidance, skill, mug_offset)

    diagram = builder.Build()
    diagram.set_name("Pouring")
    return TaskDiagram(
        diagram=diagram,
        control_period=config.control_period,
        num_steps=NUM_STEPS,
        observation_space=gymnasium.spaces.Box(-10.0, 10.0, (6,), np.float32),
        reward_terms=rewards.term_names,
        ledger_fields=SafetyLedger.FIELDS,
        randomize=randomize,
        meshcat=meshcat,
    )


def _conditions(config: PouringConfig) -> list[Condition]:
    """How an episode ends. A collision comes first: nothing that touched the mug on its way is a success."""
    mug, thermos, radius = config.mug, config.thermos, config.ball.diameter / 2
    fall = config.mug.height + config.stand_height

    def positions(balls: np.ndarray) -> np.ndarray:
        return balls.reshape(-1, 6)[:, :3]

    def poured(balls_in_mug: np.ndarray) -> bool:
        return all(mug.contains(p_MB) for p_MB in positions(balls_in_mug))

    def spilled(balls_in_mug: np.ndarray, balls_in_thermos: np.ndarray) -> bool:
        # A ball that is in neither of them and has fallen to the table, or past it.
        return any(
            p_MB[2] < radius - fall + 0.01 and not mug.contains(p_MB) and not thermos.contains(p_PB, 0.01)
            for p_MB, p_PB in zip(positions(balls_in_mug), positions(balls_in_thermos), strict=True)
        )

    balls = {"balls_in_mug": 12, "balls_in_thermos": 12}
    return [
        Condition("collision", {"touched": 1}, lambda touched: touched[0] > 0),
        # For a tenth of a second: a ball can bounce out again.
        Condition("success", {"balls_in_mug": 12}, poured, steps=10),
        Condition("spill", balls, spilled),
    ]


def _start_episode(
    context: Context,
    rng: np.random.Generator,
    options: Mapping[str, Any],
    station: PouringStation,
    guidance: SctGuidance,
    skill: Skill,
    mug_offset: float,
) -> dict[str, Any]:
    """Places the mug, the upright thermos and the balls; everything is drawn, whether or not an option replaces it."""
    unknown = set(options) - set(OPTIONS)
    if unknown:
        raise InputError(f"Pouring knows no reset option {sorted(unknown)}: it knows {', '.join(OPTIONS)}")
    episode = episode_stream(rng, bool(options.get("held_out")))
    azimuth = np.deg2rad(episode.uniform(*START_AZIMUTH_DEG))
    radius, height = episode.uniform(*START_RADIUS), episode.uniform(*START_HEIGHT)
    drawn = np.array([radius * np.cos(azimuth), radius * np.sin(azimuth), height])
    offset = mug_offset * episode.uniform(-1.0, 1.0, 2)
    p_MP = _numbers(options.get("start", drawn), 3, "start")
    p_TMug = _numbers(options.get("mug_position", offset), 2, "mug_position")
    if np.abs(p_TMug).max() > MAX_MUG_OFFSET:
        raise InputError(f"the mug can be moved by {MAX_MUG_OFFSET} m along x and y, where the arm reaches: not more")

    X_TMug = RigidTransform([*p_TMug, 0.0])
    station.set_mug(context, X_TMug)
    guidance.set_frames(context, {"mug_tip": X_TMug})
    # Turned as the template wants it, whether or not that guides: all kinds of guidance start alike.
    X_TP = skill.project(skill.initial_state, RigidTransform(X_TMug @ p_MP), {"mug_tip": X_TMug})
    station.set_pose(context, transform_to_pose(X_TP))
    return {"start": p_MP, "mug_position": p_TMug}


def _numbers(value: Any, size: int, name: str) -> np.ndarray:
    try:
        numbers = np.array(value, dtype=float)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.shape != (size,) or not np.isfinite(numbers).all():
        raise InputError(f"the reset option '{name}' is {size} finite numbers in metres, not {value}")
    return numbers


def _add_view(builder: DiagramBuilder, station: PouringStation, render_mode: str | None) -> Meshcat | None:
    query = station.GetOutputPort("query")
    if render_mode == "human":
        meshcat, _ = add_meshcat(builder, query)
        return meshcat
    if render_mode == "rgb_array":
        x, y, z = station.config.X_WT.translation()
        forward = np.array([-0.55, 0.75, -0.35]) / np.linalg.norm([-0.55, 0.75, -0.35])
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        R_WC = RotationMatrix(np.column_stack([right, np.cross(forward, right), forward]))
        picture = add_camera(
            builder,
            station.scene_graph,
            query,
            "picture",
            size=(480, 360),
            vertical_fov=np.deg2rad(40),
            X_WC=RigidTransform(R_WC, np.array([x, y - 0.05, z + 0.08]) - 1.0 * forward),
        )
        builder.ExportOutput(picture, "rgb_image")
    return None
