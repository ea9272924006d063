"""Shared control templates: data, and control laws as functions of a state and a pose (thesis, section 2.3)."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce

import numpy as np

from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import did_you_mean
from guiderail.models.common.transforms import RigidTransform
from guiderail.models.control.wrench import norm_limits
from guiderail.models.templates.active_constraints import ActiveConstraint, ConstraintGroup, Outside, group_constraints
from guiderail.models.templates.consistency import describe, find_contradiction
from guiderail.models.templates.mappings import InputMapping
from guiderail.models.templates.parts import WORLD, Frames, StatePart, angle_between, between, largest
from guiderail.models.templates.transitions import TransitionDistance

INSIDE = 1e-9  # largest violation of a pose that counts as inside the constraints [m or rad]
MAX_START_DISTANCE = 0.2  # largest distance of a start from the constraints [m]; a larger value is probably in mm
MAX_START_ANGLE = 1.0  # largest angle between a start and the constraints [rad]; a larger value is probably in degrees
MAX_SPEED_RATIO = 1.0 + 1e-9  # accepted speed relative to its limit: rounding errors must not decide
BACKTRACKS = 8  # number of attempts to find an allowed displacement, each with a shorter displacement


@dataclass(frozen=True)
class Transition:
    """Transition from a source state to the state `to` when the distance of the source falls below a threshold.

    With a hysteresis, the template returns from `to` to the source when the distance of the source exceeds
    below + hysteresis.
    """

    to: str
    below: float  # threshold [m] or [rad], in the unit of the state's distance
    hysteresis: float | None = None  # return threshold minus `below` [m] or [rad]; None: no return


@dataclass(frozen=True)
class TemplateState:
    """Phase of a task: input mapping, active constraints and distance to the next phase."""

    name: str
    input_mapping: tuple[InputMapping, ...]
    active_constraints: tuple[ActiveConstraint, ...]  # applied in this order
    transition_distance: TransitionDistance
    starts_at: float  # typical distance at the beginning, at which the phase's own progress is zero [m] or [rad]
    ends_at: float  # distance at which the phase is complete [m] or [rad]
    weight: float = 1.0  # progress per unit of distance [1/m] or [1/rad]
    transitions: tuple[Transition, ...] = ()
    max_force_n: float | None = None  # largest force of the impedance [N]; None: limit of the task
    max_torque_nm: float | None = None  # largest torque of the impedance [Nm]; None: limit of the task
    # Largest speeds of the command, at most the limits of the template; None: limits of the template.
    max_speed_m_per_s: float | None = None
    max_speed_rad_per_s: float | None = None

    @property
    def limits_wrench(self) -> bool:
        """True if the state has its own limit of force or torque."""
        return self.max_force_n is not None or self.max_torque_nm is not None

    @property
    def frame_names(self) -> set[str]:
        """Names of the object frames that the state refers to."""
        parts: tuple[StatePart, ...] = (*self.input_mapping, *self.active_constraints, self.transition_distance)
        return {frame for part in parts for frame in part.frame_names}

    @cached_property
    def grouped_constraints(self) -> tuple[ActiveConstraint | ConstraintGroup, ...]:
        """Active constraints in order; consecutive constraints in the same frame form a group."""
        return group_constraints(self.active_constraints)

    @cached_property
    def has_linearized_constraints(self) -> bool:
        """True if a constraint is linearized at the last command."""
        return any(isinstance(constraint, Outside) for constraint in self.active_constraints)

    @cached_property
    def contradiction(self) -> str | None:
        """Sentence about active constraints that contradict each other; None if no contradiction is proven."""
        contradictory = find_contradiction(self.active_constraints)
        return f"{self.name}: {describe(self.active_constraints, contradictory)}" if contradictory else None


@dataclass(frozen=True)
class Command:
    """Allowed pose for a requested pose."""

    X_WE: RigidTransform  # pose of the end effector in the world
    fraction: float  # executed part of the requested displacement, from 0 (none) to 1 (all)


@dataclass(frozen=True)
class SharedControlTemplate:
    """Prior knowledge of a task as a state machine with input mappings and active constraints.

    Users and policies act through the same template. The argument `frames` of the methods contains the poses X_WF of
    the template's object frames by name.

    Attributes:
        name: Name of the template.
        inputs: Number of inputs, each in [−1, 1].
        frames: Names of the object frames.
        states: States in the order of the file, numbered from 0; at least one.
        initial_state: Number of the initial state.
        max_speed_m_per_s, max_speed_rad_per_s: Largest speeds of the command; a state may have lower limits.
        parameters: Values of the parameters in the expressions of the file, by name.
    """

    name: str
    inputs: int
    frames: tuple[str, ...]
    states: tuple[TemplateState, ...]
    initial_state: int
    max_speed_m_per_s: float
    max_speed_rad_per_s: float
    parameters: Mapping[str, float] = field(default_factory=dict)

    @property
    def limits_wrench(self) -> bool:
        """True if a state has its own limit of force or torque."""
        return any(state.limits_wrench for state in self.states)

    def max_wrench(self, state: int) -> np.ndarray:
        """Return the limits of force and torque of a state as the bound of an impedance, (8,); see `norm_limits`.

        Without a limit, the numbers are infinite.
        """
        declared = self.states[state]
        limits = (declared.max_force_n, declared.max_torque_nm)
        return norm_limits(*(math.inf if limit is None else limit for limit in limits))

    def index(self, state: str) -> int:
        """Return the number of the state with the name `state`.

        Raises:
            InputError: If there is no such state.
        """
        names = [candidate.name for candidate in self.states]
        if state not in names:
            raise InputError(f"{self.name} has no state {state!r}; {did_you_mean(state, names)}")
        return names.index(state)

    @cached_property
    def contradiction(self) -> str | None:
        """Sentence about the first state with a proven contradiction of its active constraints; None without one."""
        return next((state.contradiction for state in self.states if state.contradiction), None)

    def check_consistency(self) -> None:
        """Check that no active constraints of a state are proven to contradict each other.

        Raises:
            InputError: If a contradiction is proven.
        """
        if self.contradiction is not None:
            raise InputError(f"the template {self.name}, state {self.contradiction}")

    def check_start(self, X_WE: RigidTransform, frames: Frames) -> None:
        """Check that a start is close enough to the active constraints to move inside.

        Raises:
            InputError: If the start is farther outside than `MAX_START_DISTANCE` or `MAX_START_ANGLE`.
        """
        state = self.state_at(X_WE, frames)
        X_WP = self.project(state, X_WE, frames)
        distance = math.dist(X_WE.translation(), X_WP.translation())
        angle = angle_between(X_WE.rotation(), X_WP.rotation())
        if distance > MAX_START_DISTANCE or angle > MAX_START_ANGLE:
            raise InputError(
                f"the start is {distance:.3g} m and {angle:.3g} rad outside of the active constraints of the template "
                f"{self.name}, state {self.states[state].name}: start at most {MAX_START_DISTANCE} m and "
                f"{MAX_START_ANGLE:g} rad outside, and give poses of objects in meters and radians"
            )

    def without_active_constraints(self) -> "SharedControlTemplate":
        """Return the template with the same states, input mappings and distances, but no active constraints."""
        return replace(self, states=tuple(replace(state, active_constraints=()) for state in self.states))

    def map(
        self, state: int, inputs: np.ndarray, X_WE: RigidTransform, frames: Frames, period_s: float
    ) -> RigidTransform:
        """Return the displacement ΔH of one period [s] for inputs (n,), clipped to [−1, 1]: map_q (equation 2.19)."""
        inputs = np.clip(inputs, -1.0, 1.0)
        parts = [m.displacement(inputs, X_WE, frames, period_s) for m in self.states[state].input_mapping]
        return reduce(self.displace, parts, RigidTransform())

    @staticmethod
    def displace(X_WE: RigidTransform, displacement: RigidTransform) -> RigidTransform:
        """Return the displaced pose H^im: displace_q (equation 2.20).

        The pose is translated along the axes of the world and rotated about the origin of the end effector E.
        """
        return RigidTransform(
            displacement.rotation().matrix() @ X_WE.rotation().matrix(), X_WE.translation() + displacement.translation()
        )

    def project(self, state: int, X_WE: RigidTransform, frames: Frames) -> RigidTransform:
        """Return the pose H^ac after the state's active constraints, applied in order: project_q (equation 2.21)."""
        for constraint in self.states[state].grouped_constraints:
            X_WE = constraint.project(X_WE, frames)
        return X_WE

    def violation(self, state: int, X_WE: RigidTransform, frames: Frames) -> float:
        """Return the largest violation of an active constraint, in position [m] or angle [rad]; 0 inside."""
        return largest(c.violation(X_WE, frames) for c in self.states[state].grouped_constraints)

    def command(
        self, state: int, X_WLast: RigidTransform, X_WRequest: RigidTransform, frames: Frames, period_s: float
    ) -> Command:
        """Return an allowed pose that is reachable in one period and close to a request.

        If the projected request exceeds the largest speeds, the requested displacement is scaled down as a whole.
        Otherwise the orientation would lag behind the position near an object, where an orientation that depends on the
        position turns quickly. The displacement is also scaled down if one constraint undoes another.

        If the last command is inside the constraints, the new command is inside too: if `BACKTRACKS` attempts fail, the
        last command is repeated. If the last command is outside (at the start of an episode, or after an object moved),
        the commands move inside at the largest speed. Constraints to positions outside of a shape are linearized at the
        last command, so that the line to the new command is outside too.

        If the pose of an object is not finite, the returned pose is not finite either; callers check it.
        """
        # Scaled before the first projection, because projecting a distant request would change its direction.
        fraction = 1.0 / max(1.0, self._speed_ratio(state, X_WLast, X_WRequest, period_s))
        constraints = self._constraints_at(state, X_WLast, frames)
        for _ in range(BACKTRACKS):
            X_WE = between(X_WLast, X_WRequest, fraction)
            for constraint in constraints:
                X_WE = constraint.project(X_WE, frames)
            ratio = self._speed_ratio(state, X_WLast, X_WE, period_s)
            if ratio <= MAX_SPEED_RATIO and largest(each.violation(X_WE, frames) for each in constraints) <= INSIDE:
                return Command(X_WE, fraction)
            fraction *= 0.98 / ratio if ratio > MAX_SPEED_RATIO else 0.5
        if self._is_inside(state, X_WLast, frames):
            return Command(X_WLast, 0.0)
        X_WE = X_WLast
        for constraint in constraints:
            X_WE = constraint.project(X_WE, frames)
        ratio = self._speed_ratio(state, X_WLast, X_WE, period_s)
        return Command(X_WE if ratio <= MAX_SPEED_RATIO else between(X_WLast, X_WE, 1.0 / ratio), 0.0)

    def _constraints_at(
        self, state: int, X_WLast: RigidTransform, frames: Frames
    ) -> tuple[ActiveConstraint | ConstraintGroup, ...]:
        """Return the constraints of a state on the command after X_WLast, in their order."""
        phase = self.states[state]
        if not phase.has_linearized_constraints:
            return phase.grouped_constraints
        return group_constraints(
            constraint.at(X_WLast, frames) if isinstance(constraint, Outside) else constraint
            for constraint in phase.active_constraints
        )

    def can_enter(self, state: int, X_WLast: RigidTransform, frames: Frames, period_s: float) -> bool:
        """Return True if one period is enough to move from the last command into a state's active constraints."""
        X_WE = self.project(state, X_WLast, frames)
        is_reachable = self._speed_ratio(state, X_WLast, X_WE, period_s) <= MAX_SPEED_RATIO
        return is_reachable and self._is_inside(state, X_WE, frames)

    def _is_inside(self, state: int, X_WE: RigidTransform, frames: Frames) -> bool:
        return self.violation(state, X_WE, frames) <= INSIDE

    @cached_property
    def _max_speeds(self) -> tuple[tuple[float, float], ...]:
        """Largest speed [m/s] and angular speed [rad/s] of the command in each state."""
        max_v, max_w = self.max_speed_m_per_s, self.max_speed_rad_per_s
        limits = ((state.max_speed_m_per_s, state.max_speed_rad_per_s) for state in self.states)
        return tuple((max_v if v is None else min(max_v, v), max_w if w is None else min(max_w, w)) for v, w in limits)

    def _speed_ratio(self, state: int, X_WLast: RigidTransform, X_WE: RigidTransform, period_s: float) -> float:
        """Return the speed between two poses relative to a state's limit, the larger of translation and rotation."""
        difference = X_WE.translation() - X_WLast.translation()
        speed, angular_speed = self._max_speeds[state]
        return max(
            math.sqrt(difference @ difference) / (speed * period_s),
            angle_between(X_WLast.rotation(), X_WE.rotation()) / (angular_speed * period_s),
        )

    @cached_property
    def _exits(self) -> tuple[tuple[tuple[int, float, int, float], ...], ...]:
        """Exits of each state, first transitions, then returns.

        An exit is the state whose distance is tested, the sign of the test, the next state and the threshold.
        """
        forward: list[list[tuple[int, float, int, float]]] = [[] for _ in self.states]
        back: list[list[tuple[int, float, int, float]]] = [[] for _ in self.states]
        for number, state in enumerate(self.states):
            for transition in state.transitions:
                target = self.index(transition.to)
                forward[number].append((number, 1.0, target, transition.below))
                if transition.hysteresis is not None:
                    back[target].append((number, -1.0, number, transition.below + transition.hysteresis))
        return tuple(tuple(f + b) for f, b in zip(forward, back, strict=True))

    def next_state(self, state: int, X_WE: RigidTransform, frames: Frames, period_s: float | None = None) -> int:
        """Return the state after `state`, at most one transition away.

        If `period_s` is given, X_WE is the last command, and a state is only entered if one period is enough to move
        from X_WE into its constraints.
        """
        for source, sign, target, threshold in self._exits[state]:
            distance = self.distance(source, X_WE, frames)
            if sign * distance < sign * threshold:
                is_waiting = period_s is not None and not self.can_enter(target, X_WE, frames, period_s)
                return state if is_waiting else target
        return state

    def state_at(self, X_WE: RigidTransform, frames: Frames) -> int:
        """Return the state in which an episode begins at X_WE.

        The state is `initial_state`, or it is reached from there by the transitions that fire at X_WE.
        """
        state = self.initial_state
        for _ in self.states:
            state = self.next_state(state, X_WE, frames)
        return state

    def distance(self, state: int, X_WE: RigidTransform, frames: Frames) -> float:
        """Return the transition distance d_t of a state, [m] or [rad]."""
        return float(self.states[state].transition_distance.value(X_WE, frames))

    @cached_property
    def _initial_progress(self) -> tuple[float, ...]:
        """Progress at the beginning of each state, summed along first transitions; 0 for unreached states."""
        progress = [0.0] * len(self.states)
        number, visited = self.initial_state, {self.initial_state}
        while self.states[number].transitions:
            state = self.states[number]
            target = self.index(state.transitions[0].to)
            if target in visited:
                break
            progress[target] = progress[number] + state.weight * (state.starts_at - state.ends_at)
            visited.add(target)
            number = target
        return tuple(progress)

    def progress(self, state: int, X_WE: RigidTransform, frames: Frames) -> float:
        """Return the progress in the task.

        Progress is the progress of previous phases plus the weighted decrease of this phase's distance. The previous
        phases are the sequence of first transitions from the initial state to this phase.

        An increase of progress is d_{t−1} − d_t of equation 3.2, multiplied by the weight of the phase. Progress is
        continuous at a transition if the distance of the phase is `ends_at` and the distance of the next phase is its
        `starts_at`.
        """
        phase = self.states[state]
        return self._initial_progress[state] + phase.weight * (phase.starts_at - self.distance(state, X_WE, frames))


def check_template(template: object, frames: Frames) -> None:
    """Raise an InputError unless `template` is a template, or if `frames` has a pose of the world, without effect."""
    if not isinstance(template, SharedControlTemplate):
        raise InputError(f"a template is a SharedControlTemplate, as load_template returns, not {brief(template)}")
    if WORLD in frames:
        raise InputError(f"the frame {WORLD} of a template can't be moved: leave its pose out, or add a frame")
