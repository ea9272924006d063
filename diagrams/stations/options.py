"""Options of stations, errors of sensors, and disturbances of a simulated station; nothing here imports Drake.

A station's sensors have named settings: exact, a wrist force-torque sensor, or an arm's joint torque sensors. Sources
of their numbers, with references to docs/bibliography.md:

- An arm with joint torque sensors [25]: at the tool a noise of 0.035 N and 0.005 Nm, a repeatability of 0.15 N and
  0.05 Nm, and an accuracy of 0.8 N and 0.15 Nm.
- Another such arm [26]: pose repeatability of 0.15 mm, joint torques accurate to 2 % of the largest torque.
- An arm with a sensor at its flange [27]: precision of 3.5 N and 0.2 Nm, accuracy of 4 N and 0.3 Nm.
- A wrist sensor [28]: resolution of 0.0125 N and 0.00075 Nm, uncertainty of about 1 % of the range.
- An identified dynamic model of the first arm, with friction [29].

Noise of 0.01 % of a joint's largest torque corresponds to the tool noise in the first arm's data sheet; friction of
0.02 % stays within the arm's repeatability. Before the tare, offsets and model errors are much larger: newtons at the
tool. Strain gauges drift with temperature, but hardly within one episode. docs/concepts/sensors.md has the resulting
errors of each arm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, field_validator

from guiderail.diagrams.envs.options import Integer, Number, Options, Pair, entries_of, increases, satisfies
from guiderail.models.common.arrays import round_period
from guiderail.models.common.transforms import MM
from guiderail.models.robots import DEFAULT_END_EFFECTOR, DEFAULT_ROBOT

CONTROL_PERIOD = 4 * round_period(0.005)  # default time between commands [s]
MAX_SUBSTEPS = 128  # largest number of a plant's time steps in `CONTROL_PERIOD`
ImpedanceControl = Literal["joint", "cartesian"]
MAX_CALIBRATION_ERROR = 0.01  # largest error [m], [rad]; a larger one is probably in millimeters or degrees
MAX_FACTOR = 100.0
"""Largest factor of a disturbance; its inverse is the smallest factor of a sampled range."""


class ContactOptions(Options):
    """Options of a station that simulates the contact of an insertion."""

    time_step: Number | None = Field(
        None,
        gt=0,
        description="time step of the plant [s], which divides control_period, such as 0.001 or 0.0025",
    )

    @field_validator("time_step")
    @classmethod
    def _at_least_shortest(cls, value: float | None) -> float | None:
        if value is not None and value < 0.999 * CONTROL_PERIOD / MAX_SUBSTEPS:
            raise ValueError(f"it is at least {CONTROL_PERIOD / MAX_SUBSTEPS:.2g} s")
        return value


class ArmOptions(ContactOptions):
    """Options of the arm station."""

    robot: str = Field(DEFAULT_ROBOT, description="name of the arm")
    end_effector: str = Field(DEFAULT_END_EFFECTOR, description="name of the tool on the flange")


class GantryOptions(ContactOptions):
    """Options of the gantry station."""

    impedance_control: ImpedanceControl = Field(
        "joint",
        description="joint: springs and dampers of the joints, solved with the contact; cartesian: the controller of "
        "an arm",
    )


Sensing = Literal["exact", "wrist", "robot"]

TARE_SKIPPED, TARE_AVERAGED = 3, 5
"""Times before and during the tare, in multiples of `CONTROL_PERIOD`. Every shipped task begins with a longer free
motion."""


@dataclass(frozen=True)
class JointTorqueAccuracy:
    """Errors of an arm's external joint torques.

    Except for the standard deviations, each value is the limit of an error that is sampled uniformly every episode.
    """

    gain: float = 0.01  # relative error of a torque
    offset: float = 0.005  # offset of a sensor, as a fraction of the joint's largest torque
    friction: float = 2e-4  # friction that a sensor measures, as a fraction of that torque
    drift: float = 5e-5  # standard deviation of a sensor's drift after `DRIFT_TIME`, as a fraction of that torque
    noise: float = 1e-4  # standard deviation of a sensor's noise, as a fraction of that torque
    mass: float = 0.02  # relative error of the mass of each link
    center: float = 2.0 * MM  # error of the center of mass of each body in each direction [m]
    payload: float = 0.05  # error of the mass of tool and workpiece [kg]


@dataclass(frozen=True)
class SensorErrors:
    """Errors of the measured wrench and pose.

    Pairs are of force [N] and torque [Nm], or of length [m] and angle [rad], except for ranges of scale and delay.
    """

    # Smallest and largest factor of the measured wrench, sampled every episode.
    wrench_scale: tuple[float, float] = (1.0, 1.0)
    wrench_bias: tuple[float, float] = (0.0, 0.0)  # largest offset of each component, sampled every episode
    wrench_drift: tuple[float, float] = (0.0, 0.0)  # standard deviation of the wrench's random walk after `DRIFT_TIME`
    # Largest change of the bias per radian that the tool turns about each axis.
    wrench_gradient: tuple[float, float] = (0.0, 0.0)
    wrench_noise: tuple[float, float] = (0.0, 0.0)  # standard deviation of white noise
    wrench_delay: tuple[int, int] = (0, 0)  # smallest and largest delay in control steps, sampled every episode
    # Largest constant error of the arm's kinematics, sampled every episode. It affects commands and measurements alike,
    # so that the actual pose of the tool differs from the measured pose.
    calibration_error: tuple[float, float] = (0.0, 0.0)
    # Resolution of a measured pose, which follows from the encoders' resolution.
    pose_resolution: tuple[float, float] = (0.0, 0.0)
    tare: bool = False  # subtract the wrench of the episode's first control steps, which are free motion
    # Errors of an arm's joint torque sensors, which replace the scale, bias, drift, gradient and noise of the wrench on
    # an arm; None if the wrench is measured at the wrist.
    joint_torque: JointTorqueAccuracy | None = None


# An absolute encoder of 19 bits has steps of 12 µrad, which are 10 µm at a reach of 0.8 m.
_KINEMATICS: dict[str, Any] = {"calibration_error": (0.15 * MM, 5e-4), "pose_resolution": (1e-5, 1.2e-5)}

SENSING: dict[Sensing, SensorErrors] = {
    "exact": SensorErrors(),
    "wrist": SensorErrors(
        wrench_scale=(0.99, 1.01),
        wrench_bias=(2.0, 0.1),
        wrench_drift=(0.05, 0.001),
        wrench_gradient=(0.05, 0.01),
        wrench_noise=(0.0125, 0.00075),
        wrench_delay=(1, 2),
        tare=True,
        **_KINEMATICS,
    ),
    "robot": SensorErrors(
        wrench_scale=(0.99, 1.01),
        wrench_bias=(3.0, 0.3),
        wrench_drift=(0.1, 0.01),
        wrench_gradient=(0.3, 0.03),
        wrench_noise=(0.05, 0.005),
        wrench_delay=(1, 5),
        tare=True,
        joint_torque=JointTorqueAccuracy(),
        **_KINEMATICS,
    ),
}
"""Errors of each setting. Without an arm, "robot" means wrench errors of the size that joint torque sensors cause."""


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
    return Field(None, description=f"{description}; default: set by the profile")


class Disturbances(Options):
    """Options of environments with a workcell: constant disturbances, and ranges that every episode samples from.

    A policy can be trained with one range and evaluated with another. `sensing` names a setting of all sensor errors.
    An entry for a single error replaces this error of the setting.
    """

    entries: ClassVar[Mapping[str, str]] = entries_of(
        "sensing",
        "wrench_scale", "wrench_bias", "wrench_noise", "wrench_delay", "calibration_error", "tare", "pose_bias",
    ) | entries_of(
        "disturbances",
        "friction_factor", "modulus_factor", "stiffness_factor", "lost_commands", "late_commands", "clock_factor",
        "payload", "joint_friction",
    )  # fmt: skip

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
    wrench_noise: Magnitudes | None = _sensor_error("standard deviation of the measured wrench: force [N], torque [Nm]")
    wrench_delay: Integer | None = Field(
        None, ge=0, le=50, description="delay of the measured wrench in control steps; default: set by the profile"
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
    joint_friction: Number = Field(
        0.0,
        ge=0,
        le=10,
        description="Coulomb friction of each of an arm's joints that its controller does not model [Nm]",
    )

    @property
    def errors(self) -> SensorErrors:
        """Errors of the sensors: errors of the setting `sensing`, replaced by the given options of single errors.

        Joint torques have separate errors. A given `wrench_scale` replaces their gain, `wrench_bias` their offset
        and the errors of the arm's model, `wrench_noise` their noise.
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
