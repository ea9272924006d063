"""Links and tables of contents of the pages, completeness of the reference, and limits on the robot page."""

import inspect
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
WRITTEN = sorted({*DOCS.glob("*.md"), *DOCS.glob("concepts/*.md"), *DOCS.glob("tutorials/*.md")})
LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)]*)?\)")


@pytest.fixture(scope="module")
def generator():
    """Return the module in `docs/` that generates the reference."""
    sys.path.insert(0, str(DOCS))
    try:
        import make_reference
    finally:
        sys.path.remove(str(DOCS))
    return make_reference


@pytest.fixture(scope="module")
def reference(generator):
    """Return the text of each generated page of the reference, by name."""
    return {name: page() for name, page in generator.PAGES.items()}


def test_links_of_pages_have_targets(generator):
    generated = {DOCS / "reference" / f"{name}.md" for name in generator.PAGES}
    for page in WRITTEN:
        for link in LINK.findall(page.read_text(encoding="utf-8")):
            if "://" not in link:
                target = (page.parent / link).resolve()
                assert target in generated or target.is_file(), f"{page.name} links to {link}, which does not exist"


def test_every_page_is_in_the_contents():
    contents = (DOCS / "index.md").read_text(encoding="utf-8")
    for page in WRITTEN:
        name = page.relative_to(DOCS).with_suffix("").as_posix()
        assert name == "index" or f"\n{name}\n" in contents, name


def test_index_for_language_models_lists_every_page():
    listed = LINK.findall((DOCS / "llms.txt").read_text(encoding="utf-8"))
    assert all((DOCS / page).is_file() for page in listed)
    pages = {page.relative_to(DOCS).as_posix() for page in WRITTEN} - {"index.md"}
    assert pages <= {*listed}, pages - {*listed}


def test_every_reference_page_is_in_a_toctree(generator):
    text = "".join(page.read_text(encoding="utf-8") for page in WRITTEN)
    assert all(f"reference/{name}\n" in text for name in generator.PAGES)


def test_reference_has_every_system_with_its_ports(reference):
    from pydrake.systems.framework import LeafSystem

    from guiderail import systems

    for name in systems.__all__:
        system = getattr(systems, name)
        if isinstance(system, type) and issubclass(system, LeafSystem):
            part = reference["systems"].partition(f"\n## {name}\n")[2].partition("\n## ")[0]
            for method, getter in vars(system).items():
                result = re.fullmatch(r"get_(\w+)_(input|output)_port", method)
                if result and "name" not in inspect.signature(getter).parameters:
                    assert f"| {result[2]} | `{result[1]}` |" in part, f"{name} lacks the port {result[1]}"


def test_reference_has_every_command_task_and_template_kind(reference):
    import typer

    from guiderail.diagrams.tasks.registry import TASKS
    from guiderail.models.templates.parts import ACTIVE_CONSTRAINTS, INPUT_MAPPINGS, TRANSITION_DISTANCES
    from guiderail.tools.cli.main import load_commands
    from guiderail.tools.evaluation.metrics import COLUMNS, statistics_of

    commands = {}
    for name, command in typer.main.get_command(load_commands()).commands.items():
        subcommands = getattr(command, "commands", None)
        if subcommands is None:
            commands[name] = command
        else:
            commands |= {f"{name} {subname}": subcommand for subname, subcommand in subcommands.items()}
    for name, command in commands.items():
        part = reference["command"].partition(f"\n## guiderail {name}\n")[2].partition("\n## ")[0]
        for option in (text for parameter in command.params for text in parameter.opts if text[:2] == "--"):
            assert option == "--help" or f"`{option}" in part or f", {option}" in part, f"{name} lacks {option}"
    assert all(f"\n## Task {name}\n" in reference["options"] for name in TASKS.names() if "/" not in name)
    kinds = (*ACTIVE_CONSTRAINTS, *INPUT_MAPPINGS, *TRANSITION_DISTANCES)
    assert all(f"\n### {name}\n" in reference["templates"] for name in kinds)
    assert all(f"| `{metric.name}` |" in reference["metrics"] for metric in (*COLUMNS, *statistics_of().values()))


def test_signatures_of_the_reference_have_types(reference):
    signatures = re.findall(r"^    (\**\w+)(: [^=]+)?(?: ?=.*)?,$", reference["names"], re.MULTILINE)
    assert len(signatures) > 100
    assert not [name for name, hint in signatures if not hint]


def test_reference_links_to_pages_that_exist(generator, reference):
    for name, page in reference.items():
        for link in LINK.findall(page):
            target = (DOCS / "reference" / link).resolve()
            is_page = link.removesuffix(".md") in generator.PAGES or target.is_file()
            assert "://" in link or is_page, f"the reference page {name} links to {link}, which does not exist"


def test_template_fields_have_descriptions(reference):
    rows = re.findall(r"^\| `(\w+)` \| (.*?) \| (.*?) \| .* \|$", reference["templates"], re.MULTILINE)
    assert len(rows) > 50
    assert not [name for name, _, description in rows if not description.strip()]


def test_reference_has_task_attributes_and_shipped_templates(reference):
    from guiderail.diagrams.tasks.task import Task
    from guiderail.models import objects

    part = reference["names"].partition("\n### Task\n")[2].partition("\n### ")[0]
    declared = [name for name in Task.__annotations__ if not name.startswith("_")]
    assert len(declared) >= 10
    assert not [name for name in declared if f"| `{name}` |" not in part]
    for file in Path(objects.__path__[0]).glob("*/*.yaml"):
        assert file.read_text(encoding="utf-8").rstrip() in reference["templates"], file.name


def test_reference_has_no_local_path(reference):
    for name, page in reference.items():
        assert str(ROOT) not in page, name
        assert " at 0x" not in page, name


def test_robot_page_has_the_limits_of_the_code():
    import numpy as np

    from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
    from guiderail.diagrams.tasks.options import COLLISION_FORCE
    from guiderail.models.common.transforms import MM
    from guiderail_hardware.drivers.driver import EXTERNAL_TORQUE_SHARE, TORQUE_SHARE, VELOCITY_SHARE
    from guiderail_hardware.models.joint_status import MAX_MISSED_MESSAGES
    from guiderail_hardware.robot.sim_driver import START
    from guiderail_hardware.station import HardwareStation

    page = (DOCS / "robot.md").read_text(encoding="utf-8").partition("\n## Limits\n")[2].partition("\n## ")[0]
    rows = {row[0]: row[1] for row in re.findall(r"^\| ([^|]+) \| ([^|]+) \|", page, re.MULTILINE)}
    effects = dict(re.findall(r"^\| ([^|]+) \| [^|]+ \| ([^|]+) \|$", page, re.MULTILINE))
    station = HardwareStation(BncWorkcell(), robot_url="memq://")
    limits, status, force = station.limits, station.status_limits, np.array(station.impedance.limits[:3])
    load = station.max_torque_shares(station.controller_plant.solve(START, station.controller_plant.posture)).max()
    age = f"{status.max_age / MM:.0f} ms"
    expected = {
        "age of a status": f"{MAX_MISSED_MESSAGES} periods: {age}",
        "time stamps of statuses": f"within {status.max_lead / MM:.0f} ms of the previous one",
        "jump of a position": f"{status.position_jump} rad ",
        "jump of a velocity": f"{status.velocity_jump} rad/s",
        "delay of this program": f"{status.max_check_interval / MM:.0f} ms ",
        "safety monitor": f"{age} without a command; every fault of a status in this table; "
        f"{2 * MAX_MISSED_MESSAGES * station.period / MM:.0f} ms without",
        "joint speed": f"{VELOCITY_SHARE:.0%} of its limit".replace("%", " %"),
        "position of the tool and of the command": f"±{limits.upper[0]} m lateral, −{-limits.lower[2]} to "
        f"{limits.upper[2]} m above",
        "force on the tool": f"{limits.force:.0f} N measured; the impedance's force is below the task's force limit, "
        f"unless `bounded_force=False` (then {force.max():.0f} N along each axis of the target, "
        f"{np.linalg.norm(force):.0f} N along",
        "external joint torque": f"{EXTERNAL_TORQUE_SHARE:.0%} of".replace("%", " %"),
        "commanded torque": f"{TORQUE_SHARE:.0%} of that".replace("%", " %"),
        "task force": f"the task's own, {COLLISION_FORCE:.0f} N",
    }
    assert [name for name, text in expected.items() if text not in rows[name]] == []
    assert f"up to {100 * load:.0f} % of it" in effects["commanded torque"]
