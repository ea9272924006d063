"""Disturbances of a simulated station that resemble unmodelled effects of a real robot; all off by default."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from pydantic import Field, field_validator
from pydrake.systems.framework import Context, DiagramBuilder

from guiderail.diagrams.envs.options import Integer, Number, Numbers, Options
from guiderail.diagrams.stations.station import (
    CONTROL_PERIOD,
    OUTPUTS,
    PLANT_PERIOD,
    Impedance,
    Station,
    export_station_ports,
)
from guiderail.models.common.errors import InputError
from guiderail.models.common.poses import POSE_SIZE
from guiderail.systems.command_disturbance import CommandDisturbance
from guiderail.systems.sensor_disturbance import SensorDisturbance

MAX_FACTOR = 100.0
"""Largest factor of a disturbance; its inverse is the smallest."""


def _factors(quantity: str) -> Any:
    return Field((1.0, 1.0), min_length=2, max_length=2, description=f"smallest and largest factor of {quantity}")


def _magnitudes(description: str) -> Any:
    return Field((0.0, 0.0), min_length=2, max_length=2, description=description)


class Disturbances(Options):
    """Options of environments with a workcell: constant disturbances, and ranges that every episode samples from.

    A policy can be trained with one range and evaluated with another.
    """

    friction_factor: Numbers = _factors("all friction, sampled every episode")
    modulus_factor: Numbers = _factors("the contact's stiffness, sampled every episode")
    wrench_scale: Numbers = _factors("the measured wrench, sampled every episode")
    wrench_bias: Numbers = _magnitudes(
        "largest offset of the measured wrench, sampled every episode: force [N], torque [Nm]"
    )
    wrench_noise: Numbers = _magnitudes("standard deviation of the measured wrench: force [N], torque [Nm]")
    wrench_delay: Integer = Field(0, ge=0, le=50, description="delay of the measured wrench in control steps")
    pose_bias: Number = Field(
        0.0, ge=0, le=0.01, description="largest offset of measured x, y, z, sampled every episode [m]"
    )
    lost_commands: Number = Field(0.0, ge=0, lt=1, description="probability that a command is lost")
    late_commands: Integer = Field(0, ge=0, le=50, description="delay of a command in control steps")
    control_period: Number | None = Field(
        None, gt=0, le=1, description="period of the controller [s]; the station's by default"
    )
    stiffness_factor: Number = Field(1.0, gt=0, le=MAX_FACTOR, description="factor of the impedance's stiffness")
    payload: Number = Field(
        0.0, ge=0, le=5, description="mass at an arm's tool that its controller does not model [kg]"
    )

    @field_validator("friction_factor", "modulus_factor", "wrench_scale")
    @classmethod
    def _check_range(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if not 1.0 / MAX_FACTOR <= value[0] <= value[1] <= MAX_FACTOR:
            raise ValueError(f"give two factors from {1.0 / MAX_FACTOR} to {MAX_FACTOR}, the smaller one first")
        return value

    @field_validator("wrench_bias", "wrench_noise")
    @classmethod
    def _check_magnitudes(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if min(value) < 0.0:
            raise ValueError("give a force and a torque, none negative")
        return value

    @property
    def any(self) -> bool:
        """True if any disturbance is on."""
        return self != type(self).model_validate({})


SIMULATION_PORTS = ("query", "body_poses")


class DisturbedStation(Station):
    """A station with disturbances between its ports and those of the inner station.

    Measured pose and wrench are disturbed; success and the contact force, by which collisions are detected, are not.
    """

    def __init__(self, station: Station, disturbances: Disturbances):
        """Construct the station; the inner one becomes part of it.

        Raises:
            InputError: If the station does not have such a disturbance.
        """
        super().__init__()
        d = self._disturbances = disturbances
        if d.payload and not hasattr(station, "set_payload"):
            raise InputError("a payload hangs from an arm's tool: choose station=arm, or leave payload out")
        self.plant, self.scene_graph = station.plant, station.scene_graph
        self.control_period, self.wraps_angles = _control_period_of(d), station.wraps_angles
        period = self.control_period
        builder = DiagramBuilder()
        self._inner = builder.AddNamedSystem("station", station)
        self._commands = commands = builder.AddNamedSystem(
            "commands", CommandDisturbance(POSE_SIZE, period, d.lost_commands, d.late_commands)
        )
        self._wrench = wrench = builder.AddNamedSystem(
            "wrench", SensorDisturbance(period, np.repeat(d.wrench_noise, 3), d.wrench_delay)
        )
        self._pose = pose = builder.AddNamedSystem("pose", SensorDisturbance(period, np.zeros(POSE_SIZE)))
        builder.Connect(commands.get_delivered_command_output_port(), station.get_desired_pose_input_port())
        builder.Connect(station.get_pose_output_port(), commands.get_pose_input_port())
        builder.Connect(station.get_wrench_output_port(), wrench.get_measurement_input_port())
        builder.Connect(station.get_pose_output_port(), pose.get_measurement_input_port())
        outputs = {name: station.GetOutputPort(name) for name in OUTPUTS}
        outputs |= {
            "pose": pose.get_disturbed_measurement_output_port(),
            "wrench": wrench.get_disturbed_measurement_output_port(),
        }
        export_station_ports(
            builder,
            commands.get_command_input_port(),
            station.get_command_time_input_port(),
            max_wrench=station.GetInputPort("max_wrench") if station.HasInputPort("max_wrench") else None,
            **outputs,
        )
        for name in SIMULATION_PORTS:
            builder.ExportOutput(station.GetOutputPort(name), name)
        builder.BuildInto(self)

    @property
    def nominal_period(self) -> float:
        """Time between commands of the inner station [s]."""
        return self._inner.nominal_period

    def set_pose(self, context: Context, pose: np.ndarray) -> None:
        """Put the robot at rest with its true tool center at `pose`, (6,); `context` is the root context."""
        self._inner.set_pose(context, pose)

    def disturb(self, context: Context, rng: np.random.Generator) -> Mapping[str, Any]:
        """Sample the disturbances of an episode, and return them by name."""
        d = self._disturbances
        friction, modulus = (_sample_factor(rng, factors) for factors in (d.friction_factor, d.modulus_factor))
        scale, seed = _sample_factor(rng, d.wrench_scale), int(rng.integers(2**31))
        bias = rng.uniform(-1.0, 1.0, 6) * np.repeat(d.wrench_bias, 3)
        pose_offset = np.append(rng.uniform(-1.0, 1.0, 3) * d.pose_bias, np.zeros(3))
        if (friction, modulus) != (1.0, 1.0):
            self._inner.set_contact(context, friction, modulus)
        if d.payload:
            self._inner.set_payload(context, d.payload)
        wrench, pose, commands = (
            system.GetMyMutableContextFromRoot(context) for system in (self._wrench, self._pose, self._commands)
        )
        self._wrench.set_error(wrench, np.full(6, scale), bias, seed)
        self._pose.set_error(pose, np.ones(POSE_SIZE), pose_offset, 0)
        # A seed of its own: with the same seed both systems would use the same random numbers.
        self._commands.set_seed(commands, int(np.random.SeedSequence(seed).generate_state(1)[0]))
        return {"friction_factor": friction, "modulus_factor": modulus, "wrench_scale": scale, "wrench_bias": bias}


def disturbed(
    build: Callable[..., Station],
    disturbances: Disturbances,
    is_simulated: bool,
    name: str,
    impedance: Impedance | None = None,
) -> Station:
    """Build a station with the impedance of a task, and with disturbances if any is on.

    Args:
        build: Builder of the station, with a parameter `impedance` if that or its stiffness is to be set.
        disturbances: Disturbances.
        is_simulated: False for a robot.
        name: Name of the station, for messages.
        impedance: Impedance of the task; the station's own by default.

    Raises:
        InputError: If the station does not have such a disturbance, or no impedance to set.
    """
    has_impedance = "impedance" in inspect.signature(build).parameters
    if impedance is not None and not has_impedance:
        raise InputError(
            f"station={name!r} takes no impedance, so its force cannot be bounded: give its builder the parameter "
            "impedance, or choose bounded_force=False"
        )
    arguments: dict[str, Any] = {} if impedance is None else {"impedance": impedance}
    if not disturbances.any:
        return build(**arguments)
    if not is_simulated:
        raise InputError(f"station={name!r} is a real robot, which has disturbances of its own: leave them out")
    if disturbances.stiffness_factor != 1.0:
        if not has_impedance:
            raise InputError(f"station={name!r} has no impedance whose stiffness could be another: leave it out")
        nominal = impedance or Impedance()
        stiffness = tuple(disturbances.stiffness_factor * value for value in nominal.stiffness)
        arguments["impedance"] = replace(nominal, stiffness=stiffness)
    return DisturbedStation(build(**arguments), disturbances)


def _sample_factor(rng: np.random.Generator, factors: tuple[float, ...]) -> float:
    """Return a factor sampled uniformly on a logarithmic scale."""
    low, high = np.log(factors)
    return float(np.exp(rng.uniform(low, high)))


def _control_period_of(d: Disturbances) -> float:
    if d.control_period is None:
        return CONTROL_PERIOD
    steps = round(d.control_period / PLANT_PERIOD)
    if steps < 1 or abs(steps * PLANT_PERIOD - d.control_period) > 1e-6:
        raise InputError(
            f"control_period is a whole number of the plant's {PLANT_PERIOD:g} s, not {d.control_period} s"
        )
    return steps * PLANT_PERIOD
