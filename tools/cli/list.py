"""`guiderail list`."""

from typing import Annotated

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
    """List tasks, guidance, stations, robots, presets and learners.

    With a task it lists the options of its environment and of a reset; with metrics, the definition of every number in
    a table. `guiderail list --json` also prints descriptions, ports, and options with their ranges.
    """
    from guiderail.diagrams.tasks.registry import IMPORT_HINT, TASKS
    from guiderail.tools.imports import import_modules

    import_modules(imports or ())
    name = None if what is None else cli.find_task(what)[0]
    if name is None:
        names = {key: list_names() for key, list_names in cli.LISTED.items()}
        if as_json:
            from guiderail.tools.catalog import describe_all

            names |= describe_all()
        print_result(names, as_json)
    elif name == "metrics":
        from guiderail.tools.evaluation.metrics import COLUMNS, statistics_of

        metrics = [*(("episode: ", one) for one in COLUMNS), *(("episodes: ", one) for one in statistics_of().values())]
        text = {prefix + one.name: one.description + (f" [{one.unit}]" if one.unit else "") for prefix, one in metrics}
        print_result(text, as_json, "_")
    elif name in cli.LISTED:
        print_result({name: cli.LISTED[name]()}, as_json)
    elif name in cli.LISTED["tasks"]():
        from guiderail.tools.catalog import describe_task, describe_task_options

        is_described = as_json and name in TASKS.names()
        print_result(describe_task(name) if is_described else describe_task_options(name), as_json, "_")
    else:
        known = did_you_mean(name, [*cli.CHOICES["listed"](), "metrics"], IMPORT_HINT)
        raise InputError(f"there is no list of {name!r}: {known}")
