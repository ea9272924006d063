"""Impedance control of a station: by a Cartesian controller, or by joints with springs and dampers.

The gantry, the arm, and the stations of packages/mujoco and packages/hardware use it. packages/cpp exports `MIN_MASS`
and `MIN_INERTIA`, which must not exceed the masses of the gantry's carriage.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from pydrake.systems.framework import DiagramBuilder, OutputPort

from guiderail.diagrams.stations.station import (
    ControllerPlant,
    Impedance,
    command_timeout,
    export_station_ports,
    to_wrench_order,
)
from guiderail.diagrams.wiring import add_system
from guiderail.models.common.errors import InputError
from guiderail.models.control.wrench import MovingInertia
from guiderail.systems.cartesian_impedance_controller import CartesianImpedanceController, ImpedanceGains
from guiderail.systems.command_checks import CommandWatchdog
from guiderail.systems.wrench_limits import EnergyTank, PhaseWrenchLimit, ReferenceGovernor
from guiderail.systems.wrench_signals import ForceMonitor

if TYPE_CHECKING:
    from guiderail.models.templates import SharedControlTemplate

TANK_CAPACITY = 5.0  # capacity of the energy tank [J], a multiple of the work of an insertion
# Smallest mass [kg] and moment of inertia [kg m²] of the moving parts. A joint's damping increases with its inertia, so
# these values give a lower bound of the dissipation that refills a tank.
MIN_MASS, MIN_INERTIA = 1.5, 2e-3
WRENCH_RATE = np.array([100.0] * 3 + [10.0] * 3 + [100.0, 10.0])
"""Largest rates of a wrench limit between the states of a template, (8,) [N/s, Nm/s]: of three forces, three torques,
the norm of the force and the norm of the torque."""


def add_controller(
    builder: DiagramBuilder,
    controller_plant: ControllerPlant,
    impedance: Impedance,
    period: float,
    *,
    contact_wrench: OutputPort,
    compensate_gravity: bool,
) -> tuple[CartesianImpedanceController, ForceMonitor, EnergyTank | None]:
    """Add a robot's controller, the monitor of its forces, and its energy tank.

    The controller checks its commands every `period` [s], which is also the period of the tank. There is a tank only if
    the impedance is bounded; the desired pose is then an input of the tank instead of the controller.
    """
    limits = to_wrench_order(impedance.limits)
    gains = ImpedanceGains(
        stiffness=np.diag(to_wrench_order(impedance.stiffness)),
        wrench_limits=limits,
        posture=controller_plant.posture,
        damping_ratio=impedance.damping_ratio,
        bound=impedance.bound,
    )
    controller = CartesianImpedanceController(
        controller_plant.plant,
        controller_plant.target,
        controller_plant.tool_center,
        gains,
        period=period,
        compensate_gravity=compensate_gravity,
        timeout=command_timeout(period),
    )
    builder.AddNamedSystem("controller", controller)
    monitor = ForceMonitor(limits)
    impedance_wrench = controller.get_impedance_wrench_output_port()
    add_system(builder, "monitor", monitor, impedance_wrench=impedance_wrench, contact_wrench=contact_wrench)
    tank = add_energy_tank(builder, impedance, period, controller.get_pose_output_port())
    if tank is not None:
        builder.Connect(tank.get_reference_pose_output_port(), controller.get_desired_pose_input_port())
        builder.Connect(tank.get_admitted_wrench_output_port(), controller.get_max_wrench_input_port())
    return controller, monitor, tank


def add_energy_tank(
    builder: DiagramBuilder, impedance: Impedance, period: float, pose: OutputPort
) -> EnergyTank | None:
    """Add the energy tank of a bounded impedance, sampled with `period` [s]; return None if there is no bound."""
    if impedance.bound is None:
        return None
    stiffness, masses = np.array(impedance.stiffness), np.repeat([MIN_MASS, MIN_INERTIA], 3)
    damping = 2.0 * impedance.damping_ratio * np.sqrt(stiffness * masses)
    tank = EnergyTank(stiffness, damping, impedance.bound, capacity=TANK_CAPACITY, period=period)
    return add_system(builder, "tank", tank, pose=pose)


def make_phase_wrench_limit(
    template: SharedControlTemplate, impedance: Impedance | None, period: float
) -> PhaseWrenchLimit | None:
    """Return the system that bounds the rate of the template's wrench limits; None if no state has a limit.

    Args:
        template: Shared control template.
        impedance: Impedance of the station; None if its wrench cannot be limited at run time.
        period: Control period [s].

    Raises:
        InputError: If a state has a limit, and the impedance is not bounded.
    """
    if not template.limits_wrench:
        return None
    if impedance is None or impedance.bound is None:
        limited = [state.name for state in template.states if state.limits_wrench]
        raise InputError(
            f"state {limited[0]!r} of template {template.name!r} limits force or torque, and the impedance of this "
            "station has no bound that can change: choose another station or bounded_force=true, or remove the limit"
        )
    # A state without limits has the station's bound, so that the ramp to another state's limits starts there.
    return PhaseWrenchLimit(impedance.bound.numbers, WRENCH_RATE, period=period)


def add_impedance_control(
    builder: DiagramBuilder,
    controller_plant: ControllerPlant,
    impedance: Impedance,
    period: float,
    *,
    state: OutputPort,
    wrench: OutputPort,
    contact_wrench: OutputPort | None = None,
    compensate_gravity: bool = True,
) -> OutputPort:
    """Add the controller of a robot, which checks its commands every `period` [s], and export a station's ports.

    `state` is the port of the joint positions and velocities, (2n,), and `wrench` the port of the measured wrench,
    (6,). `contact_wrench` is the port of the contact's wrench, (6,); by default it is the measured one. The result is
    the port of the joint torques, (n,).
    """
    controller, monitor, tank = add_controller(
        builder,
        controller_plant,
        impedance,
        period,
        contact_wrench=wrench if contact_wrench is None else contact_wrench,
        compensate_gravity=compensate_gravity,
    )
    builder.Connect(state, controller.get_estimated_state_input_port())
    export_station_ports(
        builder,
        (tank or controller).get_desired_pose_input_port(),
        controller.get_command_time_input_port(),
        pose=controller.get_pose_output_port(),
        wrench=wrench,
        contact_force=monitor.get_contact_force_output_port(),
        impedance_force=monitor.get_impedance_force_output_port(),
        saturation=controller.get_saturation_output_port(),
        command_timed_out=controller.get_command_timed_out_output_port(),
        max_wrench=None if tank is None else tank.get_max_wrench_input_port(),
    )
    return controller.get_generalized_force_output_port()


def add_joint_impedance(
    builder: DiagramBuilder,
    impedance: Impedance,
    *,
    damping: np.ndarray,
    mass: float,
    time_step: float,
    pose: OutputPort,
    state: OutputPort,
    wrench: OutputPort,
    impedance_wrench: OutputPort,
    control_period: float,
) -> OutputPort:
    """Add watchdog, tank, governor and monitor of six joints with an impedance, and export the ports of a station.

    There are a tank and a governor only if the impedance is bounded.

    Args:
        builder: Builder of the station.
        impedance: Impedance of the joints.
        damping: Damping of the joints, (6,) [N s/m, Nm s/rad].
        mass: Moving mass [kg].
        time_step: Time step of the plant [s].
        pose: Port of the joint positions, (6,).
        state: Port of the joint positions and velocities, (12,).
        wrench: Port of the measured wrench, (6,).
        impedance_wrench: Port of the forces and torques of the joints, (6,).
        control_period: Time between commands [s].

    Returns:
        Port of the desired positions, (6,).
    """
    watchdog = CommandWatchdog(control_period, command_timeout(control_period))
    monitor = ForceMonitor(np.array(impedance.limits))
    add_system(builder, "watchdog", watchdog, pose=pose)
    add_system(builder, "monitor", monitor, impedance_wrench=impedance_wrench, contact_wrench=wrench)
    tank = add_energy_tank(builder, impedance, time_step, pose)
    export_station_ports(
        builder,
        watchdog.get_desired_pose_input_port(),
        watchdog.get_command_time_input_port(),
        pose=pose,
        wrench=wrench,
        contact_force=monitor.get_contact_force_output_port(),
        impedance_force=monitor.get_impedance_force_output_port(),
        saturation=monitor.get_saturation_output_port(),
        command_timed_out=watchdog.get_command_timed_out_output_port(),
        max_wrench=None if tank is None else tank.get_max_wrench_input_port(),
    )
    if impedance.bound is None or tank is None:
        return watchdog.get_safe_pose_output_port()
    builder.Connect(watchdog.get_safe_pose_output_port(), tank.get_desired_pose_input_port())
    governor = add_system(
        builder,
        "governor",
        ReferenceGovernor(
            np.array(impedance.stiffness), damping, MovingInertia(mass, MIN_INERTIA), time_step, impedance.bound
        ),
        desired_pose=tank.get_reference_pose_output_port(),
        max_wrench=tank.get_admitted_wrench_output_port(),
        state=state,
    )
    return governor.get_reference_pose_output_port()
