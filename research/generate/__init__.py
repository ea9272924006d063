"""Generators of the files that the package ships, `python -m research.generate NAME`."""

from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import did_you_mean
from guiderail.models.primitives import Demonstrations


def _objects(name: str, dimensions: str) -> Callable[..., None]:
    def write(*folder: Path) -> None:
        model = import_module(f"guiderail.models.objects.{name}")
        for file, content in model.files(getattr(model, dimensions)()).items():
            Path(*(folder or (model.FOLDER,)), file).write_text(content)

    return write


def _passage(*folder: Path) -> None:
    path = import_module("guiderail.models.objects.narrow_passage").PATH
    import_module("research.generate.narrow_passage").generate().save(folder[0] / path.name if folder else path)


def _session(name: str) -> Callable[..., None]:
    def record(*folder: Path) -> None:
        bnc_connector = import_module("research.generate.bnc_connector")
        bnc_connector.main(*(folder or (None,)), getattr(bnc_connector, name))

    return record


def _mixtures(*folder: Path) -> None:
    mixture = import_module("guiderail.models.primitives.mixture")
    connector, passage = (
        import_module(f"guiderail.diagrams.tasks.{name}") for name in ("bnc_connector", "narrow_passage")
    )
    arrays: dict[str, np.ndarray] = {}
    for path, components in [
        (import_module("guiderail.models.objects.narrow_passage").PATH, passage.COMPONENTS),
        *((path, connector.COMPONENTS) for path in connector.DEMONSTRATIONS.values()),
    ]:
        demonstrations = Demonstrations.load(path).resampled()
        arguments = demonstrations.times[0], np.stack(demonstrations.outputs), components, 0
        fitted, key = mixture.fit_new_mixture(*arguments), mixture.digest(*arguments)
        arrays |= {f"{key}/{name}": getattr(fitted, name) for name in mixture.FIELDS}
    np.savez(Path(*(folder or [mixture.STORED_PATH.parent]), mixture.STORED_PATH.name), **arrays)


# Function that writes the files of each generator into a folder; without an argument, into the folder of the package.
GENERATORS: dict[str, Callable[..., None]] = {
    "connector-demonstrations": _session("INSERT_SESSION"),
    "connector-search-demonstrations": _session("SEARCH_SESSION"),
    "connector-firm-search-demonstrations": _session("FIRM_SEARCH_SESSION"),
    "passage-demonstrations": _passage,
    "mixtures": _mixtures,
    "connector-objects": _objects("bnc_connector", "BncDimensions"),
    "clamp-objects": _objects("grid_clamp", "GridClampDimensions"),
}


def generate(name: str, folder: Path | None = None) -> None:
    """Write the files of one generator.

    Args:
        name: One of `GENERATORS`.
        folder: Folder to write into; by default the folder of the files in the package.

    Raises:
        InputError: For an unknown name, or a folder that does not exist.
    """
    if name not in GENERATORS:
        raise InputError(f"there is nothing called {name!r} to generate: {did_you_mean(name, GENERATORS)}")
    if folder is not None and not folder.is_dir():
        raise InputError(f"there is no folder {folder}: make it first")
    GENERATORS[name](*([] if folder is None else [folder]))
