"""The arrows: tools → diagrams → systems → models."""

import ast
import re
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
# Inside tools: what a person works with never needs what was studied with it. The command is every entry point.
RESEARCH = {"studies", "figures", "stress", "benchmarks"}
ENTRY_POINTS = {"tools/cli/main.py"}
LEARNERS = ("stable_baselines3", "sb3_contrib", "torch")


def imports(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute here"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("folder", MAY_IMPORT)
def test_arrows_point_one_way(folder):
    for path in (ROOT / folder).rglob("*.py"):
        for name in imports(path):
            parts = name.split(".")
            if parts[0] == "guiderail" and len(parts) > 1:
                assert parts[1] in MAY_IMPORT[folder], f"{path.relative_to(ROOT)} imports {name}"
            if folder == "models":
                assert not name.startswith("pydrake.systems"), f"{path.relative_to(ROOT)} imports {name}"
            if folder != "tools":
                assert parts[0] not in LEARNERS, f"{path.relative_to(ROOT)} imports {name}"


def test_systems_know_no_task_and_no_robot():
    for path in (ROOT / "systems").rglob("*.py"):
        for name in imports(path):
            known = ("guiderail.models.robots", "guiderail.models.objects", "guiderail.models.demonstrations")
            assert not name.startswith(known), f"{path.relative_to(ROOT)} imports {name}"


def test_no_robot_is_known_by_name_outside_its_own_file():
    """Adding a robot is one file and its model. Only `hardware.py` speaks to one: LCM's messages are the iiwa's."""
    words = re.compile(rf"\b({'|'.join((*robot_names(), 'iiwa', 'kuka', 'franka'))})", re.IGNORECASE)
    for folder in ("systems", "diagrams"):
        for path in (ROOT / folder).rglob("*.py"):
            named = words.search(path.read_text())
            assert named is None or path.name == "hardware.py", f"{path.relative_to(ROOT)} names {named}"


def test_product_needs_no_research():
    rooms = {path.name for path in (ROOT / "tools").iterdir() if path.is_dir() and (path / "__init__.py").exists()}
    assert rooms >= RESEARCH
    for path in (ROOT / "tools").rglob("*.py"):
        inside = path.relative_to(ROOT)
        if inside.parts[1] in RESEARCH or inside.as_posix() in ENTRY_POINTS:
            continue
        for name in imports(path):
            parts = name.split(".")
            assert parts[:2] != ["guiderail", "tools"] or not RESEARCH & set(parts[2:3]), f"{inside} imports {name}"
