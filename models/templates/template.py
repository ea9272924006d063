"""A shared control template: its data, and its laws as functions of a state and a pose (thesis, section 2.3)."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce

import numpy as np
from pydrake.math import RigidTransform

from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import did_you_mean
from guiderail.models.templates.constraints import ActiveConstraint, ConstraintGroup, group_constraints
from guiderail.models.templates.geometry import Frames, angle_between, between, largest
from guiderail.models.templates.mappings import InputMapping
from guiderail.models.templates.transitions import TransitionDistance

INSIDE = 1e-9  # [m or rad] a pose that violates by no more than this is inside the constraints
BACKTRACKS = 8  # shortenings of a displacement before the command stays where it is


@dataclass(frozen=True)
class Transition:
    """Leaves a state for `to` when the state's distance falls below a threshold.

    With a hysteresis it also leads back: from `to` to the state, when the state's distance exceeds below + hysteresis.
    """

    to: str
    below: float  # [m] or [rad], in the unit of the state's distance
    hysteresis: float | None = None  # [m] or [rad]; None: it does not lead back


@dataclass(frozen=True)
class TemplateState:
    """One phase: what inputs do, where the end effector may be, and how far it is to the next phase."""

    name: str
    input_mapping: tuple[InputMapping, ...]
    active_constraints: tuple[ActiveConstraint, ...]  # applied in this order
    transition_distance: TransitionDistance
    starts_at: float  # [m] or [rad] distance at which the phase typically begins: the zero of its progress
    ends_at: float  # [m] or [rad] distance at which the phase is done
    weight: float = 1.0  # [1/m] or [1/rad] how much progress one unit of distance is
    transitions: tuple[Transition, ...] = ()

    @property
    def frame_names(self) -> set[str]:
        """The objects' frames that it needs."""
        parts: list[InputMapping | ActiveConstraint | TransitionDistance] = [*self.input_mapping]
        parts += [*self.active_constraints, self.transition_distance]
        return {frame for part in parts for frame in part.frame_names}

    @cached_property
    def grouped_constraints(self) -> tuple[ActiveConstraint | ConstraintGroup, ...]:
        """The active constraints, those in one frame together."""
        return group_constraints(self.active_constraints)


@dataclass(frozen=True)
class Command:
    """What the constraints made of a request."""

    X_WE: RigidTransform
    fraction: float  # how much of the requested displacement was possible: 1 all of it, 0 the command stays


@dataclass(frozen=True)
class SharedControlTemplate:
    """What is known about a task, written down once; a person and a policy act through it alike.

    States are numbered in the order of the file. `frames` are the names of the objects' frames; wherever a method
    takes `frames`, it is their poses X_WF by name.

    Attributes:
        name: of the template.
        inputs: how many numbers, each in [−1, 1], a person or a policy gives.
        frames: the names of the objects' frames.
        states: at least one, numbered from 0.
        initial_state: its number.
        max_speed_m_per_s, max_speed_rad_per_s: of what is commanded.
        parameters: the numbers that the file's arithmetic was done with, by name.
    """

    name: str
    inputs: int
    frames: tuple[str, ...]
    states: tuple[TemplateState, ...]
    initial_state: int
    max_speed_m_per_s: float
    max_speed_rad_per_s: float
    parameters: Mapping[str, float] = field(default_factory=dict)

    def index(self, state: str) -> int:
        """The number of the state called `state`.

        Raises:
            InputError: if there is none.
        """
        for number, candidate in enumerate(self.states):
            if candidate.name == state:
                return number
        raise InputError(f"{self.name} has no state {state!r}; {did_you_mean(state, [s.name for s in self.states])}")

    def without_active_constraints(self) -> "SharedControlTemplate":
        """The same template with its input mappings, states and distances, and nothing that holds anyone back."""
        return replace(self, states=tuple(replace(state, active_constraints=()) for state in self.states))

    def map(
        self, state: int, inputs: np.ndarray, X_WE: RigidTransform, frames: Frames, period_s: float
    ) -> RigidTransform:
        """map_q, equation 2.19: the displacement ΔH that the inputs (n,), clipped to [−1, 1], ask for in one period."""
        inputs = np.clip(inputs, -1.0, 1.0)
        parts = [m.displacement(inputs, X_WE, frames, period_s) for m in self.states[state].input_mapping]
        return reduce(self.displace, parts, RigidTransform())

    @staticmethod
    def displace(X_WE: RigidTransform, displacement: RigidTransform) -> RigidTransform:
        """displace_q, equation 2.20: H^im, translated in the world and rotated about the end effector's origin."""
        return RigidTransform(
            displacement.rotation().multiply(X_WE.rotation()), X_WE.translation() + displacement.translation()
        )

    def project(self, state: int, X_WE: RigidTransform, frames: Frames) -> RigidTransform:
        """project_q, equation 2.21: H^ac, the state's active constraints applied in their order."""
        for constraint in self.states[state].grouped_constraints:
            X_WE = constraint.project(X_WE, frames)
        return X_WE

    def violation(self, state: int, X_WE: RigidTransform, frames: Frames) -> float:
        """How far X_WE is outside of the worst active constraint, the larger of [m] and [rad]; 0 inside."""
        return largest(c.violation(X_WE, frames) for c in self.states[state].grouped_constraints)

    def command(
        self, state: int, X_WLast: RigidTransform, X_WRequest: RigidTransform, frames: Frames, period_s: float
    ) -> Command:
        """The pose nearest to a request that the constraints allow and that one period can reach from the last command.

        A constraint may ask for more than it seems: an orientation that depends on the position turns quickly where
        the position is near the object. Where the projected request is too far away for the template's greatest speeds,
        it is the displacement that is scaled down, so that the orientation never lags behind the position; likewise
        where one constraint undoes another. From a last command that is inside, a command is always inside. One that
        is outside (an episode begins there, or an object has moved) is led inside at the greatest speed.
        """
        # Within reach before it is projected: of a request far away, the projection alone would not tell a direction.
        fraction = 1.0 / max(1.0, self._load(X_WLast, X_WRequest, period_s))
        for _ in range(BACKTRACKS):
            X_WE = self.project(state, between(X_WLast, X_WRequest, fraction), frames)
            load = self._load(X_WLast, X_WE, period_s)
            if load <= 1.0 and self._is_inside(state, X_WE, frames):
                return Command(X_WE, fraction)
            fraction *= 0.98 / load if load > 1.0 else 0.5
        if self._is_inside(state, X_WLast, frames):
            return Command(X_WLast, 0.0)
        X_WE = self.project(state, X_WLast, frames)
        load = self._load(X_WLast, X_WE, period_s)
        return Command(X_WE if load <= 1.0 else between(X_WLast, X_WE, 1.0 / load), 0.0)

    def can_enter(self, state: int, X_WLast: RigidTransform, frames: Frames, period_s: float) -> bool:
        """Whether one period leads from the last command into a state's active constraints."""
        X_WE = self.project(state, X_WLast, frames)
        return self._load(X_WLast, X_WE, period_s) <= 1.0 and self._is_inside(state, X_WE, frames)

    def _is_inside(self, state: int, X_WE: RigidTransform, frames: Frames) -> bool:
        return self.violation(state, X_WE, frames) <= INSIDE

    def _load(self, X_WLast: RigidTransform, X_WE: RigidTransform, period_s: float) -> float:
        """The share of the greatest speeds that the way between two commands needs."""
        difference = X_WE.translation() - X_WLast.translation()
        return max(
            math.sqrt(difference @ difference) / (self.max_speed_m_per_s * period_s),
            angle_between(X_WLast.rotation(), X_WE.rotation()) / (self.max_speed_rad_per_s * period_s),
        )

    @cached_property
    def _ways(self) -> tuple[tuple[tuple[int, float, int, float], ...], ...]:
        """For each state, (state of the distance, sign, next state, threshold), forward transitions first."""
        forward: list[list] = [[] for _ in self.states]
        back: list[list] = [[] for _ in self.states]
        for number, state in enumerate(self.states):
            for transition in state.transitions:
                target = self.index(transition.to)
                forward[number].append((number, 1.0, target, transition.below))
                if transition.hysteresis is not None:
                    back[target].append((number, -1.0, number, transition.below + transition.hysteresis))
        return tuple(tuple(f + b) for f, b in zip(forward, back, strict=True))

    def next_state(self, state: int, X_WE: RigidTransform, frames: Frames, period_s: float | None = None) -> int:
        """The state after `state`, at most one transition away.

        With `period_s`, X_WE is the last command: a state is not entered while its constraints are out of its reach.
        """
        for source, sign, target, threshold in self._ways[state]:
            distance = self.states[source].transition_distance.value(X_WE, frames)
            if sign * distance < sign * threshold:
                waits = period_s is not None and not self.can_enter(target, X_WE, frames, period_s)
                return state if waits else target
        return state

    def state_at(self, X_WE: RigidTransform, frames: Frames) -> int:
        """The state that an episode begins in at X_WE.

        It is `initial_state`; where a transition fires there, the state that this leads to, and so on.
        """
        state = self.initial_state
        for _ in self.states:
            state = self.next_state(state, X_WE, frames)
        return state

    def distance(self, state: int, X_WE: RigidTransform, frames: Frames) -> float:
        """The transition distance d_t of a state, [m] or [rad]."""
        return self.states[state].transition_distance.value(X_WE, frames)

    @cached_property
    def _done_before(self) -> tuple[float, ...]:
        """The progress with which each state begins: what the states on the way to it are worth."""
        done = [0.0] * len(self.states)
        number, seen = self.initial_state, {self.initial_state}
        while self.states[number].transitions:
            state = self.states[number]
            target = self.index(state.transitions[0].to)
            if target in seen:
                break
            done[target] = done[number] + state.weight * (state.starts_at - state.ends_at)
            seen.add(target)
            number = target
        return tuple(done)

    def progress(self, state: int, X_WE: RigidTransform, frames: Frames) -> float:
        """How much of the task is done: the phases before, and what this one's distance has lost, weighted.

        An increase of progress is d_{t−1} − d_t of equation 3.2, for all phases on one scale. It is continuous across
        a transition where the next phase's distance is its starts_at there.
        """
        phase = self.states[state]
        return self._done_before[state] + phase.weight * (phase.starts_at - self.distance(state, X_WE, frames))
