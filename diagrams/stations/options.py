"""Options of stations, and disturbances of a simulated station; nothing here imports Drake."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, field_validator

from guiderail.diagrams.envs.options import Integer, Number, Options, Pair, increases, satisfies
from guiderail.diagrams.stations.sensing import SENSING, Sensing, SensorErrors
from guiderail.models.common.arrays import round_period
from guiderail.models.robots import DEFAULT_END_EFFECTOR, DEFAULT_ROBOT

CONTROL_PERIOD = 4 * round_period(0.005)  # [s]
MAX_HALVINGS = 7
ImpedanceControl = Literal["joint", "cartesian"]
MAX_CALIBRATION_ERROR = 0.01  # [m], [rad]; a larger one is probably in millimeters or degrees
MAX_FACTOR = 100.0
"""Largest factor of a disturbance; its inverse is the smallest factor of a sampled range."""


class ContactOptions(Options):
    """Options of a station that simulates the contact of an insertion."""

    time_step: Number | None = Field(
        None, gt=0, description="time step of the plant [s]: the control period, or half, a quarter, an eighth … of it"
    )

    @field_validator("time_step")
    @classmethod
    def _part_of_control_period(cls, value: float | None) -> float | None:
        if value is None:
            return None
        halvings = np.log2(CONTROL_PERIOD / value)
        if abs(halvings - round(halvings)) > 1e-6 or not 0 <= round(halvings) <= MAX_HALVINGS:
            raise ValueError(
                f"it is the control period, {CONTROL_PERIOD:g} s, or half, a quarter, … of it, at most {MAX_HALVINGS} "
                "times halved"
            )
        # Multiples of this value are exact: see `round_period`.
        return CONTROL_PERIOD / 2 ** round(halvings)


class ArmOptions(ContactOptions):
    """Options of the arm station."""

    robot: str = Field(DEFAULT_ROBOT, description="arm")
    end_effector: str = Field(DEFAULT_END_EFFECTOR, description="tool on the flange")


class GantryOptions(ContactOptions):
    """Options of the gantry station."""

    impedance_control: ImpedanceControl = Field(
        "joint",
        description="joint: springs and dampers of the joints, solved with the contact; cartesian: the controller of "
        "an arm",
    )


class HardwareOptions(Options):
    """Options of a station with a real arm."""

    robot: str = Field(DEFAULT_ROBOT, description="arm")
    end_effector: str = Field(DEFAULT_END_EFFECTOR, description="tool on the flange")
    driver: str = Field("", description="driver of the robot; default: the one with the robot's name")
    robot_url: str = Field("", description="LCM URL of the driver's bus, or host of the robot; default: LCM's default")
    robot_timeout: Number = Field(10.0, gt=0, description="longest wait for the robot's first status [s]")


Factors = Annotated[
    Pair,
    increases(
        1.0 / MAX_FACTOR, MAX_FACTOR, f"give two factors from {1.0 / MAX_FACTOR} to {MAX_FACTOR}, the smaller one first"
    ),
]
Magnitudes = Annotated[Pair, satisfies(lambda pair: min(pair) >= 0.0, "give two numbers, none negative")]
CalibrationError = Annotated[
    Magnitudes,
    satisfies(
        lambda pair: max(pair) <= MAX_CALIBRATION_ERROR,
        f"give an error in meters and one in radians, each at most {MAX_CALIBRATION_ERROR}",
    ),
]


def _sensor_error(description: str) -> Any:
    return Field(None, description=f"{description}; default: set by sensing")


class Disturbances(Options):
    """Options of environments with a workcell: constant disturbances, and ranges that every episode samples from.

    A policy can be trained with one range and evaluated with another. `sensing` names a setting of all sensor errors;
    an error that is given as well replaces that of the setting.
    """

    sensing: Sensing = Field(
        "exact",
        description="errors of the sensors: exact has none, wrist is a force-torque sensor at the wrist, robot "
        "estimates the wrench from joint torques; both are tared",
    )
    friction_factor: Factors = Field(
        (1.0, 1.0), description="smallest and largest factor of all friction, sampled every episode"
    )
    modulus_factor: Factors = Field(
        (1.0, 1.0), description="smallest and largest factor of the contact's stiffness, sampled every episode"
    )
    wrench_scale: Factors | None = _sensor_error(
        "smallest and largest factor of the measured wrench, sampled every episode"
    )
    wrench_bias: Magnitudes | None = _sensor_error(
        "largest offset of the measured wrench, sampled every episode: force [N], torque [Nm]"
    )
    wrench_drift: Magnitudes | None = _sensor_error(
        "random walk of the measured wrench, by its standard deviation after 10 s: force [N], torque [Nm]"
    )
    wrench_noise: Magnitudes | None = _sensor_error("standard deviation of the measured wrench: force [N], torque [Nm]")
    wrench_delay: Integer | None = Field(
        None, ge=0, le=50, description="delay of the measured wrench in control steps; default: set by sensing"
    )
    calibration_error: CalibrationError | None = _sensor_error(
        "largest error of the robot's kinematics, sampled every episode: position [m], orientation [rad]"
    )
    tare: bool | None = _sensor_error("subtract the wrench measured at the start, in free motion")
    pose_bias: Number = Field(
        0.0, ge=0, le=0.01, description="largest offset of measured x, y, z, sampled every episode [m]"
    )
    lost_commands: Number = Field(0.0, ge=0, lt=1, description="probability that a command is lost")
    late_commands: Integer = Field(0, ge=0, le=50, description="delay of a command in control steps")
    clock_factor: Number = Field(
        1.0, gt=0, le=MAX_FACTOR, description="factor of the control period; the motion is slower by this factor"
    )
    stiffness_factor: Number = Field(1.0, gt=0, le=MAX_FACTOR, description="factor of the impedance's stiffness")
    payload: Number = Field(
        0.0, ge=0, le=5, description="mass at an arm's tool that its controller does not model [kg]"
    )

    @property
    def errors(self) -> SensorErrors:
        """Errors of the sensors: those of `sensing`, with the given ones in their place.

        Joint torques have errors of their own. A given `wrench_scale` replaces their gain, `wrench_bias` their offset
        and the errors of the arm's model, `wrench_drift` their drift and friction, `wrench_noise` their noise.
        """
        errors = SENSING[self.sensing]
        given: dict[str, Any] = {
            field.name: getattr(self, field.name)
            for field in fields(SensorErrors)
            if getattr(self, field.name, None) is not None
        }
        joint_torque = errors.joint_torque
        if joint_torque is not None:
            none = {
                "wrench_scale": {"gain": 0.0},
                "wrench_bias": {"offset": 0.0, "mass": 0.0, "center": 0.0, "payload": 0.0},
                "wrench_drift": {"drift": 0.0, "friction": 0.0},
                "wrench_noise": {"noise": 0.0},
            }
            for name, replaced in none.items():
                joint_torque = replace(joint_torque, **(replaced if name in given else {}))
        if "wrench_delay" in given:
            given["wrench_delay"] = (given["wrench_delay"],) * 2
        return replace(errors, **given, joint_torque=joint_torque)

    @property
    def is_named_only(self) -> bool:
        """True if all options except `sensing` and `tare` have their defaults."""
        return self == type(self).model_validate({"sensing": self.sensing, "tare": self.tare})

    @property
    def is_active(self) -> bool:
        """True if any disturbance is on."""
        undisturbed = type(self).model_validate({})
        given = {field.name: None for field in fields(SensorErrors) if field.name in type(self).model_fields}
        return self.errors != undisturbed.errors or self.model_copy(update=given) != undisturbed
