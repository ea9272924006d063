"""Wrenches in contact: measurement at a tool, and bounds of pushes, impacts and the energy of a controller's spring.

The six limits of a bound are [translational, rotational], along and about the controller's axes. See
`docs/concepts/forces.md`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from guiderail.models.common.arrays import as_numbers, cross, is_finite, norm
from guiderail.models.common.errors import InputError, brief

POSE_ORDER = [0, 1, 2, 5, 4, 3]  # indices of the pose coordinates [x y z Rz Ry Rx] in a wrench, and vice versa

MAX_WRENCH_SIZE = 8
"""Size of a bound as a signal: six limits along and about the axes, and the limits of the norms of force and torque."""

# Limits of the force along x, y and z as fractions of the limit of its norm; the norm of these fractions is below 1.
# They favor z, the direction of insertion.
FORCE_SHARES = (0.45, 0.45, 0.75)


@dataclass(frozen=True, eq=False)  # no `==`, because the comparison of arrays is an array
class WrenchBound:
    """Limits of an impedance controller's wrench, per axis and as norms, and the assumed contact stiffness.

    Raises:
        InputError: If `axes` are not six numbers, or a number is negative or NaN.
    """

    axes: np.ndarray  # limits (6,) of [fx fy fz tx ty tz] along and about the axes [N, Nm], not negative
    force: float  # limit of the norm of the force [N], not negative
    torque: float  # limit of the norm of the torque [Nm], not negative
    # Largest stiffness of workpiece, grasp and fixture in series for which impacts are inside the bound [N/m], not
    # negative. With 0, the approach speed is not limited.
    contact_stiffness: float = 0.0
    contact_lever: float = 0.0  # largest distance of a contact from the tool center [m], not negative

    def __post_init__(self) -> None:
        numbers = (*np.ravel(self.axes), self.force, self.torque, self.contact_stiffness, self.contact_lever)
        if np.shape(self.axes) != (6,) or not all(number >= 0.0 for number in numbers):
            raise InputError(
                "the bound of a wrench is six limits, two norms, a stiffness and a lever, none negative, not "
                f"{self.axes}, {self.force}, {self.torque}, {self.contact_stiffness} and {self.contact_lever}"
            )

    @property
    def numbers(self) -> np.ndarray:
        """Bound as a signal (8,): `axes`, `force` and `torque`."""
        return np.array([*self.axes, self.force, self.torque])

    @cached_property
    def in_pose_order(self) -> WrenchBound:
        """Bound with its axes in the order of a pose, [x y z Rz Ry Rx]."""
        return replace(self, axes=self.axes[POSE_ORDER])

    def lowered_to(self, max_wrench: np.ndarray) -> WrenchBound:
        """Return the element-wise minimum of this bound and `max_wrench` (8,), with 0 for negative and NaN entries.

        A bound that arrives at run time can therefore only lower the configured bound.
        """
        return _lowered(self, np.asarray(max_wrench, dtype=float).tobytes())


@lru_cache(maxsize=16)  # several systems request the same bound at every plant step
def _lowered(bound: WrenchBound, max_wrench: bytes) -> WrenchBound:
    requested = np.frombuffer(max_wrench)
    lowest = np.minimum(bound.numbers, np.where(requested > 0.0, requested, 0.0))
    lowest.setflags(write=False)
    return replace(bound, axes=lowest[:6], force=float(lowest[6]), torque=float(lowest[7]))


def norm_limits(force: float = np.inf, torque: float = np.inf) -> np.ndarray:
    """Return a bound as a signal (8,) that limits the norms of force [N] and torque [Nm]; infinite numbers do not.

    The force along the axes is limited to `FORCE_SHARES` of `force`, and the torque about each axis to `torque` / √3,
    so that the norms never exceed the limits.

    Raises:
        InputError: If the force or the torque is not positive.
    """
    if not (force > 0.0 and torque > 0.0):
        raise InputError(f"limits of force and torque must be positive, not {force} N and {torque} Nm")
    axes = np.concatenate([force * np.array(FORCE_SHARES), np.full(3, torque / math.sqrt(3.0))])
    return np.array([*axes, norm(axes[:3]), norm(axes[3:])])


def approach_bound(bound: np.ndarray, target: np.ndarray, max_change: np.ndarray) -> np.ndarray:
    """Move a bound on a straight line towards the bound `target`, by at most `max_change` in each number.

    If the limits of the norms are at least the limits per axis at both ends, this holds on the whole line. Both bounds
    are finite signals (8,), and `max_change` (8,) is positive.

    Raises:
        InputError: If a number of a bound is not finite.
    """
    if not (is_finite(bound) and is_finite(target)):
        raise InputError(f"the bounds of an approach must be finite, not {brief(bound)} and {brief(target)}")
    change = target - bound
    excess = float(np.max(np.abs(change) / max_change))
    return target.copy() if excess <= 1.0 else bound + change / excess


PRESSED = 0.5  # share of the force by which the torque of a turning tool is reduced; see `slow_down`


class MovingInertia(NamedTuple):
    """Inertia that moves with a tool: a mass [kg] and a moment of inertia [kg m²], both positive."""

    mass: float
    moment: float


def clip_wrench(wrench: np.ndarray, axes: np.ndarray, force: float, torque: float) -> np.ndarray:
    """Clip a wrench (6,) to limits per axis (6,), then scale force and torque to the limits of their norms."""
    clipped = np.minimum(np.maximum(wrench, -axes), axes)
    for block, limit in ((clipped[:3], force), (clipped[3:], torque)):
        magnitude = norm(block)
        if magnitude > limit:
            block *= limit / magnitude
    return clipped


def slow_down(
    spring: np.ndarray, damping: np.ndarray, velocity: np.ndarray, inertia: MovingInertia, bound: WrenchBound
) -> np.ndarray:
    """Limit a spring's wrench (6,), so that no point of contact becomes faster than F / c.

        |s| ≤ F − (c − d) |v| − c l |ω|,    κ |t| ≤ F − |s| / 2 − c |v| − (c l − κ d_ω) |ω|,    κ = l m / I

    s and t are the spring's force and torque, v and ω the tool's velocities, and l is the largest distance of a contact
    from the tool center. c = 2 √(k m) is the `approach_impedance`. d = vᵀ D v / |v|² is the damping in the direction of
    motion, and d_ω that of the rotation. A contact has at most the speed u = |v| + l |ω|, and the force |s| + κ |t|
    that accelerates the mass m there is at most 1.5 (F − c u), so that u stays below F / c. With |s| in place of half
    of it, a bayonet could not be turned while a stiff impedance presses it. Only a force or torque that does positive
    work is reduced. No energy is therefore added: while it relaxes, the spring returns at most the energy that it
    stored.

    Args:
        spring: Wrench of the spring (6,) [N, Nm].
        damping: Wrench D v (6,) of the damper [N, Nm].
        velocity: Translational and rotational velocity (6,) [m/s, rad/s].
        inertia: Moving mass m and moment of inertia I.
        bound: Bound of the wrench, with F, the stiffness k of the contact, and l.
    """
    # Python numbers: NumPy's overhead would exceed the computation, which runs at every plant step.
    sx, sy, sz, tx, ty, tz = spring.tolist()
    vx, vy, vz, wx, wy, wz = velocity.tolist()
    lever = bound.contact_lever
    pushes, turns = sx * vx + sy * vy + sz * vz > 0.0, tx * wx + ty * wy + tz * wz > 0.0 and lever > 0.0
    if not (pushes or turns):
        return spring
    impedance = approach_impedance(bound.contact_stiffness, inertia.mass)
    push, speed, turn = math.hypot(sx, sy, sz), math.hypot(vx, vy, vz), math.hypot(wx, wy, wz)
    push_share = turn_share = 1.0
    if pushes:
        limit = bound.force - max(0.0, impedance * speed - float(damping[:3].dot(velocity[:3])) / speed)
        push_share = _share(push, limit - impedance * lever * turn)
    if turns:
        weight = lever * inertia.mass / inertia.moment
        limit = bound.force - PRESSED * push_share * push - impedance * speed
        limit -= max(0.0, impedance * lever * turn - weight * float(damping[3:].dot(velocity[3:])) / turn)
        turn_share = _share(weight * math.hypot(tx, ty, tz), limit)
    return spring if push_share == turn_share == 1.0 else spring * ([push_share] * 3 + [turn_share] * 3)


def _share(size: float, limit: float) -> float:
    """Return the share, from 0 to 1, of a number that is at most `limit`."""
    return 1.0 if size <= limit else max(0.0, limit) / size


def approach_impedance(contact_stiffness: float, mass: float) -> float:
    """Return c = 2 √(k m) [N s/m], the critical damping of a mass m [kg] in contact with a stiffness k [N/m].

    A mass that is pushed with F − c |v| reaches at most the speed F / c. In contact with a stiffness of at most k, it
    presses with at most F, because it does not overshoot. With half of this c, it would press with 1.3 F.
    """
    return 2.0 * math.sqrt(contact_stiffness * mass)


def impact_ratio(stiffness_ratio: float, mass_share: float = 1.0) -> float:
    """Return the largest force of an impact relative to the limit F, at the speeds that `slow_down` admits.

    A tool that does not turn presses with F − c v, and its peak force is the first maximum p of k_c x for
    m x'' + c x' + k_c x = F with x'(0) = F / c: 1 up to the assumed stiffness k, and 1.07, 1.30, 1.68 at 2, 4 and 8
    times k. A tool that presses and turns pushes a contact at its lever with up to 1.5 (F − c u), where it has the mass
    μ m, and then the peak is 1.5 μ p(k_c / (1.5² μ k)) F.

    Args:
        stiffness_ratio: Stiffness k_c of the contact relative to k.
        mass_share: μ = 1 / (1 + l² m / I), at most 1: the mass at the lever relative to the moving mass.
    """
    driven = 2.0 - PRESSED
    turning = driven * mass_share * _peak(stiffness_ratio / (driven**2 * mass_share))
    return max(_peak(stiffness_ratio), turning)


def _peak(stiffness_ratio: float) -> float:
    if stiffness_ratio <= 1.0:
        return 1.0
    root = math.sqrt(stiffness_ratio)
    phase = (math.pi - math.acos(1.0 / root)) / math.sqrt(stiffness_ratio - 1.0)
    return 1.0 + 0.5 * root * math.exp(-phase)


def bounded_wrench(
    spring: np.ndarray, damping: np.ndarray, velocity: np.ndarray, inertia: MovingInertia, bound: WrenchBound
) -> np.ndarray:
    """Compute s − β d (6,) of a clipped spring s and a damper d, with the largest β ≤ 1 for which it is in the bound.

    The clipped spring has a potential, and the damper dissipates for every β. For a constant bound and a constant rest
    position, the law is therefore passive.

    Args:
        spring: Wrench of the spring (6,) [N, Nm].
        damping: Wrench d of the damper (6,) [N, Nm].
        velocity: Translational and rotational velocity (6,) [m/s, rad/s].
        inertia: Moving mass and moment of inertia in the direction of the velocity.
        bound: Bound, along the axes of the wrenches.
    """
    s = clip_wrench(spring, bound.axes, bound.force, bound.torque)
    # A force that brakes at its limit leaves no room for the damper, on which the limit of the torque relies.
    share = damping_share(s, damping, bound)
    slow = slow_down(s, share * damping, velocity, inertia, bound)
    return slow - (share if slow is s else damping_share(slow, damping, bound)) * damping


def damping_share(spring: np.ndarray, damping: np.ndarray, bound: WrenchBound) -> float:
    """Return the largest β in [0, 1] with s − β d inside the bound, for a spring s (6,) inside and a damper d (6,)."""
    wrench = spring - damping
    f, t = wrench[:3], wrench[3:]
    if (np.abs(wrench) <= bound.axes).all() and f.dot(f) <= bound.force**2 and t.dot(t) <= bound.torque**2:
        return 1.0
    # Distance to the limit in the direction of −d, per axis.
    towards = np.where(damping > 0.0, bound.axes + spring, bound.axes - spring)
    shares = np.divide(towards, np.abs(damping), out=np.full(6, np.inf), where=damping != 0.0)
    share = min(1.0, float(shares.min()))
    for block, limit in ((slice(0, 3), bound.force), (slice(3, 6), bound.torque)):
        s, d = spring[block], damping[block]
        dd, sd, slack = float(d.dot(d)), float(s.dot(d)), limit**2 - float(s.dot(s))
        if dd > 0.0 and math.isfinite(slack):
            # β is the larger root of ‖s − β d‖² = limit².
            share = min(share, (sd + math.sqrt(max(sd * sd + dd * slack, 0.0))) / dd)
    return max(share, 0.0)


def governed_error(
    stiffness: np.ndarray,
    damping: np.ndarray,
    error: np.ndarray,
    velocity: np.ndarray,
    inertia: MovingInertia,
    step: float,
    bound: WrenchBound,
) -> np.ndarray:
    """Limit the pose error (6,) of a spring and damper for one simulation step, so that their force is in the bound.

    The plant integrates spring and damper implicitly: their force in the step is K e − (K h + D) v₁ with the velocity
    v₁ after the step. If |v₁| ≤ |v₀|, as in an impact, the force is inside the bound, provided that K e is inside the
    bound reduced by (K h + D) |v₀|. The torque is at most F I / (c l h), so that a step from rest makes no contact
    faster than F / c (see `slow_down`).

    Args:
        stiffness: Stiffness (6,) K of each coordinate [N/m, Nm/rad], positive.
        damping: Damping (6,) D of each coordinate [N s/m, Nm s/rad].
        error: Pose error (6,) e [m, rad].
        velocity: Velocity (6,) v₀ before the step [m/s, rad/s].
        inertia: Moving mass and smallest moment of inertia.
        step: Time step h [s].
        bound: Bound, with axes in the order of the coordinates.
    """
    implicit = (stiffness * step + damping) * np.abs(velocity)
    force, torque = norm(implicit[:3]), norm(implicit[3:])
    lever = approach_impedance(bound.contact_stiffness, inertia.mass) * bound.contact_lever * step
    max_torque = min(bound.torque, bound.force * inertia.moment / lever) if lever > 0.0 else bound.torque
    spring = clip_wrench(stiffness * error, bound.axes, bound.force, max_torque)
    spring = clip_wrench(
        slow_down(spring, damping * velocity, velocity, inertia, bound),
        np.maximum(bound.axes - implicit, 0.0),
        max(bound.force - force, 0.0),
        max(bound.torque - torque, 0.0),
    )
    return spring / stiffness


def center_of_pressure(wrench: np.ndarray, min_force: float) -> np.ndarray:
    """Compute the center of pressure (−τ_y, τ_x) / f_z (2,) [m] of a wrench about the tool center (6,), force first.

    If the normal force is below `min_force` [N], positive, the result is zero, because the quotient is not reliable.
    """
    if not wrench[2] >= min_force:  # for NaN too
        return np.zeros(2)
    return np.array([-wrench[4], wrench[3]]) / wrench[2]


@dataclass
class ContactPointMean:
    """Mean of the points of contact of a tool on a fixed surface, a running and then an exponential mean.

        n' = min(n + 1, N),  m' = m + (p + c − m) / n'   if f_z ≥ min_force, otherwise unchanged

    p is the tool's position in x and y, and c its center of pressure. A plug on a rim tips between two points of
    contact, each of which is up to a quarter turn beside the direction of the rim's center. Their mean shows it.

    Attributes:
        min_force: Force along z below which a sample is not used [N], positive.
        largest: Number N of samples, at least 1.
        mean: Mean m, (2,) [m].
        count: Number n of samples in the mean; 0 before the first contact.
    """

    min_force: float
    largest: float
    mean: np.ndarray = field(default_factory=lambda: np.zeros(2))
    count: float = 0.0

    def add(self, pose: np.ndarray, wrench: np.ndarray) -> None:
        """Add a sample, if it is finite: pose (6,) of the tool center, and wrench (6,) about it, force first."""
        if wrench[2] >= self.min_force and is_finite(wrench) and is_finite(pose):
            self.count = min(self.count + 1.0, self.largest)
            point = pose[:2] + center_of_pressure(wrench, self.min_force)
            self.mean = self.mean + (point - self.mean) / self.count

    def relative_to(self, pose: np.ndarray) -> np.ndarray:
        """Return the mean relative to the tool center at `pose` (6,), (2,) [m]; zero before the first contact."""
        return self.mean - pose[:2] if self.count else np.zeros(2)


def external_wrench(
    F_reaction: np.ndarray, M: np.ndarray, V: np.ndarray, A: np.ndarray, gravity: np.ndarray
) -> np.ndarray:
    """Compute the external wrench on a rigid tool, F_external = M A + bias(V) − M [0, g] − F_reaction.

    Spatial vectors are [rotational, translational] (6,), about one point P of the tool. All quantities are expressed in
    one arbitrary frame.

    Args:
        F_reaction: Wrench of the wrist on the tool (6,).
        M: Spatial inertia of the tool about P (6, 6).
        V: Spatial velocity of the tool at P in an inertial frame (6,).
        A: Spatial acceleration of the tool at P in an inertial frame (6,).
        gravity: Gravity vector (3,) [m/s²].

    Returns:
        The wrench of the surroundings on the tool (6,), [torque, force].
    """
    omega = V[:3]
    momentum = M[:, :3] @ omega  # I ω, and m ω × p_PCom from the coupling block of M
    wrench = M @ A - M[:, 3:] @ gravity - F_reaction
    wrench[:3] += cross(omega, momentum[:3])
    wrench[3:] += cross(omega, momentum[3:])
    return wrench


def check_spring_damper(stiffness: np.ndarray, damping: np.ndarray, owner: str) -> tuple[np.ndarray, np.ndarray]:
    """Check stiffness and damping (6,) of a pose's coordinates, and return copies; `owner` is a name for messages.

    Raises:
        InputError: If a shape is wrong, a stiffness is not positive, a damping is negative, or a number is not finite.
    """
    K, D = as_numbers(stiffness, "stiffness"), as_numbers(damping, "damping")
    if not K.shape == D.shape == (6,) or not ((K > 0.0) & (D >= 0.0) & np.isfinite(K) & np.isfinite(D)).all():
        raise InputError(f"{owner} needs six positive stiffnesses and six dampings, none negative, all finite")
    return K, D


def spring_energy(stiffness: np.ndarray, limits: np.ndarray, error: np.ndarray) -> float:
    """Return the energy [J] of springs K e with their forces clipped at limits F, the sum of Huber's functions.

    The energy of a spring is ½ K e² if K |e| ≤ F, and F |e| − F² / (2 K) otherwise. K (n,) is the positive stiffness
    [N/m, Nm/rad], F (n,) are the limits [N, Nm], not negative, and e (n,) is the error [m, rad].
    """
    # Python numbers: NumPy's overhead would exceed the computation, which runs several times per plant step.
    energy = 0.0
    for K, F, e in zip(stiffness.tolist(), limits.tolist(), error.tolist(), strict=True):
        distance = abs(e)
        clipped = min(distance, F / K)
        energy += K * clipped * (distance - 0.5 * clipped)
    return energy


def admissible_change(
    stiffness: np.ndarray,
    limits: tuple[np.ndarray, np.ndarray],
    errors: tuple[np.ndarray, np.ndarray],
    energy: float,
) -> tuple[float, float]:
    """Return a share from 0 to 1 of a change of reference and limits, and the energy of the springs after it [J].

    If the energy before the change is at most `energy`, so is the energy after it. The share is 1 if the whole change
    is admissible, and otherwise the result of a bisection. With constant limits the energy is convex in the share, and
    the result is the largest admissible share. With increasing limits, the result may be smaller. No limit may
    decrease: the caller applies a lower limit at once, which removes energy.

    Args:
        stiffness: Stiffness (n,) [N/m, Nm/rad], positive.
        limits: Limits (n,) before and after the change [N, Nm].
        errors: Reference minus measured pose (n,) before and after the change [m, rad].
        energy: Largest energy of the springs [J].
    """

    def stored(share: float) -> float:
        return spring_energy(stiffness, *(first + share * (second - first) for first, second in (limits, errors)))

    whole = spring_energy(stiffness, limits[1], errors[1])
    if whole <= energy:
        return 1.0, whole
    low, high = 0.0, 1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stored(middle) <= energy else (low, middle)
    return low, stored(low)
