"""What tasks share in which a robot puts one thing into another: stations by name, signals, limits, and the view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import AffineSystem, Multiplexer, Saturation

from guiderail.diagrams.cameras import add_camera, add_meshcat
from guiderail.diagrams.ledger import add_ledger
from guiderail.diagrams.stations.station import CONTROL_PERIOD, Station
from guiderail.diagrams.stations.workcell import Workcell
from guiderail.models.errors import InputError
from guiderail.models.robots.robot import DEFAULT_ROBOT
from guiderail.systems.episode_monitor import Condition
from guiderail.systems.relative_poses import RelativePoses

CLIP = 3.0
"""A policy sees (value − centre) / scale, clipped to ± this."""


def make_station(name: str, workcell: Workcell, robot: str | None = None) -> Station:
    """A simulated station by its name; `robot` says which arm, and rails have none."""
    if name == "rails":
        from guiderail.diagrams.stations.rails import RailsStation

        if robot is not None:
            raise InputError(f"rails have no robot: leave robot={robot!r} out, or use station='arm'")
        return RailsStation(workcell)
    if name == "arm":
        from guiderail.diagrams.stations.arm import ArmStation

        return ArmStation(workcell, robot=robot or DEFAULT_ROBOT)
    raise InputError(f"there is no simulated station '{name}': use 'rails' or 'arm'")


def connect_guidance(builder: DiagramBuilder, station: Station, guidance: Diagram) -> None:
    """Adds both, closes their loop and exports the guidance's `action`."""
    builder.AddNamedSystem("station", station)
    builder.AddNamedSystem("guidance", guidance)
    builder.Connect(station.get_pose_output_port(), guidance.GetInputPort("pose"))
    builder.Connect(station.get_wrench_output_port(), guidance.GetInputPort("wrench"))
    builder.Connect(guidance.GetOutputPort("desired_pose"), station.get_desired_pose_input_port())
    builder.ExportInput(guidance.GetInputPort("action"), "action")


def add_workpiece_pose(builder: DiagramBuilder, station: Station, workpiece: str, fixture: str) -> OutputPort:
    """Where the workpiece really is in the fixture, (6,): position and rotation vector, offsets included."""
    plant = station.plant
    relative = RelativePoses(plant, [plant.GetBodyByName(workpiece)], plant.GetBodyByName(fixture))
    builder.AddNamedSystem(f"{workpiece}_in_{fixture}", relative)
    builder.Connect(station.GetOutputPort("body_poses"), relative.get_body_poses_input_port())
    return relative.get_relative_poses_output_port()


def force_limit(limit: float) -> Condition:
    """Ends an episode as a collision where the impedance pushes harder than `limit` [N]."""
    return Condition("collision", {"contact_force": 1}, lambda contact_force: contact_force[0] > limit)


def add_force_ledger(
    builder: DiagramBuilder, station: Station, guidance: Diagram, violations: Mapping[str, OutputPort], limit: float
) -> OutputPort:
    """Adds the safety ledger; a collision in it is an impedance that pushes harder than `limit` [N]."""
    force = station.get_contact_force_output_port()
    too_hard = builder.AddNamedSystem("force_beyond_limit", affine(np.eye(1), [-limit]))
    builder.Connect(force, too_hard.get_input_port())
    return add_ledger(
        builder,
        CONTROL_PERIOD,
        **violations,
        contact_force=force,
        collision=too_hard.get_output_port(),
        saturation=station.get_saturation_output_port(),
        fallback=guidance.GetOutputPort("fallback"),
    )


def affine(D: np.ndarray, y0: np.ndarray | Sequence[float]) -> AffineSystem:
    """y = D u + y0, evaluated in C++."""
    outputs, inputs = D.shape
    return AffineSystem(
        A=np.zeros((0, 0)), B=np.zeros((0, inputs)), f0=np.zeros(0), C=np.zeros((outputs, 0)), D=D, y0=np.asarray(y0)
    )


def add_observation(
    builder: DiagramBuilder, signals: Sequence[OutputPort], centre: np.ndarray, scale: np.ndarray
) -> OutputPort:
    """The signals one after the other, each centred, scaled and clipped to ±`CLIP`."""
    together = builder.AddNamedSystem("observed", Multiplexer([port.size() for port in signals]))
    for index, port in enumerate(signals):
        builder.Connect(port, together.get_input_port(index))
    scaled = builder.AddNamedSystem("scaled", affine(np.diag(1.0 / scale), -centre / scale))
    clipped = builder.AddNamedSystem("clipped", Saturation(np.full(len(scale), -CLIP), np.full(len(scale), CLIP)))
    builder.Connect(together.get_output_port(), scaled.get_input_port())
    builder.Connect(scaled.get_output_port(), clipped.get_input_port())
    return clipped.get_output_port()


def add_view(
    builder: DiagramBuilder, station: Station, render_mode: str | None, X_WC: RigidTransform
) -> Meshcat | None:
    """Adds a browser view for "human", and for "rgb_array" a camera at X_WC whose image is exported as `rgb_image`."""
    if render_mode == "human":
        return add_meshcat(builder, station.GetOutputPort("query"))[0]
    if render_mode == "rgb_array":
        picture = add_camera(
            builder,
            station.scene_graph,
            station.GetOutputPort("query"),
            "picture",
            size=(640, 480),
            vertical_fov=np.deg2rad(30.0),
            X_WC=X_WC,
        )
        builder.ExportOutput(picture, "rgb_image")
    return None


def look_from_front(target: np.ndarray, distance: float, height: float) -> RigidTransform:
    """A camera X_WC that looks slightly down at `target` from the side that faces away from the arm."""
    eye = target + [0.8 * distance, -0.6 * distance, height]
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return RigidTransform(RotationMatrix(np.stack([right, np.cross(forward, right), forward], axis=1)), eye)
