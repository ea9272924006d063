"""Model files, read where no network is."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from pydrake.multibody.parsing import ModelDirective, ModelDirectives, Parser, ProcessModelDirectives
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex

from guiderail.models.common.errors import InputError

_VARIABLE = "DRAKE_ALLOW_NETWORK"
_DIRECTIVES = (".yaml", ".yml")


def add_model(plant: MultibodyPlant, path: Path | str) -> ModelInstanceIndex:
    """Adds the one model of an SDF or URDF file on this machine.

    Every `Parser` knows the remote package `drake_models`, and refuses to exist where DRAKE_ALLOW_NETWORK forbids
    packages from the network, whatever it is asked to read. A file of ours refers to none.
    """
    (model,) = add_models(plant, path)
    return model


def add_models(plant: MultibodyPlant, path: Path | str) -> list[ModelInstanceIndex]:
    """Adds the models of an SDF or URDF file, or of a file of Drake model directives (.yaml), on this machine.

    Directives may name packages (folders with a `package.xml`) that lie in the folder of their file.
    """
    with _remote_packages_may_be_named():
        parser = Parser(plant)
        if Path(path).suffix in _DIRECTIVES:
            parser.package_map().PopulateFromFolder(str(Path(path).resolve().parent))
        return parser.AddModels(str(path))


def follow_directives(plant: MultibodyPlant, directives: Sequence[ModelDirective]) -> None:
    """Adds what Drake's model directives say; files are named with their whole path (file://).

    Raises:
        InputError: if they can't be followed.
    """
    try:
        with _remote_packages_may_be_named():
            ProcessModelDirectives(ModelDirectives(directives=list(directives)), Parser(plant))
    except RuntimeError as error:
        words = " ".join(str(error).split())
        raise InputError(f"what should stand around the robot can't be added: {words}") from error


@contextmanager
def _remote_packages_may_be_named() -> Iterator[None]:
    allowed = os.environ.get(_VARIABLE)
    if allowed is None or "package_map" in allowed:
        yield
        return
    os.environ[_VARIABLE] = "package_map"
    try:
        yield
    finally:
        os.environ[_VARIABLE] = allowed
