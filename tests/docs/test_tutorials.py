"""Every block of every tutorial and every cell of every notebook runs as it stands, and prints what the page says."""

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted((DOCS / "tutorials").glob("*.md"))
NOTEBOOKS = sorted(
    page for page in (*DOCS.glob("*.md"), *DOCS.glob("*/*.md")) if "\nfile_format: mystnb\n" in page.read_text("utf-8")
)
SCREENS = 130  # lines: two screens


@pytest.fixture(scope="module")
def found(forks):
    """What is wrong with each page."""
    environment = {"DRAKE_ALLOW_NETWORK": "meshcat", "OMP_NUM_THREADS": "1", "MPLBACKEND": "agg"}
    finished = forks.run(Path(__file__).with_name("run_pages.py"), *PAGES, *NOTEBOOKS, **environment)
    assert finished.returncode == 0, finished.stderr
    return json.loads(finished.stdout.splitlines()[-1])


@pytest.mark.parametrize("page", PAGES + NOTEBOOKS, ids=lambda path: path.stem)
def test_a_tutorial_does_what_it_says(page, found):
    assert not found[page.stem], found[page.stem]


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_a_tutorial_is_short_and_in_the_contents(page):
    assert len(page.read_text(encoding="utf-8").splitlines()) <= SCREENS
    assert f"tutorials/{page.stem}\n" in (ROOT / "docs" / "index.md").read_text(encoding="utf-8")


def test_pages_on_what_a_picture_shows_draw_it_themselves():
    assert {page.stem for page in NOTEBOOKS} >= {"start", "templates", "primitives", "kgrl", "exploration", "safety"}


def test_a_cell_that_fails_is_found(forks, tmp_path):
    page = tmp_path / "wrong.md"
    cells = "```{code-cell} python\n---\ntags: [hide-input]\n---\na = 1\n```\n\n```{code-cell} python\na / 0\n```\n"
    page.write_text(f"---\nfile_format: mystnb\n---\n\n```sh\nnobody runs this\n```\n\n{cells}", encoding="utf-8")
    finished = forks.run(Path(__file__).with_name("run_pages.py"), page)
    assert "ZeroDivisionError" in json.loads(finished.stdout)["wrong"]


def test_a_page_that_says_something_else_is_found(forks, tmp_path):
    page = tmp_path / "wrong.md"
    page.write_text("```python\nprint(1 + 1)\n```\n\n```text\n3\n```\n", encoding="utf-8")
    finished = forks.run(Path(__file__).with_name("run_pages.py"), page)
    assert "it prints" in json.loads(finished.stdout)["wrong"]


def test_prose_is_about_what_there_is():
    """Files that pages name in code are there."""
    for page in [*(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "concepts").glob("*.md"), *PAGES]:
        for name in re.findall(
            r"`((?:examples|models|diagrams|tests|systems|tools)/[\w./]+)`", page.read_text("utf-8")
        ):
            assert (ROOT / name).exists(), f"{page.name} names {name}"
