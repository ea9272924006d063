"""Import root `guiderail`: lazy public names in any working directory, and the stub for type checkers."""

import ast
import pkgutil
import subprocess
import sys
from importlib import import_module, metadata
from pathlib import Path

import guiderail

ROOT = Path(__file__).parents[1]
STUB = ROOT / "src" / "guiderail" / "__init__.pyi"


def test_package_has_four_folders_and_its_version():
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


def output_of(tmp_path, *arguments):
    """Return the output of an interpreter with these arguments in another working directory."""
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout


def test_import_does_not_load_drake_or_torch(tmp_path):
    code = "import sys, guiderail; print(guiderail.__version__, 'pydrake' in sys.modules, 'torch' in sys.modules)"
    assert output_of(tmp_path, "-c", code).split()[1:] == ["False", "False"]


def test_import_registers_environments_without_drake(tmp_path):
    code = """
import sys, gymnasium, guiderail
imported = {"pydrake", "pydantic", "torch"} & {*sys.modules}
env = gymnasium.make("guiderail/NarrowPassage-v0", guidance="kgrl")
print(imported, env.unwrapped.action_space.shape)
"""
    assert output_of(tmp_path, "-c", code).split() == ["set()", "(2,)"]


def test_package_runs_as_the_command(tmp_path):
    assert output_of(tmp_path, "-m", "guiderail", "--version") == f"guiderail {guiderail.__version__}\n"
