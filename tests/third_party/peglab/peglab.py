"""What a lab brings along: a task with a world of its own, a kind of guidance, and a learner, in one installed file."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydantic import Field
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import MatrixGain, PassThrough, ZeroOrderHold

from guiderail import (
    Condition,
    Guidance,
    Known,
    LinearConstraints,
    Observed,
    Options,
    ReferenceTrajectory,
    RewardTerm,
    Station,
    Task,
    register_guidance,
    register_task,
)
from guiderail.diagrams.guidance.registry import GUIDANCE
from guiderail.models.objects.narrow_passage import NarrowPassage
from guiderail.models.policy import Policy
from guiderail.systems.constraint_violation import ConstraintViolation
from guiderail.tools.learning.learner import LEARNERS, Learner, register_learner
from guiderail.tools.rollouts.rollout import Decision

NUM_STEPS, PERIOD = 80, 0.02


class SlotOptions(Options):
    """Of the slot."""

    width: float = Field(0.14, ge=0.05, le=0.3, description="of the slot [m]")


@register_task("peglab/Slot")
class Slot(Task):
    """Through a slot and on to a goal that two demonstrations never quite reach."""

    world_kind = "plane"
    Options = SlotOptions
    options: SlotOptions
    defaults = {"guidance": "kgrl", "hold": 5}
    num_steps = NUM_STEPS
    clip = 1.0

    def world(self) -> NarrowPassage:
        middle = 0.35
        gap = (middle - self.options.width / 2, middle + self.options.width / 2)
        return NarrowPassage(start=(0.35, 0.1), goal=(0.42, 0.9), goal_radius=0.06, gap_x=gap)

    def reference(self) -> ReferenceTrajectory:
        phase = np.linspace(0.0, 1.0, NUM_STEPS)
        means = np.column_stack([np.full(NUM_STEPS, 0.35), 0.1 + 0.8 * phase])
        return ReferenceTrajectory(
            PERIOD * np.arange(NUM_STEPS), means, np.tile(0.04**2 * np.eye(2), (NUM_STEPS, 1, 1))
        )

    def constraints(self) -> LinearConstraints:
        return LinearConstraints.box([0.25, -np.inf], [0.45, np.inf])

    def observed(self) -> Sequence[Observed]:
        return (Observed("phase"), Observed("pose", 0.5, 0.5))

    def reward_terms(self, num_actions: int) -> list[RewardTerm]:
        goal = np.array(self.world().goal)
        return [RewardTerm("nearness", {"pose": 2}, lambda pose: -float(np.linalg.norm(pose - goal)))]

    def conditions(self) -> list[Condition]:
        return [Condition("success", {"pose": 2}, self.world().at_goal)]

    def reset(
        self, station: Station, guidance: Diagram, context: Context, rng: np.random.Generator, options: Any
    ) -> dict[str, Any]:
        start = np.array([0.35, 0.1]) + (0.01 if options.held_out else 0.002) * rng.standard_normal(2)
        station.set_pose(context, start)
        return {"start": start}


class OffsetOptions(Options):
    """Of the guidance."""

    reach: float = Field(0.05, gt=0, description="how far a full action leads from where the robot is [m]")


@register_guidance("peglab_offset", needs=(), label="offset", colour="#8c564b", options=OffsetOptions)
class OffsetGuidance(Guidance):
    """Commands the measured pose, as it was a control step ago, and what the policy adds."""

    def __init__(self, known: Known):
        super().__init__()
        builder, size = DiagramBuilder(), 2
        hold = builder.AddNamedSystem("action_hold", ZeroOrderHold(known.period, size))
        here = builder.AddNamedSystem("pose_hold", ZeroOrderHold(known.period, size))
        wrench = builder.AddNamedSystem("wrench", PassThrough(size))
        both = builder.AddNamedSystem("both", PassThrough(size))
        reach = float(known.options["reach"])  # type: ignore[arg-type]
        gain = builder.AddNamedSystem("gain", MatrixGain(D=reach * np.eye(size)))
        from guiderail.systems.residual import Residual

        command = builder.AddNamedSystem("command", Residual(np.ones(size)))
        free = ConstraintViolation(LinearConstraints.none(size), known.period)
        violation = builder.AddNamedSystem("violation", free)
        never = builder.AddNamedSystem("never", MatrixGain(D=np.zeros((1, size))))
        builder.Connect(both.get_output_port(), here.get_input_port())
        builder.Connect(hold.get_output_port(), gain.get_input_port())
        builder.Connect(here.get_output_port(), command.get_reference_input_port())
        builder.Connect(gain.get_output_port(), command.get_action_input_port())
        builder.Connect(hold.get_output_port(), never.get_input_port())
        builder.Connect(command.get_desired_pose_output_port(), violation.get_pose_input_port())
        builder.ExportInput(hold.get_input_port(), "action")
        builder.ExportInput(both.get_input_port(), "pose")
        builder.ExportInput(wrench.get_input_port(), "wrench")
        builder.ExportOutput(command.get_desired_pose_output_port(), "desired_pose")
        builder.ExportOutput(hold.get_output_port(), "held_action")
        builder.ExportOutput(violation.get_violation_output_port(), "constraint_violation")
        builder.ExportOutput(never.get_output_port(), "fallback")
        builder.BuildInto(self)


OFFSET = GUIDANCE.get("peglab_offset")


@register_learner("peglab_hill_climbing")
class HillClimbing(Learner):
    """Keeps the best linear policy so far, and tries a neighbour of it in each episode."""

    def __init__(self, preset: Any, env: Any, *, seed: int, **unused: Any):
        self.space = env.action_space
        self.rng = np.random.default_rng(seed)
        self.best = np.zeros((self.space.shape[0], env.observation_space.shape[0] + 1))
        self.score, self.tried, self.total = -np.inf, self.best, 0.0

    def begin(self) -> None:
        self.tried = self.best + 0.3 * self.rng.standard_normal(self.best.shape)
        self.total = 0.0

    def act(self, observation: np.ndarray) -> np.ndarray:
        return np.tanh(self.tried @ np.append(observation, 1.0)).astype(np.float32)

    def see(self, decision: Decision) -> None:
        self.total += decision.reward

    def end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        if self.total > self.score:
            self.best, self.score = self.tried, self.total
        return {}

    def policy(self, description: Mapping[str, Any]) -> Policy:
        limits = {"action_low": self.space.low.tolist(), "action_high": self.space.high.tolist()}
        layer = (self.best[:, :-1].astype(np.float32), self.best[:, -1].astype(np.float32))
        return Policy([layer], {"format": "guiderail policy 1", "pool": 1, "squash": "tanh", **limits, **description})

    def has_diverged(self) -> bool:
        return not np.isfinite(self.best).all()

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        return {"best": self.best}, {"score": self.score, "random": self.rng.bit_generator.state}

    def restore(self, arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> None:
        self.best, self.score = arrays["best"], values["score"]
        self.rng.bit_generator.state = values["random"]


HILL_CLIMBING = LEARNERS.get("peglab_hill_climbing")
