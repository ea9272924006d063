"""`guiderail generate`: the files that the project ships, written anew."""

from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import did_you_mean


def _main(module: str) -> Callable[..., None]:
    return lambda *folder: import_module(f"guiderail.{module}").main(*folder)


def _passage(*folder: Path) -> None:
    passage = import_module("guiderail.models.objects.narrow_passage.demonstrations")
    passage.generate().save(folder[0] / passage.PATH.name if folder else passage.PATH)


def _search(*folder: Path) -> None:
    recording = import_module("research.generate.bnc_connector")
    recording.main(*(folder or (None,)), recording.SEARCH_SESSION)


# Each is called with a folder, or with nothing for its own.
GENERATED: dict[str, Callable[..., None]] = {
    "connector-demonstrations": _main("tools.recording.generate.bnc_connector"),
    "connector-search-demonstrations": _search,
    "passage-demonstrations": _passage,
    "connector-objects": _main("models.objects.write_bnc"),
    "clamp-objects": _main("models.objects.write_grid_clamp"),
}


def generate(what: str, folder: Path | None = None) -> None:
    """Writes one of `GENERATED` into a folder, its own unless given.

    Raises:
        InputError: for anything else, or a folder that isn't there.
    """
    if what not in GENERATED:
        raise InputError(f"there is nothing called {what!r} to generate: {did_you_mean(what, GENERATED)}")
    if folder is not None and not folder.is_dir():
        raise InputError(f"there is no folder {folder}: make it first")
    GENERATED[what](*([] if folder is None else [folder]))
