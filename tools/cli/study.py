"""`guiderail study`."""

from pathlib import Path
from typing import Annotated

from guiderail.models.common.errors import RunsFailedError
from guiderail.tools.cli import app as cli
from guiderail.tools.cli.app import argument, option, print_result


@cli.command("study study.yaml --out studies --methods skgrl,kgrl --seeds 30,31")
def study(
    file: Annotated[Path, argument("YAML file of the study.", "FILE")],
    out: Annotated[Path, option("Folder of the study; finished runs in it are used again.")],
    methods: Annotated[str | None, option("Methods to run, comma-separated.  [default: all]")] = None,
    seeds: Annotated[
        str | None, option("Seeds instead of the study's, comma-separated; a method's own seeds take precedence.")
    ] = None,
    engine: Annotated[str | None, option("Engine: {engines}.  [default: process]", choices="engines")] = None,
    address: Annotated[
        str | None, option("Address of a Ray cluster.  [default: RAY_ADDRESS, or a local cluster]")
    ] = None,
    processes: Annotated[
        int | None, option("Number of runs in parallel.  [default: 2, or the cores of a cluster]")
    ] = None,
    trust_imports: cli.TrustImports = False,
    as_json: cli.Json = False,
) -> None:
    """Train and evaluate methods over seeds, as declared in a YAML file.

    The result is a table with one row per method, seed, checkpoint and evaluation set; a table of selected methods or
    other seeds is named after them. The same command resumes an interrupted study. A failed run does not stop the
    others: it is listed at the end, and the exit code is 1.
    """
    from guiderail.tools.experiments import declaration
    from guiderail.tools.experiments.engines.engine import make_engine
    from guiderail.tools.experiments.study import study_command
    from guiderail.tools.imports import import_stored

    declared = declaration.load_study(file)
    import_stored(declared.imports, file)
    names = None if methods is None else [name.strip() for name in methods.split(",")]
    chosen = declared.subset(names, cli.parse_integers(seeds, "--seeds"))
    running = make_engine(engine or "process", processes, address)
    result = study_command(chosen, out, running, declared.subset_name(chosen), file=file)
    print_result(result, as_json)
    if "failed" in result:
        raise RunsFailedError(result["failed"], None)
