"""`guiderail export`."""

from pathlib import Path
from typing import Annotated

import typer

from guiderail.models.common.errors import InputError
from guiderail.models.common.plugins import MissingSiblingError, find_plugins
from guiderail.models.common.registry import did_you_mean
from guiderail.tools.cli import app as cli
from guiderail.tools.cli.app import argument, option

TARGETS = {"onnx": None, "cpp": "cpp"}
"""Formats, and the sibling distribution that has the plug-in `exporter:FORMAT`; the core writes ONNX itself."""


@cli.command("export pretrained:connector --target onnx --out connector")
def export(
    run: Annotated[str, argument("Folder of a run, or pretrained:NAME ({pretrained}).", "RUN", "pretrained")],
    out: Annotated[Path, option("Folder to write; it must not exist.")],
    target: Annotated[str, option(f"Format: {', '.join(TARGETS)}.")] = "onnx",
    trust_imports: cli.TrustImports = False,
) -> None:
    """Write a skill to files that other programs read.

    With onnx, the folder contains the policy (policy.onnx), the names, units, centers and scales of observation and
    action in their order and the settings of the guidance (skill.json), and the data of its movement primitive
    (primitive.npz). With cpp, it contains a C++ library that computes the commands, its data, and a test.
    """
    exporters = dict(find_plugins("exporter"))
    if target not in TARGETS and target not in exporters:
        raise InputError(f"there is no target {target!r}: {did_you_mean(target, [*TARGETS, *exporters])}")
    if target in exporters:
        export_skill = exporters[target].load()
    elif (sibling := TARGETS[target]) is not None:
        raise MissingSiblingError(f"guiderail export --target {target}", sibling)
    else:
        from guiderail.tools.export import export_skill

    for path in export_skill(run, out):
        typer.echo(path)
