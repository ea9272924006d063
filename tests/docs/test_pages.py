"""The pages lead to what there is, and the reference says everything that it is written from."""

import inspect
import re
import sys
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
WRITTEN = sorted({*DOCS.glob("*.md"), *DOCS.glob("concepts/*.md"), *DOCS.glob("tutorials/*.md")})
LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)]*)?\)")


@pytest.fixture(scope="module")
def made():
    """The module that makes the reference, which is no part of the package."""
    sys.path.insert(0, str(DOCS))
    try:
        import make_reference
    finally:
        sys.path.remove(str(DOCS))
    return make_reference


@pytest.fixture(scope="module")
def reference(made):
    return {name: page() for name, page in made.PAGES.items()}


def test_links_of_pages_lead_somewhere(made):
    generated = {DOCS / "reference" / f"{name}.md" for name in made.PAGES}
    for page in WRITTEN:
        for link in LINK.findall(page.read_text(encoding="utf-8")):
            if "://" not in link:
                target = (page.parent / link).resolve()
                assert target in generated or target.is_file(), f"{page.name} leads to {link}"


def test_every_page_is_in_the_contents():
    contents = (DOCS / "index.md").read_text(encoding="utf-8")
    for page in WRITTEN:
        name = page.relative_to(DOCS).with_suffix("").as_posix()
        assert name == "index" or f"\n{name}\n" in contents, name


def test_every_page_of_the_reference_is_shown(made):
    text = "".join(page.read_text(encoding="utf-8") for page in WRITTEN)
    assert all(f"reference/{name}\n" in text for name in made.PAGES)


def test_every_system_is_there_with_every_port(reference):
    from pydrake.systems.framework import LeafSystem

    from guiderail import systems

    for name in systems.__all__:
        system = getattr(systems, name)
        if isinstance(system, type) and issubclass(system, LeafSystem):
            part = reference["systems"].partition(f"\n## {name}\n")[2].partition("\n## ")[0]
            for method, getter in vars(system).items():
                found = re.fullmatch(r"get_(\w+)_(input|output)_port", method)
                if found and "name" not in inspect.signature(getter).parameters:
                    assert f"| {found[2]} | `{found[1]}` |" in part, f"{name} lacks {found[1]}"


def test_every_command_task_and_kind_is_there(reference):
    import typer

    from guiderail.diagrams.tasks.registry import TASKS
    from guiderail.models.skills.kinds import ACTIVE_CONSTRAINTS, INPUT_MAPPINGS, TRANSITION_DISTANCES
    from guiderail.tools.command import app
    from guiderail.tools.rollouts.metrics import COLUMNS, STATISTICS

    for name, command in typer.main.get_command(app).commands.items():
        part = reference["command"].partition(f"\n## guiderail {name}\n")[2].partition("\n## ")[0]
        for option in (one for parameter in command.params for one in parameter.opts if one[:2] == "--"):
            assert option == "--help" or f"`{option}" in part or f", {option}" in part, f"{name} lacks {option}"
    assert all(f"\n## Task {name}\n" in reference["options"] for name in TASKS.names() if "/" not in name)
    kinds = (*ACTIVE_CONSTRAINTS, *INPUT_MAPPINGS, *TRANSITION_DISTANCES)
    assert all(f"\n### {name}\n" in reference["templates"] for name in kinds)
    assert all(f"| `{metric.name}` |" in reference["metrics"] for metric in (*COLUMNS, *STATISTICS.values()))


def test_every_field_of_a_template_says_what_it_is(reference):
    rows = re.findall(r"^\| `(\w+)` \| (.*?) \| (.*?) \| .* \|$", reference["templates"], re.MULTILINE)
    assert len(rows) > 50
    assert not [name for name, _, words in rows if not words.strip()]


def test_whatever_a_task_can_declare_and_every_shipped_template_is_there(reference):
    from guiderail.diagrams.tasks.task import Task
    from guiderail.models import skills

    part = reference["names"].partition("\n### Task\n")[2].partition("\n### ")[0]
    declared = [name for name in Task.__annotations__ if not name.startswith("_")]
    assert len(declared) > 10
    assert not [name for name in declared if f"| `{name}` |" not in part]
    for file in Path(skills.__file__).parent.glob("*.yaml"):
        assert file.read_text(encoding="utf-8").rstrip() in reference["templates"], file.name


def test_the_reference_names_no_place_of_this_machine(reference):
    for name, page in reference.items():
        assert str(ROOT) not in page, name
        assert " at 0x" not in page, name


def test_whoever_cites_it_cites_this_version():
    import guiderail

    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == guiderail.__version__
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
