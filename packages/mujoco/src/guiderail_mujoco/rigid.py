"""Gantry whose tool and workpiece are one free body, in a physics engine with rigid contact."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from functools import partial
from typing import ClassVar, NamedTuple

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.tree import SpatialInertia

from guiderail.diagrams.stations.gantry import CARRIAGE_INERTIA, CARRIAGE_MASS, joint_damping, max_stable_time_step
from guiderail.diagrams.stations.station import CONTROL_PERIOD, Impedance
from guiderail.diagrams.stations.workcell import Surface, Workcell
from guiderail.models.common.arrays import cross
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import MM, POSE_SIZE, nearest_pose
from guiderail.systems.support.drake_multibody import pose_to_transform, transform_to_pose
from guiderail_mujoco.gantry import Input
from guiderail_mujoco.station import EngineStation, contact_masks

STEP = 0.001  # default time step of the engines [s]
# Longest time step [s] at which the drag on the connector's rim is the friction up to 15 % at 20 and 40 mm/s.
MAX_STEP = 0.002
SCALE = 1.0 / MM  # the engines compute in millimeters, because their tolerances are made for lengths of about 1
SPRING_STEP = 1.0  # product of a spring's natural frequency and the time step, as `MujocoContact.spring_step`


class Body(NamedTuple):
    """Motion of the body of tool and workpiece, in the axes of the target frame T."""

    X_TW: RigidTransform  # pose of the workpiece's frame W
    v_TW: np.ndarray  # velocity of its origin, (3,) [m/s]
    w_TW: np.ndarray  # angular velocity, (3,) [rad/s]


class _Motion(NamedTuple):
    """Motion of the tool center P, in the axes of T."""

    q: np.ndarray  # pose, (6,)
    speeds: np.ndarray  # time derivative of the pose, (6,)
    axes: np.ndarray  # axes of the angles in columns, (3, 3)
    p_PW_T: np.ndarray  # vector from P to the workpiece's origin W, (3,) [m]


class RigidEngine(ABC):
    """Part of an `Engine` with rigid contact that does not depend on the physics engine.

    Tool and workpiece are one free body. The impedance's wrench acts on it, and the contact's wrench is the change of
    its momentum less that wrench. Its center of mass is at the workpiece's origin, and its moments of inertia are
    equal. The state is that of the bodies alone: the poses and velocities of tool and springs. So an engine must not
    use the contacts of the last update.
    """

    name: str  # name in messages
    station: str  # name of the station

    def __init__(
        self,
        fixture: list[Surface],
        workpiece: list[Surface],
        inertia: SpatialInertia,
        impedance: Impedance,
        period: float,
        step: float = STEP,
    ):
        """Construct the engine.

        Args:
            fixture: Surfaces of the fixture in its frame.
            workpiece: Surfaces of the workpiece in its frame.
            inertia: Inertia of the workpiece in its frame.
            impedance: Impedance of the tool.
            period: Period [s], of which the time step is a fraction.
            step: Time step [s], rounded so that the period is a multiple of it.

        Raises:
            InputError: If the engine is not installed, the step is too long for contact or impedance, or the surfaces
                have more pairs than a contact mask has bits.
        """
        self.time_step = period / max(round(period / step), 1)
        longest = min(MAX_STEP, 0.999 * max_stable_time_step(impedance))
        if self.time_step > longest * (1.0 + 1e-9):
            raise InputError(
                f"the contact of station={self.station!r} is not accurate, or its impedance not stable, with steps of "
                f"{self.time_step:g} s: set engine_step to at most {longest:.2g} s"
            )
        self._mass = CARRIAGE_MASS + inertia.get_mass()
        self._inertia = CARRIAGE_INERTIA + float(inertia.CalcRotationalInertia().get_moments().mean())
        self._stiffness, self._damping = np.array(impedance.stiffness), joint_damping(impedance)
        self._limits = np.array(impedance.limits)
        springs = [surface.spring for surface in (*fixture, *workpiece) if surface.spring is not None]
        self._spring_stiffness = np.array([spring.stiffness for spring in springs])
        masses = np.array([self._spring_mass(spring.stiffness) for spring in springs])
        self._spring_damping = np.sqrt(self._spring_stiffness * masses)
        self.positions, self.speeds = slice(0, POSE_SIZE), slice(POSE_SIZE, 2 * POSE_SIZE + len(springs))
        self.state_size = 2 * (POSE_SIZE + len(springs))
        self._build(fixture, workpiece, contact_masks((*fixture, *workpiece)))

    @abstractmethod
    def _build(self, fixture: list[Surface], workpiece: list[Surface], masks: dict[str, int]) -> None:
        """Build the model of the physics engine; `masks` are the contact masks of the surfaces' pairs."""

    def _spring_mass(self, stiffness: float) -> float:
        """Return the mass of a spring's body [kg], heavy enough for explicit integration."""
        return stiffness * (self.time_step / SPRING_STEP) ** 2

    def at_rest(self, pose: np.ndarray) -> np.ndarray:
        """Return the state with the tool at rest at `pose` (6,)."""
        state = np.zeros(self.state_size)
        state[self.positions] = pose
        return state

    def advance(self, state: np.ndarray, given: Input, num_steps: int) -> tuple[np.ndarray, np.ndarray, float]:
        """Return state, contact wrenches and actual time step; see `Engine`."""
        num_substeps = max(math.ceil(math.sqrt(given.modulus) - 1e-9), 1)
        step = self.time_step / num_substeps
        q, speeds = state[self.positions], state[self.speeds]
        X_TP = pose_to_transform(q)
        w = _axes(q) @ speeds[3:POSE_SIZE]
        v = speeds[:3] + cross(w, X_TP.rotation().matrix() @ given.X_PWorkpiece.translation())
        springs = np.stack([state[self.speeds.stop :], speeds[POSE_SIZE:]])
        self._write(step, given, Body(X_TP @ given.X_PWorkpiece, v, w), springs)
        body = self._read()
        wrenches, motion, springs = [], _motion(body, given.X_PWorkpiece, q), self._read_springs(body)
        stiffness = self._spring_stiffness * given.modulus
        damping = self._spring_damping * math.sqrt(max(given.modulus, 1.0))
        for _ in range(num_substeps * num_steps):
            load = self._stiffness * (given.desired_pose - motion.q) - self._damping * motion.speeds
            load = np.clip(load, -self._limits, self._limits)
            force, arm = load[:3], motion.p_PW_T
            torque = np.linalg.solve(motion.axes.T, load[3:]) - cross(arm, force)  # about the workpiece's origin
            self._step(body, force, torque, -stiffness * springs[0] - damping * springs[1])
            last, body = body, self._read()
            motion, springs = _motion(body, given.X_PWorkpiece, motion.q), self._read_springs(body)
            contact = self._mass * (body.v_TW - last.v_TW) / step - force
            moment = self._inertia * (body.w_TW - last.w_TW) / step - torque + cross(arm, contact)
            wrenches.append(np.concatenate([contact, moment]))
        return np.concatenate([motion.q, motion.speeds, springs[1], springs[0]]), np.array(wrenches), step

    @abstractmethod
    def _write(self, step: float, given: Input, body: Body, springs: np.ndarray) -> None:
        """Write the time step [s], input, and motions to the engine; `springs` is as in `_read_springs`."""

    @abstractmethod
    def _read(self) -> Body:
        """Return the motion of the body."""

    @abstractmethod
    def _read_springs(self, body: Body) -> np.ndarray:
        """Return positions [m] and speeds [m/s] of the springs, (2, N), with the motion of the body."""

    @abstractmethod
    def _step(self, body: Body, force: np.ndarray, torque: np.ndarray, spring_forces: np.ndarray) -> None:
        """Simulate a time step with a force at the body's origin, a torque, and the forces of the springs (N,)."""


def _motion(body: Body, X_PWorkpiece: RigidTransform, near: np.ndarray) -> _Motion:
    """Return the motion of the tool, with the pose whose angles are nearest to those of the pose `near` (6,)."""
    R_TP = body.X_TW.rotation() @ X_PWorkpiece.rotation().inverse()
    p_PW_T = R_TP @ X_PWorkpiece.translation()
    q = nearest_pose(transform_to_pose(RigidTransform(R_TP, body.X_TW.translation() - p_PW_T)), near)
    axes = _axes(q)
    speeds = np.concatenate([body.v_TW - cross(body.w_TW, p_PW_T), np.linalg.solve(axes, body.w_TW)])
    return _Motion(q, speeds, axes, p_PW_T)


def _axes(pose: np.ndarray) -> np.ndarray:
    """Return the axes of the angles Rz, Ry, Rx of a pose (6,) in columns, (3, 3)."""
    a, b = pose[3:5].tolist()
    sa, ca, sb, cb = math.sin(a), math.cos(a), math.sin(b), math.cos(b)
    return np.array([[0.0, -sa, ca * cb], [0.0, ca, sa * cb], [1.0, 0.0, -sb]])


class RigidStation(EngineStation):
    """`GantryStation` in an engine with rigid contact: only springs of surfaces are compliant."""

    engine: ClassVar[type[RigidEngine]]  # class of the engine

    def __init__(
        self,
        workcell: Workcell,
        impedance: Impedance = Impedance(),  # noqa: B008 (frozen)
        time_step: float | None = None,
        control_period: float = CONTROL_PERIOD,
        engine_step: float | None = None,
    ):
        """Construct the station; see `MujocoStation` for arguments and errors, and `RigidEngine` for its limits."""
        make = partial(self.engine, step=STEP if engine_step is None else engine_step)
        super().__init__(self.engine.station, make, workcell, impedance, time_step, control_period)
