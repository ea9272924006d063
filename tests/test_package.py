"""The package as it is installed elsewhere: nothing forgotten."""

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("models", "systems", "diagrams", "tools")


@pytest.fixture(scope="module")
def packages(tmp_path_factory):
    """The tracked sources, and the content of the wheel made of them, both away from the repository."""
    build = tmp_path_factory.mktemp("wheel")
    source = tmp_path_factory.mktemp("source")
    tracked = subprocess.run(
        ["git", "ls-files", "-z", "--", *FOLDERS, "src", "pyproject.toml", "README.md", "LICENSE"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    ).stdout.split("\0")  # fmt: skip
    for name in filter(None, tracked):
        target = source / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, target, follow_symlinks=False)
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--no-deps",
        "--no-build-isolation",
        "--quiet",
        "-w",
        build,
        source,
    ]
    subprocess.run(command, check=True)
    (wheel,) = build.glob("*.whl")
    target = tmp_path_factory.mktemp("installed")
    zipfile.ZipFile(wheel).extractall(target)
    return source, target


def test_every_file_is_in_the_wheel(packages):
    source, installed = packages
    for folder in FOLDERS:
        for path in (source / folder).rglob("*.*"):
            assert (installed / "guiderail" / path.relative_to(source)).is_file(), path.relative_to(source)
    assert all(path.name in ("guiderail",) or path.suffix == ".dist-info" for path in installed.iterdir())


def test_every_module_imports_from_the_wheel(packages, forks):
    _, installed = packages
    modules = sorted(
        ".".join(path.relative_to(installed).with_suffix("").parts).removesuffix(".__init__")
        for path in (installed / "guiderail").rglob("*.py")
    )
    code = (
        "import sys, importlib\nfor name in [name for name in sys.modules if name.split('.')[0] == 'guiderail']: "
        f"del sys.modules[name]\nsys.path.insert(0, {str(installed)!r}); sys.meta_path = "
        "[f for f in sys.meta_path if 'editable' not in getattr(f, '__module__', str(f))]\n"
        f"for name in {modules!r}: module = importlib.import_module(name); assert {str(installed)!r} in module.__file__"
    )
    result = forks.run("-c", code, folder=installed)
    assert result.returncode == 0, result.stderr
