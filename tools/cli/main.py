"""The `guiderail` command: what a person types, checked, and handed to the tool that does it."""

import json
import math
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import typer
import typer.core

from guiderail.models.common.errors import InputError, RunsFailedError
from guiderail.models.common.registry import did_you_mean
from guiderail.models.objects.insertion import COLLISION_FORCE

# Tools are imported where they are called: PyTorch and Drake take seconds, and `guiderail --help` should not.


def _known(module: str, name: str) -> Callable[[], list[str]]:
    """Looks up what can be chosen, a list or a registry, when somebody asks for it."""

    def names() -> list[str]:
        found = getattr(import_module(f"guiderail.{module}"), name)
        found = getattr(found, "names", found)
        return list(found() if callable(found) else found)

    return names


# What a word in braces in a help text stands for, and what a shell completes.
CHOICES: dict[str, Callable[[], list[str]]] = {
    "tasks": _known("tools.environments", "known_tasks"),
    "guidance": _known("diagrams.guidance.registry", "GUIDANCE"),
    "stations": _known("diagrams.stations.registry", "STATIONS"),
    "robots": _known("models.robots.robot", "robot_names"),
    "algorithms": _known("tools.learning.learner", "learner_names"),
    "presets": _known("tools.learning.config", "PRESETS"),
    "engines": _known("tools.experiments.engines.engine", "ENGINES"),
    "pictures": _known("tools.files", "PICTURES"),
    "nulls": _known("tools.evaluation.baselines", "BASELINES"),
    "axes": lambda: [axis.name for axis in import_module("guiderail.tools.evaluation.robustness").AXES],
    "listed": lambda: [*LISTED, *CHOICES["tasks"]()],
}


class Command(typer.core.TyperCommand):
    """A command whose help names the choices that there are by then."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Fills the choices in."""
        for parameter in self.params:
            words = getattr(parameter, "help", None) or ""
            for name, names in CHOICES.items():
                if f"{{{name}}}" in words:
                    words = words.replace(f"{{{name}}}", ", ".join(names()))
            parameter.help = words  # type: ignore[attr-defined]
        super().format_options(ctx, formatter)


app = typer.Typer(pretty_exceptions_enable=False, rich_markup_mode=None)


def command(example: str, name: str | None = None) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Registers a command with an example of it."""
    return app.command(name, cls=Command, epilog=f"Example: guiderail {example}")


def _complete(name: str | None) -> Callable[[str], list[str]] | None:
    if name is None:
        return None
    return lambda incomplete: [choice for choice in CHOICES[name]() if choice.startswith(incomplete)]


def _opt(words: str, *names: str, of: str | None = None, **more: Any) -> Any:
    """An option with its help; `of` is what a shell completes it with."""
    return typer.Option(*names, help=words, autocompletion=_complete(of), **more)


def _arg(words: str, metavar: str, of: str | None = None) -> Any:
    """An argument with its help."""
    return typer.Argument(help=words, metavar=metavar, autocompletion=_complete(of))


Json = Annotated[bool, _opt("Print one JSON object, for a program to read.", "--json")]
LcmUrl = Annotated[str, _opt("Of a robot: the URL of LCM.  [default: LCM's own]")]
WhichRobot = Annotated[str, _opt("Of a robot: which arm.", of="robots")]
Rehearse = Annotated[bool, _opt("A simulated robot stands in, in a process of its own.", "--sim")]
Lockstep = Annotated[
    bool, _opt("Of a rehearsal: each side waits for the other, whatever the wall's clock says.", "--synchronous")
]
Rate = Annotated[float, _opt("Of a rehearsal: the simulated robot's clock to the wall's.")]
Scenario = Annotated[
    Path | None, _opt("A file that says robot, bus and surroundings, and whether the robot is simulated.")
]
Yes = Annotated[bool, _opt("What is read out before the arm moves is so.", "--yes")]
Run = Annotated[Path, _arg("The folder of a run that guiderail train made.", "RUN")]
EpisodeSpec = Annotated[str, _arg("The folder of a run; or a task, for --policy: {tasks}.", "RUN or TASK")]
Seed = Annotated[int, _opt("The seed of the held-out initial conditions.")]
ENV_HELP = (
    "An option of the environment, such as station=arm or explored=[0,1,2]; give it as often as you like. "
    "guiderail list TASK names them all."
)
Env = Annotated[list[str] | None, _opt(ENV_HELP, "--env", metavar="key=value")]
IMPORT_HELP = "A module or a file (.py) that registers a task, guidance, a station or a learner; the run remembers it."
Imports = Annotated[list[str] | None, _opt(IMPORT_HELP, "--import", metavar="MODULE")]
OwnTask = Annotated[
    list[str] | None, _opt("A module or a file (.py) that registers the task.", "--import", metavar="MODULE")
]
PolicyName = Annotated[str, _opt("Who acts in a task: rule, or zero, white or constant actions.", "--policy")]
Guidance = Annotated[str | None, _opt("What guides: {guidance}.  [default: the task's]", of="guidance")]


def _version(asked: bool) -> None:
    if asked:
        import guiderail

        typer.echo(f"guiderail {guiderail.__version__}")
        raise typer.Exit


@app.callback()
def _guiderail(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and end.")
    ] = False,
) -> None:
    """Reinforcement learning of contact tasks that breaks nothing."""


@command("train NarrowPassage --guidance skgrl --episodes 60 --out runs/passage")
def train(
    task: Annotated[str | None, _arg("What is learned: {tasks}.", "TASK", "tasks")] = None,
    out: Annotated[Path | None, _opt("The run's folder; it must not exist, unless with --resume.")] = None,
    guidance: Guidance = None,
    algorithm: Annotated[str | None, _opt("The learner: {algorithms}.  [default: the task's]", of="algorithms")] = None,
    episodes: Annotated[int | None, _opt("How many in all.  [default: 60]")] = None,
    seed: Annotated[int | None, _opt("The seed of everything random.  [default: 0]")] = None,
    preset: Annotated[
        str | None, _opt("The learner's settings: {presets}.  [default: the task's]", of="presets")
    ] = None,
    setting: Annotated[
        list[str] | None, _opt("One setting of the learner, such as batch_size=128.", "--set", metavar="name=value")
    ] = None,
    env: Env = None,
    action_repeat: Annotated[int | None, _opt("How many control steps an action lasts.")] = None,
    reward: Annotated[str | None, _opt("sparse or shaped; Pouring: hand_shaped too, GridClamp: no_force.")] = None,
    observation: Annotated[str | None, _opt("state or image.")] = None,
    fixture_offset: Annotated[str | None, _opt("calibration, disc or known, where parts are offset.")] = None,
    station: Annotated[str | None, _opt("rails or arm, where a task has both; mujoco; hardware for a robot.")] = None,
    ledger: Annotated[
        bool | None, _opt("Write every control step into the run's ledger/.  [default: yes]", "--ledger/--no-ledger")
    ] = None,
    with_person: Annotated[
        bool, _opt("Somebody watches in the browser, pushes, stops, and says what was a success.", "--with-person")
    ] = False,
    lcm_url: Annotated[str | None, _opt("Of a robot: the URL of LCM.  [default: LCM's own]")] = None,
    robot: Annotated[str | None, _opt("Which arm.  [default: the station's]", of="robots")] = None,
    sim: Rehearse = False,
    synchronous: Lockstep = False,
    rate: Annotated[float | None, _opt("Of a rehearsal: the robot's clock to the wall's.  [default: 0.2]")] = None,
    scenario: Scenario = None,
    yes: Yes = False,
    resume: Annotated[bool, _opt("Go on with the run in --out.", "--resume")] = False,
    imports: Imports = None,
    as_json: Json = False,
) -> None:
    """Train a policy and leave a run folder.

    The folder holds the configuration, a table with a row for every episode, a ledger with one for every control step,
    a checkpoint, the policy, a learning curve and a replay. A run that was stopped goes on with --resume to the result
    it would have had.
    """
    task, folders = (None, ()) if task is None else _named(task)
    modules = (*folders, *(imports or ()))
    if imports:
        from guiderail.tools.environments import import_modules

        modules = import_modules(modules)  # first, as the station may be in one of them
    words = {"guidance": guidance, "action_repeat": action_repeat, "reward": reward, "observation": observation}
    words |= {"fixture_offset": fixture_offset, "station": station, "robot": robot, "lcm_url": lcm_url}
    environment = {k: v for k, v in words.items() if v is not None} | _environment(env)
    if (folders or "demonstrations" in environment) and task is not None and not resume:
        from guiderail.tools.datasets.validate import leaves_demonstrations

        if (sentence := leaves_demonstrations(task, environment)) is not None:
            _say(sentence)
    if _is_robot(environment.get("station")):
        there = {name: environment[name] for name in ("lcm_url", "robot") if name in environment}
        there |= {"rehearse": sim, "lockstep": synchronous} | ({} if rate is None else {"rate": rate})
        given: dict[str, Any] = {"algorithm": algorithm, "preset": preset, "episodes": episodes, "seed": seed}
        given |= {"ledger": ledger, "imports": modules}
        if task is None or out is None or resume or with_person:
            raise InputError(
                "on a robot a run begins anew and nobody pushes through a page: name a task and a folder, without "
                "--resume and --with-person"
            )
        from guiderail.tools.hardware.connection import RobotConnection
        from guiderail.tools.hardware.train import train_on_robot

        found = train_on_robot(
            task,
            out,
            RobotConnection.in_scenario(scenario, **there),
            environment=environment,
            given={name: value for name, value in given.items() if value is not None},
            settings=_pairs(setting, "--set", "batch_size=128"),
            yes=yes,
            say=_say,
        )
        _print(found, as_json)
        return
    if sim or synchronous or yes or rate is not None or scenario is not None:
        raise InputError(
            "--rehearse, --lockstep, --rate, --scenario and --yes are for a robot: give --station hardware too"
        )
    from guiderail.tools.learning import train as configure

    summary = configure.run(
        task,
        out,
        environment=environment,
        algorithm=algorithm,
        preset=preset,
        settings=_pairs(setting, "--set", "batch_size=128"),
        episodes=episodes,
        seed=seed,
        resume=resume,
        imports=modules,
        ledger=ledger,
        person=_person if with_person else None,
        demonstrator=_rule,
    )
    _print(summary, as_json)


@command("evaluate runs/passage --episodes 100 --json")
def evaluate(
    run: Run,
    episodes: Annotated[int, _opt("How many, each with held-out initial conditions.")] = 100,
    seed: Seed = 1_000_000,
    env: Env = None,
    baselines: Annotated[
        str | None,
        _opt(
            "Who else meets the same episodes, comma-separated: rule, {nulls}; or none. The demonstration alone always "
            "does, where there is one, and no action, zero, is the same.  "
            "[default: white, constant and rule; zero too where nothing is demonstrated]"
        ),
    ] = None,
    resample_offsets: Annotated[
        bool, _opt("Draw anew in every episode what is hidden in the run.", "--resample-offsets")
    ] = False,
    as_json: Json = False,
) -> None:
    """Evaluate a run's policy on what training never met, beside policies that learned nothing.

    It acts deterministically. The demonstration alone, random actions and a rule written by hand meet the same
    episodes: what they come to is what a success is worth. Their episodes are kept, and not run again. To be a policy
    for the offset that a run hides, or with --resample-offsets for any, are two claims: the row "evaluation_scope" of the table says which.
    """
    from guiderail.tools.evaluation.evaluate import evaluate as evaluate_run

    environment = _environment(env)
    others = _beside(run, environment, baselines)
    found = evaluate_run(
        run, episodes=episodes, seed=seed, environment=environment, baselines=others, resample_offsets=resample_offsets
    )
    for name in others:
        if name not in found["baselines"]:
            _say(f"{name} is left out: it was written for other inputs, or to see other things, than there are here")
    # The numbers last: they are what a person looks for.
    _print_differences([] if as_json else found.pop("differs_from_thesis"))
    _print(found, as_json)


@command("robustness runs/connector --env station=mujoco --episodes 50")
def robustness(
    runs: Annotated[list[Path], _arg("Folders of runs of one task, which are compared.", "RUN...")],
    episodes: Annotated[int, _opt("How many held-out episodes, for each who at each place.")] = 30,
    seed: Seed = 1_000_000,
    axes: Annotated[str | None, _opt("What is changed, comma-separated: {axes}.  [default: all]")] = None,
    env: Env = None,
    baselines: Annotated[
        str | None,
        _opt("Who else meets the same episodes, comma-separated: rule, {nulls}; or none.  [default: white, rule]"),
    ] = None,
    out: Annotated[
        Path | None, _opt("The folder to write, which several runs need.  [default: robustness/STATION in the run]")
    ] = None,
    as_json: Json = False,
) -> None:
    """Judge runs' policies where friction, stiffness, sensors, commands or the clock are other than they learned with.

    One thing is changed at a time; one table and one picture hold all runs. What is done is kept: started again, it
    goes on where it was interrupted, and a further run costs only its own episodes.
    """
    from guiderail.tools.evaluation.robustness import breaks
    from guiderail.tools.evaluation.robustness import robustness as judge

    environment = _environment(env)
    others = _beside(runs[0], environment, baselines)
    if baselines is None:
        others = {name: acts for name, acts in others.items() if name != "constant"}
    found = judge(
        runs, episodes=episodes, seed=seed, environment=environment, axes=axes, baselines=others, out=out, tell=_say
    )
    if as_json:
        typer.echo(json.dumps({"table": str(found["table"]), "picture": str(found["picture"]), "rows": found["rows"]}))
        return
    for line in found["table"].with_suffix(".md").read_text(encoding="utf-8").splitlines():
        typer.echo(line)
    for who in found["policies"]:
        for name, values in breaks(found["rows"], who).items():
            typer.echo(f"{who}, {name}: below 90 % at {', '.join(f'{value:.3g}' for value in values) or 'no place'}")
    typer.echo(found["table"])
    typer.echo(found["picture"])


@command("certify runs/passage --attack 1000000")
def certify(
    of: Annotated[str, _arg("The folder of a run; or a task, with --out: {tasks}.", "RUN or TASK")],
    env: Env = None,
    out: Annotated[Path | None, _opt("The folder to write.  [default: certificate in the run]")] = None,
    start_within: Annotated[
        float | None,
        _opt("How far beside its start the robot may begin, in the outputs' units.  [default: as a reset draws it]"),
    ] = None,
    attack: Annotated[int, _opt("How many steps an adversary tries to leave the bounds.")] = 0,
    imports: OwnTask = None,
    as_json: Json = False,
) -> None:
    """Bound what a skill can command for all actions, and have the bounds checked by a program that knows no guiderail.

    The certificate lists what it assumes. Check it anywhere: python checker.py FOLDER, with NumPy alone. An attack
    says how tight it is: the bounds beside the worst that an adversary found, straight through the primitive.
    """
    from guiderail.tools.certify import certify_skill

    found = certify_skill(_named(of, imports)[0], _environment(env), out=out, start_within=start_within, attack=attack)
    rows = found.get("attack", [])
    if as_json:
        typer.echo(json.dumps(found))
    else:
        for name, value in found.items():
            if name == "attack":
                continue
            words = ", ".join("–" if x is None else f"{x:.4g}" for x in value) if isinstance(value, list) else value
            typer.echo(f"{name.replace('_', ' ')}: {words}")
        if rows:
            table = Path(found["certificate"]).with_name("attack.md")
            typer.echo(table.read_text(encoding="utf-8"))
    if found["checker"] != "yes" or any(row["left"] for row in rows):
        raise typer.Exit(1)


@command("replay runs/passage --html replay.html")
def replay(
    shown: EpisodeSpec,
    html: Annotated[Path | None, _opt("The page to write, .html.  [default: replay.html in the run]")] = None,
    seed: Seed = 1_000_000,
    env: Env = None,
    station: Annotated[str | None, _opt("Where the policy acts: rails or arm.")] = None,
    picture: Annotated[Path | None, _opt("Also write what a camera sees of the episode: a file {pictures}.")] = None,
    policy: PolicyName = "scripted",
    episodes: Annotated[int | None, _opt("How many held-out episodes there are to pick from.  [default: 4]")] = None,
    imports: OwnTask = None,
) -> None:
    """Show held-out episodes as a page that any browser opens: before learning beside after, on one clock.

    It holds robots in motion, demonstrations, paths and the constraint, with plots of force, violation, action and
    phase, and needs nothing else. Before is the demonstration alone where guidance has one, else random actions.
    """
    from guiderail.tools.files import check_picture
    from guiderail.tools.visualization.film import write_film
    from guiderail.tools.visualization.replay import default_page, write_page

    environment = _environment(env) | ({} if station is None else {"station": station})
    episode = _episode(shown, policy, environment, seed, imports)
    page = default_page(Path(shown), environment) if html is None else html
    if picture is not None:
        check_picture(picture)
    write_page(page, episode, episodes=episodes)
    if picture is not None:
        write_film(picture, episode)
    typer.echo(page)


@command("film runs/passage --out episode.jpg")
def film(
    shown: EpisodeSpec,
    out: Annotated[Path, _opt("The picture to write: a file {pictures}.")],
    seed: Seed = 1_000_000,
    env: Env = None,
    policy: PolicyName = "scripted",
    imports: OwnTask = None,
) -> None:
    """Draw six moments of an episode, as a camera sees them."""
    from guiderail.tools.visualization.episode_spec import outcome
    from guiderail.tools.visualization.film import write_film

    episode = _episode(shown, policy, _environment(env), seed, imports)
    typer.echo(f"{out}: {outcome(write_film(out, episode))}")


@command("plot runs/passage")
def plot(run: Run) -> None:
    """Draw a run's learning curve into its folder."""
    from guiderail.tools.visualization.curves import plot_run

    typer.echo(plot_run(run))


@command("record runs/passage --out demonstrations.npz --episodes 5")
def record(
    run: Run,
    out: Annotated[Path, _opt("The demonstrations' file, .npz or .csv.")],
    episodes: Annotated[int, _opt("How many demonstrations.")] = 5,
    signal: Annotated[str, _opt("commanded or measured poses.")] = "commanded",
    seed: Seed = 1_000_000,
) -> None:
    """Record what a policy does as demonstrations for a primitive."""
    from guiderail.tools.datasets.record import record as record_run

    typer.echo(record_run(run, out, episodes=episodes, signal=signal, seed=seed))


@command("check demonstrations.csv --draw demonstrations.png")
def check(
    file: Annotated[
        Path,
        _arg(
            "Demonstrations (.npz, .csv or a folder of them), or a template (.yaml, or the name of a shipped one).",
            "FILE",
        ),
    ],
    draw: Annotated[
        Path | None,
        _opt("Draw the demonstrations, or a template's states (.png, .svg, .pdf; a template also .dot)."),
    ] = None,
    fit: Annotated[
        bool, _opt("Choose components, kernel and λ by what reproduces them, and say why.", "--fit")
    ] = False,
    as_json: Json = False,
) -> None:
    """Check demonstrations or a template before they are used."""
    from guiderail.tools.datasets.validate import check as check_file

    _print(check_file(file, draw, fit=fit), as_json)


@command("constraints demonstrations.npz --phases 4 --draw bounds.png --into ./peg")
def constraints(
    file: Annotated[Path, _arg("Demonstrations (.npz, .csv or a folder of them).", "FILE")],
    phases: Annotated[int, _opt("Parts of the motion, each with bounds of its own.")] = 1,
    margin: Annotated[float, _opt("Beyond what was shown, as a part of its range.")] = 0.1,
    least: Annotated[float, _opt("Beyond what was shown at least, in the outputs' unit.")] = 0.0,
    outputs: Annotated[str | None, _opt("Numbers of those that are bounded, such as 0,1.  [default: all]")] = None,
    draw: Annotated[Path | None, _opt("Draw the demonstrations and their bounds (.png, .svg, .pdf).")] = None,
    out: Annotated[Path | None, _opt("Write them as YAML, to be read and edited.")] = None,
    into: Annotated[Path | None, _opt("A task's folder whose bounds become these.")] = None,
    as_json: Json = False,
) -> None:
    """Find bounds of every command from what was demonstrated, phase by phase."""
    from guiderail.tools.datasets.bounds import constraints as find

    try:
        chosen = None if outputs is None else [int(number) for number in outputs.split(",")]
    except ValueError:
        raise InputError(f"--outputs takes whole numbers separated by commas, not {outputs!r}") from None
    how: dict[str, Any] = {"phases": phases, "margin": margin, "least": least, "outputs": chosen}
    _print(find(file, **how, draw=draw, out=out, into=into), as_json)


TARGET_HELP = "x,y,z,rx,ry,rz: the task's target in the recording's frame, in metres and degrees."


@command("import bag --out demonstrations.npz --target 0.5,0,0.2,0,0,0", "import")
def import_(
    source: Annotated[
        Path, _arg("A LeRobot v3 dataset, a ROS 2 bag, .mcap or .csv file, or a folder of them.", "SOURCE")
    ],
    out: Annotated[Path, _opt("The demonstrations' file, .npz or .csv.")],
    signal: Annotated[str | None, _opt("Which topic or feature.  [default: the one that can be meant]")] = None,
    target: Annotated[str | None, _opt(TARGET_HELP)] = None,
    rate: Annotated[float | None, _opt("Resample to so many samples a second.")] = None,
    unit: Annotated[str | None, _opt("Of positions in a CSV file that does not say it: m, cm or mm.")] = None,
    time_unit: Annotated[str | None, _opt("Of its time: s, ms, us or ns.")] = None,
    quaternion: Annotated[str | None, _opt("The order of its numbered quaternion: xyzw or wxyz.")] = None,
    angles: Annotated[str | None, _opt("Of its roll, pitch and yaw: deg or rad.")] = None,
    as_json: Json = False,
) -> None:
    """Bring demonstrations from another format.

    It says what it took for granted, and asks for what a file doesn't say and only whoever recorded it knows.
    """
    from guiderail.tools.datasets.convert import import_recording

    where = None if target is None else _floats(target, 6, "--target")
    of_csv = {"unit": unit, "time_unit": time_unit, "quaternion": quaternion, "angles": angles}
    _print(import_recording(source, out, signal=signal, target=where, rate=rate, **of_csv), as_json)


@command("export demonstrations.npz --to lerobot --out dataset")
def export(
    file: Annotated[Path, _arg("Demonstrations (.npz, .csv or a folder of them).", "FILE")],
    out: Annotated[Path, _opt("The folder to write; it must not exist.")],
    to: Annotated[str, _opt("lerobot or mcap.")],
    rate: Annotated[float | None, _opt("Resample to so many samples a second.")] = None,
    as_json: Json = False,
) -> None:
    """Take demonstrations to another format: a LeRobot v3 dataset, or ROS 2 bags in MCAP."""
    from guiderail.tools.datasets.convert import export_demonstrations

    _print(export_demonstrations(file, out, to, rate), as_json)


@command("study study.yaml --out studies --methods skgrl,kgrl --seeds 30,31")
def study(
    file: Annotated[Path, _arg("The study's YAML file.", "FILE")],
    out: Annotated[Path, _opt("The folder of the study; what is finished in it is used again.")],
    methods: Annotated[str | None, _opt("Some of its methods, separated by commas.")] = None,
    seeds: Annotated[
        str | None, _opt("Other seeds, separated by commas; a method with seeds of its own keeps them.")
    ] = None,
    engine: Annotated[str | None, _opt("What runs them: {engines}.  [default: process]", of="engines")] = None,
    address: Annotated[str | None, _opt("Of a Ray cluster.  [default: RAY_ADDRESS, or a Ray of this machine]")] = None,
    processes: Annotated[int | None, _opt("How many runs go side by side.  [default: 2, or a cluster's cores]")] = None,
    as_json: Json = False,
) -> None:
    """Train and judge methods over seeds, as a YAML file says.

    It leaves a table with a row for each method, seed, mark and what was judged on; that of some methods or other seeds
    is named by them. A study that was stopped goes on where it was with the same command. A run that fails stops none
    of the others; it is named at the end, and the command ends with 1.
    """
    from guiderail.tools.experiments import declaration

    declared = declaration.load_study(file)
    try:
        numbers = None if seeds is None else [int(number) for number in seeds.split(",")]
    except ValueError:
        raise InputError(f"--seeds takes whole numbers separated by commas, such as 0,1,2, not {seeds!r}") from None
    chosen = declared.only(None if methods is None else methods.split(","), numbers)
    from guiderail.tools.experiments.engines.engine import make_engine

    running = make_engine(engine or "process", processes, address)
    from guiderail.tools.experiments.study import study_command

    found = study_command(chosen, out, running, declared.part_name(chosen))
    differs = {} if as_json else found.pop("differs_from_thesis", {})
    _print(found, as_json)
    for methods, words in differs.items():
        _print_differences(words, f" ({methods})")
    if "failed" in found:
        raise RunsFailedError(found["failed"], None)


@command("report studies --out report.html")
def report(
    runs: Annotated[list[Path], _arg("Folders of runs, or of a study.", "RUN...")],
    out: Annotated[Path, _opt("The page to write, .html.")] = Path("report.html"),
    episodes: Annotated[
        int, _opt("Held-out episodes to judge each run on that no study judged; what was judged is used again.")
    ] = 0,
    as_json: Json = False,
) -> None:
    """Write what runs or a study came to as one page.

    It needs nothing else: learning curves with bootstrap bands, episodes to convergence, held-out success beside
    policies that learned nothing, safety from the ledger, in what it differs from the thesis, configuration, versions,
    and the commands that repeat it.
    """
    from guiderail.tools.visualization.report import write_report

    page = write_report(runs, out, episodes=episodes)
    typer.echo(json.dumps({"page": str(page)}) if as_json else page)


@command("onboard plug.stl socket.stl --unit mm --out ./peg")
def onboard(
    plug: Annotated[Path, _arg("The part in the tool: .stl, .obj, .glb, .step.", "PLUG")],
    socket: Annotated[Path, _arg("The part in the world.", "SOCKET")],
    out: Annotated[Path, _opt("The task's folder; it must not exist.")],
    unit: Annotated[str | None, _opt("Of the files' numbers: mm, cm, m or inch.")] = None,
    place: Annotated[
        str, _opt("x,y,z,rx,ry,rz in the files' unit and degrees: moves the plug's file to the target.")
    ] = "0,0,0,0,0,0",
    axis: Annotated[str, _opt("Which way the plug comes out: +x, -x, +y, -y, +z or -z.")] = "+z",
    centre: Annotated[str | None, _opt("x,y,z of a point on the axis.  [default: the plug's centre of mass]")] = None,
    turn: Annotated[float, _opt("By how many degrees the plug turns at the bottom; it is drawn turned.")] = 0.0,
    force_limit: Annotated[float, _opt("More than that ends an episode [N].")] = COLLISION_FORCE,
    friction: Annotated[float, _opt("Of all surfaces.")] = 0.2,
    scenario: Annotated[list[Path] | None, _opt("Drake model directives of what else stands there.")] = None,
    as_json: Json = False,
) -> None:
    """Make a task of two mesh files.

    The parts are drawn assembled, or --place says where the plug goes. It checks them, finds contact geometry that is
    fast and stiff enough, inserts the plug by a script, aligned and beside, records demonstrations, and leaves a folder
    that is a task: guiderail train ./peg. Every number is in its task.yaml; preview.html shows it.
    """
    from guiderail.tools.parts.create_task import ask_unit
    from guiderail.tools.parts.create_task import onboard as make

    found = make(
        plug,
        socket,
        out,
        unit=ask_unit((plug, socket), unit),
        place=_floats(place, 6, "--place"),
        axis=axis,
        centre=None if centre is None else _floats(centre, 3, "--centre"),
        turn=turn,
        force_limit=force_limit,
        friction=friction,
        scenario=scenario or (),
        say=(lambda words: None) if as_json else _tell,
    )
    _print(found, as_json)


@command("drive Pouring")
def drive(
    task: Annotated[str, _arg("The task: {tasks}.", "TASK", "tasks")],
    guidance: Guidance = None,
    env: Env = None,
    imports: OwnTask = None,
) -> None:
    """Act in the policy's place, with a gamepad or the keyboard."""
    from guiderail.tools.teleop.teleoperator import drive_by_hand

    drive_by_hand(_named(task, imports)[0], ({} if guidance is None else {"guidance": guidance}) | _environment(env))


@command("teach ./peg --out demonstrations.npz")
def teach(
    task: Annotated[str, _arg("A task's folder, or one of {tasks}.", "TASK", "tasks")],
    out: Annotated[Path, _opt("The demonstrations' file, .npz or .csv.")],
    env: Env = None,
    imports: OwnTask = None,
    as_json: Json = False,
) -> None:
    """Demonstrate a task in the browser, with sliders, keys or a gamepad.

    You move where the tool shall be, the robot follows by its impedance, an arrow and a bar show the force. Each
    demonstration is kept or discarded, and written as soon as it is kept. At the end it says what was learned.
    """
    from guiderail.tools.teleop.teach import teach as record_taught

    _print(record_taught(_named(task, imports)[0], _environment(env), out, _tell), as_json)


@command("run runs/connector --rehearse --yes")
def run(
    run: Run,
    station: Annotated[str, _opt("Where: a station that is a robot.", of="stations")] = "hardware",
    lcm_url: LcmUrl = "",
    robot: Annotated[
        str | None, _opt("Of a robot: which arm.  [default: the scenario's, or else iiwa14]", of="robots")
    ] = None,
    sim: Rehearse = False,
    synchronous: Lockstep = False,
    rate: Rate = 0.2,
    scenario: Scenario = None,
    yes: Yes = False,
    out: Annotated[Path | None, _opt("The folder of what is recorded.  [default: hardware in the run]")] = None,
    episodes: Annotated[
        int | None, _opt("So many episodes as in training, one after the other, instead: how often does it succeed?")
    ] = None,
    policy: Annotated[
        str | None, _opt("Of episodes: who acts instead of the run's policy, such as rule, zero or constant.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Run a policy on a robot.

    What is assumed of the robot is read out and has to be confirmed. Then the arm takes over where it is, approaches
    the start at a crawl and executes the skill; every control step is recorded. It ends with 0 if the skill was
    executed to its end, and with 1 if a limit, a fault of the status or a key stopped it.
    """
    from guiderail.tools.hardware.connection import RobotConnection
    from guiderail.tools.hardware.executor import run_policy

    there: dict[str, Any] = {"lcm_url": lcm_url, "rehearse": sim, "lockstep": synchronous, "rate": rate}
    there |= {} if robot is None else {"robot": robot}
    other = RobotConnection.in_scenario(scenario, **there)
    if episodes is not None:
        from guiderail.tools.evaluation.scripted import make_baseline
        from guiderail.tools.hardware.evaluate import evaluate_on_robot
        from guiderail.tools.learning.run_folder import RunFolder

        config = RunFolder(run).config()
        acting = None if policy is None else make_baseline(config.task, policy, config.seed)
        found = evaluate_on_robot(
            run, other, episodes, station=station, policy=policy or "", acting=acting, yes=yes, out=out, say=_say
        )
        _print(found, as_json)
        return
    if policy is not None:
        raise InputError("another policy than the run's acts in episodes alone: give --episodes too")
    raise typer.Exit(run_policy(run, other, station=station, yes=yes, out=out, say=_tell))


@command("serve-iiwa --seconds 60", "serve-iiwa")
def serve_iiwa(
    url: Annotated[str, _opt("The URL of LCM.  [default: LCM's own]")] = "",
    seconds: Annotated[float, _opt("How long, in simulated time.")] = 3600.0,
    command_timeout: Annotated[float, _opt("How many seconds to wait for a command.")] = 5.0,
    task: Annotated[str, _opt("What stands in front of it: {tasks}.", of="tasks")] = "BncConnector",
    rate: Annotated[
        float | None, _opt("Go by the wall's clock, or so much slower, and wait for nobody; 1 is real time.")
    ] = None,
    offset: Annotated[
        str | None, _opt("x,y of the fixture from where it is thought to be [m], such as 0.001,-0.0005.")
    ] = None,
    scenario: Annotated[Path | None, _opt("A file that says what stands around it.")] = None,
    imports: Imports = None,
) -> None:
    """Simulate an iiwa at the other end of LCM, with a deputy who stands by.

    It stands in front of a task's fixture; the command ends with 1 if commands stopped coming.
    """
    from guiderail.tools.hardware.sim_driver import serve_iiwa as serve

    task = _named(task, imports)[0]
    is_done = serve(
        url, seconds, command_timeout, task, rate=rate, offset=_numbers(offset), scenario=scenario, say=_tell
    )
    raise typer.Exit(0 if is_done else 1)


@command("stand-by --task BncConnector", "stand-by")
def stand_by(
    url: Annotated[str, _opt("The URL of LCM.  [default: LCM's own]")] = "",
    robot: WhichRobot = "iiwa14",
    task: Annotated[str, _opt("What the arm carries is this task's: {tasks}.", of="tasks")] = "BncConnector",
    imports: Imports = None,
) -> None:
    """Stop a robot where commands stop.

    For a driver that repeats the last torque for ever when the program that sent it is gone. It runs beside the driver,
    on the same machine, until it is ended; where it is missing, guiderail run moves nothing.
    """
    from guiderail.tools.hardware.safety_monitor import stand_by as wait

    wait(url, robot, _named(task, imports)[0], say=_tell)


COLUMN = 19  # characters of a number that others stand beside


LISTED: dict[str, Callable[[], Any]] = {
    **{name: CHOICES[name] for name in ("tasks", "guidance", "stations", "robots", "presets")},
    "learners": CHOICES["algorithms"],
}


@command("list BncConnector", "list")
def list_(
    what: Annotated[str | None, _arg("One of {listed}, metrics; everything unless given.", "WHAT", "listed")] = None,
    imports: Imports = None,
    as_json: Json = False,
) -> None:
    """List what there is to choose from.

    With a task it lists the options of its environment and of a reset, and with metrics what each number of a table
    means. As JSON, without a word, it is everything: tasks, guidance, stations, robots and learners with their ports,
    options and ranges.
    """
    from guiderail.tools.environments import import_modules

    import_modules(imports or ())
    what = None if what is None else _named(what)[0]
    if what is None:
        names = {name: names() for name, names in LISTED.items()}
        _print(names | _listing().everything() if as_json else names, as_json)
    elif what == "metrics":
        from guiderail.tools.evaluation.metrics import COLUMNS, STATISTICS

        numbers = (*(("episode: ", m) for m in COLUMNS), *(("episodes: ", m) for m in STATISTICS.values()))
        _print({of + m.name: m.words + (f" [{m.unit}]" if m.unit else "") for of, m in numbers}, as_json, "_")
    elif what in LISTED:
        _print({what: LISTED[what]()}, as_json)
    elif what in CHOICES["tasks"]():
        listing = _listing()
        declared = as_json and what in listing.TASKS.names()
        _print(listing.task(what) if declared else listing.options_in_words(what), as_json, "_")
    else:
        from guiderail.tools.environments import IMPORTED

        known = did_you_mean(what, [*CHOICES["listed"](), "metrics"], IMPORTED)
        raise InputError(f"there is no list of {what!r}: {known}")


def _listing() -> Any:
    from guiderail.tools.cli import catalog as listing  # it imports everything that it lists

    return listing


@command("demo --out demo")
def demo(
    out: Annotated[Path, _opt("Where the run goes; an earlier demo there is replaced.")] = Path("demo"),
    episodes: Annotated[int, _opt("How many to learn from.")] = 32,
    seed: Annotated[int, _opt("The seed of everything random.")] = 0,
) -> None:
    """Watch sKGRL learn to avoid an obstacle in a minute or two."""
    from guiderail.tools.cli.demo import run_demo

    run_demo(out, episodes=episodes, seed=seed)


def main(arguments: list[str] | None = None) -> None:
    """Runs the command and ends the process: 0 for success, 2 for what a person gave wrong, in one sentence."""
    # Matrices here are small: threads that wait for each other cost more than they give, and runs go side by side.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        code = app(args=arguments, prog_name="guiderail", standalone_mode=False)
    except InputError as error:
        code = _refuse(str(error))
    except RunsFailedError as error:
        for sentence in error.sentences:
            _say(sentence)
        code = 1
    except (KeyboardInterrupt, typer.Abort):
        _say(f"stopped{_how_to_go_on(arguments)}")
        code = 130
    except BrokenPipeError:
        code = 1
    except Exception as error:
        if not hasattr(error, "format_message"):
            raise
        code = _refuse(_usage_sentence(error))
    sys.exit(code if isinstance(code, int) else 0)


def _how_to_go_on(arguments: list[str]) -> str:
    """Of a command that was stopped; a run without a checkpoint, as on a robot, does not go on."""
    what, *words = map(str, [*arguments, ""])
    if what == "study":
        return "; the same command goes on where it was"
    values = [word.partition("=")[2] or following for word, following in pairwise(words) if word.startswith("--out")]
    if what == "train" and values and (Path(values[-1]) / "checkpoint").is_dir():
        return "; go on with --resume"
    return ""


def _usage_sentence(error: Any) -> str:
    """What typer found wrong with the command line, as one sentence that says what to do."""
    message = " ".join(str(error.format_message()).split()).rstrip(".")
    message = message[:1].lower() + message[1:]
    context = getattr(error, "ctx", None)
    path = context.command_path if context is not None else "guiderail"
    if hasattr(error, "possibilities"):
        known = [name for parameter in context.command.params for name in parameter.opts] if context else []
        return f"there is no option {error.option_name}: {did_you_mean(error.option_name, known)}"
    if "command" in message and context is not None and hasattr(context.command, "list_commands"):
        names = context.command.list_commands(context)
        typed = message.partition("'")[2].partition("'")[0]
        if typed:
            return f"there is no command {typed}: {did_you_mean(typed, names)}"
        return f"what should be done? choose one of {', '.join(names)}"
    return f"{message}: see {path} --help"


def _refuse(sentence: str) -> int:
    _say(sentence)
    return 2


def _tell(words: str) -> None:
    print(words, flush=True)


def _say(sentence: str) -> None:
    print(f"guiderail: {sentence}", file=sys.stderr, flush=True)


def _pairs(given: list[str] | None, option: str, example: str) -> dict[str, str]:
    """`key=value` pairs as a dictionary."""
    for pair in given or []:
        if "=" not in pair:
            raise InputError(f"{option} takes name=value, such as {example}, not {pair!r}")
    return {key.strip(): value.strip() for key, _, value in (pair.partition("=") for pair in given or [])}


def _floats(text: str, count: int, option: str) -> list[float]:
    """Numbers separated by commas."""
    try:
        numbers = [float(number) for number in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise InputError(f"{option} takes {count} numbers separated by commas, not {text!r}")
    return numbers


def _numbers(given: str | None) -> tuple[float, ...] | None:
    """Numbers that are separated by commas."""
    try:
        return None if given is None else tuple(float(value) for value in given.split(","))
    except ValueError:
        raise InputError(f"numbers are separated by commas, such as 0.001,-0.0005, not {given!r}") from None


def _environment(given: list[str] | None) -> dict[str, Any]:
    """Options of an environment, each value as YAML would read it."""
    if not given:
        return {}
    from guiderail.tools.environments import as_value

    return {key: as_value(value) for key, value in _pairs(given, "--env", "station=arm").items()}


def _named(task: str, imports: Sequence[str] | None = None) -> tuple[str, tuple[str, ...]]:
    """A task's name where the path of its folder was typed, and what a run has to import for it.

    What registers the task is imported first.
    """
    if imports:
        from guiderail.tools.environments import import_modules

        import_modules(imports)
    if not (Path(task) / "task.yaml").is_file():
        return task, ()
    from guiderail.tools.environments import task_named

    return task_named(task)


def _is_robot(station: Any) -> bool:
    """Whether that is a station, and no simulated one."""
    if station is None:
        return False
    stations = import_module("guiderail.diagrams.stations.registry").STATIONS
    return station in stations.names() and not stations.get(station).is_simulated


def _beside(run: Path, environment: Mapping[str, Any], names: str | None) -> dict[str, Any]:
    """Null policies and rules by name, for an evaluation; unless named those that the run's task has."""
    from guiderail.tools.environments import changed_environment
    from guiderail.tools.evaluation.scripted import SCRIPTED_POLICIES, make_baseline
    from guiderail.tools.learning.run_folder import RunFolder
    from guiderail.tools.visualization.style import is_demonstrated

    config = RunFolder(run).config()
    where = changed_environment(config.task, config.environment, environment)
    if names is None:
        zero = [] if is_demonstrated(where.get("guidance")) else ["zero"]
        rule = ["scripted"] if config.task in SCRIPTED_POLICIES and where.get("observation") != "image" else []
        chosen = [*zero, "uniform_random", "constant", *rule]
    else:
        chosen = [] if names == "none" else [name.strip() for name in names.split(",")]
    return {name: make_baseline(config.task, name, config.seed) for name in chosen}


def _person() -> Any:
    """Whoever opens the page; nothing goes on before."""
    from guiderail.tools.teleop.supervisor import MeshcatSupervisor

    person = MeshcatSupervisor(_tell)
    person.wait()
    return person


def _rule(task: str) -> Any:
    """The rule written by hand for a task, which demonstrates it to a learner."""
    from guiderail.tools.evaluation.scripted import make_baseline

    return make_baseline(task, "scripted")


def _episode(shown: str, policy: str, environment: Mapping[str, Any], seed: int, imports: Sequence[str] | None) -> Any:
    """The episode that is shown: of a run, or of a task with a policy that nobody trained."""
    from guiderail.tools.visualization import episode_spec as showing

    shown = _named(shown, imports)[0]
    if Path(shown).is_dir() or shown not in CHOICES["tasks"]():
        return showing.EpisodeSpec.of_run(Path(shown), environment, seed)
    from guiderail.tools.environments import check_environment
    from guiderail.tools.evaluation.scripted import make_baseline

    arguments = check_environment(shown, environment)
    return showing.EpisodeSpec(shown, arguments, make_baseline(shown, policy), policy, policy, seed=seed)


def _print_differences(differs: Sequence[str], of: str = "") -> None:
    """In what something differs from the thesis, line by line."""
    if differs:
        typer.echo(f"differs from the thesis in{of}")
    for words in differs:
        typer.echo(f"  · {words}")


def _json(result: Mapping[str, Any]) -> str:
    """A result for a program."""

    # JSON knows no infinity: what is unbounded, such as the slack of no constraint at all, is null there.
    def known(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {key: known(one) for key, one in value.items()}
        if isinstance(value, list | tuple):
            return [known(one) for one in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return json.dumps(known(result), allow_nan=False)


def _print(result: Mapping[str, Any], as_json: bool, space: str = " ") -> None:
    """A result for a program or for a person; what others came to in the same episodes stands beside it."""
    if as_json:
        typer.echo(_json(result))
        return
    from guiderail.tools.evaluation.metrics import STATISTICS, SYMBOLS
    from guiderail.tools.tables import cell

    columns = [*result.get("baselines", ())]
    said = {key: key if " " in key else key.replace("_", space) for key in result}
    units = {key: STATISTICS[key].unit for key in {*result} & {*STATISTICS}}
    said |= {key: f"{said[key]} [{unit}]" for key, unit in units.items() if unit in SYMBOLS}
    width = max(len(words) for words in said.values())
    titles = ["policy", *("demonstration alone" if name == "demonstration" else name for name in columns)]
    if columns:
        typer.echo("  ".join([" " * width, *(f"{title:<{COLUMN}}" for title in titles)]).rstrip())
    for key, value in result.items():
        if key == "baselines" or any(key.startswith(f"{name}_") for name in (*columns, "demonstration")):
            continue
        cells = [cell(value), *(cell(result[f"{name}_{key}"]) for name in columns if f"{name}_{key}" in result)]
        typer.echo("  ".join([f"{said[key]:<{width}}", *(f"{one:<{COLUMN}}" for one in cells)]).rstrip())
