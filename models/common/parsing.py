"""Parsing of local model files, without access to the network."""

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from xml.etree import ElementTree

from pydrake.multibody.parsing import PackageMap, Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex

from guiderail.models.common.errors import InputError

_VARIABLE = "DRAKE_ALLOW_NETWORK"
_DIRECTIVES = (".yaml", ".yml")
_PACKAGE = "package.xml"  # file of a ROS package
_OWN_URL, _MODELS = "package://guiderail/", Path(__file__).parents[1]  # URL and folder of this package's models


def add_models(plant: MultibodyPlant, path: Path | str) -> list[ModelInstanceIndex]:
    """Add the models of a local SDF or URDF file, or of a file of Drake model directives (.dmd.yaml), to a plant.

    `path` may also name a model of this package, such as package://guiderail/robots/iiwa14.urdf. Directives may refer
    to packages (folders with a `package.xml`) in the folder of their file. `package://` in a model refers to packages
    above its file, packages next to these, and packages in the folders of ROS_PACKAGE_PATH.

    Raises:
        InputError: If the file is of another type, or the file or one of its meshes cannot be read.
    """
    with allow_package_map():
        parser = local_parser(plant)
        if str(path).startswith(_OWN_URL):
            path = _MODELS / str(path).removeprefix(_OWN_URL)
        _refuse_crossed_limits(Path(path))
        if Path(path).suffix in _DIRECTIVES:
            parser.package_map().PopulateFromFolder(str(Path(path).resolve().parent))
        else:
            _add_packages(parser.package_map(), Path(path))
        try:
            return parser.AddModels(str(path))
        except (RuntimeError, SystemExit) as error:  # a failed assertion of Drake is a SystemExit
            words = " ".join(str(error).split())
            raise InputError(f"the model {path}, or a mesh in it, can't be read: {words}") from error


def _add_packages(packages: PackageMap, path: Path) -> None:
    """Add the packages that a model may name by `package://`; the nearest package of a name is used."""
    try:
        if b"package://" not in path.read_bytes():
            return
    except OSError:
        return  # a file that Drake's parser refuses
    above = [folder for folder in path.resolve().parents if (folder / _PACKAGE).is_file()]
    for xml in (*(folder / _PACKAGE for folder in above), *(xml for folder in above for xml in _siblings(folder))):
        if (name := _package_name(xml)) and not packages.Contains(name):
            packages.Add(name, str(xml.parent))
    if os.environ.get("ROS_PACKAGE_PATH"):
        others = PackageMap.MakeEmpty()
        others.PopulateFromRosPackagePath()
        for name in others.GetPackageNames():
            if not packages.Contains(name):
                packages.Add(name, others.GetPath(name))


def _siblings(package: Path) -> list[Path]:
    """Return the `package.xml` of the packages next to a package, in the order of their names."""
    return sorted(package.parent.glob(f"*/{_PACKAGE}"))


def _package_name(xml: Path) -> str:
    """Return the name of a package; empty if its `package.xml` cannot be read."""
    try:
        return (ElementTree.parse(xml).findtext("name") or "").strip()
    except (ElementTree.ParseError, OSError, ValueError):
        return ""


def _refuse_crossed_limits(path: Path) -> None:
    """Raise an `InputError` if a joint's lower limit is above its upper one; Drake's error would not name the joint."""
    try:
        joints = list(ElementTree.parse(path).iter("joint"))
    except (ElementTree.ParseError, OSError, ValueError):
        return  # not XML, or a file that Drake's parser refuses
    for joint in joints:
        for limit in joint.iter("limit"):  # attributes in URDF, elements in SDF
            lower, upper = (_to_float(limit.get(name, limit.findtext(name))) for name in ("lower", "upper"))
            if lower > upper:
                name = joint.get("name", "")
                raise InputError(f"the lower position limit of joint {name!r} in {path} is above the upper one")


def _to_float(text: str | None) -> float:
    try:
        return float(text or "nan")
    except ValueError:
        return math.nan


def local_parser(plant: MultibodyPlant) -> Parser:
    """Return a parser without the package `drake_models`, whose files Drake would download; see `allow_package_map`."""
    parser = Parser(plant)
    parser.package_map().Remove("drake_models")
    parser.package_map().Add("guiderail", str(_MODELS))
    return parser


@contextmanager
def allow_package_map() -> Iterator[None]:
    """Allow Drake's `Parser` to register the remote package `drake_models`; nothing is downloaded.

    The constructor of the parser registers this package, and raises an error if DRAKE_ALLOW_NETWORK forbids it.
    """
    allowed = os.environ.get(_VARIABLE)
    if allowed is None or "package_map" in allowed:
        yield
        return
    os.environ[_VARIABLE] = "package_map"
    try:
        yield
    finally:
        os.environ[_VARIABLE] = allowed
