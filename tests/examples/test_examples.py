"""Examples run, are short and pass the type checker."""

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
FILES = sorted(EXAMPLES.glob("*.py"))
MAX_LINES = 60
SHORTER = {"SAMPLES, EXECUTED = 8, 10, 4": "SAMPLES, EXECUTED = 4, 2, 4"}  # a tenth of the simulations of a plan


@pytest.mark.parametrize("file", FILES, ids=lambda path: path.stem)
def test_example_is_short_and_runs_in_another_folder(file, forks, tmp_path):
    text, program = file.read_text(), tmp_path / file.name
    for long, short in SHORTER.items():
        text = text.replace(long, short)
    program.write_text(text)
    finished = forks.run(program, folder=tmp_path, DRAKE_ALLOW_NETWORK="meshcat", OMP_NUM_THREADS="1")
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout.strip()
    assert len(text.splitlines()) <= MAX_LINES


def test_examples_pass_mypy_without_path_settings(tmp_path):
    configuration = tmp_path / "mypy.ini"
    # Other packages are skipped, because reading them takes seconds.
    skipped = "pydrake.*,numpy.*,scipy.*,pandas.*,pydantic.*,gymnasium.*,matplotlib.*,torch.*"
    configuration.write_text(f"[mypy]\n[mypy-{skipped}]\nfollow_imports = skip\nfollow_imports_for_stubs = True\n")
    # mypy searches the packages of this interpreter, where an editable install must suffice.
    command = [sys.executable, "-m", "mypy", "--config-file", str(configuration), *map(str, FILES)]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert "import-not-found" not in result.stdout, result.stdout
    assert "import-untyped" not in result.stdout or "guiderail" not in result.stdout, result.stdout
    assert result.returncode == 0, result.stdout
