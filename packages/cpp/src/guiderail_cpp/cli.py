"""`guiderail export`."""

from pathlib import Path
from typing import Annotated

import typer

from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import did_you_mean, find_plugins
from guiderail.tools.cli import app as cli
from guiderail.tools.cli.app import argument, command, option

EXPORTERS = dict(find_plugins("exporter"))
"""Entry point of each format; other packages add theirs as plug-ins of the kind `exporter`."""


@command("export pretrained:connector --target onnx --out connector")
def export(
    run: Annotated[str, argument("Folder of a run, or pretrained:NAME ({pretrained}).", "RUN", "pretrained")],
    out: Annotated[Path, option("Folder to write; it must not exist.")],
    target: Annotated[str, option(f"Format: {', '.join(EXPORTERS)}.")] = "onnx",
    trust_imports: cli.TrustImports = False,
) -> None:
    """Write a skill to files that other programs read.

    With onnx, the folder contains the policy (policy.onnx), the names, units, centers and scales of observation and
    action in their order and the settings of the guidance (skill.json), and the data of its movement primitive
    (primitive.npz). Its loop.py runs the skill without an environment: python FOLDER/loop.py replays recorded steps,
    and needs onnxruntime (the extra guiderail[onnx]). With cpp, it contains a C++ library that computes the commands,
    its data, and a test.
    """
    if target not in EXPORTERS:
        raise InputError(f"there is no target {target!r}: {did_you_mean(target, EXPORTERS)}")
    for path in EXPORTERS[target].load()(run, out):
        typer.echo(path)
