"""Code blocks of tutorials and cells of notebook pages: they run, and tutorials show the printed output."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted((DOCS / "tutorials").glob("*.md"))
RUN = [*PAGES, DOCS / "robot.md"]
NOTEBOOKS = sorted(
    page for page in (*DOCS.glob("*.md"), *DOCS.glob("*/*.md")) if "\nfile_format: mystnb\n" in page.read_text("utf-8")
)
MAX_LINES = 140  # two screens
LONG_PAGES = {"compose_systems": 220}  # a complete program, from the plant to the environment


@pytest.fixture
def run_page(forks):
    """Return a function that runs a page in a process of its own; it returns the finished process."""
    environment = {"DRAKE_ALLOW_NETWORK": "meshcat", "OMP_NUM_THREADS": "1", "MPLBACKEND": "agg"}
    return lambda page: forks.run(Path(__file__).with_name("run_page.py"), page, **environment)


@pytest.mark.parametrize("page", RUN + NOTEBOOKS, ids=lambda path: path.stem)
def test_page_runs_and_shows_the_printed_output(page, run_page):
    finished = run_page(page)
    assert finished.returncode == 0, finished.stderr[-8000:]


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_tutorial_is_short_and_in_the_contents(page):
    assert len(page.read_text(encoding="utf-8").splitlines()) <= LONG_PAGES.get(page.stem, MAX_LINES)
    assert f"tutorials/{page.stem}\n" in (DOCS / "index.md").read_text(encoding="utf-8")


def test_snippets_of_the_readme_run(forks, tmp_path):
    text = (ROOT / "README.md").read_text("utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    assert len(blocks) == 2
    assert all(len(block.split("\n\n")[-1].splitlines()) <= 10 for block in blocks)
    (tmp_path / "snippets.py").write_text("\n".join(blocks))
    finished = forks.run(tmp_path / "snippets.py", folder=tmp_path, OMP_NUM_THREADS="1")
    assert finished.returncode == 0, finished.stderr
    assert round(float(finished.stdout), 6) == 1.3
    assert {path.name for path in tmp_path.glob("*.stl")} == {"plug.stl", "socket.stl"}
    assert len(text.split()) <= 900


def test_concept_pages_are_notebooks():
    assert {page.stem for page in NOTEBOOKS} >= {"start", "templates", "primitives", "kgrl", "exploration", "safety"}


CELLS = "```{code-cell} python\n---\ntags: [hide-input]\n---\na = 1\n```\n\n```{code-cell} python\na / 0\n```\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"---\nfile_format: mystnb\n---\n\n```sh\nnot run\n```\n\n{CELLS}", "ZeroDivisionError"),
        ("```python\nprint(1 + 1)\n```\n\n```text\n3\n```\n", "the step prints\n2"),
    ],
)
def test_failing_cell_and_wrong_output_are_reported(text, message, run_page, tmp_path):
    (tmp_path / "wrong.md").write_text(text, encoding="utf-8")
    finished = run_page(tmp_path / "wrong.md")
    assert finished.returncode == 1
    assert message in finished.stderr


def test_files_named_in_pages_exist():
    for page in [*DOCS.glob("*.md"), *DOCS.glob("concepts/*.md"), *PAGES]:
        for name in re.findall(
            r"`((?:examples|models|diagrams|tests|systems|tools)/[\w./]+)`", page.read_text("utf-8")
        ):
            assert (ROOT / name).exists(), f"{page.name} names {name}, which does not exist"


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_evaluation_trusts_imports_when_training_has_imports(page):
    text = page.read_text("utf-8")
    for run in re.findall(r"guiderail train .*--import .*--out ([\w/]+)", text):
        assert all("--trust-imports" in options for options in re.findall(rf"guiderail evaluate {run}\b(.*)", text))
