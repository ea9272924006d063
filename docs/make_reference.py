"""Generation of the reference pages from docstrings, signatures and registries."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
import textwrap
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic_core import PydanticUndefined

from guiderail.models.common.registry import is_sibling_module

SECTION = re.compile(r"^(Args|Attributes|Raises|Returns|Yields):\s*(.*)$")
ENTRY = re.compile(r"^(\*{0,2}[\w, /*]+):\s+(.*)$")
DIAGRAM = re.compile(r"\.\. pydrake_system::\n\n(?:    .*\n?|\n)+")
WORDS = {"Args": "Argument", "Attributes": "Attribute", "Raises": "Raises"}


def make(folder: Path) -> None:
    """Write all pages into a folder. Unchanged files are not touched, so that Sphinx does not rebuild them."""
    folder.mkdir(exist_ok=True)
    for name, page in PAGES.items():
        text = page()
        path = folder / f"{name}.md"
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


# --- Markdown ---


def prose(text: str) -> str:
    """Return a docstring's text as Markdown, with asterisks, angles and dollars escaped outside of code."""
    parts = re.split(r"(``.*?``|`[^`]*`)", text)
    return "".join(part if part.startswith("`") else re.sub(r"([*<$])", r"\\\1", part) for part in parts)


def cell(text: Any) -> str:
    """Return a text as the content of a table cell."""
    return " ".join(prose(str(text)).split()).replace("|", "\\|")


def code(text: Any) -> str:
    """Return a text as code, also for table cells."""
    return f"`{text}`".replace("|", "\\|") if str(text) else ""


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table; an empty string without rows."""
    rows = list(rows)
    if not rows:
        return ""
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)]) + "\n\n"


# --- docstrings ---


def sections(doc: str) -> tuple[str, dict[str, list[tuple[str, str]]]]:
    """Split a docstring into its text and its sections, each a list of names and descriptions."""
    text: list[str] = []
    result: dict[str, list[tuple[str, str]]] = {}
    current = None
    for line in doc.splitlines():
        head = SECTION.match(line)
        if head:
            current = result.setdefault(head[1], [])
        elif current is not None and (line.startswith("    ") or not line.strip()):
            if not line.strip():
                continue
            entry = ENTRY.match(line[4:])
            if entry and not line.startswith("     "):
                current.append((entry[1], entry[2]))
            elif current:
                current[-1] = (current[-1][0], f"{current[-1][1]} {line.strip()}")
            else:
                current.append(("", line.strip()))
        else:
            current = None
            text.append(line)
    return "\n".join(text).strip(), result


def documented(thing: Any) -> str:
    """Return a docstring as Markdown: its text, and a table for each section."""
    text, result = sections(DIAGRAM.sub("", (inspect.getdoc(thing) or "") + "\n"))
    page = paragraphs(text) + "\n\n"
    for name, rows in result.items():
        if name in WORDS:
            page += table([WORDS[name], "meaning"], [(code(n), cell(words)) for n, words in rows])
        else:
            page += f"{name}: " + " ".join(cell(f"{n}: {words}" if n else words) for n, words in rows) + "\n\n"
    return page


def paragraphs(text: str) -> str:
    """Return text as Markdown; indented lines are equations or code."""
    lines = []
    for line in text.splitlines():
        lines.append(line if line.startswith("    ") else prose(line))
    return "\n".join(lines)


def signature(name: str, thing: Callable[..., Any]) -> str:
    """Return the signature with its types as a code block."""
    try:
        described = inspect.signature(thing)
    except (ValueError, TypeError):
        return ""
    words = []
    for one in described.parameters.values():
        if one.name == "self":
            continue
        stars = {one.VAR_POSITIONAL: "*", one.VAR_KEYWORD: "**"}.get(one.kind, "")
        hint = "" if one.annotation is one.empty else f": {_annotation(one.annotation)}"
        default = "" if one.default is one.empty else f"{' = ' if hint else '='}{_default(one.default)}"
        if one.kind is one.KEYWORD_ONLY and "*" not in words and not any(word.startswith("*") for word in words):
            words.append("*")
        words.append(f"{stars}{one.name}{hint}{default}")
    result = described.return_annotation
    arrow = "" if result in (described.empty, None, "None") else f" -> {_annotation(result)}"
    line = f"{name}({', '.join(words)}){arrow}"
    if len(line) > 88:
        line = f"{name}(\n" + "".join(f"    {word},\n" for word in words) + f"){arrow}"
    return f"```python\n{line}\n```\n\n"


def _annotation(annotation: Any) -> str:
    """Return an annotation as in the source, without the names of modules."""
    text = annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)
    return re.sub(r"\b(?:\w+\.)+(?=[A-Za-z_]\w*)", "", text.strip("'"))


def _default(value: Any) -> str:
    text = repr(value)
    return "..." if " at 0x" in text or text.startswith("<") else text


def field_words(kind: type) -> dict[str, str]:
    """Return the description of each field: from the docstring, the pydantic field or the comment behind it."""
    words: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if not is_sibling_module(base.__module__):
            continue
        lines = textwrap.dedent(inspect.getsource(base)).splitlines()
        for node in ast.parse("\n".join(lines)).body[0].body:  # type: ignore[attr-defined]
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                comment = re.search(r"#\s(.*)$", lines[(node.end_lineno or node.lineno) - 1])
                words[node.target.id] = comment[1] if comment else ""
        _, result = sections(inspect.cleandoc(vars(base).get("__doc__") or ""))
        for names, text in (*result.get("Attributes", ()), *result.get("Args", ())):
            words |= {name.strip(" *"): text for name in re.split("[,/]", names)}
    return words | {name: one.description for name, one in getattr(kind, "model_fields", {}).items() if one.description}


def field_types(kind: type) -> dict[str, str]:
    """Return type and range of each field as text."""
    hints = typing.get_type_hints(kind, include_extras=True)
    bounds = {n: _bounds(f.metadata) for n, f in getattr(kind, "model_fields", {}).items()}
    return {name: f"{_typed(hint)}{bounds.get(name, '')}" for name, hint in hints.items()}


def _typed(hint: Any) -> str:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        metadata = [m for one in arguments[1:] for m in getattr(one, "metadata", [one])]
        return _typed(arguments[0]) + _bounds(metadata)
    if origin in (typing.Union, types.UnionType):
        return " or ".join("nothing" if one is type(None) else _typed(one) for one in arguments)
    if origin is typing.Literal:
        return " or ".join(map(repr, arguments))
    if origin is tuple:
        return f"list of {_typed(arguments[0])}"
    if origin is dict:
        return f"mapping to {_typed(arguments[1])}"
    return {typing.Any: "anything"}.get(hint) or getattr(hint, "__name__", str(hint))


def _bounds(metadata: Iterable[Any]) -> str:
    signs = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
    return "".join(
        f" {sign} {getattr(one, name):g}" for one in metadata for name, sign in signs.items() if hasattr(one, name)
    )


# --- pages ---


def systems() -> str:
    """Return the page of LeafSystems with their ports."""
    from pydrake.systems.framework import LeafSystem

    from guiderail import systems as module

    page = (
        "# Systems\n\nEvery control law is a Drake `LeafSystem` with named ports: `from guiderail.systems import …`. "
        "Port `x` has the getter `get_x_input_port()` or `get_x_output_port()`. Ports whose names are constructor "
        "arguments have one getter, by name.\n\n"
    )
    for name in sorted(module.__all__):
        system = getattr(module, name)
        if not (inspect.isclass(system) and issubclass(system, LeafSystem)):
            continue
        page += f"## {name}\n\n{signature(name, system)}{documented(system)}"
        page += table(["", "port", "what it is"], ports(system))
    return page


def ports(system: type) -> list[tuple[str, str, str]]:
    """Return kind, name and description of each port of a system, by its getters."""
    rows = []
    for kind in ("input", "output"):
        for getter in vars(system):
            if found := re.fullmatch(rf"get_(\w+)_{kind}_port", getter):
                text, _ = sections(inspect.getdoc(getattr(system, getter)) or "")
                has_many = "name" in inspect.signature(getattr(system, getter)).parameters
                name = f"one per {found[1]}" if has_many else code(found[1])
                rows.append((kind, name, cell(text.removeprefix("Return the port of the "))))
    return rows


def api() -> str:
    """Return the page of public names."""
    import guiderail
    from guiderail.diagrams import guidance
    from guiderail.diagrams.envs.observation import CLOCKS
    from guiderail.diagrams.guidance import guidance as guidance_ports
    from guiderail.diagrams.guidance.registry import REQUIREMENTS
    from guiderail.diagrams.stations.station import OUTPUTS
    from guiderail.models import primitives
    from guiderail.models.common.termination import TERMINATIONS

    page = (
        "# Public names\n\nNames that `guiderail`, `guiderail.models.primitives` and `guiderail.diagrams.guidance` "
        "export. [Systems](systems.md) have a separate page.\n\n"
    )
    seen: set[str] = set()
    for module in (guiderail, primitives, guidance):
        page += f"## {module.__name__}\n\n"
        for name in sorted(module.__all__, key=str.lower):
            thing = getattr(module, name)
            if name.startswith("__") or name in seen or not callable(thing):
                continue
            seen.add(name)
            page += f"### {name}\n\n" + exported(name, thing)
    page += "## Constants\n\n"
    rows = [
        ("guiderail.diagrams.envs.observation.CLOCKS", CLOCKS, "signals that every observation can have"),
        (
            "guiderail.models.common.termination.TERMINATIONS",
            TERMINATIONS,
            "terminations of an episode; the empty one while it runs",
        ),
        (
            "guiderail.diagrams.guidance.registry.REQUIREMENTS",
            tuple(REQUIREMENTS),
            "requirements of `register_guidance`",
        ),
        ("guiderail.diagrams.stations.station.OUTPUTS", OUTPUTS, "signals that every station has"),
        ("guiderail.diagrams.guidance.guidance.OUTPUTS", guidance_ports.OUTPUTS, "signals that every guidance has"),
    ]
    return page + table(
        ["name", "values", "description"], [(code(n), _listed(map(repr, w)), cell(m)) for n, w, m in rows]
    )


def exported(name: str, thing: Any) -> str:
    """Return the documentation of a class with its public methods, or of a function.

    A name of another package is only attributed to it: links of its documentation have no targets here.
    """
    package = thing.__module__.partition(".")[0]
    if not package.startswith("guiderail"):
        return f"From `{package}`.\n\n"
    page = documented(thing)
    if not inspect.isclass(thing):
        return signature(name, thing) + page
    own = "__init__" in vars(thing) and not dataclasses.is_dataclass(thing)
    if own or dataclasses.is_dataclass(thing):
        page = signature(name, thing) + page
    if own and thing.__init__.__doc__:
        page += documented(thing.__init__)
    rows = []
    for method, value in vars(thing).items():
        function = value.__func__ if isinstance(value, classmethod | staticmethod) else value
        if method.startswith("_") or not (inspect.isfunction(function) or isinstance(function, property)):
            continue
        text, _ = sections(inspect.getdoc(function) or "")
        call = method if isinstance(function, property) else f"{method}({_arguments(function)})"
        rows.append((code(call), cell(text.split("\n\n")[0])))
    return page + table(["member", "description"], rows)


def _arguments(function: Callable[..., Any]) -> str:
    return ", ".join(name for name in inspect.signature(function).parameters if name not in ("self", "cls"))


def command() -> str:
    """Return the page of commands with their options."""
    import typer

    from guiderail.tools.cli.app import expand_choices
    from guiderail.tools.cli.main import load_commands

    group: Any = typer.main.get_command(load_commands())
    commands: dict[str, Any] = {}
    for name, one in group.commands.items():
        commands |= {f"{name} {part}": sub for part, sub in one.commands.items()} if hasattr(one, "commands") else {}
        commands |= {} if hasattr(one, "commands") else {name: one}
    page = (
        "# Commands\n\n`guiderail COMMAND --help` prints the same. `--json` prints the result as one JSON object.\n\n"
    )
    for name, one in commands.items():
        page += f"## guiderail {name}\n\n{prose(inspect.cleandoc(one.help or ''))}\n\n"
        page += f"```sh\n{(one.epilog or '').removeprefix('Example: ')}\n```\n\n"
        kinds = _kinds(inspect.unwrap(one.callback))
        rows = []
        for parameter in one.params:
            if parameter.name == "help":
                continue
            words = expand_choices(parameter.help or "")
            arguments = parameter.opts + parameter.secondary_opts
            is_option = arguments[0].startswith("-")
            shown = ", ".join(arguments) if is_option else parameter.metavar or parameter.name.upper()
            is_flag = getattr(parameter, "is_flag", False)
            if is_option and not is_flag:
                shown += f" {parameter.metavar or kinds[parameter.name]}"
            default = (
                "" if is_flag or parameter.default in (None, "", inspect.Parameter.empty) else code(parameter.default)
            )
            rows.append((code(shown), cell(words), default))
        page += table(["", "description", "default"], rows)
    return page


def _kinds(function: Any) -> dict[str, str]:
    """Return the kind of value of each parameter of a command."""
    words = {str: "TEXT", int: "NUMBER", float: "NUMBER", Path: "PATH"}
    result = {}
    for name, annotation in typing.get_type_hints(function).items():
        kinds = [one for one in typing.get_args(annotation) or (annotation,) if one is not type(None)]
        result[name] = words.get(kinds[0], "TEXT") if kinds else ""
    return result


def options() -> str:
    """Return the page of tasks, guidance, stations, robots and learners with their options."""
    from guiderail.tools.catalog import describe_all

    known = describe_all()
    page = (
        "# Tasks, guidance and their options\n\n`make_env(task, …)`, `gymnasium.make`, and `--env key=value` take "
        "them; `guiderail list --json` prints them.\n\n## All environments\n\n"
    )
    page += _options(known["options"]["common"])
    for part, title in (("primitive", "guidance made of demonstrations"), ("template", "guidance made of a template")):
        page += f"## With {title}\n\n" + _options(known["options"][part])
    for name, task in known["tasks"].items():
        page += f"## Task {name}\n\n{prose(task['description'])}\n\n"
        rows = [("environment", code(task["environment"]))]
        rows += [
            (key, _listed(task[key])) for key in ("guidance", "stations", "rewards", "observations", "difficulties")
        ]
        rows += [("defaults", _listed([f"{k}={v}" for k, v in task["defaults"].items()]))]
        page += table(["", ""], rows) + _options(task["options"])
        page += "Options of `reset`:\n\n" + _options(task["reset_options"])
    page += "## Guidance\n\n" + table(
        ["name", "description", "needs"],
        [
            (code(n), cell(g["description"]), cell(" or ".join(" and ".join(x) for x in g["needs"])))
            for n, g in known["guidance"].items()
        ],
    )
    page += "## Stations\n\n" + table(
        ["name", "description", "workcell kind"],
        [(code(n), cell(s["description"]), cell(s["workcell_kind"])) for n, s in known["stations"].items()],
    )
    for name, station in known["stations"].items():
        if station["options"]:
            page += f"### Station {name}\n\n" + _options(station["options"])
    page += "## Robots and end effectors\n\n" + table(
        ["name", "description"],
        [(code(n), cell(r["description"])) for part in ("robots", "end_effectors") for n, r in known[part].items()],
    )
    return page + "## Learners\n\n" + _listed(known["learners"]) + "\n"


def _listed(values: Iterable[Any]) -> str:
    return ", ".join(code(value) for value in values)


def _options(rows: list[Mapping[str, Any]]) -> str:
    return (
        table(
            ["option", "description", "type and range", "default"],
            [(code(r["name"]), cell(r["description"]), _range(r), _format_default(r["default"])) for r in rows],
        )
        or "None.\n\n"
    )


def _format_default(default: Any) -> str:
    return "" if default in (None, "") or default is PydanticUndefined else code(default)


def _range(row: Mapping[str, Any]) -> str:
    signs = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
    bounds = [f"{sign} {row[key]:g}" for key, sign in signs.items() if key in row]
    among = [_listed(row["choices"])] if row.get("choices") else [cell(row["type"])]
    return ", ".join(among + bounds)


TEMPLATE_WORDS = {
    "name": "name of the template in messages and pictures",
    "inputs": "number of inputs of a user or policy, 1 to 6, each in [−1, 1]",
    "frames": "names of objects whose poses the task gives; `world` and `tool` always exist",
    "parameters": "named numbers that a task can replace; any number below can be an expression of them",
    "initial_state": "the initial state; the first one by default",
    "max_speed_m_per_s": "largest commanded speed [m/s]",
    "max_speed_rad_per_s": "largest commanded angular speed [rad/s]",
    "states": "states by name: see below",
}
STATE_WORDS = {
    "input_mapping": "list of mappings from inputs to motion, which are added",
    "active_constraints": "list of constraints onto which the requested pose is projected, in this order",
    "transition_distance": "distance to the end of the state, in meters or degrees; `…` below is the unit",
    "starts_at_…": "distance at which the state's progress is 0",
    "ends_at_…": "distance at which the state ends; that of the first transition by default",
    "max_force_n": "largest force of the impedance [N]; default: the task's, which no state can raise",
    "max_torque_nm": "largest torque of the impedance [Nm]; default: the task's",
    "max_speed_m_per_s": "largest commanded speed [m/s]; default: the template's, which no state can raise",
    "max_speed_rad_per_s": "largest commanded angular speed [rad/s]; default: the template's",
    "weight_per_…": "weight of a meter or a degree in the reward's progress; 1 by default",
    "transitions": "list of `to`, `below_…` and optionally `hysteresis_…`: the state changes to `to` when its "
    "distance falls below `below_…`, and back when that distance exceeds `below_…` + `hysteresis_…`; without "
    "`hysteresis_…` it never returns",
}


KINDS_NOTES = {
    "active_constraints": "They are applied in the order of the file. No kind bounds the rotation about F's z axis "
    "(yaw) to a range: `fixed_orientation`, `tilt_limits` and `tilt_by_distance` determine it. "
    "Without any of them the orientation is free.\n\n",
    "input_mapping": "For all inputs, a command moves no faster than `max_speed_m_per_s` and "
    "`max_speed_rad_per_s`.\n\n",
}


def shipped_templates() -> str:
    """Return the files of the shipped templates."""
    from importlib import resources

    folder = Path(str(resources.files("guiderail.models") / "objects"))
    page = ""
    for file in sorted(folder.glob("*/*.yaml"), key=lambda one: one.name):
        name = file.name.removesuffix(".yaml")
        page += f"### The template {name}\n\n`load_template({name!r})`:\n\n"
        page += f"```yaml\n{file.read_text(encoding='utf-8').rstrip()}\n```\n\n"
    return page


def templates() -> str:
    """Return the page of template files."""
    from guiderail.models.templates import schema
    from guiderail.models.templates.parts import ACTIVE_CONSTRAINTS, INPUT_MAPPINGS, TRANSITION_DISTANCES

    if changed := {*TEMPLATE_WORDS} ^ {*schema.TemplateFile.model_fields}:
        raise ValueError(f"the fields of a template changed: {changed} have no description here")
    page = (
        "# Template files\n\nA shared control template is a YAML file; `load_template(path)` reads it and "
        "`guiderail template validate FILE` reports the first error. "
        "[Write a template](../tutorials/write_a_template.md) is a tutorial.\n\n"
    )
    page += table(["field", "description"], [(code(n), cell(w)) for n, w in TEMPLATE_WORDS.items()])
    page += "## A state\n\n" + table(["field", "description"], [(code(n), cell(w)) for n, w in STATE_WORDS.items()])
    page += (
        f"At most {schema.MAX_STATES} states, {schema.MAX_PARTS} entries in a list, and {schema.MAX_NUMBER:g} "
        "for any number.\n\n"
    )
    kinds = (
        ("Input mappings", "input_mapping", INPUT_MAPPINGS),
        ("Active constraints", "active_constraints", ACTIVE_CONSTRAINTS),
        ("Transition distances", "transition_distance", TRANSITION_DISTANCES),
    )
    for title, where, registry in kinds:
        page += f"## {title}\n\nEach entry of `{where}` has `kind` and the fields of that kind.\n\n"
        page += KINDS_NOTES.get(where, "")
        for name, kind in registry.items():
            page += f"### {name}\n\n{paragraphs(sections(inspect.getdoc(kind) or '')[0])}\n\n"
            words, kinds_of = field_words(kind), field_types(kind)
            rows = []
            for one in dataclasses.fields(kind):
                missing = one.default is dataclasses.MISSING
                rows.append(
                    (
                        code(one.name),
                        cell(kinds_of.get(one.name, "")),
                        cell(words.get(one.name, "")),
                        "" if missing else code(one.default),
                    )
                )
            page += table(["field", "type", "description", "default"], rows)
    page += "## Shipped templates\n\nOther tasks can use them with other parameters, or start from a copy.\n\n"
    return page + shipped_templates()


def workcells() -> str:
    """Return the page of workcells and stations with their signals."""
    from pydrake.systems.framework import PortDataType

    from guiderail.diagrams.envs.config import EnvConfig
    from guiderail.diagrams.envs.make import make_station
    from guiderail.diagrams.stations import station as station_ports
    from guiderail.diagrams.stations.registry import STATIONS, stations_for
    from guiderail.diagrams.stations.workcell import ConvexWorkcell, Workcell
    from guiderail.diagrams.tasks.registry import TASKS

    page = (
        "# Workcells and stations\n\nA task names a station, and its `workcell()` returns the object that a "
        "station of that kind is built from. [Make your own task](../tutorials/own_task.md) uses a plane. For a "
        "workcell of another kind, `register_station` decorates a subclass of `Station` that is built from it. Every "
        "station has the inputs and outputs below; sizes are those of a pose with six numbers.\n\n"
    )
    rows = (
        (port, size, cell(words))
        for port, size, words in re.findall(
            r"^(`\w+`) +(\d+) +(.*(?:\n {6}.*)*)", inspect.getdoc(station_ports) or "", re.MULTILINE
        )
    )
    page += table(["port", "size", "description"], rows)
    tasks = {TASKS.get(name).station.kind.workcell_kind: name for name in ("NarrowPassage", "GridClamp", "Pouring")}
    for kind, task in tasks.items():
        workcell = EnvConfig.resolve(task, {}).declared.workcell()
        page += f"## {kind}\n\nStations: {_listed(stations_for(kind))}. The task `{task}` has "
        page += f"`{type(workcell).__module__}.{type(workcell).__name__}`.\n\n"
        if kind == "insertion":
            page += "Any object with these methods is a workcell:\n\n"
            for protocol in (Workcell, ConvexWorkcell):
                where = " (for `station=mujoco`)" if protocol is ConvexWorkcell else ""
                page += f"### {protocol.__name__}{where}\n\n" + exported(protocol.__name__, protocol)
        else:
            page += f"### {type(workcell).__name__}\n\n" + exported(type(workcell).__name__, type(workcell))
        rows = []
        for name in stations_for(kind):
            if not STATIONS.get(name).is_simulated:
                continue
            station = make_station(EnvConfig.resolve(task, {"station": name}))
            ports = (station.get_output_port(index) for index in range(station.num_output_ports()))
            sizes = {one.get_name(): one.size() for one in ports if one.get_data_type() == PortDataType.kVectorValued}
            rows.append((code(name), ", ".join(f"`{port}` {size}" for port, size in sizes.items())))
            page += f"### Station {name}\n\n" + documented(STATIONS.get(name).build)
        page += "Signals and their sizes:\n\n" + table(["station", "signals"], rows)
    return page


def studies() -> str:
    """Return the page of study files."""
    from guiderail_studies import declaration

    page = (
        "# Study files\n\n`guiderail study FILE --out D` runs methods × seeds × numbers of episodes × evaluation sets. "
        "Those of the project are in `research/studies`. Unknown fields are refused.\n\n"
    )
    kinds = (declaration.Study, declaration.Method, declaration.LearnerChoice, declaration.EvalSet, declaration.Sweep)
    for kind in (*kinds, declaration.Ratio):
        words, kinds_of = field_words(kind), field_types(kind)
        page += f"## {kind.__name__}\n\n{prose(sections(inspect.getdoc(kind) or '')[0])}\n\n"
        rows = []
        for name, field in kind.model_fields.items():
            default = "" if field.is_required() else code(_model_default(field.default))
            rows.append((code(field.alias or name), cell(kinds_of[name]), cell(words[name]), default))
        page += table(["field", "type", "description", "default"], rows)
    return page


def _model_default(value: Any) -> str:
    if isinstance(value, tuple) and value and hasattr(type(value[0]), "model_fields"):
        return f"[{type(value[0]).__name__}]"
    return f"{type(value).__name__}" if hasattr(type(value), "model_fields") else repr(value)


def files() -> str:
    """Return the page of files."""
    from guiderail.models.primitives import io as limits
    from guiderail.models.primitives.demonstrations import Demonstrations
    from guiderail.tools.evaluation.metrics import COLUMNS
    from guiderail.tools.evaluation.step_log import MEANINGS
    from guiderail.tools.learning.learner_config import PRESETS, OffPolicyConfig
    from guiderail.tools.learning.run_folder import RunConfig, RunFolder

    page = (
        f"# Files\n\n## A run\n\n{prose(sections(inspect.getdoc(RunFolder) or '')[0])}\n\n"
        "| file | content |\n|---|---|\n"
        "| `config.yaml` | the resolved configuration: the fields below |\n"
        "| `episodes.csv` | one row per episode: see below |\n"
        "| `steps/*.parquet` | one row per control step: see below |\n"
        "| `checkpoint/` | state from which `--resume` continues |\n"
        "| `policy.safetensors`, `policy.json` | weights and shape of the policy; loading them runs no code |\n"
        "| `learning_curve.png`, `replay.html` | pictures and page |\n\n"
    )
    page += "### config.yaml\n\n" + _fields(RunConfig)
    page += f"### learner, in config.yaml\n\n{prose(sections(inspect.getdoc(OffPolicyConfig) or '')[0])} "
    page += f"Presets are {', '.join(code(name) for name in PRESETS)}; `--set name=value` changes one setting.\n\n"
    page += _fields(OffPolicyConfig)
    page += (
        "### episodes.csv\n\nFurther columns `reward_…` are the sums of the reward terms. `collisions` and "
        "`collision_steps` count the signal that `Task.collision` names. An episode that a "
        "`TerminationTerm` ends as `collision` is counted only if that signal is above its limit too.\n\n"
    )
    page += table(["column", "unit", "meaning"], [(code(m.name), cell(m.unit), cell(m.description)) for m in COLUMNS])
    page += "### Step log\n\n`…_i` are columns for the numbers of a pose or a wrench.\n\n"
    page += table(["column", "unit", "meaning"], [(code(n), cell(u), cell(w)) for n, (u, w) in MEANINGS.items()])
    page += (
        f"## Demonstrations\n\n{paragraphs(inspect.getdoc(Demonstrations.load) or '').split('Raises:')[0]}\n"
        f"{paragraphs(inspect.getdoc(Demonstrations.save) or '').split('Raises:')[0]}\n"
        "An `.npz` that `save` writes has `times` and `outputs` with the samples of all demonstrations one after the "
        "other, `lengths` with their numbers of samples, and `names`. "
        f"At most {limits.MAX_DEMONSTRATIONS} demonstrations, "
        f"{limits.MAX_NUMBERS:,} numbers and {limits.MAX_FILE_SIZE:,} bytes.\n\n"
        "## Templates and studies\n\n[Template files](templates.md) and [study files](studies.md) are YAML.\n"
    )
    return page


def _fields(kind: type) -> str:
    words, kinds_of = field_words(kind), field_types(kind)
    rows = []
    for one in dataclasses.fields(kind):
        default = "" if one.default is dataclasses.MISSING else code(one.default)
        rows.append((code(one.name), cell(kinds_of[one.name]), cell(words[one.name]), default))
    return table(["field", "type", "description", "default"], rows)


def metrics() -> str:
    """Return the page of metrics."""
    from guiderail.tools.evaluation.metrics import COLUMNS, statistics_of

    heads = ["name", "unit", "meaning"]
    page = (
        "# Metrics\n\nEach metric is defined once, in `guiderail.tools.evaluation.metrics`, and computed from the "
        "`EpisodeTrace`. `guiderail list metrics` prints them.\n\n## Episodes\n\n"
    )
    page += table(heads, [(code(m.name), cell(m.unit), cell(m.description)) for m in COLUMNS])
    page += "## Statistics of many episodes\n\nIn tables of studies, those of training have the prefix `training_`.\n\n"
    return page + table(heads, [(code(m.name), cell(m.unit), cell(m.description)) for m in statistics_of().values()])


def errors() -> str:
    """Return the page of exceptions and exit codes."""
    from guiderail.models.common.errors import InputError, RunsFailedError
    from guiderail.models.primitives import UnsolvableError
    from guiderail.systems import PolicyError
    from guiderail_mujoco.gantry import DivergedError

    page = (
        "# Errors\n\n| exit code | meaning |\n|---|---|\n"
        "| 0 | success |\n"
        "| 1 | runs of a study failed, a check failed, or commands to a robot stopped arriving |\n"
        "| 2 | wrong input: one sentence, before anything moves or is written |\n"
        "| 130 | interrupted by Ctrl-C |\n\n"
        "Exceptions of the Python API:\n\n"
    )
    for error in (InputError, UnsolvableError, PolicyError, DivergedError, RunsFailedError):
        bases = ", ".join(base.__name__ for base in error.__bases__)
        page += f"## {error.__name__}\n\nA `{bases}`, from `{error.__module__}`. {documented(error)}"
    return page


def examples() -> str:
    """Return the page of examples, each under its task."""
    page = "# Examples\n\nEach example is a file in `examples/` that the tests run.\n\n"
    for path in sorted((Path(__file__).parents[1] / "examples").glob("*.py")):
        source = path.read_text(encoding="utf-8")
        doc = ast.get_docstring(ast.parse(source)) or ""
        title, _, description = doc.partition(": ")
        body, description = source.split('"""', 2)[2].strip(), description[:1].upper() + description[1:]
        page += f"## {title}\n\n{prose(description)}\n\n`examples/{path.name}`\n\n```python\n{body}\n```\n\n"
    return page


def wiring() -> str:
    """Return the page of guidance diagrams with all connections."""
    import numpy as np
    from pydrake.math import RigidTransform

    from guiderail.diagrams.guidance import GUIDANCE, PlacedTemplate, PrimitiveConfig, PriorKnowledge, build_guidance
    from guiderail.diagrams.guidance.registry import missing_requirements
    from guiderail.models.control.command_filters import KeepOut
    from guiderail.models.primitives import LinearConstraints, ReferenceTrajectory
    from guiderail.models.templates import load_template

    period, box = 0.02, LinearConstraints.box([-1.0, -1.0], [1.0, 1.0])
    times = period * np.arange(20)
    reference = ReferenceTrajectory(times, np.column_stack([times, times]), np.tile(0.01 * np.eye(2), (20, 1, 1)))
    walls = KeepOut([[5.0, 5.0]], [[6.0, 6.0]], box, margin=0.0)
    skill = PrimitiveConfig(reference, box, period, horizon=4, keep_out=walls)
    demonstrated = PriorKnowledge(period, primitive=skill, pose_size=2)
    template = PriorKnowledge(period, template=PlacedTemplate(load_template("grid_clamp"), {"hole": RigidTransform()}))
    page = (
        "# Guidance diagrams\n\nConnections in the diagrams of `build_guidance`, here with planar demonstrations "
        "and with the grid clamp's template. A diagram's own ports have no system before the dot. "
        "[Systems](systems.md) describes each system.\n\n"
    )
    for name in GUIDANCE.names():
        if not GUIDANCE.get(name).build.__module__.startswith("guiderail."):
            continue
        prior = template if not missing_requirements(GUIDANCE.get(name).needs, {"template"}) else demonstrated
        diagram = build_guidance(name, prior)
        page += f"## {name}\n\n{prose(inspect.getdoc(GUIDANCE.get(name).build) or '').split(chr(10) * 2)[0]}\n\n"
        page += table(["from", "to"], [(code(one), code(other)) for one, other in connections(diagram)])
    return page


def connections(diagram: Any) -> list[tuple[str, str]]:
    """Return every connection of a diagram, from and to, as `system.port`."""
    from pydrake.systems.framework import InputPortIndex, OutputPortIndex

    rows = []
    for index in range(diagram.num_input_ports()):
        for system, port in diagram.GetInputPortLocators(InputPortIndex(index)):
            rows.append((f".{diagram.get_input_port(index).get_name()}", _port(system.get_input_port(port))))
    rows += sorted(
        (_port(source.get_output_port(output)), _port(system.get_input_port(port)))
        for (system, port), (source, output) in diagram.connection_map().items()
    )
    for index in range(diagram.num_output_ports()):
        source, output = diagram.get_output_port_locator(OutputPortIndex(index))
        rows.append((_port(source.get_output_port(output)), f".{diagram.get_output_port(index).get_name()}"))
    return rows


def _port(port: Any) -> str:
    return f"{port.get_system().get_name()}.{port.get_name()}"


PAGES: dict[str, Callable[[], str]] = {
    "examples": examples,
    "systems": systems,
    "wiring": wiring,
    "names": api,
    "command": command,
    "options": options,
    "workcells": workcells,
    "templates": templates,
    "studies": studies,
    "files": files,
    "metrics": metrics,
    "errors": errors,
}
