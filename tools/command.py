"""The `guiderail` command: what a person types, checked, and handed to the tool that does it."""

import json
import math
import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from guiderail.models.errors import InputError

# Tools are imported where they are called: PyTorch and Drake take seconds, and `guiderail --help` should not.
app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object, for a program to read.")]
Run = Annotated[Path, typer.Argument(help="A folder that guiderail train made.")]


@app.callback()
def _guiderail() -> None:
    """Reinforcement learning of contact tasks that breaks nothing."""


@app.command()
def train(
    task: Annotated[str | None, typer.Argument(help="What is learned, such as NarrowPassage.")] = None,
    out: Annotated[Path | None, typer.Option(help="The run's folder; it must not exist, unless with --resume.")] = None,
    guidance: Annotated[str | None, typer.Option(help="What guides the policy.  [default: skgrl or sct]")] = None,
    algorithm: Annotated[str | None, typer.Option(help="tqc or sac.  [default: the task's]")] = None,
    episodes: Annotated[int | None, typer.Option(help="How many in all.  [default: 60]")] = None,
    seed: Annotated[int | None, typer.Option(help="Of everything random.  [default: 0]")] = None,
    preset: Annotated[str | None, typer.Option(help="The learner's settings.  [default: the task's]")] = None,
    setting: Annotated[list[str] | None, typer.Option("--set", help="One setting, such as batch_size=128.")] = None,
    hold: Annotated[int | None, typer.Option(help="Control steps that an action lasts.")] = None,
    reward: Annotated[
        str | None, typer.Option(help="sparse or shaped; Pouring also has hand_shaped, GridClamp no_force.")
    ] = None,
    observation: Annotated[str | None, typer.Option(help="state or image.")] = None,
    uncertainty: Annotated[str | None, typer.Option(help="calibration or disc, for the connector.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the run in --out.")] = False,
    as_json: Json = False,
) -> None:
    """Train a policy; leaves a run folder."""
    from guiderail.tools.learning import configure as training

    given = {"guidance": guidance, "hold": hold, "reward": reward, "observation": observation}
    summary = training.run(
        task,
        out,
        environment={k: v for k, v in (given | {"uncertainty": uncertainty}).items() if v is not None},
        algorithm=algorithm,
        preset=preset,
        settings=_settings(setting or []),
        episodes=episodes,
        seed=seed,
        resume=resume,
    )
    _print(summary, as_json)


@app.command()
def evaluate(
    run: Run,
    episodes: Annotated[int, typer.Option(help="How many, each with held-out initial conditions.")] = 100,
    seed: Annotated[int, typer.Option(help="Of the held-out initial conditions.")] = 1_000_000,
    as_json: Json = False,
) -> None:
    """Judge a run's deterministic policy on what training never drew, beside the demonstration alone."""
    from guiderail.tools.rollouts.evaluate import evaluate as evaluate_run

    _print(evaluate_run(run, episodes=episodes, seed=seed), as_json)


@app.command()
def replay(
    run: Run,
    html: Annotated[Path | None, typer.Option(help="The page to write.  [default: replay.html in the run]")] = None,
    seed: Annotated[int, typer.Option(help="Of the held-out initial condition shown.")] = 1_000_000,
    station: Annotated[str | None, typer.Option(help="Where the policy acts: rails or arm, for the connector.")] = None,
    picture: Annotated[Path | None, typer.Option(help="What a camera sees of the episode, a .png to write.")] = None,
) -> None:
    """Write one self-contained page with the robot, the demonstrations, the executed paths and the constraint."""
    from guiderail.tools.viewing.replay import write_replay

    typer.echo(write_replay(run, html, seed=seed, station=station, picture=picture))


@app.command()
def plot(run: Run) -> None:
    """Draw a run's learning curve into its folder."""
    from guiderail.tools.viewing.plot import plot_run

    typer.echo(plot_run(run))


@app.command()
def record(
    run: Run,
    out: Annotated[Path, typer.Option(help="The demonstrations' file, .npz or .csv.")],
    episodes: Annotated[int, typer.Option(help="How many demonstrations.")] = 5,
    signal: Annotated[str, typer.Option(help="commanded or measured poses.")] = "commanded",
    seed: Annotated[int, typer.Option(help="Of the first held-out initial condition.")] = 1_000_000,
) -> None:
    """Record what a policy does, as demonstrations that a primitive can learn from."""
    from guiderail.tools.recording.record import record as record_run

    typer.echo(record_run(run, out, episodes=episodes, signal=signal, seed=seed))


@app.command()
def check(
    file: Annotated[Path, typer.Argument(help="Demonstrations (.npz, .csv) or a skill (.yaml).")],
    draw: Annotated[Path | None, typer.Option(help="Draw a skill's state machine (.png, .svg, .pdf, .dot).")] = None,
    as_json: Json = False,
) -> None:
    """Check a file of demonstrations or a skill before anything is learned from it."""
    from guiderail.tools.check import check as check_file

    _print(check_file(file, draw), as_json)


@app.command()
def study(
    task: Annotated[str, typer.Argument(help="What is learned; or smoothness, which compares ways to explore.")],
    out: Annotated[Path, typer.Option(help="The folder of the study; finished runs in it are kept.")],
    guidance: Annotated[str, typer.Option(help="One or several, separated by commas.")] = "residual,kgrl,skgrl",
    algorithm: Annotated[str, typer.Option(help="One or several, separated by commas.")] = "tqc",
    seeds: Annotated[int, typer.Option(help="Runs of each.")] = 3,
    episodes: Annotated[int | None, typer.Option(help="Of each run.  [default: 60; smoothness: 4]")] = None,
    preset: Annotated[str, typer.Option(help="The learner's settings.")] = "robust",
    hold: Annotated[int | None, typer.Option(help="Control steps that an action lasts.")] = None,
    evaluations: Annotated[int, typer.Option(help="Held-out episodes of each run.")] = 20,
    as_json: Json = False,
) -> None:
    """Train and evaluate several guidances or learners over seeds, or compare how smoothly one can explore."""
    if task == "smoothness":
        from guiderail.tools.studies.smoothness import smoothness

        _print(smoothness(out, episodes=4 if episodes is None else episodes), as_json)
        return
    from guiderail.tools.studies.study import study as run_study

    result = run_study(
        task,
        out,
        guidance=guidance.split(","),
        algorithms=algorithm.split(","),
        seeds=seeds,
        episodes=60 if episodes is None else episodes,
        preset=preset,
        hold=hold,
        evaluations=evaluations,
    )
    _print(result, as_json)


@app.command()
def reproduce(
    figure: Annotated[str, typer.Argument(help="A figure of the thesis, such as 5.6, or 'table 3.3'.")],
    seeds: Annotated[int, typer.Option(help="Runs of each method.")] = 3,
    episodes: Annotated[int | None, typer.Option(help="Of each run.  [default: the figure's own]")] = None,
    out: Annotated[Path, typer.Option(help="The folder; finished runs in it are used again.")] = Path("reproductions"),
    as_json: Json = False,
) -> None:
    """Make a figure of the thesis anew: a picture, and a table with the numbers behind it."""
    from guiderail.tools.figures import reproduce as reproduce_figure

    _print(reproduce_figure(figure, seeds=seeds, episodes=episodes, out=out), as_json)


@app.command()
def bench(
    what: Annotated[str, typer.Argument(help="primitive or simulation.")],
    as_json: Json = False,
) -> None:
    """Measure how fast the primitive or the simulation is on this machine."""
    from importlib import import_module

    if what not in ("primitive", "simulation"):
        raise InputError(f"there is no benchmark {what!r}: choose primitive or simulation")
    import_module(f"guiderail.tools.benchmarks.{what}").main(as_json)


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Where the run goes; an earlier demo there is replaced.")] = Path("demo"),
    episodes: Annotated[int, typer.Option(help="How many to learn from.")] = 32,
    seed: Annotated[int, typer.Option(help="Of everything random.")] = 0,
) -> None:
    """Watch sKGRL learn to avoid an obstacle in a narrow passage, in a minute or two."""
    from guiderail.tools.demo import run_demo

    run_demo(out, episodes=episodes, seed=seed)


def main(arguments: list[str] | None = None) -> None:
    """Runs the command and ends the process: 0 for success, 2 for what a person gave wrong, in one sentence."""
    # Matrices here are small: threads that wait for each other cost more than they give, and runs go side by side.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    try:
        code = app(args=arguments, prog_name="guiderail", standalone_mode=False)
    except InputError as error:
        code = _refuse(str(error))
    except (KeyboardInterrupt, typer.Abort):
        _say("stopped; a run goes on with guiderail train --resume --out RUN")
        code = 130
    except BrokenPipeError:
        code = 1
    except Exception as error:
        if not hasattr(error, "format_message"):
            raise
        code = _refuse(_usage_sentence(error))
    sys.exit(code if isinstance(code, int) else 0)


def _usage_sentence(error: Any) -> str:
    """What typer found wrong with the command line, as one sentence that says what to do."""
    message = " ".join(str(error.format_message()).split()).rstrip(".")
    message = message[:1].lower() + message[1:]
    context = getattr(error, "ctx", None)
    if "command" in message and context is not None and hasattr(context.command, "list_commands"):
        return f"{message.split('. ')[0]}: choose one of {', '.join(context.command.list_commands(context))}"
    path = context.command_path if context is not None else "guiderail"
    return f"{message}: see {path} --help"


def _refuse(sentence: str) -> int:
    _say(sentence)
    return 2


def _say(sentence: str) -> None:
    print(f"guiderail: {sentence}", file=sys.stderr)


def _settings(pairs: list[str]) -> dict[str, str]:
    """`key=value` pairs as a dictionary."""
    for pair in pairs:
        if "=" not in pair:
            raise InputError(f"--set takes name=value, such as batch_size=128, not {pair!r}")
    return {key.strip(): value.strip() for key, _, value in (pair.partition("=") for pair in pairs)}


def _print(result: dict[str, Any], as_json: bool) -> None:
    """A result for a program or for a person."""
    if as_json:
        # JSON knows no infinity: what is unbounded, such as the slack of no constraint at all, is null there.
        known = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in result.items()}
        typer.echo(json.dumps(known, allow_nan=False))
        return
    width = max(len(key) for key in result)
    for key, value in result.items():
        shown = "–" if value is None else f"{value:.4g}" if isinstance(value, float) else value
        typer.echo(f"{key.replace('_', ' '):<{width}}  {shown}")
