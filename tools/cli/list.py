"""`guiderail list`."""

from itertools import chain
from typing import Annotated, Any

import typer

from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import did_you_mean
from guiderail.tools.cli import app as cli
from guiderail.tools.cli.app import argument, print_result


@cli.command("list BncConnector", "list")
def list_(
    what: Annotated[
        str | None, argument("One of {listed}, or metrics; everything by default.", "WHAT", "listed")
    ] = None,
    imports: cli.Imports = None,
    as_json: cli.Json = False,
) -> None:
    """List tasks, guidance, stations, robots, drivers, kernels, learners, engines and presets.

    With a task it lists the options of its environment and of a reset, the basic ones first; with a learner or a
    preset, its settings; with a guidance, its ports and options; with another name of a list, its description; with
    metrics, the definition of every number in a table. An entry of a structured option, such as .variance of history,
    is given as history.variance=1e-8. `guiderail list --json` also prints descriptions, ports, and options with their
    ranges.
    """
    from guiderail.diagrams.tasks.registry import IMPORT_HINT, TASKS
    from guiderail.tools.imports import import_modules

    import_modules(imports or ())
    name = None if what is None else cli.find_task(what)[0]
    if name is None:
        names: dict[str, Any] = {key: _usable(key) for key in cli.LISTED}
        broken = {key: messages for key in cli.LISTED if (messages := cli.find_broken(key))}
        if as_json:
            from guiderail.tools.catalog import describe_all

            names |= describe_all() | {"broken": broken}
        print_result(names, as_json)
        for message in () if as_json else chain(*map(dict.values, broken.values())):
            typer.echo(f"broken: {message}")
    elif name == "metrics":
        from guiderail.tools.evaluation.metrics import COLUMNS, statistics_of

        metrics = [
            *(("episode: ", column) for column in COLUMNS),
            *(("episodes: ", m) for m in statistics_of().values()),
        ]
        text = {prefix + m.name: m.description + (f" [{m.unit}]" if m.unit else "") for prefix, m in metrics}
        print_result(text, as_json, "_")
    elif name in cli.LISTED:
        print_result({name: _usable(name)}, as_json)
        for message in () if as_json else cli.find_broken(name).values():
            typer.echo(f"broken: {message}")
    elif name in cli.LISTED["tasks"]():
        from guiderail.tools.catalog import describe_task, describe_task_groups, describe_task_options

        if as_json:
            print_result(describe_task(name) if name in TASKS.names() else describe_task_options(name), as_json)
            return
        for group, options in describe_task_groups(name).items():
            typer.echo(f"[{group}]")
            print_result(options, as_json, "_")
    elif (described := _describe_entry(name, as_json)) is not None:
        print_result(described, as_json, "_")
    else:
        known = did_you_mean(
            name, [*cli.CHOICES["listed"](), *chain(*map(_usable, cli.LISTED)), "metrics"], IMPORT_HINT
        )
        raise InputError(f"there is no list of {name!r}: {known}")


def _describe_entry(name: str, as_json: bool) -> dict[str, Any] | None:
    """Return settings of a learner or a preset, or the description of another entry of a list; None if unknown."""
    from guiderail.tools.catalog import describe_all, describe_guidance_options, indent_entries

    if name in cli.LISTED["presets"]() or name in cli.LISTED["learners"]():
        from guiderail.tools.learning.config import config_values, resolve_preset

        is_preset = name in cli.LISTED["presets"]()
        values = config_values(resolve_preset(name if is_preset else None, None if is_preset else name, None))
        return values if as_json else indent_entries(values)
    if name in cli.LISTED["guidance"]() and not as_json:
        return describe_guidance_options(name)
    if not any(name in _usable(key) for key in cli.LISTED):
        return None
    for key, entries in describe_all().items():
        if key in cli.LISTED and isinstance(entries, dict) and name in entries:
            return {"kind": key, **entries[name]}
    return None


def _usable(key: str) -> list[str]:
    """Return the names of a list without those of broken entry points."""
    broken = cli.find_broken(key)
    return [name for name in cli.LISTED[key]() if name not in broken]
