"""What a robot in a laboratory is like that nobody modelled: options of an environment, all off unless given."""

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
    POSE_SIZE,
    Impedance,
    Station,
    export_station_ports,
)
from guiderail.models.common.errors import InputError
from guiderail.systems.command_disturbance import CommandDisturbance
from guiderail.systems.sensor_disturbance import SensorDisturbance

MANY_TIMES = 100.0
"""The largest factor that anything may be off by, either way."""


def _factors(words: str) -> Any:
    return Field((1.0, 1.0), min_length=2, max_length=2, description=f"least and greatest factor of {words}")


def _largest(words: str) -> Any:
    return Field((0.0, 0.0), min_length=2, max_length=2, description=words)


class Disturbances(Options):
    """Of every environment with a workpiece and a fixture: what is drawn anew in every episode, and what never changes.

    A range is a task's uncertainty: a policy may be trained with it, and is judged with any other.
    """

    friction_factor: Numbers = _factors("all friction, drawn every episode")
    modulus_factor: Numbers = _factors("the contact's stiffness, drawn every episode")
    wrench_scale: Numbers = _factors("what the wrench sensor says, drawn every episode")
    wrench_bias: Numbers = _largest("largest offset of the wrench sensor, drawn every episode: force [N], torque [Nm]")
    wrench_noise: Numbers = _largest("standard deviation of a sample of the wrench: force [N], torque [Nm]")
    wrench_delay: Integer = Field(0, ge=0, le=50, description="control steps by which the wrench is late")
    pose_bias: Number = Field(0.0, ge=0, le=0.01, description="largest error of measured x, y, z, every episode [m]")
    lost_commands: Number = Field(0.0, ge=0, lt=1, description="how likely a command doesn't arrive")
    late_commands: Integer = Field(0, ge=0, le=50, description="control steps by which a command is late")
    control_period: Number | None = Field(
        None, gt=0, le=1, description="of the controller's clock [s], the station's own"
    )
    stiffness_factor: Number = Field(1.0, gt=0, le=MANY_TIMES, description="of the impedance's stiffness")
    payload: Number = Field(0.0, ge=0, le=5, description="mass at an arm's tool that its controller ignores [kg]")

    @field_validator("friction_factor", "modulus_factor", "wrench_scale")
    @classmethod
    def _check_range(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if not 1.0 / MANY_TIMES <= value[0] <= value[1] <= MANY_TIMES:
            raise ValueError(f"give two factors from {1.0 / MANY_TIMES} to {MANY_TIMES}, the smaller one first")
        return value

    @field_validator("wrench_bias", "wrench_noise")
    @classmethod
    def _check_magnitudes(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if min(value) < 0.0:
            raise ValueError("give a force and a torque, none negative")
        return value

    @property
    def any(self) -> bool:
        """Whether anything is other than it should be."""
        return self != type(self).model_validate({})


SIMULATION_PORTS = ("query", "body_poses")


class DisturbedStation(Station):
    """Another station with disturbances between its ports and whoever uses them.

    Its outputs are what a robot would believe; success, and the force that a collision is judged by, stay the truth.
    """

    def __init__(self, station: Station, disturbances: Disturbances):
        """
        Args:
            station: what is disturbed; it becomes part of this one.
            disturbances: in what way.

        Raises:
            InputError: if the station cannot be disturbed like that.
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
            builder, commands.get_command_input_port(), station.get_command_time_input_port(), **outputs
        )
        for name in SIMULATION_PORTS:
            builder.ExportOutput(station.GetOutputPort(name), name)
        builder.BuildInto(self)

    @property
    def nominal_period(self) -> float:
        """Of the station that is disturbed [s]."""
        return self._inner.nominal_period

    def set_pose(self, context: Context, pose: np.ndarray) -> None:
        """Puts the robot at rest with its tool centre at `pose`, (6,), really; `context` is the root context."""
        self._inner.set_pose(context, pose)

    def disturb(self, context: Context, rng: np.random.Generator) -> Mapping[str, Any]:
        """Draws what an episode's contact and sensors are like."""
        d = self._disturbances
        friction, modulus = (_sample_factor(rng, factors) for factors in (d.friction_factor, d.modulus_factor))
        scale, seed = _sample_factor(rng, d.wrench_scale), int(rng.integers(2**31))
        bias = rng.uniform(-1.0, 1.0, 6) * np.repeat(d.wrench_bias, 3)
        beside = np.append(rng.uniform(-1.0, 1.0, 3) * d.pose_bias, np.zeros(3))
        if (friction, modulus) != (1.0, 1.0):
            self._inner.set_contact(context, friction, modulus)
        if d.payload:
            self._inner.set_payload(context, d.payload)
        own = {name: system.GetMyMutableContextFromRoot(context) for name, system in self._systems().items()}
        self._wrench.set_error(own["wrench"], np.full(6, scale), bias, seed)
        self._pose.set_error(own["pose"], np.ones(POSE_SIZE), beside, 0)
        # Of its own: both count their steps, and two that share seed and count draw from one stream.
        self._commands.set_seed(own["commands"], int(np.random.SeedSequence(seed).generate_state(1)[0]))
        return {"friction_factor": friction, "modulus_factor": modulus, "wrench_scale": scale, "wrench_bias": bias}

    def _systems(self) -> dict[str, Any]:
        return {"wrench": self._wrench, "pose": self._pose, "commands": self._commands}


def disturbed(build: Callable[..., Station], disturbances: Disturbances, is_simulated: bool, name: str) -> Station:
    """The station that `build` makes, disturbed where anything is; otherwise it is that station itself.

    Args:
        build: makes it; takes an `impedance` where its stiffness can be disturbed.
        disturbances: in what way.
        simulated: whether it is a simulation.
        name: of the station.

    Raises:
        InputError: if it cannot be disturbed like that.
    """
    if not disturbances.any:
        return build()
    if not is_simulated:
        raise InputError(f"station={name!r} is a real robot, which has disturbances of its own: leave them out")
    how: dict[str, Any] = {}
    if disturbances.stiffness_factor != 1.0:
        if "impedance" not in inspect.signature(build).parameters:
            raise InputError(f"station={name!r} has no impedance whose stiffness could be another: leave it out")
        nominal = Impedance()
        stiffness = tuple(disturbances.stiffness_factor * value for value in nominal.stiffness)
        how["impedance"] = replace(nominal, stiffness=stiffness)
    return DisturbedStation(build(**how), disturbances)


def _sample_factor(rng: np.random.Generator, factors: tuple[float, ...]) -> float:
    """A factor between two, as likely to double as to halve."""
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
