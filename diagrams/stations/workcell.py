"""What a station works on: the fixture that stands in the world and the workpiece that the robot holds."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol, runtime_checkable

from pydrake.geometry import CollisionFilterDeclaration, GeometryId, GeometrySet, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, Frame, RigidBody

from guiderail.models.objects.surfaces import Surface


class Workcell(Protocol):
    """A task's objects. A station calls each method once, in this order, while it is built.

    The target frame T is where the tool centre P is when the task is done; every pose that enters or leaves a station
    is X_TP. Only the nominal world is known here: what a task draws anew for an episode is moved in the context.
    """

    @property
    def X_WT(self) -> RigidTransform:
        """The target frame in the world."""

    def add_fixture(self, plant: MultibodyPlant) -> None:
        """Adds what stands in the world."""

    def add_workpiece(self, plant: MultibodyPlant, tool_centre: Frame) -> RigidBody:
        """Adds what the robot holds, fixed to the tool centre, and returns its body."""

    def filter_contacts(self, plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
        """Excludes pairs of geometry that can't or mustn't touch; called once the plant is finalized."""


@runtime_checkable
class ConvexWorkcell(Protocol):
    """What a workcell also has whose contact another engine than Drake can calculate."""

    def fixture_surfaces(self) -> list[Surface]:
        """What of the fixture touches, in its body's frame."""

    def workpiece_surfaces(self) -> list[Surface]:
        """What of the workpiece touches, in its body's frame."""


def movable_frame(plant: MultibodyPlant, name: str) -> FixedOffsetFrame:
    """A frame whose pose in its parent a reset may change in the context, and whatever is welded to it follows."""
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
    """Excludes contact between surfaces of two bodies: each pair names some of the fixture's, some of the workpiece's.

    `drake:collision_filter_group` inside an SDF file can't do this: it filters whole bodies.
    """
    of_fixture, of_workpiece = (_geometries(plant, scene_graph, body) for body in (fixture, workpiece))
    manager = scene_graph.collision_filter_manager()
    for first, second in pairs:
        manager.Apply(
            CollisionFilterDeclaration().ExcludeBetween(
                GeometrySet([of_fixture[name] for name in first]), GeometrySet([of_workpiece[name] for name in second])
            )
        )


def _geometries(plant: MultibodyPlant, scene_graph: SceneGraph, body: str) -> dict[str, GeometryId]:
    inspector = scene_graph.model_inspector()
    ids = plant.GetCollisionGeometriesForBody(plant.GetBodyByName(body))
    return {inspector.GetName(geometry).split("::")[-1]: geometry for geometry in ids}
