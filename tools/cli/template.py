"""`guiderail template`."""

from pathlib import Path
from typing import Annotated

from guiderail.tools.cli import app as cli
from guiderail.tools.cli.app import argument, command, option, print_result

template = cli.command_group("template", "Validate shared control templates.")


@command("template validate pouring --draw pouring.svg", "validate", template)
def validate_template(
    file: Annotated[Path, argument("Template (.yaml), or one of {templates}.", "FILE")],
    draw: Annotated[Path | None, option("Picture of the states to write: .png, .svg, .pdf or .dot.")] = None,
    imports: cli.TemplateImports = None,
    as_json: cli.Json = False,
) -> None:
    """Validate and summarize a shared control template before it is used."""
    from guiderail.tools.validate_template import validate_template as check

    cli.import_files(imports)
    print_result(check(file, draw), as_json)
