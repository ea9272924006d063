"""Interface of a workcell: the fixture in the world and the workpiece in the robot's tool."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np
from pydrake.geometry import CollisionFilterDeclaration, GeometryId, GeometrySet, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, Frame, RigidBody
from pydrake.systems.framework import Context

from guiderail.models.common.parsing import add_models


class Workcell(Protocol):
    """Objects of a task.

    A station calls `add_fixture`, `add_workpiece` and, in Drake, `filter_contacts` in this order for its simulated
    plant. A controller's plant contains only the workpiece, so `add_workpiece` may be called for that plant first.

    The tool center P is at the target frame T when the task is done; all poses of a station are X_TP. Objects are added
    at their nominal poses; offsets of an episode are set in the context.
    """

    @property
    def X_WT(self) -> RigidTransform:
        """Pose of the target frame in the world."""

    def add_fixture(self, plant: MultibodyPlant) -> None:
        """Add the fixture."""

    def add_workpiece(self, plant: MultibodyPlant, tool_center: Frame) -> RigidBody:
        """Add the workpiece, fixed to the tool center, and return its body."""

    def filter_contacts(self, plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
        """Exclude contact between pairs of geometries, after the plant is finalized."""


def contact_lever(workcell: Workcell) -> float:
    """Return the largest distance of the workpiece's contact geometry from the tool center [m], by bounding boxes."""
    plant, scene_graph = MultibodyPlant(0.0), SceneGraph()
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    workpiece = workcell.add_workpiece(plant, plant.world_frame())
    plant.Finalize()
    X_PW = workpiece.body_frame().CalcPose(plant.CreateDefaultContext(), plant.world_frame())
    inspector, corners = scene_graph.model_inspector(), np.array(list(product((-1.0, 1.0), repeat=3))).T
    lever = 0.0
    for geometry in plant.GetCollisionGeometriesForBody(workpiece):
        box = inspector.GetObbInGeometryFrame(geometry)
        if box is not None:  # None for a half space
            X_PBox = X_PW @ inspector.GetPoseInFrame(geometry) @ box.pose()
            points = X_PBox.multiply(corners * box.half_width()[:, None])
            lever = max(lever, float(np.linalg.norm(points, axis=0).max()))
    return lever


@dataclass(frozen=True)
class Cylinder:
    """Cylinder about its z axis."""

    radius: float  # [m]
    length: float  # [m]


@dataclass(frozen=True)
class Box:
    """Box with edges along the axes of its frame."""

    x: float  # [m]
    y: float  # [m]
    z: float  # [m]


@dataclass(frozen=True)
class Hull:
    """Convex hull of vertices (V, 3) [m]."""

    vertices: np.ndarray


@dataclass(frozen=True)
class Spring:
    """Spring-loaded prismatic joint of a surface: adds compliance where a physics engine's contact is too stiff."""

    axis: tuple[float, float, float]  # direction of the joint (3,) in the body's frame
    stiffness: float  # [N/m]


@dataclass(frozen=True)
class Surface:
    """Convex solid of a body's collision geometry."""

    name: str  # unique name
    pair: str  # name of the pair; surfaces of two bodies collide if their pairs have the same name
    shape: Cylinder | Box | Hull  # shape in the surface's frame
    friction: float  # friction coefficient of the pair
    position: tuple[float, float, float] = field(default=(0.0, 0.0, 0.0))  # position (3,) [m] of the frame in the body
    pitch: float = 0.0  # rotation of the frame about the body's y axis [rad]
    spring: Spring | None = None  # joint that carries the surface; None if the surface is fixed to the body


@runtime_checkable
class ConvexWorkcell(Protocol):
    """Interface of a workcell that engines other than Drake can simulate, such as MuJoCo."""

    def fixture_surfaces(self) -> list[Surface]:
        """Return the contact surfaces of the fixture, in its body's frame."""

    def workpiece_surfaces(self) -> list[Surface]:
        """Return the contact surfaces of the workpiece, in its body's frame."""


class MovableWorkcell(ABC):
    """Workcell with a fixture and a workpiece on frames; a reset moves the frames in the context."""

    fixture: ClassVar[str]  # name of the fixture's body
    workpiece: ClassVar[str]  # name of the workpiece's body
    # Pairs without contact: names of surfaces of the fixture, then of the workpiece. (`drake:collision_filter_group` in
    # an SDF file filters whole bodies only.)
    filtered_pairs: ClassVar[Sequence[tuple[Iterable[str], Iterable[str]]]] = ()
    # Drake's approximation of the contact. "lagged" bounds the friction by the last step's normal force. That is zero
    # at the new contact points of a tilted workpiece that slides along a rim, so that the drag is too small. "similar"
    # bounds it by the present force, but lifts a sliding contact by friction × speed × time step: by 40 µm at
    # 20 mm/s and 10 ms. `guiderail.diagrams.tasks.contact_probe` measures the drag.
    contact_approximation: ClassVar[str] = "lagged"
    # Time step of the plant at which the contact has converged [s]; None: that of the station.
    time_step: ClassVar[float | None] = None

    @property
    @abstractmethod
    def X_WF(self) -> RigidTransform:
        """Pose of the nominal fixture."""

    @property
    @abstractmethod
    def X_FT(self) -> RigidTransform:
        """Pose of the target on the fixture."""

    @abstractmethod
    def sdf(self, body: str) -> Path:
        """Return the path of the SDF file of a body."""

    @property
    def X_WT(self) -> RigidTransform:
        """Pose of the target in the world: pose of the workpiece assembled in the nominal fixture."""
        return self.X_WF @ self.X_FT

    def add_fixture(self, plant: MultibodyPlant) -> None:
        """Add the fixture, on a frame that `set_fixture_offset` moves."""
        self._add(plant, self.fixture, FixedOffsetFrame("fixture_mount", plant.world_frame(), self.X_WF))

    def add_workpiece(self, plant: MultibodyPlant, tool_center: Frame) -> RigidBody:
        """Add the workpiece, on a frame that `set_grasp_offset` moves."""
        return self._add(plant, self.workpiece, FixedOffsetFrame("grasp", tool_center, RigidTransform()))

    def _add(self, plant: MultibodyPlant, name: str, frame: FixedOffsetFrame) -> RigidBody:
        (model,) = add_models(plant, self.sdf(name))
        body = plant.GetBodyByName(name, model)
        plant.WeldFrames(plant.AddFrame(frame), body.body_frame())
        return body

    def filter_contacts(self, plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
        """Exclude contact between the `filtered_pairs`."""
        fixture, workpiece = (self._geometries(plant, scene_graph, name) for name in (self.fixture, self.workpiece))
        manager = scene_graph.collision_filter_manager()
        for first, second in self.filtered_pairs:
            manager.Apply(
                CollisionFilterDeclaration().ExcludeBetween(
                    GeometrySet([fixture[name] for name in first]), GeometrySet([workpiece[name] for name in second])
                )
            )

    def _geometries(self, plant: MultibodyPlant, scene_graph: SceneGraph, body: str) -> dict[str, GeometryId]:
        inspector = scene_graph.model_inspector()
        ids = plant.GetCollisionGeometriesForBody(plant.GetBodyByName(body))
        return {inspector.GetName(geometry).split("::")[-1]: geometry for geometry in ids}

    def set_fixture_offset(self, plant: MultibodyPlant, plant_context: Context, X_TTactual: RigidTransform) -> None:
        """Move the fixture so that the task is done at the pose X_TTactual relative to the nominal target."""
        X_WF = self.X_WT @ X_TTactual @ self.X_FT.inverse()
        plant.GetFrameByName("fixture_mount").SetPoseInParentFrame(plant_context, X_WF)

    def set_grasp_offset(self, plant: MultibodyPlant, plant_context: Context, X_PWorkpiece: RigidTransform) -> None:
        """Place the workpiece at X_PWorkpiece relative to the tool center."""
        plant.GetFrameByName("grasp").SetPoseInParentFrame(plant_context, X_PWorkpiece)

    def workpiece_in_target(self, plant: MultibodyPlant, plant_context: Context) -> RigidTransform:
        """Return the pose of the workpiece relative to its goal in the actual fixture: the identity at the goal."""
        X_FWorkpiece = plant.GetFrameByName(self.workpiece).CalcPose(plant_context, plant.GetFrameByName(self.fixture))
        return self.X_FT.inverse() @ X_FWorkpiece
