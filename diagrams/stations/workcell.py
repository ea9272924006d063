"""Interface of a workcell: the fixture in the world and the workpiece in the robot's tool."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol, runtime_checkable

from pydrake.geometry import CollisionFilterDeclaration, GeometryId, GeometrySet, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, Frame, RigidBody

from guiderail.models.objects.surfaces import Surface


class Workcell(Protocol):
    """Objects of a task. A station calls each method once, in this order, while it is built.

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


@runtime_checkable
class ConvexWorkcell(Protocol):
    """Interface of a workcell with contact that other engines than Drake can compute too."""

    def fixture_surfaces(self) -> list[Surface]:
        """Return the contact surfaces of the fixture, in its body's frame."""

    def workpiece_surfaces(self) -> list[Surface]:
        """Return the contact surfaces of the workpiece, in its body's frame."""


def movable_frame(plant: MultibodyPlant, name: str) -> FixedOffsetFrame:
    """Return a frame with a pose in its parent that can be set in the context; bodies welded to it follow."""
    frame = plant.GetFrameByName(name)
    assert isinstance(frame, FixedOffsetFrame)
    return frame


def exclude_contacts(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    fixture: str,
    workpiece: str,
    pairs: Iterable[tuple[Iterable[str], Iterable[str]]],
) -> None:
    """Exclude contact between surfaces of fixture and workpiece.

    `drake:collision_filter_group` in an SDF file filters whole bodies only.

    Args:
        plant: Finalized plant.
        scene_graph: Its scene graph.
        fixture: Name of the fixture's body.
        workpiece: Name of the workpiece's body.
        pairs: Pairs of surface names, of the fixture and of the workpiece.
    """
    fixture_ids, workpiece_ids = (_geometries(plant, scene_graph, body) for body in (fixture, workpiece))
    manager = scene_graph.collision_filter_manager()
    for first, second in pairs:
        manager.Apply(
            CollisionFilterDeclaration().ExcludeBetween(
                GeometrySet([fixture_ids[name] for name in first]),
                GeometrySet([workpiece_ids[name] for name in second]),
            )
        )


def _geometries(plant: MultibodyPlant, scene_graph: SceneGraph, body: str) -> dict[str, GeometryId]:
    inspector = scene_graph.model_inspector()
    ids = plant.GetCollisionGeometriesForBody(plant.GetBodyByName(body))
    return {inspector.GetName(geometry).split("::")[-1]: geometry for geometry in ids}
