"""NarrowPassage: a planar robot that must get through a gap and around what was put in its way (4.4.1, 5.4.1)."""

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import gymnasium
import numpy as np
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import TrajectorySource, ZeroOrderHold
from pydrake.trajectories import PiecewisePolynomial

from guiderail.diagrams.cameras import add_camera, add_meshcat
from guiderail.diagrams.env import GuidedEnv
from guiderail.diagrams.guidance import PRIMITIVE_GUIDANCE, build_guidance, check_guidance
from guiderail.diagrams.guidance.primitive_skill import PrimitiveSkill
from guiderail.diagrams.ledger import add_ledger
from guiderail.diagrams.stations.plane import PlaneConfig, PlaneStation
from guiderail.diagrams.task import TaskDiagram
from guiderail.models.demonstrations import narrow_passage as demonstrations
from guiderail.models.errors import InputError
from guiderail.models.objects.narrow_passage import NarrowPassage, action_cost
from guiderail.models.primitives import ReferenceTrajectory
from guiderail.systems.constraint_violation import ConstraintViolation
from guiderail.systems.episode_monitor import SUCCESS, Condition, EpisodeMonitor
from guiderail.systems.reward_system import RewardSystem, RewardTerm
from guiderail.systems.safety_ledger import SafetyLedger

NUM_STEPS = demonstrations.NUM_STEPS
IMAGE_SIZE = (144, 110)
"""Width and height of the policy's image (4.4.1, end)."""

SUCCESS_REWARD = 200.0
COMPONENTS = 20
"""Of the mixture: with 8 to 16 of them the passage is blurred."""

FLOOR = 0.002
"""m: how well a hand repeats itself; added to the demonstrations' covariance as a standard deviation."""

BLOCKED_STEPS = 20
BLOCKED_PROGRESS = 1e-4


@lru_cache(maxsize=1)
def reference_trajectory() -> ReferenceTrajectory:
    """What the nine demonstrations have in common: Gaussian mixture and regression, fitted once a process."""
    return ReferenceTrajectory.from_demonstrations(demonstrations.load(), components=COMPONENTS, floor=FLOOR)


def make_skill(world: NarrowPassage, config: PlaneConfig, **parameters: Any) -> PrimitiveSkill:
    """The nine demonstrations with this world's constraints; `parameters` are further ones of `PrimitiveSkill`."""
    return PrimitiveSkill(
        reference=reference_trajectory(),
        constraints=world.constraints,
        control_period=config.control_period,
        keep_out=world.keep_out(),
        wrench_size=2,
        **parameters,
    )


def make_env(
    guidance: str = "skgrl",
    reward: str = "sparse",
    observation: str = "state",
    render_mode: str | None = None,
    hold: int = 5,
    kappa: float = 1.0,
    history: int = 10,
    history_variance: float = 1e-6,
    history_source: str = "commanded",
    gains: tuple[float, float] | None = None,
) -> GuidedEnv:
    """`gymnasium.make("guiderail/NarrowPassage-v0", ...)`.

    Args:
        guidance: "kmp", "residual", "safe_residual", "kgrl" or "skgrl".
        reward: "sparse" is the thesis's (4.22-4.25); "shaped" adds how much nearer the goal came, in centimetres.
        observation: "state" is the time in [-1, 1] (the thesis's policy state); "image" is 110 x 144 x 3.
        render_mode: None, "human" (a browser view) or "rgb_array".
        hold: control steps per decision.
        kappa, history, history_variance, history_source, gains: see `PrimitiveSkill`; the histories are sKGRL's.

    A reset takes the option `start`: (x, y) to start from, instead of where the demonstrations do.
    """
    check_guidance(guidance, PRIMITIVE_GUIDANCE, "NarrowPassage")
    if reward not in ("sparse", "shaped"):
        raise InputError(f"there is no reward '{reward}': use 'sparse' or 'shaped'")
    if observation not in ("state", "image"):
        raise InputError(f"there is no observation '{observation}': use 'state' or 'image'")
    world, config = NarrowPassage(), PlaneConfig()
    skill = make_skill(
        world,
        config,
        kappa=kappa,
        history=history,
        history_variance=history_variance,
        history_source=history_source,
        gains=None if gains is None else tuple(gains),
    )
    return GuidedEnv(
        build_task(
            world,
            config,
            build_guidance(guidance, skill, "NarrowPassage"),
            shaped=reward == "shaped",
            image=observation == "image",
            render_mode=render_mode,
        ),
        hold=hold,
        render_mode=render_mode,
    )


def build_task(
    world: NarrowPassage,
    config: PlaneConfig,
    guidance: Diagram,
    *,
    shaped: bool = False,
    image: bool = False,
    render_mode: str | None = None,
) -> TaskDiagram:
    """Wires the plane, a guidance diagram, reward, monitor and ledger."""
    builder = DiagramBuilder()
    station = builder.AddNamedSystem("station", PlaneStation(world, config))
    builder.AddNamedSystem("guidance", guidance)
    pose, desired_pose = station.GetOutputPort("pose"), guidance.GetOutputPort("desired_pose")
    force = station.GetOutputPort("contact_force_magnitude")
    fallback = guidance.GetOutputPort("fallback")
    builder.Connect(pose, guidance.GetInputPort("pose"))
    builder.Connect(station.GetOutputPort("contact_force"), guidance.GetInputPort("wrench"))
    builder.Connect(desired_pose, station.GetInputPort("desired_pose"))

    violations = {}
    for name, port in (("commanded_violation", desired_pose), ("measured_violation", pose)):
        violation = builder.AddNamedSystem(name, ConstraintViolation(world.constraints, config.control_period))
        builder.Connect(port, violation.get_pose_input_port())
        violations[name] = violation.get_violation_output_port()

    monitor = builder.AddNamedSystem("monitor", EpisodeMonitor(_conditions(world), config.control_period))
    for name, port in (("pose", pose), ("contact_force", force), ("fallback", fallback)):
        builder.Connect(port, monitor.get_signal_input_port(name))
    termination = monitor.get_termination_output_port()

    # Held from the last control step: a displacement is the difference.
    last_pose = builder.AddNamedSystem("last_pose", ZeroOrderHold(config.control_period, 2))
    builder.Connect(pose, last_pose.get_input_port())
    reward = builder.AddNamedSystem("reward", RewardSystem(_reward_terms(world, shaped)))
    for name, port in (("pose", pose), ("last_pose", last_pose.get_output_port()), ("termination", termination)):
        builder.Connect(port, reward.get_signal_input_port(name))

    ledger = add_ledger(
        builder,
        config.control_period,
        **violations,
        contact_force=force,
        collision=force,  # nothing in this world may be touched
        saturation=station.GetOutputPort("saturation"),
        fallback=fallback,
    )

    builder.ExportInput(guidance.GetInputPort("action"), "action")
    space, seen = _add_image(builder, station) if image else _add_phase(builder, config)
    builder.ExportOutput(seen, "observation")
    exported = {
        **violations,
        "reward": reward.get_reward_output_port(),
        **{name: reward.get_term_output_port(name) for name in reward.term_names},
        "termination": termination,
        "contact_force": force,
        "ledger": ledger,
        "desired_pose": desired_pose,
        "pose": pose,
    }
    for name, port in exported.items():
        builder.ExportOutput(port, name)
    meshcat: Meshcat | None = None
    if render_mode == "human":
        meshcat, _ = add_meshcat(builder, station.GetOutputPort("query"))
    elif render_mode == "rgb_array":
        picture = add_camera(
            builder,
            station.scene_graph,
            station.GetOutputPort("query"),
            "picture",
            size=(480, 640),
            vertical_fov=np.deg2rad(40),
            X_WC=RigidTransform(RotationMatrix(np.diag([1.0, -1.0, -1.0])), [0.4, 0.5, 1.5]),
        )
        builder.ExportOutput(picture, "rgb_image")

    start = reference_trajectory().means[0]

    def randomize(context: Context, rng: np.random.Generator, options: Mapping[str, Any]) -> dict[str, Any]:
        pose = _checked_start(options, start)
        station.set_pose(context, pose)
        return {"start": pose}

    def push(context: Context, displacement: np.ndarray) -> None:
        station.set_pose(context, station.get_pose(context) + displacement)

    diagram = builder.Build()
    diagram.set_name("NarrowPassage")
    return TaskDiagram(
        diagram=diagram,
        control_period=config.control_period,
        num_steps=NUM_STEPS,
        observation_space=space,
        reward_terms=reward.term_names,
        ledger_fields=SafetyLedger.FIELDS,
        randomize=randomize,
        push=push,
        meshcat=meshcat,
    )


def _conditions(world: NarrowPassage) -> list[Condition]:
    return [
        Condition("success", {"pose": 2}, world.at_goal),
        # Pressed against a wall, or stopped before it by a filter, and getting nowhere.
        Condition(
            "blocked",
            {"pose": 2, "contact_force": 1, "fallback": 1},
            lambda pose, contact_force, fallback: (contact_force[0] > 0 or fallback[0] > 0) and world.in_passage(pose),
            steps=BLOCKED_STEPS,
            progress=lambda pose, contact_force, fallback: pose[1],
            min_progress=BLOCKED_PROGRESS,
        ),
    ]


def _reward_terms(world: NarrowPassage, shaped: bool) -> list[RewardTerm]:
    terms = [
        RewardTerm("action_cost", {"pose": 2, "last_pose": 2}, lambda pose, last_pose: action_cost(pose - last_pose)),
        RewardTerm("obstacle_cost", {"pose": 2}, world.obstacle_cost),
        RewardTerm(
            "terminal_reward", {"termination": 1}, lambda termination: SUCCESS_REWARD * (termination[0] == SUCCESS)
        ),
    ]
    if shaped:
        terms.append(
            RewardTerm(
                "progress",
                {"pose": 2, "last_pose": 2},
                lambda pose, last_pose: 100.0 * (math.dist(last_pose, world.goal) - math.dist(pose, world.goal)),
            )
        )
    return terms


def _add_phase(builder: DiagramBuilder, config: PlaneConfig) -> tuple[gymnasium.spaces.Box, OutputPort]:
    """The time, from -1 at the start of an episode to 1 at its end."""
    end = NUM_STEPS * config.control_period
    phase = PiecewisePolynomial.FirstOrderHold([0.0, end], np.array([[-1.0, 1.0]]))
    source = builder.AddNamedSystem("phase", TrajectorySource(phase))
    return gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32), source.get_output_port()


def _add_image(builder: DiagramBuilder, station: PlaneStation) -> tuple[gymnasium.spaces.Box, OutputPort]:
    """The plane from above, lying on its side: the way up is to the right."""
    R_WC = RotationMatrix(np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]))
    image = add_camera(
        builder,
        station.scene_graph,
        station.GetOutputPort("query"),
        "observation_camera",
        size=IMAGE_SIZE,
        vertical_fov=np.deg2rad(30),
        X_WC=RigidTransform(R_WC, [0.42, 0.5, 1.5]),
    )
    width, height = IMAGE_SIZE
    return gymnasium.spaces.Box(0, 255, (height, width, 3), np.uint8), image


def _checked_start(options: Mapping[str, Any], default: np.ndarray) -> np.ndarray:
    unknown = set(options) - {"start"}
    if unknown:
        raise InputError(f"NarrowPassage knows no reset option {sorted(unknown)}: it knows 'start'")
    try:
        start = np.array(options.get("start", default), dtype=float)
    except (TypeError, ValueError):
        start = np.empty(0)
    if start.shape != (2,) or not np.isfinite(start).all():
        raise InputError(f"the reset option 'start' is (x, y) in metres, not {options['start']}")
    return start
