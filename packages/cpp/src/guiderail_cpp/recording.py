"""Recorded steps of a skill: random measurements, and the actions and commands that Python computes for them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.guidance.registry import build_guidance
from guiderail.diagrams.tasks.options import CONTACT_MEMORY, MIN_CONTACT_FORCE
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import WRENCH_SIZE
from guiderail.models.control.wrench import ContactPointMean, center_of_pressure
from guiderail.models.policy import Policy
from guiderail.tools.environments import make_environment
from guiderail_cpp.arrays import Arrays
from guiderail_cpp.skill import TrainedSkill

Entries = Sequence[Mapping[str, Any]]
"""Entries of an observation, as in `skill.json`."""
EPISODES = 4  # number of recorded episodes
SPREAD = 0.3  # probability that a random entry of the observation is far outside, where it is clipped
START_SPREAD, TRACKING_SPREAD = 1e-3, 5e-4  # standard deviations of measured poses at a start and around a command


COMPUTED = ("time", "phase", "pose", "desired_pose", "center_of_pressure", "mean_contact_point")
"""Signals that follow from the measured pose and wrench and from the commands."""


def signal_sizes(entries: Entries) -> dict[str, int]:
    """Return the sizes of the observed signals by name."""
    sizes: dict[str, int] = {}
    for entry in entries:
        if entry["index"] < 0:
            raise InputError(f"the entry {entry['name']} counts from the end of its signal: count from its beginning")
        sizes[entry["signal"]] = max(sizes.get(entry["signal"], 0), entry["index"] + 1)
    return sizes


def record_skill(skill: TrainedSkill, signals: Mapping[str, int], episodes: int = EPISODES, seed: int = 0) -> Arrays:
    """Record random episodes of a skill, without a plant.

    The guidance diagram of the environment computes the commands. The network is evaluated in double precision, as in
    C++; the policy in Python rounds to single precision.

    Args:
        skill: Skill.
        signals: Sizes of the observed signals by name.
        episodes: Number of episodes.
        seed: Seed of the random numbers.
    """
    rng, rows, start = np.random.default_rng(seed), [], _start(skill)
    period, size = skill.prior.period, skill.prior.pose_size
    entries = skill.description["observation"]
    guidance = build_guidance(skill.config.environment["guidance"], skill.prior)
    for _ in range(episodes):
        simulator = Simulator(guidance)
        context = simulator.get_mutable_context()
        ports = {name: guidance.GetInputPort(name) for name in ("action", "pose", "wrench")}
        values = {name: np.zeros(port.size()) for name, port in ports.items()}
        values["pose"] = start + START_SPREAD * rng.normal(size=size)
        for name, port in ports.items():
            port.FixValue(context, values[name])
        simulator.Initialize()
        command = guidance.GetOutputPort("desired_pose").Eval(context)
        contact = ContactPointMean(MIN_CONTACT_FORCE, CONTACT_MEMORY / period)
        for step in range(skill.num_steps):
            pose = values["pose"] if step == 0 else command + TRACKING_SPREAD * rng.normal(size=size)
            raw = _random_signals(entries, signals, rng)
            if step % skill.config.action_repeat == 0:
                own = {"time": [step * period], "pose": pose, "desired_pose": command}
                if signals.get("wrench") == WRENCH_SIZE:
                    own["center_of_pressure"] = center_of_pressure(raw["wrench"], MIN_CONTACT_FORCE)
                    own["mean_contact_point"] = contact.relative_to(pose)
                own["phase"] = [-1.0 + 2.0 * step / skill.num_steps]
                for name in ("state", "transition_distance"):
                    if guidance.HasOutputPort(name):
                        own[name] = guidance.GetOutputPort(name).Eval(context)
                observed = {name: np.array(own.get(name, raw[name])) for name in signals}
                action = double_action(skill.policy, _observe(entries, observed))
            if signals.get("wrench") == WRENCH_SIZE:
                contact.add(pose, raw["wrench"])
            for name, value in (("action", action), ("pose", pose)):
                ports[name].FixValue(context, value)
            simulator.AdvanceTo((step + 1) * period)
            command = guidance.GetOutputPort("desired_pose").Eval(context)
            fallback = guidance.GetOutputPort("fallback").Eval(context)
            flat = np.concatenate([raw[name] for name in signals])
            rows.append((float(step == 0), flat, pose, action, command, fallback[0]))
    names = ("reset", "signals", "pose", "action", "command", "fallback")
    columns = zip(*rows, strict=True)
    return {f"replay/{name}": np.array(column, dtype=float) for name, column in zip(names, columns, strict=True)}


def _start(skill: TrainedSkill) -> np.ndarray:
    """Return a pose at which episodes begin."""
    if skill.prior.primitive is not None:
        return skill.prior.primitive.reference.means[0]
    # The poses of a task's robot and objects depend on the task: its environment knows them.
    env = make_environment(skill.config.task, skill.config.environment)
    try:
        env.reset(seed=0)
        env.step(np.zeros(env.action_space.shape or 1))
        return np.array(env.unwrapped.trace.measured[0])  # type: ignore[attr-defined]
    finally:
        env.close()


def _random_signals(entries: Entries, signals: Mapping[str, int], rng: np.random.Generator) -> dict[str, np.ndarray]:
    raw = {name: np.zeros(size) for name, size in signals.items()}
    for entry in entries:
        width = entry["scale"] * (10.0 * entry["clip"] if rng.uniform() < SPREAD else 1.0)
        raw[entry["signal"]][entry["index"]] = entry["center"] + width * rng.normal()
    return raw


def _observe(entries: Entries, signals: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the observation (n,) for the signals, in single precision."""
    values = [
        np.clip(
            signals[entry["signal"]][entry["index"]] * (1.0 / entry["scale"]) + -entry["center"] / entry["scale"],
            -entry["clip"],
            entry["clip"],
        )
        for entry in entries
    ]
    return np.array(values, dtype=np.float32)


def double_action(policy: Policy, observation: np.ndarray) -> np.ndarray:
    """Return the action of a policy's network for an observation (n,) of single precision, in double precision."""
    hidden = observation.astype(float)
    for index, (weight, bias) in enumerate(policy.layers):
        hidden = weight.astype(float) @ hidden + bias
        if index + 1 == len(policy.layers):
            break
        if policy.description["activation"] == "normalized_relu":
            hidden = hidden - hidden.mean()
            hidden = hidden / math.sqrt((hidden * hidden).mean() + float(np.float32(1e-5)))
        hidden = np.tanh(hidden) if policy.description["activation"] == "tanh" else np.maximum(hidden, 0.0)
    low, high = (np.asarray(policy.description[f"action_{end}"], np.float32).astype(float) for end in ("low", "high"))
    if policy.description.get("squash", "tanh") == "clip":
        return np.clip(hidden, low, high)
    return low + 0.5 * (np.tanh(hidden) + 1.0) * (high - low)
