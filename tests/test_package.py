"""Source distribution (sdist) and wheel: complete, and importable without the repository."""

import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("models", "systems", "diagrams", "tools")


def tracked_files():
    """Return the sorted names of all files of the repository that git does not ignore."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\0")
    return sorted(name for name in names if name and (ROOT / name).exists())


@pytest.fixture(scope="module")
def packages(tmp_path_factory):
    """Return the folders of the extracted sdist of the tracked files and of the extracted wheel built from it."""
    source, build = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("build")
    for name in tracked_files():
        target = source / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, target, follow_symlinks=False)
    code = f"from setuptools import build_meta; build_meta.build_sdist({str(build)!r})"
    subprocess.run([sys.executable, "-c", code], cwd=source, check=True, capture_output=True)
    (archive,) = build.glob("*.tar.gz")
    with tarfile.open(archive) as file:
        file.extractall(build, filter="data")
    (sdist,) = (path for path in build.iterdir() if path.is_dir())
    code = f"from setuptools import build_meta; build_meta.build_wheel({str(build)!r})"
    subprocess.run([sys.executable, "-c", code], cwd=sdist, check=True)
    (wheel,) = build.glob("*.whl")
    installed = tmp_path_factory.mktemp("installed")
    zipfile.ZipFile(wheel).extractall(installed)
    return sdist, installed


def test_sdist_has_every_tracked_file(packages):
    sdist, _ = packages
    links = {f"src/guiderail/{folder}" for folder in FOLDERS}
    missing = [name for name in tracked_files() if name not in links and not (sdist / name).is_file()]
    assert not missing


def test_wheel_has_exactly_the_four_folders(packages):
    _, installed = packages
    for name in tracked_files():
        if name.split("/")[0] in FOLDERS and "." in Path(name).name:
            assert (installed / "guiderail" / name).is_file(), name
    assert all(path.name == "guiderail" or path.suffix == ".dist-info" for path in installed.iterdir())
    assert {path.name for path in (installed / "guiderail").iterdir() if path.is_dir()} == set(FOLDERS)


NOT_IMPORTABLE = {"guiderail_hardware.drivers.fci_simulated"}  # needs franky-sim, which is in another environment


def test_every_module_imports_from_the_wheel(packages, forks):
    _, installed = packages
    modules = sorted(
        ".".join(path.relative_to(installed).with_suffix("").parts).removesuffix(".__init__")
        for path in (installed / "guiderail").rglob("*.py")
    )
    modules = [name for name in modules if name not in NOT_IMPORTABLE]
    code = (
        "import sys, importlib\nfor name in [name for name in sys.modules if name.split('.')[0] == 'guiderail']: "
        f"del sys.modules[name]\nsys.path.insert(0, {str(installed)!r}); sys.meta_path = "
        "[f for f in sys.meta_path if 'editable' not in getattr(f, '__module__', str(f))]\n"
        f"for name in {modules!r}: module = importlib.import_module(name); assert {str(installed)!r} in module.__file__"
    )
    result = forks.run("-c", code, folder=installed)
    assert result.returncode == 0, result.stderr
