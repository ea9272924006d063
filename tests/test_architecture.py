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
# Siblings, and the other siblings that each of them imports where they are installed (`require_sibling`, extras).
REQUIRED = {
    "guiderail_calibration": ("guiderail_studies",),
    "guiderail_cpp": (),
    "guiderail_data": ("guiderail_parts",),
    "guiderail_hardware": ("guiderail_mujoco",),
    "guiderail_lerobot": (),
    "guiderail_mujoco": (),
    "guiderail_parts": (),
    "guiderail_studies": (),
    "lerobot_robot_guiderail": ("guiderail_lerobot",),
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
    """Return the path of every module of the core and of the siblings, by name."""
    result = {}
    for source in (ROOT / "src", *sorted((ROOT / "packages").glob("*/src"))):
        folders = [source / "guiderail" / folder for folder in MAY_IMPORT] if source == ROOT / "src" else [source]
        for path in (path for folder in folders for path in folder.rglob("*.py")):
            parts = path.relative_to(source).with_suffix("").parts
            result[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return result


def import_graph():
    """Return the imported modules of every module, with those of functions and of `if TYPE_CHECKING`."""
    known, graph = module_paths(), {}
    for module, path in known.items():
        targets = {name if name in known else name.rpartition(".")[0] for name in imports(path)}
        graph[module] = (targets & known.keys()) - {module}
    return graph


def test_modules_have_no_import_cycle():
    try:
        TopologicalSorter(import_graph()).prepare()
    except CycleError as error:
        pytest.fail(f"import cycle: {' → '.join(error.args[1])}")


def test_core_imports_no_sibling_and_siblings_import_only_what_they_require():
    graph = import_graph()
    assert {top_level(module) for module in graph} == {"guiderail", *REQUIRED}
    for module, targets in graph.items():
        allowed = {top_level(module), "guiderail", *REQUIRED.get(top_level(module), ())}
        if top_level(module) == "guiderail":
            allowed = {"guiderail"}
        for target in targets:
            assert top_level(target) in allowed, f"{module} imports {target}"


def test_core_names_no_module_of_a_sibling():
    """A plug-in is found by its entry point; the names of the distributions are only in the two named files."""
    named = re.compile("|".join(name for name in REQUIRED))
    for folder in MAY_IMPORT:
        for path in (ROOT / folder).rglob("*.py"):
            if path.relative_to(ROOT).as_posix() not in ("models/common/registry.py", "models/common/errors.py"):
                match = named.search(path.read_text(encoding="utf-8"))
                assert match is None, f"{path.relative_to(ROOT)} names {match}"


def top_level(module):
    return module.partition(".")[0]
