"""Cartesian impedance controller of a station with an arm or a gantry."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame
from pydrake.systems.framework import DiagramBuilder, OutputPort

from guiderail.diagrams.stations.station import Impedance, export_station_ports, to_wrench_order
from guiderail.systems.cartesian_impedance_controller import CartesianImpedanceController, ImpedanceGains
from guiderail.systems.impedance_monitor import ImpedanceMonitor


class ControllerPlant(Protocol):
    """Model of a robot for its controller: with tool and workpiece, without fixture and offsets."""

    @property
    def plant(self) -> MultibodyPlant:
        """Plant with the robot only."""

    @property
    def target(self) -> Frame:
        """Target frame T."""

    @property
    def tool_center(self) -> Frame:
        """Frame of the tool center P."""

    @property
    def posture(self) -> np.ndarray:
        """Joint positions to which the null space returns, (n,)."""


def impedance_gains(impedance: Impedance, posture: np.ndarray) -> ImpedanceGains:
    """Return the gains of the controller for a station's impedance."""
    return ImpedanceGains(
        stiffness=np.diag(to_wrench_order(impedance.stiffness)),
        wrench_limits=to_wrench_order(impedance.limits),
        posture=posture,
        damping_ratio=impedance.damping_ratio,
    )


def add_controller(
    builder: DiagramBuilder,
    controller_plant: ControllerPlant,
    impedance: Impedance,
    period: float,
    *,
    compensate_gravity: bool,
) -> tuple[CartesianImpedanceController, ImpedanceMonitor]:
    """Add a robot's controller, sampled with `period` [s], and the monitor of its wrench; the caller connects them."""
    controller = builder.AddNamedSystem(
        "controller",
        CartesianImpedanceController(
            controller_plant.plant,
            controller_plant.target,
            controller_plant.tool_center,
            impedance_gains(impedance, controller_plant.posture),
            period=period,
            compensate_gravity=compensate_gravity,
        ),
    )
    monitor = builder.AddNamedSystem("monitor", ImpedanceMonitor(to_wrench_order(impedance.limits)))
    return controller, monitor


def add_impedance_control(
    builder: DiagramBuilder,
    controller_plant: ControllerPlant,
    impedance: Impedance,
    period: float,
    *,
    state: OutputPort,
    wrench: OutputPort,
    compensate_gravity: bool = True,
) -> OutputPort:
    """Add the controller of a robot, and export the ports of a station.

    Args:
        builder: Builder of the station.
        controller_plant: Model of the robot.
        impedance: Impedance at the tool center.
        period: Sampling period of the controller and its command watchdog [s].
        state: Port of joint positions and velocities, (2n,).
        wrench: Port of the wrench, (6,).
        compensate_gravity: Add the torque of the robot's weight.

    Returns:
        The port of the torques, (n,).
    """
    controller, monitor = add_controller(
        builder, controller_plant, impedance, period, compensate_gravity=compensate_gravity
    )
    builder.Connect(state, controller.get_estimated_state_input_port())
    builder.Connect(controller.get_impedance_wrench_output_port(), monitor.get_impedance_wrench_input_port())
    export_station_ports(
        builder,
        controller.get_desired_pose_input_port(),
        controller.get_command_time_input_port(),
        pose=controller.get_pose_output_port(),
        wrench=wrench,
        contact_force=monitor.get_contact_force_output_port(),
        saturation=controller.get_saturation_output_port(),
        command_timed_out=controller.get_command_timed_out_output_port(),
    )
    return controller.get_generalized_force_output_port()
