"""What a robot in a laboratory is like that nobody modelled: options of an environment, all off unless given."""

from __future__ import annotations

from typing import Any

from pydantic import Field, field_validator

from guiderail.diagrams.options import Integer, Number, Numbers, Options

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
    def _is_a_range(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if not 1.0 / MANY_TIMES <= value[0] <= value[1] <= MANY_TIMES:
            raise ValueError(f"give two factors from {1.0 / MANY_TIMES} to {MANY_TIMES}, the smaller one first")
        return value

    @field_validator("wrench_bias", "wrench_noise")
    @classmethod
    def _is_two_sizes(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if min(value) < 0.0:
            raise ValueError("give a force and a torque, none negative")
        return value

    @property
    def any(self) -> bool:
        """Whether anything is other than it should be."""
        return self != type(self).model_validate({})
