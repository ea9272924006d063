"""Bullet as a rigid reference among the physics engines: gantry station and its engine."""

from __future__ import annotations

import math
import tempfile
import weakref
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix

from guiderail.diagrams.stations.registry import register_station
from guiderail.diagrams.stations.workcell import Box, Hull, Surface
from guiderail.models.common.errors import import_extra
from guiderail_mujoco.gantry import Input
from guiderail_mujoco.rigid import SCALE, Body, RigidEngine, RigidStation
from guiderail_mujoco.station import EngineOptions

# Distance at which a contact begins, as a fraction of a shape's size; 1.4 µm for the connector. A contact that begins
# earlier has the normal of a face that the workpiece would slide past, such as a chamfer's: the default of 0.02 gives
# 1.4 times the friction at 40 mm/s.
CONTACT_DISTANCE = 2e-4
ITERATIONS = 50  # iterations of the solver
NO_LIMIT = 1e9  # Bullet's own limit of a body's speed is 100 mm/s


class BulletEngine(RigidEngine):
    """Bullet as an `Engine`: rigid contact with a friction cone. Contacts are detected again in each step."""

    name, station = "Bullet", "pybullet"

    def _build(self, fixture: list[Surface], workpiece: list[Surface], masks: dict[str, int]) -> None:
        self._bullet = bullet = import_extra("pybullet")
        self._client = {"physicsClientId": bullet.connect(bullet.DIRECT)}
        weakref.finalize(self, bullet.disconnect, **self._client)
        bullet.setPhysicsEngineParameter(
            numSolverIterations=ITERATIONS, solverResidualThreshold=0.0, enableConeFriction=1, enableFileCaching=0,
            deterministicOverlappingPairs=1, **self._client,
        )  # fmt: skip
        self._springs: list[tuple[int, int]] = []  # body and link of each spring
        with tempfile.TemporaryDirectory() as folder:
            self._fixture, self._refreshed = self._add_body(fixture, 0.0, masks, Path(folder))
            self._tool, _ = self._add_body(workpiece, self._mass, masks, Path(folder))
        moments = [self._inertia * SCALE**2] * 3
        bullet.changeDynamics(self._tool, -1, localInertiaDiagonal=moments, **self._client)

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
        masses = [0.0 if s is None else self._spring_mass(s.stiffness) for s in springs]
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
        for number, (link, spring) in enumerate(zip(links, springs, strict=True)):
            mask = masks[link[0].pair]
            bullet.setCollisionFilterGroupMask(body, number, mask, mask, **self._client)
            refreshed.append((number, mask, link[0].friction))
            if spring is not None:
                # Bullet brakes new joints by a motor.
                bullet.setJointMotorControl2(body, number, bullet.VELOCITY_CONTROL, force=0.0, **self._client)
                self._springs.append((body, number))
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

    def _write(self, step: float, given: Input, body: Body, springs: np.ndarray) -> None:
        bullet, client = self._bullet, self._client
        # The distance is a global variable of Bullet, which other simulations in this process may change.
        bullet.setPhysicsEngineParameter(fixedTimeStep=step, contactBreakingThreshold=CONTACT_DISTANCE, **client)
        for link, _, friction in self._refreshed:
            bullet.changeDynamics(self._fixture, link, lateralFriction=friction * given.friction, **client)
        bullet.resetBasePositionAndOrientation(self._fixture, *_bullet_pose(given.X_TFixture), **client)
        bullet.resetBasePositionAndOrientation(self._tool, *_bullet_pose(body.X_TW), **client)
        bullet.resetBaseVelocity(self._tool, SCALE * body.v_TW, body.w_TW, **client)
        for spring, (position, speed) in zip(self._springs, SCALE * springs.T, strict=True):
            bullet.resetJointState(*spring, position, speed, **client)

    def _read(self) -> Body:
        position, (x, y, z, w) = self._bullet.getBasePositionAndOrientation(self._tool, **self._client)
        velocity, rate = self._bullet.getBaseVelocity(self._tool, **self._client)
        X_TW = RigidTransform(Quaternion(np.array([w, x, y, z])), np.array(position) / SCALE)
        return Body(X_TW, np.array(velocity) / SCALE, np.array(rate))

    def _read_springs(self, body: Body) -> np.ndarray:
        states = [self._bullet.getJointState(*spring, **self._client)[:2] for spring in self._springs]
        return np.array(states).reshape(-1, 2).T / SCALE

    def _step(self, body: Body, force: np.ndarray, torque: np.ndarray, spring_forces: np.ndarray) -> None:
        bullet, client = self._bullet, self._client
        # A new broadphase proxy has no contacts of the last step, whose normals would be outdated.
        for link, mask, _ in self._refreshed:
            bullet.setCollisionFilterGroupMask(self._fixture, link, mask, mask, **client)
        for spring, spring_force in zip(self._springs, SCALE * spring_forces, strict=True):
            bullet.setJointMotorControl2(*spring, bullet.TORQUE_CONTROL, force=spring_force, **client)
        origin = SCALE * body.X_TW.translation()
        bullet.applyExternalForce(self._tool, -1, SCALE * force, origin, bullet.WORLD_FRAME, **client)
        bullet.applyExternalTorque(self._tool, -1, SCALE**2 * torque, bullet.WORLD_FRAME, **client)
        bullet.stepSimulation(**client)


def _bullet_pose(X: RigidTransform) -> tuple[np.ndarray, np.ndarray]:
    """Return Bullet's position and quaternion of a pose."""
    return SCALE * X.translation(), np.roll(X.rotation().ToQuaternion().wxyz(), -1)


def _vertices(surface: Surface) -> np.ndarray:
    """Return the vertices of a hull in the frame of its body (V, 3) [m]."""
    assert isinstance(surface.shape, Hull)
    R = RotationMatrix.MakeYRotation(surface.pitch).matrix()
    return np.asarray(surface.shape.vertices) @ R.T + surface.position


@register_station("pybullet", workcell_kind="insertion", options=EngineOptions)
class BulletStation(RigidStation):
    """`GantryStation` in Bullet."""

    engine = BulletEngine
