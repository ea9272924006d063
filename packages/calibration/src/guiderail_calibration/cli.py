"""`guiderail calibrate` and `guiderail probe`."""

from pathlib import Path
from typing import Annotated

import typer

from guiderail.models.common.errors import InputError
from guiderail.tools.cli import app as cli
from guiderail.tools.cli.app import argument, option, print_message, print_result, to_json

Run = Annotated[str, argument("Folder of a run, or pretrained:NAME ({pretrained}).", "RUN")]


@cli.command("calibrate runs/connector --recordings recordings --probe probe.npz")
def calibrate(
    run: Run,
    recordings: Annotated[
        Path | None,
        option(
            "Folder of recorded episodes: a step log, as evaluate --steps writes it, or a run with one.  [default: "
            "none; then only variants.yaml is written, with draws of the prior]"
        ),
    ] = None,
    probe: Annotated[
        Path | None, option("Probing motion that was recorded.  [default: episodes of the run's policy]")
    ] = None,
    env: cli.Env = None,
    parameters: Annotated[
        str | None, option("Parameters, comma-separated.  [default: all that the environment has]")
    ] = None,
    draws: Annotated[int, option("Number of simulated draws of the prior, five episodes each.")] = 240,
    predicted: Annotated[
        int, option("Number of draws of the posterior for which the policy is simulated; 0 for no prediction.")
    ] = 40,
    variants: Annotated[int, option("Number of variants of the environment in variants.yaml.")] = 10,
    out: Annotated[Path | None, option("Folder to write.  [default: calibration in the run]")] = None,
    processes: cli.Processes = None,
    trust_imports: cli.TrustImports = False,
    as_json: cli.Json = False,
) -> None:
    """Infer a robot's friction, stiffness and sensor errors from one to twenty recorded episodes.

    The sensitivities are printed first: a parameter that the recordings cannot identify is named and keeps its prior.
    Then follow the posterior, the predicted success and force of the policy on this robot, and a check that the model
    explains the recordings. variants.yaml in the folder continues training on draws of the posterior: guiderail train
    TASK --variants FILE --set init_from=RUN. Simulations are stored, so the same command resumes.
    """
    from guiderail_calibration.calibrate import calibrate as run_calibration
    from guiderail_calibration.calibrate import write_prior_variants
    from guiderail_calibration.inference import describe_check

    names = None if parameters is None else [name.strip() for name in parameters.split(",") if name.strip()]
    if recordings is None:
        if probe is not None:
            raise InputError("--probe is a recorded motion: give --recordings too")
        file = write_prior_variants(run, variants, environment=cli.parse_environment(env), parameters=names, out=out)
        print_result({"variants": str(file)}, as_json)
        return
    result = run_calibration(
        run,
        recordings,
        probe=probe,
        environment=cli.parse_environment(env),
        parameters=names,
        draws=draws,
        predicted=predicted,
        number=variants,
        out=out,
        processes=processes,
        log=print_message,
    )
    if as_json:
        typer.echo(to_json(result))
        return
    for row in result["parameters"]:
        note = "" if row["identifiable"] == "yes" else ", not identified"
        typer.echo(f"{row['meaning']}: {row['median']:.3g}, 90 % from {row['low']:.3g} to {row['high']:.3g}{note}")
    if (prediction := result["prediction"]) is not None:
        typer.echo(
            f"predicted success rate {prediction['success']:.0%}, 90 % from {prediction['low']:.0%} to "
            f"{prediction['high']:.0%}; peak force of an episode {prediction['peak_force']:.1f} N, 90 % from "
            f"{prediction['peak_force_low']:.1f} to {prediction['peak_force_high']:.1f} N"
        )
    typer.echo(describe_check(result["explained"], result["p"]))
    for name in ("page", "posterior", "variants"):
        typer.echo(result[name])


@cli.command("probe runs/connector --out probe.npz")
def probe(
    run: Run,
    out: Annotated[Path, option("File of the probing motion to write, .npz or .csv.")],
    env: cli.Env = None,
    as_json: cli.Json = False,
) -> None:
    """Write a probing motion that makes contact and sensors identifiable: press, slide, wiggle and lift.

    It is a demonstration for guidance=kmp, so that the force limit of the environment bounds its forces. The printed
    options of the environment record it: guiderail evaluate TASK --policy zero --episodes 5 --steps DIR with them.
    """
    from guiderail_calibration.probe import record_options

    print_result(record_options(run, cli.parse_environment(env), out), as_json)
