"""BncConnector: insert, align and lock a bayonet connector whose place is not exactly known (4.4.2, 5.4.2)."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import gymnasium
import numpy as np
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import AffineSystem, Multiplexer, Saturation, TrajectorySource, ZeroOrderHold
from pydrake.trajectories import PiecewisePolynomial

from guiderail.diagrams.cameras import add_camera, add_meshcat
from guiderail.diagrams.env import GuidedEnv
from guiderail.diagrams.guidance import build_guidance, check_guidance
from guiderail.diagrams.guidance.primitive_skill import PrimitiveSkill
from guiderail.diagrams.stations.bnc_workcell import LOCKED_ANGLE, LOCKED_HEIGHT, BncWorkcell
from guiderail.diagrams.stations.station import CONTROL_PERIOD, POSE_SIZE, Station
from guiderail.diagrams.task import TaskDiagram
from guiderail.diagrams.tasks.bnc_uncertainty import BncUncertainty
from guiderail.models.demonstrations import bnc_connector as demonstrations
from guiderail.models.errors import InputError
from guiderail.models.primitives import LinearConstraints, ReferenceTrajectory
from guiderail.systems.constraint_violation import ConstraintViolation
from guiderail.systems.episode_monitor import TERMINATIONS, Condition, EpisodeMonitor
from guiderail.systems.relative_poses import RelativePoses
from guiderail.systems.reward_system import RewardSystem, RewardTerm
from guiderail.systems.safety_ledger import SafetyLedger

MM, DEGREE = 1e-3, np.deg2rad(1.0)
NUM_STEPS = demonstrations.NUM_STEPS
SENSIBLE_GUIDANCE = ("kmp", "residual", "kgrl", "skgrl")

COMPONENTS = 16
# How well a hand repeats itself: added to the demonstrations' covariance as a standard deviation.
FLOOR = np.array([0.05 * MM, 0.05 * MM, 0.1 * MM, 0.2 * DEGREE, 0.05 * DEGREE, 0.05 * DEGREE])

# ρ [m², rad²]. The thesis's 1e-8 is (0.1 mm)², much for demonstrations that vary by a millimetre: jerk at the same
# exploration RMS is then 52 times below KGRL's, at 1e-10 26 times (white actions in x and y, held ten control steps).
HISTORY_VARIANCE = 1e-11
ALIGNMENT = 2.0 * MM  # |x|, |y| of every command: equation 4.26
COLLISION_FORCE = 35.0  # [N], of the impedance
LOCKED_BESIDE = 1.0 * MM  # a plug that is as low and as turned beside the jack is not locked
LOCKED_STEPS = 3  # control steps for which the plug must be locked before that counts

# A policy sees (value − centre) / scale, clipped to ±3: [time, pose, wrench]. The wrench's torques are small, and they
# are what tells on which side of the rim the plug sits: 0.02 Nm at 4 N.
END = NUM_STEPS * CONTROL_PERIOD
POSE_CENTRE = np.array([0.0, 0.0, 5.0 * MM, 45.0 * DEGREE, 0.0, 0.0])
POSE_SCALE = np.array([2.0 * MM, 2.0 * MM, 8.0 * MM, 45.0 * DEGREE, 1.5 * DEGREE, 1.5 * DEGREE])
WRENCH_SCALE = np.array([5.0, 5.0, 8.0, 0.02, 0.02, 0.2])
CLIP = 3.0

# Equations 4.27 and 4.28; the thesis gives no unit of f: here it is 10 N and 0.5 Nm.
ACTION_WEIGHT = FORCE_WEIGHT = 0.01
REWARD_WRENCH = np.array([10.0, 10.0, 10.0, 0.5, 0.5, 0.5])
SUCCESS_REWARD, COLLISION_REWARD = 60.0, -50.0
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
    station: str = "rails",
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
        guidance: "kmp", "residual", "kgrl" or "skgrl".
        reward: "sparse" is the thesis's (4.27, 4.28); "shaped" adds the depth gained, in millimetres.
        observation: "state": time, pose and wrench, scaled.
        uncertainty: "calibration", "disc" or "known": see `BncUncertainty`, which also has the options of a reset.
        station: "rails" or "arm".
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
    uncertain = BncUncertainty(uncertainty)
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
        isotropic_groups=((0, 1, 2), (3, 4, 5)),
    )
    workcell = BncWorkcell()
    task = build_task(
        workcell,
        make_station(station, workcell),
        build_guidance(guidance, skill, "BncConnector"),
        uncertain,
        num_actions=skill.num_actions,
        shaped=reward == "shaped",
        render_mode=render_mode,
    )
    return GuidedEnv(task, hold=hold, render_mode=render_mode)


def make_station(name: str, workcell: BncWorkcell) -> Station:
    """A simulated station by its name."""
    if name == "rails":
        from guiderail.diagrams.stations.rails import RailsStation

        return RailsStation(workcell)
    if name == "arm":
        from guiderail.diagrams.stations.arm import ArmStation

        return ArmStation(workcell)
    raise InputError(f"there is no simulated station '{name}': use 'rails' or 'arm'")


def build_task(
    workcell: BncWorkcell,
    station: Station,
    guidance: Diagram,
    uncertain: BncUncertainty,
    *,
    num_actions: int,
    shaped: bool = False,
    render_mode: str | None = None,
) -> TaskDiagram:
    """Wires a station, a guidance diagram, reward, monitor and ledger."""
    builder = DiagramBuilder()
    builder.AddNamedSystem("station", station)
    builder.AddNamedSystem("guidance", guidance)
    pose, desired_pose = station.get_pose_output_port(), guidance.GetOutputPort("desired_pose")
    wrench, force = station.get_wrench_output_port(), station.get_contact_force_output_port()
    builder.Connect(pose, guidance.GetInputPort("pose"))
    builder.Connect(wrench, guidance.GetInputPort("wrench"))
    builder.Connect(desired_pose, station.get_desired_pose_input_port())
    builder.ExportInput(guidance.GetInputPort("action"), "action")

    plant = station.plant
    plug_in_jack = builder.AddNamedSystem(
        "plug_in_jack", RelativePoses(plant, [plant.GetBodyByName("plug")], plant.GetBodyByName("jack"))
    )
    builder.Connect(station.GetOutputPort("body_poses"), plug_in_jack.get_body_poses_input_port())
    plug = plug_in_jack.get_relative_poses_output_port()

    violations = {}
    for name, port in (("commanded_violation", desired_pose), ("measured_violation", pose)):
        violation = builder.AddNamedSystem(name, ConstraintViolation(alignment_constraints(), CONTROL_PERIOD))
        builder.Connect(port, violation.get_pose_input_port())
        violations[name] = violation.get_violation_output_port()

    monitor = builder.AddNamedSystem("monitor", EpisodeMonitor(_conditions(workcell), CONTROL_PERIOD))
    builder.Connect(plug, monitor.get_signal_input_port("plug"))
    builder.Connect(force, monitor.get_signal_input_port("contact_force"))
    termination = monitor.get_termination_output_port()

    reward = builder.AddNamedSystem("reward", RewardSystem(_reward_terms(num_actions, shaped)))
    builder.ConnectInput("action", reward.get_signal_input_port("action"))
    builder.Connect(wrench, reward.get_signal_input_port("wrench"))
    builder.Connect(termination, reward.get_signal_input_port("termination"))
    if shaped:
        # Held from the last control step: a depth that was gained is the difference.
        last_plug = builder.AddNamedSystem("last_plug", ZeroOrderHold(CONTROL_PERIOD, 6))
        builder.Connect(plug, last_plug.get_input_port())
        builder.Connect(plug, reward.get_signal_input_port("plug"))
        builder.Connect(last_plug.get_output_port(), reward.get_signal_input_port("last_plug"))

    too_hard = builder.AddNamedSystem("force_beyond_limit", _affine(np.eye(1), [-COLLISION_FORCE]))
    builder.Connect(force, too_hard.get_input_port())
    ledger = builder.AddNamedSystem("ledger", SafetyLedger(CONTROL_PERIOD))
    recorded = {
        **violations,
        "contact_force": force,
        "collision": too_hard.get_output_port(),
        "saturation": station.get_saturation_output_port(),
        "fallback": guidance.GetOutputPort("fallback"),
    }
    for name, port in recorded.items():
        builder.Connect(port, ledger.get_record_input_port(name))

    exported = {
        **violations,
        "observation": _add_observation(builder, pose, wrench),
        "reward": reward.get_reward_output_port(),
        **{name: reward.get_term_output_port(name) for name in reward.term_names},
        "termination": termination,
        "contact_force": force,
        "ledger": ledger.get_ledger_output_port(),
        "desired_pose": desired_pose,
        "pose": pose,
        "wrench": wrench,
    }
    for name, port in exported.items():
        builder.ExportOutput(port, name)
    meshcat = _add_view(builder, station, workcell, render_mode)
    diagram = builder.Build()
    diagram.set_name("BncConnector")
    start = alignment_constraints().nearest(reference_trajectory().means[0])

    def randomize(context: Context, rng: np.random.Generator, options: Mapping[str, Any]) -> dict[str, Any]:
        jack, grasp = uncertain.draw(rng, options)
        plant_context = plant.GetMyMutableContextFromRoot(context)
        workcell.set_jack_offset(plant, plant_context, RigidTransform([*jack, 0.0]))
        workcell.set_grasp_offset(plant, plant_context, RigidTransform([*grasp, 0.0]))
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
    )


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
        Condition("collision", {"contact_force": 1}, lambda contact_force: contact_force[0] > COLLISION_FORCE),
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
            RewardTerm("depth", {"plug": 6, "last_plug": 6}, lambda plug, last_plug: (last_plug[2] - plug[2]) / MM)
        )
    return terms


def _affine(D: np.ndarray, y0: np.ndarray | list[float]) -> AffineSystem:
    """y = D u + y0, evaluated in C++."""
    outputs, inputs = D.shape
    return AffineSystem(
        A=np.zeros((0, 0)), B=np.zeros((0, inputs)), f0=np.zeros(0), C=np.zeros((outputs, 0)), D=D, y0=np.asarray(y0)
    )


def _add_observation(builder: DiagramBuilder, pose: OutputPort, wrench: OutputPort) -> OutputPort:
    """[time, pose, wrench], each centred, scaled and clipped."""
    clock = TrajectorySource(PiecewisePolynomial.FirstOrderHold([0.0, END], np.array([[0.0, END]])))
    together = builder.AddNamedSystem("time_pose_wrench", Multiplexer([1, POSE_SIZE, 6]))
    centre = np.concatenate([[0.5 * END], POSE_CENTRE, np.zeros(6)])
    scale = np.concatenate([[0.5 * END], POSE_SCALE, WRENCH_SCALE])
    scaled = builder.AddNamedSystem("scaled", _affine(np.diag(1.0 / scale), -centre / scale))
    clipped = builder.AddNamedSystem("clipped", Saturation(np.full(len(scale), -CLIP), np.full(len(scale), CLIP)))
    for index, port in enumerate((builder.AddNamedSystem("clock", clock).get_output_port(), pose, wrench)):
        builder.Connect(port, together.get_input_port(index))
    builder.Connect(together.get_output_port(), scaled.get_input_port())
    builder.Connect(scaled.get_output_port(), clipped.get_input_port())
    return clipped.get_output_port()


def _add_view(
    builder: DiagramBuilder, station: Station, workcell: BncWorkcell, render_mode: str | None
) -> Meshcat | None:
    if render_mode == "human":
        return add_meshcat(builder, station.GetOutputPort("query"))[0]
    if render_mode == "rgb_array":
        picture = add_camera(
            builder,
            station.scene_graph,
            station.GetOutputPort("query"),
            "picture",
            size=(640, 480),
            vertical_fov=np.deg2rad(30.0),
            X_WC=view_of_jack(workcell),
        )
        builder.ExportOutput(picture, "rgb_image")
    return None


def view_of_jack(workcell: BncWorkcell, distance: float = 0.16, height: float = 0.06) -> RigidTransform:
    """A camera that looks slightly down at the jack from the side that faces away from the arm."""
    target = np.array(workcell.p_WJ) + [0.0, 0.0, 0.02]
    eye = target + [0.8 * distance, -0.6 * distance, height]
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return RigidTransform(RotationMatrix(np.stack([right, np.cross(forward, right), forward], axis=1)), eye)
