"""Bullet as a rigid reference among the physics engines: gantry station and its engine."""

from __future__ import annotations

import math
import tempfile
import weakref
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import SpatialInertia

from guiderail.diagrams.stations.gantry import CARRIAGE_INERTIA, CARRIAGE_MASS, joint_damping, max_stable_time_step
from guiderail.diagrams.stations.registry import register_station
from guiderail.diagrams.stations.station import CONTROL_PERIOD, Impedance
from guiderail.diagrams.stations.workcell import Box, Hull, Surface, Workcell
from guiderail.models.common.arrays import cross
from guiderail.models.common.errors import InputError, import_extra
from guiderail.models.common.transforms import MM, POSE_SIZE, nearest_pose
from guiderail.systems.support.drake_multibody import pose_to_transform, transform_to_pose
from guiderail_mujoco.gantry import Input
from guiderail_mujoco.station import EngineOptions, EngineStation, contact_masks

STEP = 0.001  # default time step of the engine [s]
# Longest time step [s] at which the drag on the connector's rim is the friction up to 15 % at 20 and 40 mm/s.
MAX_STEP = 0.002
SCALE = 1.0 / MM  # Bullet computes in millimeters, because its tolerances are made for lengths of about 1
# Distance at which a contact begins, as a fraction of a shape's size; 1.4 µm for the connector. A contact that begins
# earlier has the normal of a face that the workpiece would slide past, such as a chamfer's: the default of 0.02 gives
# 1.4 times the friction at 40 mm/s.
CONTACT_DISTANCE = 2e-4
ITERATIONS = 50  # iterations of the solver
SPRING_STEP = 1.0  # product of a spring's natural frequency and the time step, as `MujocoContact.spring_step`
NO_LIMIT = 1e9  # Bullet's own limit of a body's speed is 100 mm/s


class _Spring(NamedTuple):
    """Spring-loaded link of a body."""

    body: int
    link: int
    stiffness: float  # [N/m]
    damping: float  # [N s/m]


class BulletEngine:
    """Bullet as an `Engine`: rigid contact with a friction cone.

    Tool and workpiece are one free body. The impedance's wrench acts on it, and the contact's wrench is the change of
    its momentum less that wrench. Its center of mass is at the workpiece's origin, and its moments of inertia are
    equal. Contacts are detected again in each step, so the state is that of the bodies alone.
    """

    name = "Bullet"

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
            InputError: If PyBullet is not installed, the step is too long for contact or impedance, or the surfaces
                have more pairs than a contact mask has bits.
        """
        self._bullet = bullet = import_extra("pybullet")
        self.time_step = period / max(round(period / step), 1)
        longest = min(MAX_STEP, 0.999 * max_stable_time_step(impedance))
        if self.time_step > longest * (1.0 + 1e-9):
            raise InputError(
                f"the contact of station='pybullet' is not accurate, or its impedance not stable, with steps of "
                f"{self.time_step:g} s: set engine_step to at most {longest:.2g} s"
            )
        masks = contact_masks((*fixture, *workpiece))
        self._client = {"physicsClientId": bullet.connect(bullet.DIRECT)}
        weakref.finalize(self, bullet.disconnect, **self._client)
        bullet.setPhysicsEngineParameter(
            numSolverIterations=ITERATIONS, solverResidualThreshold=0.0, enableConeFriction=1, enableFileCaching=0,
            deterministicOverlappingPairs=1, **self._client,
        )  # fmt: skip
        self._mass = CARRIAGE_MASS + inertia.get_mass()
        self._inertia = CARRIAGE_INERTIA + float(inertia.CalcRotationalInertia().get_moments().mean())
        self._springs: list[_Spring] = []
        with tempfile.TemporaryDirectory() as folder:
            self._fixture, self._refreshed = self._add_body(fixture, 0.0, masks, Path(folder))
            self._tool, _ = self._add_body(workpiece, self._mass, masks, Path(folder))
        moments = [self._inertia * SCALE**2] * 3
        bullet.changeDynamics(self._tool, -1, localInertiaDiagonal=moments, **self._client)
        self._stiffness, self._damping = np.array(impedance.stiffness), joint_damping(impedance)
        self._limits = np.array(impedance.limits)
        num_springs = len(self._springs)
        self.positions, self.speeds = slice(0, POSE_SIZE), slice(POSE_SIZE, 2 * POSE_SIZE + num_springs)
        self.state_size = 2 * (POSE_SIZE + num_springs)

    def _add_body(
        self, surfaces: Sequence[Surface], mass: float, masks: dict[str, int], folder: Path
    ) -> tuple[int, list[tuple[int, int, float]]]:
        """Add a body whose surfaces are links, and return its number and link, mask and friction of each link.

        The convex hulls of a pair are one link, which costs half as much. A body with a mass has the friction 1,
        because Bullet multiplies the coefficients of two bodies.
        """
        bullet = self._bullet
        hulls: dict[str, list[Surface]] = {}
        links: list[list[Surface]] = []
        for surface in surfaces:
            if surface.spring is None and isinstance(surface.shape, Hull):
                if surface.pair not in hulls:
                    links.append(hulls.setdefault(surface.pair, []))
                hulls[surface.pair].append(surface)
            else:
                links.append([surface])
        springs = [link[0].spring for link in links]
        masses = [0.0 if s is None else s.stiffness * (self.time_step / SPRING_STEP) ** 2 for s in springs]
        frames = [link[0].position if len(link) == 1 else (0.0, 0.0, 0.0) for link in links]
        pitches = [link[0].pitch if len(link) == 1 else 0.0 for link in links]
        quaternions = [[0.0, math.sin(pitch / 2), 0.0, math.cos(pitch / 2)] for pitch in pitches]
        axes = [
            [0.0, 0.0, 1.0] if s is None else RotationMatrix.MakeYRotation(pitch).matrix().T @ s.axis
            for s, pitch in zip(springs, pitches, strict=True)
        ]
        none = [[0.0] * 3] * len(links)
        body: int = bullet.createMultiBody(
            baseMass=mass,
            linkMasses=masses,
            linkCollisionShapeIndices=[self._shape(link, folder) for link in links],
            linkVisualShapeIndices=[-1] * len(links),
            linkPositions=[SCALE * np.array(frame) for frame in frames],
            linkOrientations=quaternions,
            linkInertialFramePositions=none,
            linkInertialFrameOrientations=[[0.0, 0.0, 0.0, 1.0]] * len(links),
            linkParentIndices=[0] * len(links),
            linkJointTypes=[bullet.JOINT_FIXED if s is None else bullet.JOINT_PRISMATIC for s in springs],
            linkJointAxis=axes,
            **self._client,
        )
        for number in range(-1, len(links)):
            bullet.changeDynamics(body, number, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0, **self._client)
            bullet.changeDynamics(body, number, lateralFriction=1.0, **self._client)
        bullet.changeDynamics(body, -1, maxJointVelocity=NO_LIMIT, **self._client)
        refreshed = []
        for number, (link, spring, spring_mass) in enumerate(zip(links, springs, masses, strict=True)):
            mask = masks[link[0].pair]
            bullet.setCollisionFilterGroupMask(body, number, mask, mask, **self._client)
            refreshed.append((number, mask, link[0].friction))
            if spring is not None:
                # Bullet brakes new joints by a motor.
                bullet.setJointMotorControl2(body, number, bullet.VELOCITY_CONTROL, force=0.0, **self._client)
                damping = math.sqrt(spring.stiffness * spring_mass)
                self._springs.append(_Spring(body, number, spring.stiffness, damping))
        return body, refreshed

    def _shape(self, surfaces: Sequence[Surface], folder: Path) -> int:
        """Return the number of a collision shape in the frame of the only surface, or in that of the body."""
        bullet, shape = self._bullet, surfaces[0].shape
        if isinstance(shape, Hull):
            solids = [shape.vertices] if len(surfaces) == 1 else [_vertices(surface) for surface in surfaces]
            return self._hulls([SCALE * vertices for vertices in solids], folder)
        if isinstance(shape, Box):
            half = [0.5 * SCALE * edge for edge in (shape.x, shape.y, shape.z)]
            return int(bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=half, **self._client))
        size = {"radius": SCALE * shape.radius, "height": SCALE * shape.length}
        return int(bullet.createCollisionShape(bullet.GEOM_CYLINDER, **size, **self._client))

    def _hulls(self, solids: Sequence[np.ndarray], folder: Path) -> int:
        """Return the number of a shape of convex hulls; Bullet reads several of them from a file in `folder` only."""
        lines, first = [], 1
        for number, vertices in enumerate(solids):
            last = first + len(vertices) - 1
            lines += [f"o {number}", *(f"v {x:.17g} {y:.17g} {z:.17g}" for x, y, z in vertices)]
            lines += [f"f {i} {i + 1} {i + 2}" for i in range(first, last - 1)]
            first = last + 1
        file = folder / f"{len(list(folder.iterdir()))}.obj"
        file.write_text("\n".join([*lines, ""]), encoding="utf-8")
        return int(self._bullet.createCollisionShape(self._bullet.GEOM_MESH, fileName=str(file), **self._client))

    def at_rest(self, pose: np.ndarray) -> np.ndarray:
        """Return the state with the tool at rest at `pose` (6,)."""
        state = np.zeros(self.state_size)
        state[self.positions] = pose
        return state

    def advance(self, state: np.ndarray, given: Input, num_steps: int) -> tuple[np.ndarray, np.ndarray, float]:
        """Return state, contact wrenches and actual time step; see `Engine`."""
        bullet, client = self._bullet, self._client
        num_substeps = max(math.ceil(math.sqrt(given.modulus) - 1e-9), 1)
        step = self.time_step / num_substeps
        # The distance is a global variable of Bullet, which other simulations in this process may change.
        bullet.setPhysicsEngineParameter(fixedTimeStep=step, contactBreakingThreshold=CONTACT_DISTANCE, **client)
        for link, _, friction in self._refreshed:
            bullet.changeDynamics(self._fixture, link, lateralFriction=friction * given.friction, **client)
        self._write(state, given)
        wrenches, motion = [], self._motion(given.X_PWorkpiece, state[self.positions])
        for _ in range(num_substeps * num_steps):
            # A new broadphase proxy has no contacts of the last step, whose normals would be outdated.
            for link, mask, _ in self._refreshed:
                bullet.setCollisionFilterGroupMask(self._fixture, link, mask, mask, **client)
            self._push_springs(given.modulus)
            load = self._stiffness * (given.desired_pose - motion.q) - self._damping * motion.speeds
            load = np.clip(load, -self._limits, self._limits)
            force, arm = load[:3], motion.p_PW_T
            torque = np.linalg.solve(motion.axes.T, load[3:]) - cross(arm, force)  # about the workpiece's origin
            bullet.applyExternalForce(self._tool, -1, SCALE * force, SCALE * motion.p_TW, bullet.WORLD_FRAME, **client)
            bullet.applyExternalTorque(self._tool, -1, SCALE**2 * torque, bullet.WORLD_FRAME, **client)
            bullet.stepSimulation(**client)
            last, motion = motion, self._motion(given.X_PWorkpiece, motion.q)
            contact = self._mass * (motion.v_TW - last.v_TW) / step - force
            moment = self._inertia * (motion.w_TW - last.w_TW) / step - torque + cross(arm, contact)
            wrenches.append(np.concatenate([contact, moment]))
        springs = np.array([bullet.getJointState(s.body, s.link, **client)[:2] for s in self._springs]).reshape(-1, 2)
        springs = springs / SCALE
        return np.concatenate([motion.q, motion.speeds, springs[:, 1], springs[:, 0]]), np.array(wrenches), step

    def _write(self, state: np.ndarray, given: Input) -> None:
        """Write a state, and the poses of fixture and workpiece, to the engine."""
        bullet, client = self._bullet, self._client
        bullet.resetBasePositionAndOrientation(self._fixture, *_bullet_pose(given.X_TFixture), **client)
        q, speeds = state[self.positions], state[self.speeds]
        X_TP = pose_to_transform(q)
        w = _axes(q) @ speeds[3:POSE_SIZE]
        v = speeds[:3] + cross(w, X_TP.rotation().matrix() @ given.X_PWorkpiece.translation())
        bullet.resetBasePositionAndOrientation(self._tool, *_bullet_pose(X_TP @ given.X_PWorkpiece), **client)
        bullet.resetBaseVelocity(self._tool, SCALE * v, w, **client)
        springs = zip(self._springs, speeds[POSE_SIZE:], state[self.speeds.stop :], strict=True)
        for spring, speed, position in springs:
            bullet.resetJointState(spring.body, spring.link, SCALE * position, SCALE * speed, **client)

    def _motion(self, X_PWorkpiece: RigidTransform, near: np.ndarray) -> _Motion:
        """Return the motion of the tool, with the pose whose angles are nearest to those of the pose `near` (6,)."""
        position, (x, y, z, w) = self._bullet.getBasePositionAndOrientation(self._tool, **self._client)
        velocity, rate = self._bullet.getBaseVelocity(self._tool, **self._client)
        R_TP = RotationMatrix(Quaternion(np.array([w, x, y, z]))) @ X_PWorkpiece.rotation().inverse()
        p_PW_T = R_TP @ X_PWorkpiece.translation()
        p_TW, v_TW, w_TW = np.array(position) / SCALE, np.array(velocity) / SCALE, np.array(rate)
        q = nearest_pose(transform_to_pose(RigidTransform(R_TP, p_TW - p_PW_T)), near)
        axes = _axes(q)
        speeds = np.concatenate([v_TW - cross(w_TW, p_PW_T), np.linalg.solve(axes, w_TW)])
        return _Motion(q, speeds, axes, p_TW, v_TW, w_TW, p_PW_T)

    def _push_springs(self, modulus: float) -> None:
        """Apply the springs' forces for one step; `modulus` is the factor of their stiffness."""
        for spring in self._springs:
            position, speed, *_ = self._bullet.getJointState(spring.body, spring.link, **self._client)
            stiffness, damping = spring.stiffness * modulus, spring.damping * math.sqrt(max(modulus, 1.0))
            self._bullet.setJointMotorControl2(
                spring.body, spring.link, self._bullet.TORQUE_CONTROL, force=-stiffness * position - damping * speed,
                **self._client,
            )  # fmt: skip


class _Motion(NamedTuple):
    """Motion of the tool, in the axes of the target frame T."""

    q: np.ndarray  # pose of the tool center P, (6,)
    speeds: np.ndarray  # time derivative of the pose, (6,)
    axes: np.ndarray  # axes of the angles in columns, (3, 3)
    p_TW: np.ndarray  # position of the workpiece's origin W, (3,) [m]
    v_TW: np.ndarray  # velocity of W, (3,) [m/s]
    w_TW: np.ndarray  # angular velocity, (3,) [rad/s]
    p_PW_T: np.ndarray  # vector from P to W, (3,) [m]


def _axes(pose: np.ndarray) -> np.ndarray:
    """Return the axes of the angles Rz, Ry, Rx of a pose (6,) in columns, (3, 3)."""
    a, b = pose[3:5].tolist()
    sa, ca, sb, cb = math.sin(a), math.cos(a), math.sin(b), math.cos(b)
    return np.array([[0.0, -sa, ca * cb], [0.0, ca, sa * cb], [1.0, 0.0, -sb]])


def _bullet_pose(X: RigidTransform) -> tuple[np.ndarray, np.ndarray]:
    """Return Bullet's position and quaternion of a pose."""
    return SCALE * X.translation(), np.roll(X.rotation().ToQuaternion().wxyz(), -1)


def _vertices(surface: Surface) -> np.ndarray:
    """Return the vertices of a hull in the frame of its body (V, 3) [m]."""
    assert isinstance(surface.shape, Hull)
    R = RotationMatrix.MakeYRotation(surface.pitch).matrix()
    return np.asarray(surface.shape.vertices) @ R.T + surface.position


@register_station("pybullet", workcell_kind="insertion", options=EngineOptions)
class BulletStation(EngineStation):
    """`GantryStation` in Bullet, a rigid reference: without compliance of contacts, except for springs of surfaces."""

    def __init__(
        self,
        workcell: Workcell,
        impedance: Impedance = Impedance(),  # noqa: B008 (frozen)
        time_step: float | None = None,
        control_period: float = CONTROL_PERIOD,
        engine_step: float | None = None,
    ):
        """Construct the station; see `MujocoStation` for arguments and errors, and `BulletEngine` for its limits."""
        step = STEP if engine_step is None else engine_step
        super().__init__("pybullet", partial(BulletEngine, step=step), workcell, impedance, time_step, control_period)
