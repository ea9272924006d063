"""Imports of user code by name: modules, files and task folders that register tasks, guidance, stations or learners.

Importing executes code. `import_modules` imports what the user names. `import_stored` imports what a file names, such
as the configuration of a run; a module or file that this process has not imported before is executed only while
`trust_imports` is active.
"""

import hashlib
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from importlib import import_module
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path

from guiderail.diagrams.tasks.registry import is_task_folder, register_task_folder
from guiderail.models.common.errors import InputError, brief, naming_failures

_IMPORTED_FILES: dict[Path, bytes] = {}  # content of each file when it was imported
_TRUSTED = ContextVar("trusted", default=False)  # True if imports that a file names may be executed


@contextmanager
def trust_imports() -> Iterator[None]:
    """Allow files that are read in this context, such as run folders, to import the code that they name."""
    token = _TRUSTED.set(True)
    try:
        yield
    finally:
        _TRUSTED.reset(token)


def is_trusted() -> bool:
    """Return True if files may import the code that they name; see `trust_imports`."""
    return _TRUSTED.get()


def import_modules(modules: Iterable[str], remedy: str = ": restore it, or give another --import") -> tuple[str, ...]:
    """Import modules, files (.py) or task folders that register tasks, guidance, stations or learners.

    Args:
        modules: Names of modules, or paths of files or task folders.
        remedy: End of the message about a missing module, file or folder.

    Returns:
        Names with which the modules can be imported again. Files and folders have absolute paths, so that a run can be
        resumed from another folder.
    """
    names = []
    for module in modules:
        path = Path(module)
        if is_task_folder(path):
            register_task_folder(path)
            names.append(str(path.resolve()))
        elif path.suffix == ".py" and path.is_file():
            names.append(_import_file(path))
        elif _is_module(module):
            with naming_failures(f"importing {module}"):
                names.append(import_module(module).__name__)
        else:
            kind = "file or task folder" if path.is_absolute() or len(path.parts) > 1 else "module, file or task folder"
            name = module if module.isprintable() else brief(module)
            raise InputError(f"there is no {kind} {name} to import{remedy}")
    return tuple(names)


def import_stored(modules: Iterable[str], source: Path) -> tuple[str, ...]:
    """Import the modules that a file names, unless that would execute new code without trust (`trust_imports`).

    A task folder contains no code. A module or file that this process has imported before needs no trust; a file is
    executed again if its content has changed.

    Args:
        modules: Names of modules, or paths of files or task folders.
        source: File that names the modules, for messages.

    Returns:
        Names with which the modules can be imported again, as `import_modules` returns them.
    """
    modules = tuple(modules)
    if not _TRUSTED.get() and (untrusted := [module for module in modules if _executes(module)]):
        names = [repr(module) if len(module) < 300 else brief(module) for module in untrusted[:2]]
        more = [f"{len(untrusted) - len(names)} more"] if len(untrusted) > len(names) else []
        raise InputError(
            f"{source} imports {' and '.join([*names, *more])}, which would execute code: read it first, then give "
            "--trust-imports"
        )
    is_run = source.name == "config.yaml" and not all(module.endswith(".py") for module in modules)
    moved = ", or evaluate the policy in its new place with --task NEW_FOLDER and the run's --env options" * is_run
    return import_modules(modules, f", which {source} names: restore it{moved}")


def _executes(module: str) -> bool:
    """Return True if importing would execute a module or file that this process has not imported before."""
    path = Path(module)
    if is_task_folder(path):
        return False
    if path.suffix == ".py" and path.is_file():
        return path.resolve() not in _IMPORTED_FILES
    return _is_dotted_name(module) and module not in sys.modules


def _is_dotted_name(name: str) -> bool:
    """Return True for identifiers joined by dots; `find_spec` would also accept paths and relative names."""
    return all(part.isidentifier() for part in name.split("."))


def _is_module(name: str) -> bool:
    """Return True if there is a module of that name, even if its package cannot be imported.

    A folder without `__init__.py` does not count: Python imports it as a namespace package, which registers nothing.
    """
    if not _is_dotted_name(name):
        return False
    try:
        spec = find_spec(name)
        return spec is not None and spec.origin is not None
    except ModuleNotFoundError as error:
        return not f"{name}.".startswith(f"{error.name}.")
    except (Exception, SystemExit):  # its package raises an error, which the import reports, or it has no spec
        return name not in sys.modules  # for example __main__


def module_name(path: Path) -> str:
    """Return the name in `sys.modules` of an imported file; it differs for files of the same name in two folders."""
    path = path.resolve()
    return f"guiderail_imported_{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"


def _import_file(path: Path) -> str:
    """Run a file with its folder on `sys.path`, as for a script, unless it has run with the same content before."""
    path = path.resolve()
    content = path.read_bytes()
    if _IMPORTED_FILES.get(path) == content:
        return str(path)
    name = module_name(path)
    spec = spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[name] = module_from_spec(spec)
    folder = str(path.parent)
    sys.path.insert(0, folder)
    try:
        with naming_failures(f"importing {path.name}"):
            spec.loader.exec_module(module)
    finally:
        sys.path.remove(folder)
    _IMPORTED_FILES[path] = content
    return str(path)
