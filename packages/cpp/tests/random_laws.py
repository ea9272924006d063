"""Random inputs of each law, and the results that Python computes for them, for the program `replay`."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from importlib.util import find_spec
from itertools import pairwise

import numpy as np
from pydrake.systems.analysis import Simulator
from safetensors.numpy import save

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_prior_knowledge
from guiderail.diagrams.guidance.primitive import make_law
from guiderail.diagrams.guidance.prior import PrimitiveConfig, PriorKnowledge
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import RigidTransform, pose_to_transform, rpy_rotation, transform_to_pose
from guiderail.models.control.wrench import MovingInertia, WrenchBound, bounded_wrench, governed_error
from guiderail.models.laws.law import Command, Law, safe_command
from guiderail.models.laws.template_law import TemplateLaw
from guiderail.models.policy import Policy
from guiderail.models.primitives import LinearConstraints, Matern52, ReferenceTrajectory
from guiderail.models.templates import load_template, parse_template
from guiderail.systems.command_checks import CommandWatchdog, ConstraintViolation
from guiderail.systems.wrench_limits import PhaseWrenchLimit
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.pretrained import find_run
from guiderail_cpp.arrays import Arrays, frozen, primitive_arrays
from guiderail_cpp.project import governor_arrays, policy_arrays
from guiderail_cpp.recording import double_action
from guiderail_cpp.templates import template_arrays

Files = tuple[bytes, bytes]
"""Content of the files of the data and of the recording."""
EPISODE = 400  # control steps of an episode


def _files(data: Arrays, recording: Arrays, texts: dict[str, str] | None = None) -> Files:
    recorded = {f"replay/{name}": np.asarray(values, dtype=float) for name, values in recording.items()}
    return save(frozen(data), metadata=texts), save(frozen(recorded))


def record_law(law: Law, steps, rng, start, action, near, episode=EPISODE, *, has_states=False) -> Arrays:
    """Take control steps with random actions and measured poses; the functions draw them.

    `record_skill` does the same with the diagram of an environment.
    """
    columns: dict[str, list] = {name: [] for name in ("reset", "action", "pose", "command", "fallback", "violation")}
    columns |= {"state": []} if has_states else {}
    for step in range(steps):
        number = step % episode
        if number == 0:
            pose = start(rng)
            state, command = law.start(pose), Command(pose)
        else:
            pose = near(rng, command.pose)
            state = law.next(state, command, pose)
        taken = action(rng, number)
        command = safe_command(law.command(state, taken, pose, np.zeros(0)), command.pose)
        columns["reset"].append(float(number == 0))
        columns["action"].append(taken)
        columns["pose"].append(pose)
        columns["command"].append(command.pose)
        columns["fallback"].append(float(command.fallback))
        columns["violation"].append(max(command.violation, ConstraintViolation.UNCONSTRAINED))
        if has_states:
            columns["state"].append(float(state.number))
    return columns


def held(scale: float, size: int, repeat: int = 5, limit: float = np.inf) -> Callable:
    """Return a function that draws uniform actions, each held for several steps."""
    last = np.zeros(size)

    def draw(rng, step):
        nonlocal last
        if step % repeat == 0:
            last = np.clip(scale * rng.uniform(-1.0, 1.0, size), -limit, limit)
        return last

    return draw


def _primitive(
    config: PrimitiveConfig, *, history: bool, scale: float, steps: int, pose_noise: float = 0.0, episode: int = EPISODE
) -> Files:
    rng, outputs = np.random.default_rng(0), config.num_outputs
    law = make_law(PriorKnowledge(config.control_period, primitive=config, pose_size=outputs), history=history)
    first = config.reference.means[0]
    recording = record_law(
        law, steps, rng,
        start=lambda rng: first + 1e-3 * rng.normal(size=outputs),
        action=held(scale, config.num_actions),
        near=lambda rng, command: command + pose_noise * rng.normal(size=outputs),
        episode=min(law.primitive.num_steps, episode),
    )  # fmt: skip
    return _files(primitive_arrays(law), recording)


def connector(**options) -> PrimitiveConfig:
    """Return the primitive of the connector that comes with the package."""
    config = RunFolder(find_run("pretrained:connector")).config()
    return make_prior_knowledge(EnvConfig.resolve(config.task, {**config.environment, **options})).primitive


def kgrl(steps: int) -> Files:
    return _primitive(connector(), history=False, scale=3.0, steps=steps)


def skgrl(steps: int) -> Files:
    return _primitive(connector(guidance="skgrl"), history=True, scale=8.0, steps=steps)


def skgrl_measured(steps: int) -> Files:
    history = {"history": 4, "history.source": "measured", "history.variance": 1e-8}
    config = connector(guidance="skgrl", **history)
    return _primitive(config, history=True, scale=8.0, steps=steps // 2, pose_noise=2e-5, episode=160)


def skgrl_oblique(steps: int) -> Files:
    """Oblique constraints of three outputs that differ from step to step, and a kernel that is less smooth."""
    rng, N = np.random.default_rng(1), 80
    times = np.linspace(0.0, 4.0, N)
    means = np.stack([0.1 * np.sin(times), 0.1 * np.cos(2 * times), 0.05 * times], axis=1)
    A = 0.02 * rng.normal(size=(N, 3, 3))
    covariances = A @ A.transpose(0, 2, 1) + 1e-5 * np.eye(3)
    G = rng.normal(size=(5, 3))
    c = np.array([(G @ mean).tolist() for mean in means]) - 0.012 * np.linalg.norm(G, axis=1)
    config = PrimitiveConfig(
        ReferenceTrajectory(times, means, covariances), LinearConstraints(np.broadcast_to(G, (N, 5, 3)), c),
        times[1] - times[0], history=3, history_variance=1e-7, horizon=15, kernel=Matern52(1.0),
    )  # fmt: skip
    return _primitive(config, history=True, scale=2.0, steps=steps)


def equal_bounds(steps: int) -> Files:
    """An output that must not move, at every third step; at the others its bounds differ."""
    config = connector()
    lower, upper = np.full((config.reference.num_steps, 6), -np.inf), np.full((config.reference.num_steps, 6), np.inf)
    lower[:, [0, 1, 4]], upper[:, [0, 1, 4]] = -2e-3, 2e-3
    lower[::3, 4] = upper[::3, 4] = 0.0
    config = replace(config, constraints=LinearConstraints.box(lower, upper))
    return _primitive(config, history=False, scale=3.0, steps=steps // 2, episode=160)


def _template(template, frames, steps, start, *, velocity=False, period=0.01, limit=0.004, seed=0) -> Files:
    """Episodes begin at the same pose, because it takes seconds to find one that some templates allow."""
    rng = np.random.default_rng(seed)
    start = _allowed_start(template, frames, start, rng)
    mapping = load_template("end_effector_velocity") if velocity else None
    law = TemplateLaw(template, frames, period, input_mapping=mapping, max_tracking_error=limit)
    recording = record_law(
        law, steps // 2, rng,
        start=lambda rng: start,
        action=held(1.6, (mapping or template).inputs, 10, limit=1.0),
        near=lambda rng, command: command + 2e-3 * rng.normal(size=6),
        episode=160,
        has_states=True,
    )  # fmt: skip
    data = template_arrays(template, frames)
    if mapping is not None:
        data |= template_arrays(mapping, {}, "mapping/")
    data |= {"period": np.array([period]), "template/max_tracking_error": np.array([limit])}
    return _files(data, recording)


def _allowed_start(template, frames, start, rng):
    while True:
        pose = start + np.array([0.02] * 3 + [0.1] * 3) * rng.normal(size=6)
        with suppress(InputError):
            template.check_start(pose_to_transform(pose), frames)
            return pose


def _shipped(name: str, steps: int, *, velocity: bool = False) -> Files:
    template = load_template(name)
    X_WF = RigidTransform(rpy_rotation(0.3, -0.2, 0.5), [0.4, 0.1, 0.2])
    frames, far = dict.fromkeys(template.frames, X_WF), name != "grid_clamp"
    X_WE = RigidTransform(X_WF.rotation(), X_WF.translation() + ([0.25, 0.1, 0.3] if far else [0.03, 0.02, 0.08]))
    start = transform_to_pose(template.project(template.initial_state, X_WE, frames))
    return _template(template, frames, steps, start, velocity=velocity)


EVERY_KIND = """
name: every_kind
inputs: 6
frames: [a, b]
max_speed_m_per_s: 0.1
max_speed_rad_per_s: 0.6
initial_state: far
states:
  far:
    input_mapping:
      - {kind: translation, inputs: [0, 1, 2], speed_m_per_s: 0.06, frame: tool}
      - {kind: uneven, above: 0.9, below: 0.7,
         of: {kind: uneven, above: 0.5, below: 0.9,
              of: {kind: rotation, inputs: [3, 4, 5], speed_rad_per_s: 0.5, frame: a}}}
    active_constraints:
      - {kind: half_space, frame: a, normal: [0.2, 0.1, 1.0], offset_m: -0.05}
      - {kind: box, frame: a, lower_m: [-0.2, -0.2, -0.1], upper_m: [0.2, 0.2, 0.25]}
      - {kind: outside_box, frame: b, lower_m: [-0.03, -0.03, -0.03], upper_m: [0.03, 0.03, 0.03], margin_m: 0.01}
      - {kind: outside_sphere, frame: a, radius_m: 0.03, center_m: [0.06, 0.06, 0.06]}
      - {kind: outside_cylinder, frame: b, radius_m: 0.02, min_m: -0.05, max_m: 0.05}
      - {kind: keep_above, frame: a, height_m: -0.08, points_m: [[0, 0, 0], [0.02, 0.01, -0.02]]}
      - {kind: tilt_limits, frame: a, min_deg: -20, max_deg: 25}
    transition_distance: {kind: distance, frame: a, point_m: [0.01, 0.0, 0.02]}
    starts_at_m: 0.2
    transitions: [{to: near, below_m: 0.09, hysteresis_m: 0.03}]
  near:
    max_speed_m_per_s: 0.05
    input_mapping:
      - {kind: translation, inputs: [0, 1, 2], speed_m_per_s: 0.05, frame: a}
      - {kind: tilt_towards, inputs: [3, 4], speed_rad_per_s: 0.4, frame: b}
    active_constraints:
      - {kind: inside_sphere, frame: a, radius_m: 0.15}
      - {kind: cylinder, frame: a, min_radius_m: 0.01, max_radius_m: 0.1}
      - {kind: sector, frame: a, min_deg: -150, max_deg: 150}
      - {kind: funnel, frame: a, radius_m: 0.05, height_m: 0.09, slope: 0.6}
      - {kind: tilt_by_distance, frame: a, distance_m: [0.02, 0.12], tilt_deg: [10, 0], turns_along: false}
    transition_distance: {kind: axis_distance, frame: a}
    starts_at_m: 0.1
    transitions: [{to: turn, below_m: 0.03, hysteresis_m: 0.01}]
  turn:
    input_mapping:
      - {kind: rotation, inputs: [3, 4, 5], speed_rad_per_s: 0.5}
      - {kind: translation, inputs: [2], speed_m_per_s: 0.03, frame: a, axes: [[0, 0, 1]]}
    active_constraints:
      - {kind: box, frame: a, lower_m: [-0.05, -0.05, -0.02], upper_m: [0.05, 0.05, 0.06]}
    transition_distance: {kind: height, frame: a}
    starts_at_m: 0.06
    ends_at_m: 0.01
"""


def _every_kind(state: str, steps: int) -> Files:
    """Random steps that begin in a state of the template."""
    frames = {
        "a": RigidTransform(rpy_rotation(0.1, -0.2, 0.4), [0.4, 0.1, 0.2]),
        "b": RigidTransform(rpy_rotation(-0.3, 0.1, -0.6), [0.52, 0.12, 0.22]),
    }
    template = parse_template(EVERY_KIND.replace("initial_state: far", f"initial_state: {state}"))
    p_AE = [-0.1, -0.05, 0.1] if state == "far" else [0.03, 0.02, 0.03]
    X_WE = frames["a"] @ RigidTransform(rpy_rotation(0.0, 0.1, 0.0), p_AE)
    start = transform_to_pose(template.project(template.initial_state, X_WE, frames))
    return _template(template, frames, steps, start, limit=0.05)


def policy(steps: int) -> Files:
    rng, sizes = np.random.default_rng(3), (17, 64, 63, 3)
    layers = [
        (rng.normal(size=(after, before)).astype(np.float32), rng.normal(size=after).astype(np.float32))
        for before, after in pairwise(sizes)
    ]
    description = {
        "observation_shape": [17], "activation": "normalized_relu", "squash": "tanh",
        "action_low": [-1.0, -2.0, 0.0], "action_high": [1.0, 1.0, 0.5],
    }  # fmt: skip
    network = Policy(layers, description)
    observations = rng.normal(size=(steps, 17)).astype(np.float32)
    actions = [double_action(network, observation) for observation in observations]
    recording = {"reset": np.zeros(steps), "observation": observations, "action": actions}
    return _files(policy_arrays(network), recording, {"activation": "normalized_relu", "squash": "tanh"})


STIFFNESS = np.array([1500.0, 1200.0, 1500.0, 30.0, 20.0, 30.0])
DAMPING = np.array([90.0, 80.0, 100.0, 0.5, 0.4, 0.5])
BOUND = WrenchBound(np.array([9.0, 9.0, 15.0, 3.0, 2.0, 3.0]), 19.0, 4.0, 2.5e4, 0.03)
INERTIA = MovingInertia(1.5, 2e-3)
GOVERNOR = governor_arrays(
    STIFFNESS, DAMPING, np.append(BOUND.numbers, [BOUND.contact_stiffness, BOUND.contact_lever]), INERTIA, 0.005
)


def governor(steps: int) -> Files:
    rng = np.random.default_rng(4)
    pose, velocity = rng.normal(size=(2, steps, 6))
    velocity *= 0.1
    desired = pose + 0.02 * rng.normal(size=(steps, 6))
    max_wrench = np.where(rng.uniform(size=(steps, 8)) < 0.1, np.nan, 25.0 * rng.uniform(-0.1, 1.0, (steps, 8)))
    reference = [
        pose[t] + governed_error(
            STIFFNESS, DAMPING, desired[t] - pose[t], velocity[t], INERTIA, 0.005,
            BOUND.lowered_to(max_wrench[t]).in_pose_order,
        )
        for t in range(steps)
    ]  # fmt: skip
    recording = {
        "reset": np.zeros(steps), "pose": pose, "velocity": velocity, "desired": desired, "max_wrench": max_wrench,
        "reference": reference,
    }  # fmt: skip
    return _files(GOVERNOR, recording)


def force_bound(steps: int) -> Files:
    rng = np.random.default_rng(5)
    spring, damper = 12.0 * rng.normal(size=(2, steps, 6))
    velocity = 0.1 * rng.normal(size=(steps, 6))
    inertia = np.column_stack([rng.uniform(1.0, 10.0, steps), rng.uniform(0.002, 0.1, steps)])
    wrench = [
        bounded_wrench(spring[t], damper[t], velocity[t], MovingInertia(*inertia[t]), BOUND) for t in range(steps)
    ]
    recording = {
        "reset": np.zeros(steps), "spring": spring, "damper": damper, "velocity": velocity, "inertia": inertia,
        "wrench": wrench,
    }  # fmt: skip
    return _files(GOVERNOR, recording)


def _record_system(system, output: str, inputs: Callable, steps: int, period: float, episode: int = 200) -> Arrays:
    """Evaluate an output of a system at the beginning of each period, before the events of this instant."""
    rows: dict[str, list] = {"reset": [], "time": [], output: []}
    for step in range(steps):
        number = step % episode
        values = inputs(number)
        if number == 0:
            simulator = Simulator(system, system.CreateDefaultContext())
            context = simulator.get_mutable_context()
        for name, value in values.items():
            system.GetInputPort(name).FixValue(context, value)
        if number == 0:
            simulator.Initialize()
        rows["reset"].append(float(number == 0))
        rows["time"].append(context.get_time())
        yield_values = {name: np.array(value) for name, value in values.items()}
        for name, value in yield_values.items():
            rows.setdefault(name, []).append(value)
        if output == "safe_pose":
            simulator.AdvanceTo(context.get_time())
            simulator.AdvancePendingEvents()
            rows.setdefault("timed_out", []).append(system.GetOutputPort("command_timed_out").Eval(context)[0])
        rows[output].append(np.array(system.GetOutputPort(output).Eval(context)))
        simulator.AdvanceTo((number + 1) * period)
    return rows


def phase_limit(steps: int) -> Files:
    rng, period = np.random.default_rng(6), 0.02
    limits, rate = rng.uniform(3.0, 30.0, (3, 8)), np.full(8, 40.0)
    state, states = 0.0, []

    def inputs(number):
        nonlocal state
        if number % 17 == 0:
            state = float(rng.integers(0, 3))
        states.append([state])
        return {"state_max_wrench": limits[int(state)], "max_wrench": rng.uniform(5.0, 40.0, 8)}

    system = PhaseWrenchLimit(limits.max(axis=0), rate, period=period)
    rows = _record_system(system, "phase_max_wrench", inputs, steps, period)
    data = {"phase_limit/limits": limits, "phase_limit/max_change": rate * period}
    recording = {"bound": rows["phase_max_wrench"], "state": np.array(states)}
    recording |= {name: rows[name] for name in ("reset", "max_wrench")}
    return _files(data, recording)


def rate_limiter(steps: int) -> Files:
    from guiderail_hardware.systems.pose_rate_limiter import PoseRateLimiter

    rng, period = np.random.default_rng(7), 0.01
    desired = np.zeros(6)

    def inputs(number):
        nonlocal desired
        if number % 7 == 0:
            desired = np.array([0.02, 0.02, 0.02, 3.0, 1.0, 3.0]) * rng.normal(size=6)
        bad = np.full(6, np.nan) if rng.uniform() < 0.05 else desired
        return {"desired_pose": bad, "pose": 0.01 * rng.normal(size=6), "blend_factor": [float(number > 3)]}

    rows = _record_system(PoseRateLimiter(period=period), "limited_pose", inputs, steps, period)
    recording = {
        "reset": rows["reset"], "desired": rows["desired_pose"], "pose": rows["pose"],
        "controlled": rows["blend_factor"], "limited": rows["limited_pose"],
    }  # fmt: skip
    data = {"period": np.array([period]), "speed": np.array([0.25]), "angular_speed": np.array([1.5])}
    return _files(data, recording)


def watchdog(steps: int) -> Files:
    rng, period = np.random.default_rng(8), 0.01

    def inputs(number):
        desired = np.full(6, np.inf) if rng.uniform() < 0.05 else rng.normal(size=6)
        stamp = number * period + rng.choice([0.0, -0.05, -0.2, 0.005, 0.5])
        return {
            "desired_pose": desired, "pose": rng.normal(size=6), "blend_factor": [float(number > 3)],
            "command_time": [stamp],
        }  # fmt: skip

    rows = _record_system(CommandWatchdog(period), "safe_pose", inputs, steps, period)
    recording = {
        "reset": rows["reset"], "time": rows["time"], "desired": rows["desired_pose"], "pose": rows["pose"],
        "stamp": rows["command_time"], "controlled": rows["blend_factor"], "followed": rows["safe_pose"],
        "timed_out": rows["timed_out"],
    }  # fmt: skip
    return _files({"period": np.array([period]), "timeout": np.array([0.1])}, recording)


LAWS: dict[str, Callable[[int], Files]] = {
    "kgrl": kgrl,
    "kgrl, equal bounds": equal_bounds,
    "skgrl": skgrl,
    "skgrl, measured history": skgrl_measured,
    "skgrl, oblique constraints": skgrl_oblique,
    "template grid_clamp": lambda steps: _shipped("grid_clamp", steps),
    "template pouring": lambda steps: _shipped("pouring", steps),
    "template pouring_aimed": lambda steps: _shipped("pouring_aimed", steps),
    "template pouring_shielded": lambda steps: _shipped("pouring_shielded", steps),
    "template of every kind, far": lambda steps: _every_kind("far", steps),
    "template of every kind, near": lambda steps: _every_kind("near", steps),
    "template of every kind, turn": lambda steps: _every_kind("turn", steps),
    "constraints on a velocity": lambda steps: _shipped("pouring", steps, velocity=True),
    "policy": policy,
    "governor": governor,
    "force bound": force_bound,
    "limit of a state": phase_limit,
    "watchdog": watchdog,
}
if find_spec("guiderail_hardware") is not None:  # which has the system that limits the rate in Python
    LAWS["rate limiter"] = rate_limiter

TOLERANCES = {"kgrl, equal bounds": 1e-11}
"""Largest differences of laws that are solved less accurately in Python, where this equation is violated by 2e-12."""
TOLERANCE = 1e-12
