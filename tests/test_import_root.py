"""What `import guiderail` gives: to a person, to an interpreter elsewhere, and to tools that read code."""

import ast
import pkgutil
import subprocess
import sys
from importlib import import_module, metadata
from pathlib import Path

import guiderail

ROOT = Path(__file__).parents[1]
STUB = ROOT / "src" / "guiderail" / "__init__.pyi"


def test_tools_that_look_for_a_package_find_its_parts():
    assert {module.name for module in pkgutil.iter_modules(guiderail.__path__)} >= {
        "models", "systems", "diagrams", "tools",
    }  # fmt: skip
    assert guiderail.__version__ == metadata.version("guiderail")


def test_every_public_name_is_what_it_says():
    for node in ast.parse(STUB.read_text()).body:
        if isinstance(node, ast.ImportFrom):
            (alias,) = node.names
            assert alias.asname == alias.name  # otherwise a type checker takes it for private
            defined = getattr(import_module(f"guiderail.{node.module}"), alias.name)
            assert getattr(guiderail, alias.name) is defined
            assert alias.name in guiderail.__all__


def bare(code, tmp_path):
    """Runs code in an interpreter that was started elsewhere."""
    return subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)


def test_importing_costs_nothing_before_a_name_is_used(tmp_path):
    code = "import sys, guiderail; print(guiderail.__version__, 'pydrake' in sys.modules, 'torch' in sys.modules)"
    assert bare(code, tmp_path).stdout.split()[1:] == ["False", "False"]


def test_import_registers_environments_without_drake(tmp_path):
    code = """
import sys, gymnasium, guiderail
imported = {"pydrake", "pydantic", "torch"} & {*sys.modules}
env = gymnasium.make("guiderail/NarrowPassage-v0", guidance="kgrl")
print(imported, env.unwrapped.action_space.shape)
"""
    assert bare(code, tmp_path).stdout.split() == ["set()", "(2,)"]
