"""Notebooks in `examples/notebooks`: the cells run in order, and no output is stored."""

import json
import shutil
from pathlib import Path

import pytest

SHORTEN_PICTURES = "import run_pages; run_pages.shorten_pictures()"
NOTEBOOKS = sorted((Path(__file__).parents[2] / "examples" / "notebooks").glob("*.ipynb"))


def code_cells(notebook):
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    return [cell for cell in cells if cell["cell_type"] == "code"]


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(notebook, forks, tmp_path):
    program = tmp_path / "cells.py"
    shutil.copy(Path(__file__).with_name("run_pages.py"), tmp_path)  # the program imports it from its own folder
    program.write_text("\n".join([SHORTEN_PICTURES, *("".join(cell["source"]) for cell in code_cells(notebook))]))
    finished = forks.run(program, folder=tmp_path, MPLBACKEND="agg", OMP_NUM_THREADS="1")
    assert finished.returncode == 0, finished.stderr


def test_notebooks_are_complete_and_have_no_outputs():
    assert [path.stem for path in NOTEBOOKS] == ["1_environment", "2_train", "3_evaluate"]
    assert not any(cell["outputs"] for notebook in NOTEBOOKS for cell in code_cells(notebook))
