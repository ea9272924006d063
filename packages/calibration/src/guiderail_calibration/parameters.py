"""Parameters that a calibration infers, with their priors: values of the disturbances of a simulated station."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import did_you_mean
from guiderail.tools.environments import check_environment
from guiderail_studies.robustness import AXES, ONLY_ON_ARM, Axis


@dataclass(frozen=True)
class Parameter:
    """Parameter of a simulation with a uniform prior, on a linear or a logarithmic scale."""

    axis: Axis  # function from a value to options of the environment, and the label with the unit
    low: float  # smallest value
    high: float  # largest value
    scale: str = "linear"  # "linear", "log" or "integer"

    @property
    def name(self) -> str:
        """Name of the parameter, as in `--parameters`."""
        return self.axis.name

    def value(self, quantiles: np.ndarray) -> np.ndarray:
        """Return the values of quantiles of the prior, each from 0 to 1."""
        q = np.clip(np.asarray(quantiles, dtype=float), 0.0, 1.0)
        if self.scale == "log":
            return np.asarray(self.low * (self.high / self.low) ** q)
        if self.scale == "integer":
            return np.asarray(self.low + np.minimum(np.floor(q * (self.high - self.low + 1)), self.high - self.low))
        return np.asarray(self.low + q * (self.high - self.low))


_AXES = {axis.name: axis for axis in AXES}
PARAMETERS = tuple(
    Parameter(_AXES[name], low, high, scale)
    for name, low, high, scale in (
        ("friction", 0.4, 2.5, "log"),
        ("modulus", 0.1, 10.0, "log"),
        ("stiffness", 0.5, 2.0, "log"),
        ("clearance", 0.5, 2.0, "log"),
        ("wrench_scale", 0.5, 2.0, "log"),
        ("wrench_bias", 0.0, 4.0, "linear"),
        ("wrench_noise", 0.02, 1.0, "log"),
        ("wrench_delay", 1, 8, "integer"),
        ("pose_bias", 0.0, 1.0, "linear"),
        ("lost", 0.0, 0.4, "linear"),
        ("late", 0, 6, "integer"),
        ("payload", 0.0, 1.0, "linear"),
        ("joint_friction", 0.0, 1.0, "linear"),
    )
)
NOT_OFFERED = {
    "damping": "no option changes the damping of the impedance",
    "inertia": "no option changes the apparent inertia of the robot",
}
"""Properties of robots that no option of a simulated station describes, with the reason."""


def select_parameters(
    task: str, environment: Mapping[str, Any], names: Sequence[str] | None = None
) -> tuple[tuple[Parameter, ...], dict[str, str]]:
    """Return the parameters that an environment has, and by name the reason why others are left out.

    Args:
        task: Name of the task.
        environment: Options of the environment.
        names: Names of the parameters; None for all that the environment has.

    Raises:
        InputError: If a name is unknown, or the environment does not have one of the named parameters, or none at all.
    """
    known = {parameter.name: parameter for parameter in PARAMETERS}
    for name in names or ():
        if name not in known:
            raise InputError(f"there is no parameter {name!r}: {did_you_mean(name, known)}")
    resolved = check_environment(task, environment)
    selected, left_out = [], {} if names else dict(NOT_OFFERED)
    for name in names or known:
        reason = _reason(task, resolved, environment, known[name])
        if not reason:
            selected.append(known[name])
        elif names:
            raise InputError(f"{name} cannot be calibrated: {reason}")
        else:
            left_out[name] = reason
    if not selected:
        raise InputError(f"{task} on station={resolved.get('station')!r} has no parameter that can be calibrated")
    return tuple(selected), left_out


def _reason(task: str, resolved: Mapping[str, Any], environment: Mapping[str, Any], parameter: Parameter) -> str:
    """Return why an environment does not have a parameter; "" if it has it."""
    if parameter.name in ONLY_ON_ARM and resolved.get("station") != "arm":
        return "only an arm has it"
    try:
        for value in parameter.value(np.array([0.0, 0.5, 1.0])):
            check_environment(task, {**environment, **parameter.axis.change(resolved, float(value))})
    except InputError as error:
        return str(error)
    return ""


def options_of(
    task: str, environment: Mapping[str, Any], parameters: Sequence[Parameter], quantiles: np.ndarray
) -> dict[str, Any]:
    """Return the options of an environment with the parameters (d,) at quantiles (d,) of their priors."""
    resolved = check_environment(task, environment)
    changes: dict[str, Any] = {}
    for parameter, quantile in zip(parameters, quantiles, strict=True):
        changes |= parameter.axis.change(resolved, float(parameter.value(quantile)))
    return changes
