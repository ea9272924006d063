"""Notebooks in `examples/notebooks`: the cells run in order, and no output is stored."""

import json
import re
import shutil
import tomllib
from pathlib import Path

import pytest

SHORTEN_PICTURES = "import run_page; run_page.shorten_pictures()"  # imports modules of guiderail
NOTEBOOKS = sorted((Path(__file__).parents[2] / "examples" / "notebooks").glob("*.ipynb"))


def code_cells(notebook):
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    return [cell for cell in cells if cell["cell_type"] == "code"]


def code_of(cell):
    """Return the code of a cell without the magic commands of a kernel, which install packages."""
    return "".join(line for line in cell["source"] if not line.startswith("%"))


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(notebook, forks, tmp_path):
    program = tmp_path / "cells.py"
    shutil.copy(Path(__file__).with_name("run_page.py"), tmp_path)  # the program imports it from its own folder
    code = "\n".join(code_of(cell) for cell in code_cells(notebook))
    code, count = re.subn(r"^(import|from) guiderail\b.*$", rf"\g<0>\n{SHORTEN_PICTURES}", code, count=1, flags=re.M)
    assert count == 1  # the fork has imported guiderail, a notebook has to do so itself
    program.write_text(code)
    finished = forks.run(program, folder=tmp_path, MPLBACKEND="agg", OMP_NUM_THREADS="1")
    assert finished.returncode == 0, finished.stderr


def test_colab_notebook_installs_the_wheel_of_this_version_first():
    (notebook,) = (path for path in NOTEBOOKS if path.stem == "0_colab")
    name, install = code_cells(notebook)[0]["source"]
    version = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text("utf-8"))["project"]["version"]
    assert name.startswith(f'WHEEL = "guiderail-{version}-py3-none-any.whl"')
    assert install.startswith("%pip install --quiet {WHEEL} ")


def test_notebooks_are_complete_and_have_no_outputs():
    assert [path.stem for path in NOTEBOOKS] == ["0_colab", "1_environment", "2_train", "3_evaluate"]
    assert not any(cell["outputs"] for notebook in NOTEBOOKS for cell in code_cells(notebook))
