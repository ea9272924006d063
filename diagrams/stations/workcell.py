"""What a station works on: the fixture that stands in the world and the workpiece that the robot holds."""

from __future__ import annotations

from typing import Protocol

from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, RigidBody


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
