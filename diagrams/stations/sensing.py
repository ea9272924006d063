"""Named settings of a station's sensors: exact, a wrist force-torque sensor, or an arm's joint torque sensors.

Data sheets and papers that the numbers come from, by their number in docs/bibliography.md:

- An arm with joint torque sensors [25]: at the tool a noise of 0.035 N and 0.005 Nm, a repeatability of 0.15 N and
  0.05 Nm, and an accuracy of 0.8 N and 0.15 Nm.
- Another such arm [26]: pose repeatability of 0.15 mm, joint torques accurate to 2 % of the largest torque.
- An arm with a sensor at its flange [27]: precision of 3.5 N and 0.2 Nm, accuracy of 4 N and 0.3 Nm.
- A wrist sensor [28]: resolution of 0.0125 N and 0.00075 Nm, uncertainty of about 1 % of the range.
- An identified dynamic model of the first arm, with friction [29].

Noise of 0.01 % of a joint's largest torque gives the tool noise in the first arm's data sheet; friction of 0.02 % stays
within the arm's repeatability. Before the tare, offsets and model errors are much larger: newtons at the tool.
Strain gauges drift with temperature, but hardly within one episode. docs/concepts/sensors.md has the resulting
errors of each arm.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from guiderail.models.common.transforms import MM

Sensing = Literal["exact", "wrist", "robot"]

TARE_SKIPPED, TARE_AVERAGED = 3, 5
"""Numbers of control steps before and during the tare. Every shipped task begins with a longer free motion."""


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
    """Errors of the measured wrench and pose, in pairs of force [N] and torque [Nm], or length [m] and angle [rad]."""

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
"""Errors of each setting. On a station without an arm, "robot" has wrench errors like those of joint torque sensors."""
