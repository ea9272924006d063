"""The import root `guiderail`: lazy public names, in any working directory and for tools that read code."""

import ast
import pkgutil
import subprocess
import sys
from importlib import import_module, metadata
from pathlib import Path

import guiderail

ROOT = Path(__file__).parents[1]
STUB = ROOT / "src" / "guiderail" / "__init__.pyi"


def test_package_tools_find_the_four_parts():
    assert {module.name for module in pkgutil.iter_modules(guiderail.__path__)} >= {
        "models", "systems", "diagrams", "tools",
    }  # fmt: skip
    assert guiderail.__version__ == metadata.version("guiderail")


def test_public_names_match_the_stub():
    for node in ast.parse(STUB.read_text()).body:
        if isinstance(node, ast.ImportFrom):
            (alias,) = node.names
            assert alias.asname == alias.name  # otherwise type checkers treat it as private
            defined = getattr(import_module(f"guiderail.{node.module}"), alias.name)
            assert getattr(guiderail, alias.name) is defined
            assert alias.name in guiderail.__all__


def run_elsewhere(code, tmp_path):
    """Run code in an interpreter with another working directory."""
    return subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)


def test_import_does_not_load_drake_or_torch(tmp_path):
    code = "import sys, guiderail; print(guiderail.__version__, 'pydrake' in sys.modules, 'torch' in sys.modules)"
    assert run_elsewhere(code, tmp_path).stdout.split()[1:] == ["False", "False"]


def test_import_registers_environments_without_drake(tmp_path):
    code = """
import sys, gymnasium, guiderail
imported = {"pydrake", "pydantic", "torch"} & {*sys.modules}
env = gymnasium.make("guiderail/NarrowPassage-v0", guidance="kgrl")
print(imported, env.unwrapped.action_space.shape)
"""
    assert run_elsewhere(code, tmp_path).stdout.split() == ["set()", "(2,)"]


def test_package_runs_as_the_command(tmp_path):
    command = [sys.executable, "-m", "guiderail", "--version"]
    printed = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    assert printed == f"guiderail {guiderail.__version__}\n"
