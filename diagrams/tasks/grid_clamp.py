"""GridClamp: push five pegs into five holes at once until they snap, with forces as small as they can be (3.4.2)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import MatrixGain, ZeroOrderHold

from guiderail.diagrams.env import GuidedEnv
from guiderail.diagrams.guidance import check_guidance
from guiderail.diagrams.guidance.residual_descent import ResidualDescent
from guiderail.diagrams.guidance.sct import SctGuidance
from guiderail.diagrams.stations.grid_clamp_workcell import GridClampWorkcell
from guiderail.diagrams.stations.station import CONTROL_PERIOD, POSE_SIZE, Station
from guiderail.diagrams.task import TaskDiagram
from guiderail.diagrams.tasks.grid_clamp_uncertainty import GridClampUncertainty
from guiderail.diagrams.tasks.insertion import (
    CLIP,
    add_force_ledger,
    add_observation,
    add_view,
    add_workpiece_pose,
    connect_guidance,
    force_limit,
    look_from_front,
    make_station,
)
from guiderail.models.errors import InputError
from guiderail.models.skills import Skill, load_skill
from guiderail.systems.episode_monitor import TERMINATIONS, Condition, EpisodeMonitor
from guiderail.systems.reward_system import RewardSystem, RewardTerm
from guiderail.systems.safety_ledger import SafetyLedger

MM = 1e-3
GUIDANCE = ("sct", "residual", "none")
REWARDS = ("shaped", "no_force", "sparse")
NUM_STEPS = 500
"""After so many control steps an episode is over: 100 decisions at 10 Hz; the thesis's take 140 on average."""

# More than the cuboid lets the impedance push with: 6 mm below the seat and 8 mm beside, at 1500 N/m.
COLLISION_FORCE = 35.0  # [N], of the impedance
SEATED = 0.5 * MM  # a clamp that is lower than this has snapped in
SEATED_BESIDE = 1.0 * MM  # a clamp that is as low beside its holes has not
SEATED_STEPS = 3  # control steps for which it must be seated before that counts

# The command waits while the clamp is farther than this from it: 12 N, twice what the snap asks for.
LEASH = 8.0 * MM

# The hand-designed skill before hands over a clamp above the hole, about here.
START_HEIGHT = (0.015, 0.018)  # [m]: the tips 3 to 6 mm above the table
START_BESIDE = 0.2 * MM  # along x and along y

# What a policy sees, [position, force], is centred and scaled by these.
CENTRE = np.array([0.0, 0.0, 12.0 * MM, 0.0, 0.0, 0.0])
SCALE = np.array([2.0 * MM, 2.0 * MM, 10.0 * MM, 2.0, 2.0, 5.0])

SUCCESS_REWARD = 50.0  # equation 3.11
SHAPING, FORCE_WEIGHT = 300.0, 1.0 / 12.0  # equation 3.12: [1/m], [1/N²]
_SUCCESS = TERMINATIONS.index("success")


def make_skill() -> Skill:
    """The template of section 3.4.2."""
    return load_skill("grid_clamp")


def make_guidance(kind: str, active_constraints: bool = True) -> Diagram:
    """The guidance of a kind, its commands inside the template's cuboid unless `active_constraints` is False."""
    check_guidance(kind, GUIDANCE, "GridClamp")
    skill = make_skill()
    constrained = skill if active_constraints else skill.without_active_constraints()
    if kind == "residual":
        heights = (max(START_HEIGHT), -skill.parameters["push_m"])
        speed, reach = skill.parameters["speed_m_per_s"], skill.parameters["width_m"] / 2
        return ResidualDescent(constrained, "hole", heights, speed, reach, CONTROL_PERIOD)
    return SctGuidance(
        skill,
        {"hole": RigidTransform()},
        CONTROL_PERIOD,
        input_mapping=None if kind == "sct" else load_skill("end_effector_velocity"),
        active_constraints=active_constraints,
        leash=LEASH if active_constraints else np.inf,
    )


def make_env(
    guidance: str = "sct",
    reward: str = "shaped",
    observation: str = "state",
    uncertainty: str = "calibration",
    station: str = "rails",
    robot: str | None = None,
    render_mode: str | None = None,
    hold: int = 5,
    active_constraints: bool = True,
) -> GuidedEnv:
    """`gymnasium.make("guiderail/GridClamp-v0", ...)`.

    Args:
        guidance: "sct" (three inputs through the template), "residual" (three numbers added to a straight descent) or
            "none" (a 6D end-effector velocity).
        reward: "shaped" is the thesis's (3.11, 3.12), "no_force" the same without the cost of force, "sparse" without
            the distance gained.
        observation: "state": position of the clamp in the hole's frame and force, scaled.
        uncertainty: "calibration", "disc" or "known": see `GridClampUncertainty`; it also has the options of a reset.
        station: "rails" or "arm".
        robot: which arm, a name of `robot_names()`; the default one unless given.
        render_mode: None, "human" (a browser view) or "rgb_array".
        hold: control steps per decision.
        active_constraints: whether commands stay inside the template's cuboid, whoever guides; without, only the
            impedance's own limits of force hold a policy back.
    """
    if reward not in REWARDS:
        raise InputError(f"there is no reward '{reward}': use {', '.join(REWARDS)}")
    if observation != "state":
        raise InputError(f"GridClamp has no observation '{observation}': use 'state', position and force")
    workcell = GridClampWorkcell()
    task = build_task(
        workcell,
        make_station(station, workcell, robot),
        make_guidance(guidance, active_constraints),
        GridClampUncertainty(uncertainty),
        reward=reward,
        hold=hold,
        render_mode=render_mode,
    )
    return GuidedEnv(task, hold=hold, render_mode=render_mode)


def build_task(
    workcell: GridClampWorkcell,
    station: Station,
    guidance: Diagram,
    uncertain: GridClampUncertainty,
    *,
    reward: str = "shaped",
    hold: int = 5,
    render_mode: str | None = None,
) -> TaskDiagram:
    """Wires a station, a guidance diagram, reward, monitor and ledger."""
    builder = DiagramBuilder()
    connect_guidance(builder, station, guidance)
    pose, contact_force = station.get_pose_output_port(), station.get_contact_force_output_port()
    first_three = np.eye(3, POSE_SIZE)
    position = builder.AddNamedSystem("position", MatrixGain(D=first_three))
    force = builder.AddNamedSystem("force", MatrixGain(D=first_three))
    # Held from the last control step: a distance that was gained is the difference.
    last_position = builder.AddNamedSystem("last_position", ZeroOrderHold(CONTROL_PERIOD, 3))
    builder.Connect(pose, position.get_input_port())
    builder.Connect(station.get_wrench_output_port(), force.get_input_port())
    builder.Connect(position.get_output_port(), last_position.get_input_port())

    monitor = builder.AddNamedSystem("monitor", EpisodeMonitor(_conditions(workcell), CONTROL_PERIOD))
    clamp = add_workpiece_pose(builder, station, "clamp", "table")
    builder.Connect(clamp, monitor.get_signal_input_port("clamp"))
    builder.Connect(contact_force, monitor.get_signal_input_port("contact_force"))
    termination = monitor.get_termination_output_port()

    terms = _reward_terms(reward, guidance.GetInputPort("action").size(), hold)
    rewards = builder.AddNamedSystem("reward", RewardSystem(terms))
    signals = {
        "termination": termination,
        "action": guidance.GetOutputPort("held_action"),
        "force": force.get_output_port(),
        "position": position.get_output_port(),
        "last_position": last_position.get_output_port(),
    }
    for name in dict.fromkeys(name for term in terms for name in term.inputs):
        builder.Connect(signals[name], rewards.get_signal_input_port(name))

    violations = {name: guidance.GetOutputPort(name) for name in ("commanded_violation", "measured_violation")}
    exported = {
        **violations,
        "observation": add_observation(builder, (signals["position"], signals["force"]), CENTRE, SCALE),
        "reward": rewards.get_reward_output_port(),
        **{name: rewards.get_term_output_port(name) for name in rewards.term_names},
        "termination": termination,
        "contact_force": contact_force,
        "ledger": add_force_ledger(builder, station, guidance, violations, COLLISION_FORCE),
        "desired_pose": guidance.GetOutputPort("desired_pose"),
        "pose": pose,
        "wrench": station.get_wrench_output_port(),
    }
    for name, port in exported.items():
        builder.ExportOutput(port, name)
    target = np.array(workcell.p_WG) + [0.0, 0.0, 0.01]
    meshcat = add_view(builder, station, render_mode, look_from_front(target, distance=0.28, height=0.10))
    diagram = builder.Build()
    diagram.set_name("GridClamp")
    plant = station.plant

    def randomize(context: Context, rng: np.random.Generator, options: Mapping[str, Any]) -> dict[str, Any]:
        table, grasp = uncertain.draw(rng, options)
        plant_context = plant.GetMyMutableContextFromRoot(context)
        workcell.set_table_offset(plant, plant_context, RigidTransform([*table, 0.0]))
        workcell.set_grasp_offset(plant, plant_context, RigidTransform([*grasp, 0.0]))
        start = np.zeros(POSE_SIZE)
        start[:3] = *rng.uniform(-START_BESIDE, START_BESIDE, 2), rng.uniform(*START_HEIGHT)
        station.set_pose(context, start)
        return {"table_offset": table.copy(), "grasp_offset": grasp.copy()}

    def push(context: Context, displacement: np.ndarray) -> None:
        station.set_pose(context, pose.Eval(station.GetMyContextFromRoot(context)) + displacement)

    return TaskDiagram(
        diagram=diagram,
        control_period=CONTROL_PERIOD,
        num_steps=NUM_STEPS,
        observation_space=gymnasium.spaces.Box(-CLIP, CLIP, (6,), np.float32),
        reward_terms=rewards.term_names,
        ledger_fields=SafetyLedger.FIELDS,
        randomize=randomize,
        push=push,
        meshcat=meshcat,
    )


def _conditions(workcell: GridClampWorkcell) -> list[Condition]:
    seat = workcell.X_GT.translation()[2]

    def is_seated(clamp: np.ndarray) -> bool:
        """`clamp` is X_GC, position and rotation vector."""
        return bool(clamp[2] - seat < SEATED and np.hypot(clamp[0], clamp[1]) < SEATED_BESIDE)

    return [
        Condition("success", {"clamp": POSE_SIZE}, is_seated, steps=SEATED_STEPS),
        force_limit(COLLISION_FORCE),
    ]


def _reward_terms(reward: str, num_actions: int, hold: int) -> list[RewardTerm]:
    """Equations 3.11 and 3.12; what they give once a decision is divided among its control steps."""
    terms = [
        RewardTerm(
            "terminal_reward",
            {"termination": 1},
            lambda termination: SUCCESS_REWARD * (termination[0] == _SUCCESS),
        ),
        RewardTerm("action_cost", {"action": num_actions}, lambda action: -float(action @ action) / hold),
    ]
    if reward != "no_force":
        terms.append(RewardTerm("force_cost", {"force": 3}, lambda force: -FORCE_WEIGHT * float(force @ force) / hold))
    if reward != "sparse":
        terms.append(
            RewardTerm(
                "shaping",
                {"position": 3, "last_position": 3},
                lambda position, last_position: SHAPING * float(last_position[2] - position[2]),
            )
        )
    return terms
