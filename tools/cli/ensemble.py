"""`guiderail ensemble`."""

from pathlib import Path
from typing import Annotated

from guiderail.tools.cli import app as cli
from guiderail.tools.cli.app import argument, option, print_result


@cli.command("ensemble runs/seed0 runs/seed1 runs/seed2 --out runs/mean")
def ensemble(
    runs: Annotated[list[str], argument("Folders of runs with the same observations and guidance.", "RUN...")],
    out: Annotated[Path, option("Folder to write; it must not exist.")],
    trust_imports: cli.TrustImports = False,
    as_json: cli.Json = False,
) -> None:
    """Write the mean of several runs' policies as one policy.

    The folder is evaluated like a run: guiderail evaluate runs/mean. The standard deviation of the networks' actions is
    the column disagreement of the step log that evaluate --steps writes.
    """
    from guiderail.tools.ensemble import write_ensemble

    members = write_ensemble(runs, out).members
    print_result({"policy": str(out), "networks": len(members)}, as_json)
