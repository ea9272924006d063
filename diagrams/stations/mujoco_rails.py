"""The tool centre on six rails, in another physics engine: is a skill one of Drake's contact only?"""

from __future__ import annotations

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, FixedOffsetFrame, SpatialInertia
from pydrake.systems.framework import Context, DiagramBuilder

from guiderail.diagrams.stations.mujoco_model import MujocoContact, mujoco_model
from guiderail.diagrams.stations.registry import register_station
from guiderail.diagrams.stations.station import (
    CONTROL_PERIOD,
    PLANT_PERIOD,
    POSE_SIZE,
    ContactOptions,
    Impedance,
    Station,
    checked_pose,
    export_station_ports,
)
from guiderail.diagrams.stations.workcell import ConvexWorkcell, Workcell
from guiderail.models.errors import InputError
from guiderail.systems.command_watchdog import CommandWatchdog
from guiderail.systems.impedance_monitor import ImpedanceMonitor
from guiderail.systems.mujoco_rails import MovedBodies, MujocoRails


@register_station("mujoco", world="workcell", options=ContactOptions)
class MujocoStation(Station):
    """`RailsStation`'s twin, stepped by MuJoCo: ports, rails, impedance, watchdog and filter are the same.

    Drake's plant is still there, without joints or a step: it knows where the fixture stands and how the workpiece
    sits in the tool, which a reset draws into its context, and what all of it looks like.
    """

    def __init__(
        self,
        workcell: Workcell,
        impedance: Impedance = Impedance(),  # noqa: B008 (frozen)
        time_step: float | None = None,
        wrench_time_constant: float = 0.01,
        contact: MujocoContact = MujocoContact(),  # noqa: B008 (frozen)
    ):
        """
        Args:
            workcell: what stands in the world and what is held.
            impedance: of the rails.
            time_step: at which commands are taken in, and poses and wrenches given out [s]; half a control period
                unless given. The engine's own is finer.
            wrench_time_constant: of the wrench's low-pass filter [s].
            contact: of the engine.

        Raises:
            InputError: if MuJoCo isn't installed, or nobody described the workcell's surfaces as convex solids.
        """
        super().__init__()
        time_step = time_step or PLANT_PERIOD
        if not isinstance(workcell, ConvexWorkcell):
            raise InputError(
                f"station='mujoco' collides convex solids, and {type(workcell).__name__} doesn't say which: "
                "give it the methods of ConvexWorkcell"
            )
        builder = DiagramBuilder()
        self.scene_graph = builder.AddSystem(SceneGraph())
        self.plant = plant = builder.AddNamedSystem("plant", MultibodyPlant(0.0))
        moved = _add_workcell(plant, self.scene_graph, workcell)
        inertia = moved.workpiece.CalcSpatialInertiaInBodyFrame(plant.CreateDefaultContext())
        surfaces = workcell.fixture_surfaces(), workcell.workpiece_surfaces()
        model = mujoco_model(*surfaces, inertia, impedance, contact, time_step)
        rails = MujocoRails(model, plant, moved, workcell.X_WT, time_step, wrench_time_constant)
        self.rails = builder.AddNamedSystem("rails", rails)
        watchdog = builder.AddNamedSystem("watchdog", CommandWatchdog(CONTROL_PERIOD))
        monitor = builder.AddNamedSystem("monitor", ImpedanceMonitor(np.array(impedance.limits)))
        builder.Connect(plant.get_body_poses_output_port(), rails.get_nominal_body_poses_input_port())
        builder.Connect(watchdog.get_safe_pose_output_port(), rails.get_desired_pose_input_port())
        builder.Connect(rails.get_pose_output_port(), watchdog.get_pose_input_port())
        builder.Connect(rails.get_impedance_wrench_output_port(), monitor.get_impedance_wrench_input_port())
        builder.Connect(
            rails.get_geometry_poses_output_port(), self.scene_graph.get_source_pose_port(plant.get_source_id())
        )
        export_station_ports(
            builder,
            watchdog.get_desired_pose_input_port(),
            watchdog.get_command_time_input_port(),
            pose=rails.get_pose_output_port(),
            wrench=rails.get_wrench_output_port(),
            contact_force=monitor.get_contact_force_output_port(),
            saturation=monitor.get_saturation_output_port(),
            holding=watchdog.get_holding_output_port(),
        )
        builder.ExportOutput(self.scene_graph.get_query_output_port(), "query")
        builder.ExportOutput(rails.get_body_poses_output_port(), "body_poses")
        builder.BuildInto(self)

    def set_pose(self, context: Context, pose: np.ndarray) -> None:
        """Puts the carriage at rest at `pose`, (6,); `context` is the root context."""
        self.rails.set_pose(self.rails.GetMyMutableContextFromRoot(context), checked_pose(pose, POSE_SIZE))

    def set_contact(self, context: Context, friction: float, modulus: float) -> None:
        """Multiplies the engine's friction and compliance; `context` is the root context."""
        self.rails.set_contact(self.rails.GetMyMutableContextFromRoot(context), friction, modulus)


def _add_workcell(plant: MultibodyPlant, scene_graph: SceneGraph, workcell: Workcell) -> MovedBodies:
    """Adds fixture, tool and workpiece to a plant in which nothing moves, and finalizes it."""
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    workcell.add_fixture(plant)
    if plant.num_bodies() != 2:  # with the world
        raise InputError(f"station='mujoco' knows a fixture of one body, and {type(workcell).__name__} adds another")
    fixture = plant.get_body(BodyIndex(1))
    target = plant.AddFrame(FixedOffsetFrame("target", plant.world_frame(), workcell.X_WT))
    model = plant.AddModelInstance("rails")
    tool = plant.AddRigidBody("tool_centre", model, SpatialInertia.SolidSphereWithMass(1.0, 0.01))
    plant.WeldFrames(target, tool.body_frame())
    workpiece = workcell.add_workpiece(plant, tool.body_frame())
    plant.Finalize()
    return MovedBodies(fixture, tool, workpiece)
