"""Scenario file: robot, driver address and surroundings in Drake's terms, real or simulated."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
import yaml
from pydrake.common.yaml import yaml_load_typed
from pydrake.lcm import DrakeLcmParams
from pydrake.manipulation import IiwaDriver
from pydrake.multibody.parsing import ModelDirective, ModelDirectives, ProcessModelDirectives
from pydrake.multibody.plant import MultibodyPlant

from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.files import read_bytes
from guiderail.models.common.parsing import allow_package_map, local_parser
from guiderail.models.common.yaml import MAX_SIZE, check_yaml

HARDWARE, SIMULATION = "hardware", "simulation"
_TAGS = ("!IiwaDriver", "!PandaDriver", "!Rpy")  # accepted tags, which name classes
# Supported fields of Drake's classes. Any other field that differs from its default is refused. If, for example, a
# channel suffix were ignored, commands would move another robot.
SUPPORTED = ("control_mode", "lcm_bus", "lcm_url")


@dataclass
class PandaDriver:
    """Driver of a Panda, with the fields of Drake's `IiwaDriver`."""

    lcm_bus: str = "default"
    control_mode: str = "torque_only"


@dataclass
class Scenario:
    """Robot, its bus and its surroundings.

    All fields except `station` are fields of a scenario of Drake's `hardware_sim`; its other fields are refused.
    """

    station: str = SIMULATION  # "simulation" for a simulated driver, or "hardware"
    # Model directives of the surroundings, for a simulated driver.
    directives: list[ModelDirective] = field(default_factory=list)
    # LCM buses by name.
    lcm_buses: dict[str, DrakeLcmParams] = field(default_factory=lambda: {"default": DrakeLcmParams()})
    # Driver by the name of the robot; exactly one.
    model_drivers: dict[str, IiwaDriver | PandaDriver] = field(default_factory=dict)

    @property
    def robot(self) -> str:
        """Name of the robot."""
        return next(iter(self.model_drivers))

    @property
    def robot_url(self) -> str:
        """LCM URL of the robot's bus."""
        return self.lcm_buses[self.model_drivers[self.robot].lcm_bus].lcm_url

    @property
    def is_simulated(self) -> bool:
        """True for a simulated driver."""
        return self.station == SIMULATION


# Required kinds of YAML nodes and their names; Drake's reader has no message for another kind.
_KINDS = {
    "model_drivers": (yaml.MappingNode, "a mapping"),
    "lcm_buses": (yaml.MappingNode, "a mapping"),
    "directives": (yaml.SequenceNode, "a list"),
}


def _check_kinds(text: str) -> None:
    """Raise a ValueError if the root, a collection of the root, or an entry of a collection has the wrong kind."""
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    if not isinstance(root, yaml.MappingNode):
        raise ValueError("it must be a mapping with model_drivers")
    for key, node in root.value:
        if key.value not in _KINDS:
            continue
        _check_kind(node, *_KINDS[key.value], key.value)
        is_list = isinstance(node, yaml.SequenceNode)
        entries = enumerate(node.value) if is_list else ((name.value, entry) for name, entry in node.value)
        for name, entry in entries:
            if name != "<<":  # a merge key may have a list of mappings
                _check_kind(entry, yaml.MappingNode, "a mapping", f"{name} of {key.value}")


def _check_kind(node: Any, kind: type[yaml.Node], name: str, what: str) -> None:
    if not isinstance(node, kind):
        actual = brief(node.value) if isinstance(node, yaml.ScalarNode) else f"a {node.id}"
        raise ValueError(f"{what} must be {name}, not {actual}")


def read_typed(
    path: Path,
    defaults: Any,
    what: str,
    tags: tuple[str, ...],
    check: Callable[[str], None] = lambda text: None,
) -> Any:
    """Read a YAML file as an object of the class of `defaults`.

    Args:
        path: File.
        defaults: Object with the values that the file may leave out.
        what: Noun for messages.
        tags: Accepted tags, which name classes.
        check: Function that raises a ValueError for a text that Drake's reader has no message for.

    Raises:
        InputError: If the file does not exist, is too large, or is not of the class.
    """
    text = read_bytes(path, what, MAX_SIZE).decode("utf-8", errors="replace")
    check_yaml(text, str(path), tags)  # Drake's reader has no limits
    try:
        check(text)
        return yaml_load_typed(schema=type(defaults), data=text, defaults=defaults)
    except (yaml.YAMLError, RuntimeError, LookupError, ValueError, TypeError, AttributeError, AssertionError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path} is no {what}: {reason}") from error


def load_scenario(path: Path) -> Scenario:
    """Read a scenario file.

    Raises:
        InputError: If the file does not exist or is invalid, or sets an unsupported field of a driver or a bus.
    """
    scenario = read_typed(path, Scenario(), "scenario", _TAGS, _check_kinds)
    if scenario.station not in (HARDWARE, SIMULATION):
        raise InputError(f"{path}: a station is {HARDWARE} or {SIMULATION}, not {scenario.station!r}")
    if len(scenario.model_drivers) != 1:
        raise InputError(f"{path}: exactly one robot must have a driver, not {len(scenario.model_drivers)}")
    driver = scenario.model_drivers[scenario.robot]
    expected = {"iiwa14": IiwaDriver, "panda": PandaDriver}.get(scenario.robot)
    if expected is not None and not isinstance(driver, expected):
        tags = f"!{expected.__name__}, not !{type(driver).__name__}"
        raise InputError(f"{path}: the driver of {scenario.robot} has the tag {tags}")
    if driver.control_mode != "torque_only":
        raise InputError(
            f"{path}: the impedance controller sends torques, so the driver must accept them: set "
            "control_mode: torque_only"
        )
    if driver.lcm_bus not in scenario.lcm_buses:
        raise InputError(
            f"{path}: {scenario.robot}'s driver is on the bus {driver.lcm_bus!r}, which lcm_buses does not define"
        )
    try:
        url = urlsplit(scenario.robot_url)
    except ValueError:
        raise InputError(f"{path}: {brief(scenario.robot_url)} is no address: give udpm://ADDRESS:PORT") from None
    if url.scheme not in ("", "udpm", "memq") or parse_qs(url.query).get("ttl", ["0"])[-1] not in ("0", "1"):
        raise InputError(
            f"{path}: messages to {brief(scenario.robot_url)} leave the local network: give a udpm:// address with a "
            "ttl of 0 or 1, or give another address by --robot-url"
        )
    for config in (driver, scenario.lcm_buses[driver.lcm_bus]):
        for name in (each.name for each in getattr(config, "__fields__", ()) if each.name not in SUPPORTED):
            value = getattr(config, name)
            if not np.array_equal(value, getattr(type(config)(), name)):
                raise InputError(
                    f"{path}: {name} is {value!r}, which is not supported: leave it out, and start the driver "
                    "without it"
                )
    return scenario


def follow_directives(plant: MultibodyPlant, directives: Sequence[ModelDirective], folder: Path | None = None) -> None:
    """Add the models of Drake model directives to a plant.

    The directives name files by absolute paths (file://), in the package `guiderail`, which has the models of this
    package (package://guiderail/robots/iiwa14.urdf), or in a package (folder with a `package.xml`) in `folder`.

    Raises:
        InputError: If the directives cannot be processed.
    """
    try:
        with allow_package_map():
            parser = local_parser(plant)
            if folder is not None:
                parser.package_map().PopulateFromFolder(str(folder.resolve()))
            ProcessModelDirectives(ModelDirectives(directives=list(directives)), parser)
    except (RuntimeError, SystemExit) as error:
        words = " ".join(str(error).split())
        raise InputError(f"the model directives can't be processed: {words}") from error
