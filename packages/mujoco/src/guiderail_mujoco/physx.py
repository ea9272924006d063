"""PhysX, by the library SAPIEN, as a second rigid reference: gantry station and its engine."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix

from guiderail.diagrams.stations.registry import register_station
from guiderail.diagrams.stations.workcell import Box, Hull, Spring, Surface
from guiderail.models.common.arrays import cross
from guiderail.models.common.errors import InputError, import_extra
from guiderail_mujoco.gantry import DivergedError, Input
from guiderail_mujoco.rigid import SCALE, Body, RigidEngine, RigidStation
from guiderail_mujoco.station import EngineOptions
from guiderail_mujoco.surfaces import prism

# Distance at which a contact of two shapes begins, half of it for each [m]. It is below the resolution of PhysX's
# coordinates, so contacts begin when shapes touch. A contact that begins earlier has the normal of a face that the
# workpiece would slide past, such as a chamfer's: with 20 µm, drag is 1.5 times the friction at 40 mm/s.
CONTACT_DISTANCE = 2e-8
ITERATIONS = 100  # iterations of the solver; with 50, the lever arm on the rim depends on the order of contacts
MAX_VERTICES = 255  # vertices of a convex hull in PhysX, which simplifies hulls that have more
SPRING_RADIUS = 0.01  # radius of gyration of a spring's body, which cannot turn, and lever arm of its joints [m]
NO_LIMIT = 1e9  # PhysX's own limit of a body's angular velocity is 100 rad/s
MAX_COORDINATE = 1e3  # largest coordinate [m]; PhysX does not check for infinite coordinates


class _Spring(NamedTuple):
    """Spring-loaded body."""

    body: Any  # rigid body of PhysX
    entity: Any  # its entity in SAPIEN
    is_on_tool: bool  # True if the spring moves with the tool, otherwise with the fixture
    X_BS: RigidTransform  # pose of the surface in the frame of workpiece or fixture, with the spring at rest
    axis: np.ndarray  # direction in that frame, (3,)


class PhysxEngine(RigidEngine):
    """PhysX as an `Engine`: rigid contact whose friction acts at two points of each patch, in single precision.

    Each update has a scene of its own, because a scene keeps contacts, and the order in which they are solved.
    """

    name, station = "PhysX", "sapien"

    def _build(self, fixture: list[Surface], workpiece: list[Surface], masks: dict[str, int]) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # SAPIEN warns of missing graphics, which only its renderer needs
            self._sapien = sapien = import_extra("sapien")
        self._physx = physx = sapien.physx
        self._materials: dict[float, Any] = {}  # by friction coefficient
        self._springs: list[_Spring] = []
        self._fixture, self._X_TFixture = sapien.Entity(), RigidTransform()
        static = physx.PhysxRigidStaticComponent()
        self._fixture.add_component(static)
        self._tool, self._body = sapien.Entity(), self._rigid_body(self._mass, self._inertia)
        self._tool.add_component(self._body)
        for parent, surfaces, is_on_tool in ((static, fixture, False), (self._body, workpiece, True)):
            for surface in surfaces:
                mask = masks[surface.pair]
                shape = self._shape(surface)
                shape.contact_offset, shape.rest_offset = 0.5 * CONTACT_DISTANCE * SCALE, 0.0
                shape.set_collision_groups([mask, 0, 0, 0] if is_on_tool else [0, mask, 0, 0])
                X_BS = RigidTransform(RotationMatrix.MakeYRotation(surface.pitch), surface.position)
                if surface.spring is None:
                    shape.local_pose = self._pose(X_BS)
                    parent.attach(shape)
                else:
                    self._add_spring(surface.spring, shape, parent, is_on_tool, X_BS)
        self._entities = [self._fixture, self._tool, *(spring.entity for spring in self._springs)]
        self._scene = self._new_scene()

    def _new_scene(self) -> Any:
        """Return a scene with all bodies."""
        common = self._physx.get_scene_config()  # common to all simulations in this process
        own = self._physx.PhysxSceneConfig()
        own.gravity = [0.0, 0.0, 0.0]
        own.enable_pcm = False  # otherwise contact points, with outdated normals, are kept from step to step
        own.enable_tgs, own.enable_enhanced_determinism = True, True
        self._physx.set_scene_config(own)
        try:
            scene = self._sapien.Scene([self._physx.PhysxCpuSystem()])
        finally:
            self._physx.set_scene_config(common)
        for entity in self._entities:
            scene.add_entity(entity)
        return scene

    def _rigid_body(self, mass: float, inertia: float) -> Any:
        """Return a body with a mass [kg] and moment of inertia [kg m²] about its origin, about all axes."""
        body = self._physx.PhysxRigidDynamicComponent()
        body.mass, body.inertia, body.cmass_local_pose = mass, [inertia * SCALE**2] * 3, self._sapien.Pose()
        body.linear_damping = body.angular_damping = 0.0
        body.max_angular_velocity = NO_LIMIT
        body.sleep_threshold = 0.0  # it never sleeps
        body.solver_position_iterations, body.solver_velocity_iterations = ITERATIONS, 1
        return body

    def _shape(self, surface: Surface) -> Any:
        """Return the collision shape of a surface in its frame."""
        physx, shape, mu = self._physx, surface.shape, surface.friction
        material = self._materials.setdefault(mu, physx.PhysxMaterial(mu, mu, 0.0))
        if isinstance(shape, Box):
            return physx.PhysxCollisionShapeBox([0.5 * SCALE * edge for edge in (shape.x, shape.y, shape.z)], material)
        vertices = np.asarray(shape.vertices) if isinstance(shape, Hull) else prism(shape)
        if len(vertices) > MAX_VERTICES:
            raise InputError(
                f"a convex solid has at most {MAX_VERTICES} vertices in PhysX, and {surface.name} has {len(vertices)}"
            )
        vertices = (SCALE * vertices).astype(np.float32)
        return physx.PhysxCollisionShapeConvexMesh(vertices, [1.0, 1.0, 1.0], material)

    def _add_spring(self, spring: Spring, shape: Any, parent: Any, is_on_tool: bool, X_BS: RigidTransform) -> None:
        """Add a body that can move along the spring only.

        Joints at three points forbid all other motion. SAPIEN locks displacements, but offers for rotations only
        limits, between which a body turns in each step, so that its friction has a wrong direction.
        """
        mass, axis = self._spring_mass(spring.stiffness), np.array(spring.axis)
        body = self._rigid_body(mass, mass * SPRING_RADIUS**2)
        body.attach(shape)
        entity = self._sapien.Entity()
        entity.add_component(body)
        R_BJ = RotationMatrix.MakeFromOneVector(axis, 0)
        for direction, locks_y in (([1.0, 0.0, 0.0], True), ([-1.0, 0.0, 0.0], True), ([0.0, 1.0, 0.0], False)):
            X_BJ = RigidTransform(R_BJ, X_BS.translation() + SPRING_RADIUS * (R_BJ @ np.array(direction)))
            joint = self._physx.PhysxDriveComponent(body)
            joint.parent = parent
            joint.pose_in_parent, joint.pose_in_child = self._pose(X_BJ), self._pose(X_BS.InvertAndCompose(X_BJ))
            joint.set_limit_z(0.0, 0.0)
            if locks_y:
                joint.set_limit_y(0.0, 0.0)
            entity.add_component(joint)
        self._springs.append(_Spring(body, entity, is_on_tool, X_BS, axis))

    def _pose(self, X: RigidTransform) -> Any:
        """Return a pose in PhysX's units."""
        if not np.abs(X.translation()).max() < MAX_COORDINATE:
            raise DivergedError(f"the simulation failed in PhysX: a coordinate exceeds {MAX_COORDINATE:g} m")
        return self._sapien.Pose(SCALE * X.translation(), X.rotation().ToQuaternion().wxyz())

    def _frame(self, spring: _Spring, body: Body) -> tuple[Body, np.ndarray, np.ndarray]:
        """Return the motion of the spring's frame, the spring's direction, and its position at rest (3,) [m]."""
        frame = body if spring.is_on_tool else Body(self._X_TFixture, np.zeros(3), np.zeros(3))
        return frame, frame.X_TW.rotation() @ spring.axis, frame.X_TW @ spring.X_BS.translation()

    def _write(self, step: float, given: Input, body: Body, springs: np.ndarray) -> None:
        for friction, material in self._materials.items():
            material.static_friction = material.dynamic_friction = friction * given.friction
        for entity in self._entities:
            self._scene.remove_entity(entity)
        self._scene = self._new_scene()
        self._scene.physx_system.timestep = step
        self._X_TFixture = given.X_TFixture
        self._fixture.pose = self._pose(given.X_TFixture)
        self._tool.pose = self._pose(body.X_TW)
        self._body.linear_velocity, self._body.angular_velocity = SCALE * body.v_TW, body.w_TW
        for spring, (position, speed) in zip(self._springs, springs.T, strict=True):
            frame, axis, rest = self._frame(spring, body)
            offset = rest + position * axis - frame.X_TW.translation()
            rotation = frame.X_TW.rotation() @ spring.X_BS.rotation()
            spring.entity.pose = self._pose(RigidTransform(rotation, frame.X_TW.translation() + offset))
            velocity = frame.v_TW + cross(frame.w_TW, offset) + speed * axis
            spring.body.linear_velocity, spring.body.angular_velocity = SCALE * velocity, frame.w_TW

    def _read(self) -> Body:
        pose = self._tool.pose
        values = np.concatenate([pose.p, pose.q, self._body.linear_velocity, self._body.angular_velocity], dtype=float)
        if not np.isfinite(values).all():
            raise DivergedError("the simulation failed in PhysX: its state is not finite")
        X_TW = RigidTransform(Quaternion(values[3:7] / np.linalg.norm(values[3:7])), values[:3] / SCALE)
        return Body(X_TW, values[7:10] / SCALE, values[10:])

    def _read_springs(self, body: Body) -> np.ndarray:
        states = np.empty((2, len(self._springs)))
        for number, spring in enumerate(self._springs):
            frame, axis, rest = self._frame(spring, body)
            position = np.array(spring.entity.pose.p, dtype=float) / SCALE
            velocity = np.array(spring.body.linear_velocity, dtype=float) / SCALE
            velocity -= frame.v_TW + cross(frame.w_TW, position - frame.X_TW.translation())
            states[:, number] = axis @ (position - rest), axis @ velocity
        return states

    def _step(self, body: Body, force: np.ndarray, torque: np.ndarray, spring_forces: np.ndarray) -> None:
        self._body.add_force_torque(SCALE * force, SCALE**2 * torque)
        for spring, spring_force in zip(self._springs, spring_forces, strict=True):
            push = SCALE * spring_force * self._frame(spring, body)[1]
            spring.body.add_force_torque(push, np.zeros(3))
            if spring.is_on_tool:
                self._body.add_force_at_point(-push, spring.entity.pose.p)
        self._scene.physx_system.step()


@register_station("sapien", workcell_kind="insertion", options=EngineOptions)
class PhysxStation(RigidStation):
    """`GantryStation` in PhysX."""

    engine = PhysxEngine
