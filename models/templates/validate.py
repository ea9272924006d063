"""What `guiderail check TEMPLATE.yaml` asks of a template, beyond what loading it refuses.

The checks sample: they place the template's objects and the end effector at random near each other and look at what the
laws do. A mistake that shows in one pose of a few hundred is found, a rarer one may not be.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from guiderail.models.templates.geometry import Frames, angle_between
from guiderail.models.templates.template import SharedControlTemplate

SAMPLES = 200
REACH = 0.6  # [m] how far from an object poses are sampled
TOLERANCE = 1e-9  # [m or rad]
GREEDY_STEPS = 400
GREEDY_PERIOD = 0.05  # [s]
CONTROL_PERIOD = 0.01  # [s]
ARRIVALS = 5  # at each transition

Scenes = Sequence[tuple[RigidTransform, Frames]]


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong, or odd."""

    is_error: bool
    message: str


def validate(template: SharedControlTemplate, seed: int = 0) -> list[Finding]:
    """Everything that was found, errors first."""
    rng = np.random.default_rng(seed)
    scenes = [_scene(template, rng) for _ in range(SAMPLES)]
    findings = [
        *_unused(template),
        *_unreachable(template),
        *_constraints(template, scenes),
        *_transitions(template, scenes, rng),
        *_jumps(template, scenes),
    ]
    return sorted(findings, key=lambda finding: not finding.is_error)


def _scene(
    template: SharedControlTemplate, rng: np.random.Generator
) -> tuple[RigidTransform, dict[str, RigidTransform]]:
    """An end effector at random near upright objects that stand at random."""
    frames = {}
    for name in template.frames:
        yaw = RotationMatrix.MakeZRotation(rng.uniform(-np.pi, np.pi))
        frames[name] = RigidTransform(yaw, rng.uniform(-0.3, 0.3, 3))
    X_WF = frames[template.frames[rng.integers(len(frames))]] if frames else RigidTransform()
    # As many poses near as far: constraints are closest to each other near an object.
    p_FE = rng.normal(size=3)
    p_FE *= REACH * rng.uniform() / np.linalg.norm(p_FE)
    R_FE = RotationMatrix(Rotation.random(rng=rng).as_matrix())
    return RigidTransform(X_WF.rotation() @ R_FE, X_WF @ p_FE), frames


def _unused(template: SharedControlTemplate) -> Iterator[Finding]:
    used = {i for state in template.states for mapping in state.input_mapping for i in mapping.used_inputs}
    for i in sorted(set(range(template.inputs)) - used):
        yield Finding(False, f"input {i} moves nothing in any state; lower `inputs` or map it")
    named = {frame for state in template.states for frame in state.frame_names}
    for frame in sorted(set(template.frames) - named):
        yield Finding(False, f"the frame {frame} is never used; leave it out")


def _unreachable(template: SharedControlTemplate) -> Iterator[Finding]:
    reached, waiting = set(), [template.initial_state]
    while waiting:
        number = waiting.pop()
        if number not in reached:
            reached.add(number)
            waiting += [template.index(transition.to) for transition in template.states[number].transitions]
    for number, state in enumerate(template.states):
        if number not in reached:
            yield Finding(True, f"no transition leads to the state {state.name}; add one, or leave the state out")


def _constraints(template: SharedControlTemplate, scenes: Scenes) -> Iterator[Finding]:
    """Each constraint idempotent; their sequence too, and inside every one of them."""
    for number, state in enumerate(template.states):
        for i, constraint in enumerate(state.active_constraints):
            name = f"{state.name}: active constraint {i + 1} ({type(constraint).__name__})"
            worst = max(constraint.violation(constraint.project(X, frames), frames) for X, frames in scenes)
            if worst > TOLERANCE:
                yield Finding(True, f"{name} is not idempotent: projecting twice moves by {worst:.2g} m or rad")
        outside = np.zeros(len(state.active_constraints))
        again = 0.0
        for X, frames in scenes:
            X_WP = template.project(number, X, frames)
            outside += [c.violation(X_WP, frames) > TOLERANCE for c in state.active_constraints]
            again = max(again, _difference(template.project(number, X_WP, frames), X_WP))
        for i in np.flatnonzero(outside).tolist():
            kind = type(state.active_constraints[i]).__name__
            if outside[i] == len(scenes):
                why = "contradicts the constraints after it; no pose satisfies them all"
            else:
                why = (
                    f"is undone by a constraint after it in {outside[i] / len(scenes):.0%} of the poses; "
                    "put it last, or make room for both"
                )
            yield Finding(True, f"{state.name}: active constraint {i + 1} ({kind}) {why}")
        if again > TOLERANCE and not outside.any():
            yield Finding(True, f"{state.name}: the constraints in their order are not idempotent ({again:.2g})")


def _difference(X_WA: RigidTransform, X_WB: RigidTransform) -> float:
    """The larger of metres and radians between two poses."""
    return max(
        float(np.linalg.norm(X_WA.translation() - X_WB.translation())),
        angle_between(X_WA.rotation(), X_WB.rotation()),
    )


def _transitions(template: SharedControlTemplate, scenes: Scenes, rng: np.random.Generator) -> Iterator[Finding]:
    """Some inputs, from some pose inside a state's constraints, bring its distance below every threshold."""
    for number, state in enumerate(template.states):
        goals = [(f"the transition to {t.to}", t.below) for t in state.transitions]
        goals = goals or [("the end", state.ends_at + TOLERANCE)]
        lowest = min(threshold for _, threshold in goals)
        starts = sorted(
            ((template.project(number, X, frames), frames) for X, frames in scenes),
            key=lambda start: template.distance(number, *start),
        )
        # From the nearest pose, and from where a phase begins: either proves that the distance can get there.
        best = np.inf
        for X, frames in [starts[0], *starts[len(starts) // 2 :: len(starts) // 8]]:
            best = min(best, _greedy(template, number, X, frames, lowest)[0])
            if best < lowest:
                break
        for goal, threshold in goals:
            if best > threshold:
                inside = template.distance(number, *starts[0])
                why = (
                    "no input leads there" if inside <= threshold else "the active constraints keep it away from there"
                )
                yield Finding(
                    True, f"{state.name}: {goal} never fires: {why} (nearest {best:.3g}, threshold {threshold:.3g})"
                )
        if all(template.distance(number, X, frames) < lowest for X, frames in starts):
            yield Finding(False, f"{state.name}: every pose is below the threshold; the state is left at once")


def _greedy(
    template: SharedControlTemplate,
    number: int,
    X_WE: RigidTransform,
    frames: Frames,
    enough: float,
    period: float = GREEDY_PERIOD,
) -> tuple[float, RigidTransform]:
    """The least distance that the single input that lowers it most, chosen anew at every step, reaches, and where."""
    candidates = [sign * row for row in np.eye(template.inputs) for sign in (1.0, -1.0)]
    best = template.distance(number, X_WE, frames)
    for _ in range(GREEDY_STEPS):
        options = []
        for inputs in candidates:
            request = template.displace(X_WE, template.map(number, inputs, X_WE, frames, period))
            X = template.command(number, X_WE, request, frames, period).X_WE
            options.append((template.distance(number, X, frames), X))
        distance, X_WE = min(options, key=lambda option: option[0])
        if distance > best - 1e-6 * period:
            return min(best, distance), X_WE
        best = distance
        if best < enough:
            return best, X_WE
    return best, X_WE


def _jumps(template: SharedControlTemplate, scenes: Scenes) -> Iterator[Finding]:
    """Where a transition is due, one control step leads into the next state's constraints; otherwise it waits."""
    reach = GREEDY_PERIOD * max(template.max_speed_m_per_s, template.max_speed_rad_per_s)
    for number, state in enumerate(template.states):
        inside = [(template.project(number, X, frames), frames) for X, frames in scenes]
        for transition in state.transitions:
            target, arrived, waiting, worst = template.index(transition.to), 0, 0, 0.0
            before = [start for start in inside if template.distance(number, *start) >= transition.below]
            for X, frames in before[:ARRIVALS]:
                # Slowly where it comes near, or it would arrive farther beyond the threshold than a control step leads.
                _, X_WE = _greedy(template, number, X, frames, transition.below + reach)
                distance, X_WE = _greedy(template, number, X_WE, frames, transition.below, CONTROL_PERIOD)
                if distance < transition.below:
                    arrived += 1
                    waiting += not template.can_enter(target, X_WE, frames, CONTROL_PERIOD)
                    worst = max(worst, template.violation(target, X_WE, frames))
            if waiting:
                yield Finding(
                    False,
                    f"{state.name}: the transition to {transition.to} waits in {waiting} of {arrived} arrivals, as the "
                    f"command is up to {worst:.2g} m or rad outside of the next state's constraints; let them meet at "
                    "the threshold",
                )
