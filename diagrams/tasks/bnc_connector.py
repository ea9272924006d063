"""BncConnector: insert, align and lock a bayonet connector whose place is not exactly known (4.4.2, 5.4.2)."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import gymnasium
import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import TrajectorySource, ZeroOrderHold
from pydrake.trajectories import PiecewisePolynomial

from guiderail.diagrams.env import GuidedEnv
from guiderail.diagrams.guidance import build_guidance, check_guidance
from guiderail.diagrams.guidance.primitive_skill import PrimitiveSkill
from guiderail.diagrams.stations.bnc_workcell import LOCKED_ANGLE, LOCKED_HEIGHT, BncWorkcell
from guiderail.diagrams.stations.station import CONTROL_PERIOD, POSE_SIZE, Station
from guiderail.diagrams.task import Symmetry, TaskDiagram
from guiderail.diagrams.tasks.bnc_uncertainty import BncUncertainty
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
from guiderail.models.demonstrations import bnc_connector as demonstrations
from guiderail.models.errors import InputError
from guiderail.models.keep_out import KeepOut
from guiderail.models.primitives import LinearConstraints, ReferenceTrajectory
from guiderail.systems.constraint_violation import ConstraintViolation
from guiderail.systems.episode_monitor import TERMINATIONS, Condition, EpisodeMonitor
from guiderail.systems.reward_system import RewardSystem, RewardTerm
from guiderail.systems.safety_ledger import SafetyLedger

MM, DEGREE = 1e-3, np.deg2rad(1.0)
NUM_STEPS = demonstrations.NUM_STEPS
SENSIBLE_GUIDANCE = ("kmp", "residual", "safe_residual", "kgrl", "skgrl")

COMPONENTS = 16
# How well a hand repeats itself: added to the demonstrations' covariance as a standard deviation.
FLOOR = np.array([0.05 * MM, 0.05 * MM, 0.1 * MM, 0.2 * DEGREE, 0.05 * DEGREE, 0.05 * DEGREE])

# ρ [m², rad²]. The thesis's 1e-8 is (0.1 mm)², much for demonstrations that vary by a millimetre: linear jerk at
# the same exploration RMS is then 2.6 times below KGRL's, at 1e-10 19 and at 1e-11 47 times (`guiderail study
# smoothness`, an action at every control step).
HISTORY_VARIANCE = 1e-11
ISOTROPIC_GROUPS = ((0, 1, 2), (3, 4, 5))  # outputs of one unit, which residual learning moves alike
ALIGNMENT = 2.0 * MM  # |x|, |y| of every command: equation 4.26
COLLISION_FORCE = 35.0  # [N], of the impedance
LOCKED_BESIDE = 1.0 * MM  # a plug that is as low and as turned beside the jack is not locked
LOCKED_STEPS = 3  # control steps for which the plug must be locked before that counts

# What a policy sees, [time, pose, wrench], is centred and scaled by these. The wrench's torques are small, and they
# are what tells on which side of the rim the plug sits: 0.02 Nm at 4 N.
END = NUM_STEPS * CONTROL_PERIOD
POSE_CENTRE = np.array([0.0, 0.0, 5.0 * MM, 45.0 * DEGREE, 0.0, 0.0])
POSE_SCALE = np.array([2.0 * MM, 2.0 * MM, 8.0 * MM, 45.0 * DEGREE, 1.5 * DEGREE, 1.5 * DEGREE])
WRENCH_SCALE = np.array([5.0, 5.0, 8.0, 0.02, 0.02, 0.2])

# Equations 4.27 and 4.28; the thesis gives no unit of f: here it is 10 N and 0.5 Nm.
ACTION_WEIGHT = FORCE_WEIGHT = 0.01
REWARD_WRENCH = np.array([10.0, 10.0, 10.0, 0.5, 0.5, 0.5])
SUCCESS_REWARD, COLLISION_REWARD = 60.0, -50.0
# [1/mm]. A lock comes when the demonstrations end, however soon the plug dropped: paid at the end only, a policy that
# wiggles until it drops is worth as much as one that feels where to go, and fails now and then. From the start to the
# lock it is 15.6 mm, the last 5.5 of them in the jack.
DEPTH_REWARD = 5.0

# A jack has two equal sides: half a turn about its axis changes the signs of what lies across it.
HALF_TURN = np.array([-1.0, -1.0, 1.0, 1.0, -1.0, -1.0])  # of a pose's x, y, z, Rz, Ry, Rx
HALF_TURN_OF_WRENCH = np.array([-1.0, -1.0, 1.0, -1.0, -1.0, 1.0])
_SUCCESS, _COLLISION = TERMINATIONS.index("success"), TERMINATIONS.index("collision")


@lru_cache(maxsize=1)
def reference_trajectory() -> ReferenceTrajectory:
    """What the five demonstrations have in common: Gaussian mixture and regression, fitted once a process."""
    return ReferenceTrajectory.from_demonstrations(demonstrations.load(), components=COMPONENTS, floor=FLOOR)


def alignment_constraints() -> LinearConstraints:
    """|x|, |y| ≤ 2 mm, equation 4.26."""
    bound = np.array([ALIGNMENT, ALIGNMENT, np.inf, np.inf, np.inf, np.inf])
    return LinearConstraints.box(-bound, bound)


def make_env(
    guidance: str = "skgrl",
    reward: str = "sparse",
    observation: str = "state",
    uncertainty: str = "calibration",
    grasp_angle: float = 0.0,
    station: str = "rails",
    robot: str | None = None,
    render_mode: str | None = None,
    hold: int = 10,
    kappa: float = 1.0,
    explored: tuple[int, ...] = (0, 1),
    history: int = 10,
    history_variance: float = HISTORY_VARIANCE,
    history_source: str = "commanded",
    adaptive_history: bool = False,
    gains: tuple[float, ...] | None = None,
) -> GuidedEnv:
    """`gymnasium.make("guiderail/BncConnector-v0", ...)`.

    Args:
        guidance: "kmp", "residual", "safe_residual", "kgrl" or "skgrl".
        reward: "sparse" is the thesis's (4.27, 4.28); "shaped" adds `DEPTH_REWARD` for the depth gained.
        observation: "state": time, pose and wrench, scaled.
        uncertainty: "calibration", "disc" or "known": see `BncUncertainty`, which also has the options of a reset.
        grasp_angle: how far the plug tilts in the tool at most, degrees, anew every episode.
        station: "rails" or "arm".
        robot: which arm, a name of `robot_names()`; the default one unless given.
        render_mode: None, "human" (a browser view) or "rgb_array".
        hold: control steps per decision.
        explored: which of x, y, z, Rz, Ry, Rx an action moves, by number.
        kappa, history, history_variance, history_source, adaptive_history, gains: see `PrimitiveSkill`; the histories
            are sKGRL's.
    """
    check_guidance(guidance, SENSIBLE_GUIDANCE, "BncConnector")
    if reward not in ("sparse", "shaped"):
        raise InputError(f"there is no reward '{reward}': use 'sparse' or 'shaped'")
    if observation != "state":
        raise InputError(f"BncConnector has no observation '{observation}': use 'state', time, pose and wrench")
    uncertain = BncUncertainty(uncertainty, grasp_angle)
    skill = PrimitiveSkill(
        reference=reference_trajectory(),
        constraints=alignment_constraints(),
        control_period=CONTROL_PERIOD,
        kappa=kappa,
        explored=tuple(explored),
        history=history,
        history_variance=history_variance,
        history_source=history_source,
        adaptive_history=adaptive_history,
        gains=None if gains is None else tuple(gains),
        isotropic_groups=ISOTROPIC_GROUPS,
        # No walls are known here: what safe residual learning is projected to is the alignment alone.
        keep_out=KeepOut(np.empty((0, POSE_SIZE)), np.empty((0, POSE_SIZE)), alignment_constraints(), margin=0.0),
    )
    workcell = BncWorkcell()
    task = build_task(
        workcell,
        make_station(station, workcell, robot),
        build_guidance(guidance, skill, "BncConnector"),
        uncertain,
        explored=skill.explored_outputs,
        shaped=reward == "shaped",
        render_mode=render_mode,
    )
    return GuidedEnv(task, hold=hold, render_mode=render_mode)


def build_task(
    workcell: BncWorkcell,
    station: Station,
    guidance: Diagram,
    uncertain: BncUncertainty,
    *,
    explored: tuple[int, ...],
    shaped: bool = False,
    render_mode: str | None = None,
) -> TaskDiagram:
    """Wires a station, a guidance diagram that moves the `explored` outputs, reward, monitor and ledger."""
    builder = DiagramBuilder()
    connect_guidance(builder, station, guidance)
    pose, desired_pose = station.get_pose_output_port(), guidance.GetOutputPort("desired_pose")
    wrench, force = station.get_wrench_output_port(), station.get_contact_force_output_port()
    plug = add_workpiece_pose(builder, station, "plug", "jack")

    violations = {}
    for name, port in (("commanded_violation", desired_pose), ("measured_violation", pose)):
        violation = builder.AddNamedSystem(name, ConstraintViolation(alignment_constraints(), CONTROL_PERIOD))
        builder.Connect(port, violation.get_pose_input_port())
        violations[name] = violation.get_violation_output_port()

    monitor = builder.AddNamedSystem("monitor", EpisodeMonitor(_conditions(workcell), CONTROL_PERIOD))
    builder.Connect(plug, monitor.get_signal_input_port("plug"))
    builder.Connect(force, monitor.get_signal_input_port("contact_force"))
    termination = monitor.get_termination_output_port()

    reward = builder.AddNamedSystem("reward", RewardSystem(_reward_terms(len(explored), shaped)))
    builder.ConnectInput("action", reward.get_signal_input_port("action"))
    builder.Connect(wrench, reward.get_signal_input_port("wrench"))
    builder.Connect(termination, reward.get_signal_input_port("termination"))
    if shaped:
        # Held from the last control step: a depth that was gained is the difference.
        last_plug = builder.AddNamedSystem("last_plug", ZeroOrderHold(CONTROL_PERIOD, 6))
        builder.Connect(plug, last_plug.get_input_port())
        builder.Connect(plug, reward.get_signal_input_port("plug"))
        builder.Connect(last_plug.get_output_port(), reward.get_signal_input_port("last_plug"))

    exported = {
        **violations,
        "observation": _add_observation(builder, pose, wrench),
        "reward": reward.get_reward_output_port(),
        **{name: reward.get_term_output_port(name) for name in reward.term_names},
        "termination": termination,
        "contact_force": force,
        "ledger": add_force_ledger(builder, station, guidance, violations, COLLISION_FORCE),
        "desired_pose": desired_pose,
        "pose": pose,
        "wrench": wrench,
    }
    for name, port in exported.items():
        builder.ExportOutput(port, name)
    meshcat = add_view(builder, station, render_mode, view_of_jack(workcell))
    diagram = builder.Build()
    diagram.set_name("BncConnector")
    plant = station.plant
    start = alignment_constraints().nearest(reference_trajectory().means[0])

    def randomize(context: Context, rng: np.random.Generator, options: Mapping[str, Any]) -> dict[str, Any]:
        jack, grasp = uncertain.draw(rng, options)
        plant_context = plant.GetMyMutableContextFromRoot(context)
        workcell.set_jack_offset(plant, plant_context, RigidTransform([*jack, 0.0]))
        workcell.set_grasp_offset(plant, plant_context, _grasp(grasp))
        station.set_pose(context, start)
        return {"jack_offset": jack.copy(), "grasp_offset": grasp.copy()}

    def push(context: Context, displacement: np.ndarray) -> None:
        station.set_pose(
            context, station.get_pose_output_port().Eval(station.GetMyContextFromRoot(context)) + displacement
        )

    return TaskDiagram(
        diagram=diagram,
        control_period=CONTROL_PERIOD,
        num_steps=NUM_STEPS,
        observation_space=gymnasium.spaces.Box(-CLIP, CLIP, (1 + 2 * POSE_SIZE,), np.float32),
        reward_terms=reward.term_names,
        ledger_fields=SafetyLedger.FIELDS,
        randomize=randomize,
        push=push,
        meshcat=meshcat,
        symmetry=Symmetry((1.0, *HALF_TURN, *HALF_TURN_OF_WRENCH), tuple(HALF_TURN[list(explored)])),
    )


def _grasp(offset: np.ndarray) -> RigidTransform:
    """X_PPlug of an offset: x, y, and where the plug tilts its angles about x and y."""
    tilt = RotationMatrix(RollPitchYaw(*offset[2:], 0.0)) if len(offset) > 2 else RotationMatrix()
    return RigidTransform(tilt, [*offset[:2], 0.0])


def _conditions(workcell: BncWorkcell) -> list[Condition]:
    locked_height, locked_angle = workcell.dimensions.locked_height, -workcell.dimensions.detent_angle

    def is_locked(plug: np.ndarray) -> bool:
        """`plug` is X_JPlug, position and rotation vector, which for an upright plug is its turn about z."""
        return bool(
            abs(plug[2] - locked_height) < LOCKED_HEIGHT
            and abs(plug[5] - locked_angle) < LOCKED_ANGLE
            and np.hypot(plug[0], plug[1]) < LOCKED_BESIDE
        )

    return [
        Condition("success", {"plug": 6}, is_locked, steps=LOCKED_STEPS),
        force_limit(COLLISION_FORCE),
    ]


def _reward_terms(num_actions: int, shaped: bool) -> list[RewardTerm]:
    def force_cost(wrench: np.ndarray) -> float:
        scaled = wrench / REWARD_WRENCH
        return -FORCE_WEIGHT * float(scaled @ scaled)

    def terminal_reward(termination: np.ndarray) -> float:
        return SUCCESS_REWARD * (termination[0] == _SUCCESS) + COLLISION_REWARD * (termination[0] == _COLLISION)

    terms = [
        RewardTerm("action_cost", {"action": num_actions}, lambda action: -ACTION_WEIGHT * float(action @ action)),
        RewardTerm("force_cost", {"wrench": 6}, force_cost),
        RewardTerm("terminal_reward", {"termination": 1}, terminal_reward),
    ]
    if shaped:
        terms.append(
            RewardTerm(
                "depth",
                {"plug": 6, "last_plug": 6},
                lambda plug, last_plug: DEPTH_REWARD * float(last_plug[2] - plug[2]) / MM,
            )
        )
    return terms


def _add_observation(builder: DiagramBuilder, pose: OutputPort, wrench: OutputPort) -> OutputPort:
    """[time, pose, wrench], each centred, scaled and clipped."""
    clock = TrajectorySource(PiecewisePolynomial.FirstOrderHold([0.0, END], np.array([[0.0, END]])))
    builder.AddNamedSystem("clock", clock)
    centre = np.concatenate([[0.5 * END], POSE_CENTRE, np.zeros(6)])
    scale = np.concatenate([[0.5 * END], POSE_SCALE, WRENCH_SCALE])
    return add_observation(builder, (clock.get_output_port(), pose, wrench), centre, scale)


def view_of_jack(workcell: BncWorkcell) -> RigidTransform:
    """A camera that looks slightly down at the jack."""
    return look_from_front(np.array(workcell.p_WJ) + [0.0, 0.0, 0.02], distance=0.11, height=0.05)
