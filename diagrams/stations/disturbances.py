"""Disturbances of a simulated station that resemble unmodelled effects of a real robot; all off by default."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, DiagramBuilder, OutputPort
from pydrake.systems.primitives import Adder, ConstantVectorSource

from guiderail.diagrams.stations.options import SENSING, Disturbances, SensorErrors
from guiderail.diagrams.stations.station import (
    OUTPUTS,
    Impedance,
    Station,
    export_station_ports,
    tare_steps,
    whole_multiple,
)
from guiderail.diagrams.stations.wrapped_stations import WrappedStation
from guiderail.diagrams.wiring import add_system
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import POSE_SIZE, WRENCH_SIZE
from guiderail.systems.disturbances import CommandDisturbance, SensorDisturbance
from guiderail.systems.wrench_signals import WrenchTare

SIMULATION_PORTS = ("query", "body_poses", "contact_results")  # those that a station has
EXACT_WRENCH = "exact_wrench"
"""Port of the wrench without sensor errors, (6,)."""


class DisturbedStation(WrappedStation):
    """A station with disturbances between its ports and the ports of an inner station.

    Measured pose and wrench are disturbed; success and the contact force, by which collisions are detected, are not.
    A further output, `exact_wrench`, is the wrench without errors.
    """

    def __init__(self, station: Station, disturbances: Disturbances):
        """Construct the station; the given `station` becomes its subsystem.

        Raises:
            InputError: If the station does not support one of the disturbances.
        """
        super().__init__(station)
        d = self._disturbances = disturbances
        if d.payload and not hasattr(station, "set_payload"):
            raise InputError("a payload hangs from an arm's tool: choose station=arm, or leave payload out")
        self.control_period, self.wraps_angles = _disturbed_period(d, station), station.wraps_angles
        period = self.control_period
        builder = DiagramBuilder()
        builder.AddNamedSystem("station", station)
        self._commands = commands = CommandDisturbance(POSE_SIZE, period, d.lost_commands, d.late_commands)
        builder.AddNamedSystem("commands", commands)
        e = self._errors = _without_replaced_errors(d, station)
        self._calibration: list[ConstantVectorSource] = []
        resolution = np.repeat(e.pose_resolution, 3)
        self._pose = pose = SensorDisturbance(period, np.zeros(POSE_SIZE), resolution=resolution)
        builder.AddNamedSystem("pose", pose)
        delivered, measured = commands.get_delivered_command_output_port(), station.get_pose_output_port()
        if any(e.calibration_error):
            delivered = self._add_constant(builder, "calibration_of_commands", delivered)
            measured = self._add_constant(builder, "calibration_of_poses", measured)
        builder.Connect(delivered, station.get_desired_pose_input_port())
        builder.Connect(measured, pose.get_measurement_input_port())
        builder.Connect(pose.get_disturbed_measurement_output_port(), commands.get_pose_input_port())
        wrench = self._add_wrench(builder, station.get_wrench_output_port(), measured)
        exact = station.GetOutputPort(EXACT_WRENCH if station.HasOutputPort(EXACT_WRENCH) else "wrench")
        outputs = {name: station.GetOutputPort(name) for name in OUTPUTS}
        outputs |= station.impedance_force()
        outputs |= {"pose": pose.get_disturbed_measurement_output_port(), "wrench": wrench}
        export_station_ports(
            builder,
            commands.get_command_input_port(),
            station.get_command_time_input_port(),
            max_wrench=station.GetInputPort("max_wrench") if station.HasInputPort("max_wrench") else None,
            **outputs,
        )
        for name in filter(station.HasOutputPort, SIMULATION_PORTS):
            builder.ExportOutput(station.GetOutputPort(name), name)
        builder.ExportOutput(exact, EXACT_WRENCH)
        builder.BuildInto(self)

    def _add_constant(self, builder: DiagramBuilder, name: str, port: OutputPort) -> OutputPort:
        """Add a constant pose, which a reset sets, to the value of `port`; return the port of the sum."""
        source = builder.AddNamedSystem(name, ConstantVectorSource(np.zeros(POSE_SIZE)))
        total = add_system(builder, f"{name}_added", Adder(2, POSE_SIZE), port, source.get_output_port())
        self._calibration.append(source)
        return total.get_output_port()

    def _add_wrench(self, builder: DiagramBuilder, wrench: OutputPort, pose: OutputPort) -> OutputPort:
        """Add errors, tare and delay of the wrench; return the port of the measured wrench.

        A robot tares its own sensor, so the delay of the transmission to the policy follows the tare.
        """
        e, period = self._errors, self.control_period
        delay, has_gradient = e.wrench_delay[1], any(e.wrench_gradient)
        self._wrench = SensorDisturbance(
            period,
            np.repeat(e.wrench_noise, 3),
            0 if e.tare else delay,
            drift=np.repeat(e.wrench_drift, 3),
            configuration_size=POSE_SIZE if has_gradient else 0,
        )
        add_system(builder, "wrench", self._wrench, measurement=wrench)
        if has_gradient:
            builder.Connect(pose, self._wrench.get_configuration_input_port())
        self._delay = self._wrench if delay and not e.tare else None
        measured: OutputPort = self._wrench.get_disturbed_measurement_output_port()
        if e.tare:
            tare = WrenchTare(period, *tare_steps(self._inner.control_period))
            measured = add_system(builder, "tare", tare, measured_wrench=measured).get_tared_wrench_output_port()
            if delay:
                self._delay = SensorDisturbance(period, np.zeros(WRENCH_SIZE), delay)
                add_system(builder, "wrench_delay", self._delay, measurement=measured)
                measured = self._delay.get_disturbed_measurement_output_port()
        return measured

    def disturb(self, context: Context, rng: np.random.Generator) -> Mapping[str, Any]:
        """Sample the disturbances of an episode; return them by name."""
        d, e = self._disturbances, self._errors
        friction, modulus = (_sample_factor(rng, factors) for factors in (d.friction_factor, d.modulus_factor))
        scale, seed = _sample_factor(rng, e.wrench_scale), int(rng.integers(2**31))
        bias = rng.uniform(-1.0, 1.0, 6) * np.repeat(e.wrench_bias, 3)
        pose_offset = np.append(rng.uniform(-1.0, 1.0, 3) * d.pose_bias, np.zeros(3))
        if (friction, modulus) != (1.0, 1.0):
            self._inner.set_contact(context, friction, modulus)
        wrench, pose, commands = (
            system.GetMyMutableContextFromRoot(context) for system in (self._wrench, self._pose, self._commands)
        )
        self._wrench.set_error(wrench, np.full(6, scale), bias, seed)
        self._pose.set_error(pose, np.ones(POSE_SIZE), pose_offset, 0)
        # A separate seed: with the same seed, both systems would use the same random numbers.
        self._commands.set_seed(commands, int(np.random.SeedSequence(seed).generate_state(1)[0]))
        sampled = {"friction_factor": friction, "modulus_factor": modulus, "wrench_scale": scale, "wrench_bias": bias}
        further = (*e.calibration_error, *e.wrench_gradient, e.wrench_delay[1] - e.wrench_delay[0])
        if any(further) or e.joint_torque is not None:
            sampled |= self._disturb_further(context, np.random.default_rng([int(rng.integers(2**31)), seed]))
        if d.payload:  # after the inner station has sampled its own errors of the tool
            self._inner.set_payload(context, d.payload)
        return sampled

    def _disturb_further(self, context: Context, rng: np.random.Generator) -> dict[str, Any]:
        """Sample wrench delay, wrench gradient, calibration and the inner station's errors; return them by name."""
        e = self._errors
        delay = int(rng.integers(e.wrench_delay[0], e.wrench_delay[1], endpoint=True))
        # Within a few centimeters, the gradient over position is negligible.
        gradient = np.zeros((WRENCH_SIZE, POSE_SIZE))
        gradient[:, 3:] = rng.uniform(-1.0, 1.0, (WRENCH_SIZE, 3)) * np.repeat(e.wrench_gradient, 3)[:, None]
        calibration = rng.uniform(-1.0, 1.0, POSE_SIZE) * np.repeat(e.calibration_error, 3)
        if self._delay is not None:
            own = self._delay.GetMyMutableContextFromRoot(context)
            self._delay.set_delay(own, delay)
        if any(e.wrench_gradient):
            self._wrench.set_gradient(self._wrench.GetMyMutableContextFromRoot(context), gradient)
        for source, sign in zip(self._calibration, (-1.0, 1.0), strict=False):
            own = source.GetMyMutableContextFromRoot(context)
            source.get_mutable_source_value(own).SetFromVector(sign * calibration)
        sampled = {"wrench_delay": delay, "wrench_gradient": gradient, "calibration_error": calibration}
        return sampled | dict(self._inner.disturb(context, rng))


def _without_replaced_errors(disturbances: Disturbances, station: Station) -> SensorErrors:
    """Return the errors to add at a station's ports, without the errors that its joint torque errors already cause."""
    errors = disturbances.errors
    if errors.joint_torque is None:
        return errors
    if not getattr(station, "estimates_wrench", False):
        return replace(errors, joint_torque=None)
    options = disturbances.model_dump(exclude_none=True)
    exact = SENSING["exact"]
    replaced = ("wrench_scale", "wrench_bias", "wrench_drift", "wrench_noise")
    without_error = {name: getattr(exact, name) for name in replaced if name not in options}
    return replace(errors, **without_error, wrench_gradient=exact.wrench_gradient)


def disturbed(
    build: Callable[..., Station],
    disturbances: Disturbances,
    is_simulated: bool,
    name: str,
    impedance: Impedance | None = None,
) -> Station:
    """Build a station with the impedance of a task, and with disturbances if there are any.

    Args:
        build: Builder of the station; it needs the parameter `impedance` for an `impedance` or a stiffness factor.
        disturbances: Disturbances of the station; on a real robot only `sensing` and `tare`, and only the tare is
            applied.
        is_simulated: False for a real robot.
        name: Name of the station, for messages.
        impedance: Impedance of the task; the builder's own by default, or `Impedance()` if it declares none and there
            is a stiffness factor.

    Raises:
        InputError: If the station does not support a disturbance, has no impedance to set, or is a real robot and there
            are other disturbances than `sensing` and `tare`.
    """
    own_impedance = inspect.signature(build).parameters.get("impedance")
    if impedance is not None and own_impedance is None:
        raise InputError(
            f"station={name!r} takes no impedance, so its force cannot be bounded: give its builder the parameter "
            "impedance, or choose bounded_force=False"
        )
    arguments: dict[str, Any] = {} if impedance is None else {"impedance": impedance}
    if not disturbances.is_active:
        return build(**arguments)
    if not is_simulated and disturbances.is_named_only:
        # A real robot has its own sensor errors, so only the tare of the setting is used.
        can_tare = "tare" in inspect.signature(build).parameters
        return build(**arguments, **({"tare": True} if can_tare and disturbances.errors.tare else {}))
    if not is_simulated:
        raise InputError(f"station={name!r} is a real robot, which has disturbances of its own: leave them out")
    if disturbances.stiffness_factor != 1.0:
        if own_impedance is None:
            raise InputError(f"station={name!r} has no impedance: leave stiffness_factor out")
        default = own_impedance.default
        nominal = impedance or (default if isinstance(default, Impedance) else Impedance())
        stiffness = tuple(disturbances.stiffness_factor * value for value in nominal.stiffness)
        arguments["impedance"] = replace(nominal, stiffness=stiffness)
    if disturbances.joint_friction:
        if "joint_friction" not in inspect.signature(build).parameters:
            raise InputError("only an arm's joints have friction: choose station=arm, or leave joint_friction out")
        arguments["joint_friction"] = disturbances.joint_friction
    errors = disturbances.errors
    if errors.joint_torque is not None and "joint_torque" in inspect.signature(build).parameters:
        arguments["joint_torque"] = errors.joint_torque
    return DisturbedStation(build(**arguments), disturbances)


def _sample_factor(rng: np.random.Generator, factors: tuple[float, ...]) -> float:
    """Return a factor sampled uniformly on a logarithmic scale."""
    low, high = np.log(factors)
    return float(np.exp(rng.uniform(low, high)))


def _disturbed_period(d: Disturbances, station: Station) -> float:
    if d.clock_factor == 1.0:
        return station.control_period
    period = d.clock_factor * station.control_period
    try:
        return whole_multiple(period, station.time_step)
    except InputError:
        raise InputError(
            f"clock_factor {d.clock_factor:g} makes a control period of {period:g} s: it must be a whole multiple of "
            f"the plant's time step of {station.time_step:g} s"
        ) from None
