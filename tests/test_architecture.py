"""Import order of the folders (tools → diagrams → systems → models) and absence of import cycles."""

import ast
import re
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from guiderail.models.robots.robot import robot_names

ROOT = Path(__file__).parents[1]
MAY_IMPORT = {
    "models": {"models"},
    "systems": {"models", "systems"},
    "diagrams": {"models", "systems", "diagrams"},
    "tools": {"models", "systems", "diagrams", "tools"},
}
LEARNERS = ("stable_baselines3", "sb3_contrib", "torch")


def imports(path, nodes=None):
    """Yield the imported modules and names of a file, or of some of its syntax tree nodes."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if nodes is None else nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute here"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("folder", MAY_IMPORT)
def test_folder_imports_only_folders_below_it(folder):
    for path in (ROOT / folder).rglob("*.py"):
        for name in imports(path):
            parts = name.split(".")
            if parts[0] == "guiderail" and len(parts) > 1:
                assert parts[1] in MAY_IMPORT[folder], f"{path.relative_to(ROOT)} imports {name}"
            assert parts[0] not in ("research", "tests"), f"{path.relative_to(ROOT)} imports {name}"
            if folder == "models":
                assert not name.startswith("pydrake.systems"), f"{path.relative_to(ROOT)} imports {name}"
            if folder != "tools":
                assert parts[0] not in LEARNERS, f"{path.relative_to(ROOT)} imports {name}"


def test_systems_import_no_task_and_no_robot():
    for path in (ROOT / "systems").rglob("*.py"):
        for name in imports(path):
            modules = ("guiderail.models.robots", "guiderail.models.objects", "guiderail.models.demonstrations")
            assert not name.startswith(modules), f"{path.relative_to(ROOT)} imports {name}"


def test_systems_and_diagrams_name_no_robot():
    """A new robot needs one file and a model only. The drivers of robots are in `packages/hardware`."""
    names = re.compile(rf"\b({'|'.join((*robot_names(), 'iiwa', 'kuka', 'franka'))})", re.IGNORECASE)
    for folder in ("systems", "diagrams"):
        for path in (ROOT / folder).rglob("*.py"):
            relative = path.relative_to(ROOT)
            match = names.search(path.read_text(encoding="utf-8"))
            assert match is None, f"{relative} names {match}"


def module_paths():
    """Return the path of every module of the package, by name."""
    result = {}
    for folder in MAY_IMPORT:
        for path in (ROOT / folder).rglob("*.py"):
            parts = ["guiderail", *path.relative_to(ROOT).with_suffix("").parts]
            result[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return result


def test_modules_have_no_import_cycle():
    """Imports inside functions are ignored: they are executed after both modules are loaded."""
    known = module_paths()
    graph = {}
    for module, path in known.items():
        top_level = [
            statement
            for node in ast.parse(path.read_text(encoding="utf-8")).body
            for statement in ([node] if not isinstance(node, ast.If) else [])
        ]
        targets = set()
        for name in imports(path, top_level):
            target = name if name in known else name.rpartition(".")[0]
            if target in known and target != module:
                targets.add(target)
        graph[module] = targets
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"import cycle: {' → '.join(error.args[1])}")
