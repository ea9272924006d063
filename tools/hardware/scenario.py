"""Where a robot is, as a file: Drake's own words, and one switch between a simulated robot and a real one."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml
from pydrake.common.yaml import yaml_load_typed
from pydrake.lcm import DrakeLcmParams
from pydrake.manipulation import IiwaDriver
from pydrake.multibody.parsing import ModelDirective

from guiderail.models.common.errors import InputError

HARDWARE, SIMULATION = "hardware", "simulation"
# Of Drake's own classes. Another word would be passed over: with a suffix, another robot than the one meant would move.
FOLLOWED = ("control_mode", "lcm_bus", "lcm_url")


@dataclass
class PandaDriver:
    """The driver of a Panda, as Drake's own of an iiwa is written; torque is what it is controlled by."""

    lcm_bus: str = "default"
    control_mode: str = "torque_only"


@dataclass
class Scenario:
    """A robot, its bus and what stands around it.

    The words are those of Drake's `hardware_sim`, so that its files can be read here and the other way round.

    Attributes:
        station: "simulation", where a simulated robot stands in, or "hardware".
        directives: what stands around the fixture, in a simulation: Drake's model directives.
        lcm_buses: by name.
        model_drivers: by the name of the robot; exactly one.
    """

    station: str = SIMULATION
    directives: list[ModelDirective] = field(default_factory=list)
    lcm_buses: dict[str, DrakeLcmParams] = field(default_factory=lambda: {"default": DrakeLcmParams()})
    model_drivers: dict[str, IiwaDriver | PandaDriver] = field(default_factory=dict)

    @property
    def robot(self) -> str:
        """Its name."""
        return next(iter(self.model_drivers))

    @property
    def lcm_url(self) -> str:
        """Of the robot's bus."""
        return self.lcm_buses[self.model_drivers[self.robot].lcm_bus].lcm_url

    @property
    def is_simulated(self) -> bool:
        """Whether a simulated robot stands in."""
        return self.station == SIMULATION


def load_scenario(path: Path) -> Scenario:
    """Reads a scenario.

    Raises:
        InputError: if there is no such file, it makes no sense, or it says of a driver or a bus what nothing here
            follows.
    """
    if not path.is_file():
        raise InputError(f"there is no scenario {path}")
    try:
        scenario = yaml_load_typed(schema=Scenario, filename=str(path), defaults=Scenario())
    except (yaml.YAMLError, RuntimeError, LookupError, ValueError, TypeError, AttributeError, AssertionError) as error:
        words = " ".join(str(error).split())
        raise InputError(f"{path} is no scenario: {words}") from error
    if scenario.station not in (HARDWARE, SIMULATION):
        raise InputError(f"{path}: a station is {HARDWARE} or {SIMULATION}, not {scenario.station!r}")
    if len(scenario.model_drivers) != 1:
        raise InputError(f"{path}: exactly one robot has a driver, not {len(scenario.model_drivers)}")
    driver = scenario.model_drivers[scenario.robot]
    if driver.control_mode != "torque_only":
        raise InputError(f"{path}: the impedance is here, so the driver takes torques: control_mode: torque_only")
    if driver.lcm_bus not in scenario.lcm_buses:
        raise InputError(
            f"{path}: {scenario.robot}'s driver is on the bus {driver.lcm_bus!r}, which is none of its own"
        )
    for said in (driver, scenario.lcm_buses[driver.lcm_bus]):
        for name in (one.name for one in getattr(said, "__fields__", ()) if one.name not in FOLLOWED):
            value = getattr(said, name)
            if not np.array_equal(value, getattr(type(said)(), name)):
                raise InputError(
                    f"{path}: {name} is {value!r}, which nothing here follows: leave it out, and start the driver "
                    "without it"
                )
    return scenario
