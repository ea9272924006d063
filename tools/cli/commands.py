"""Commands of the core: train, evaluate, visualize, list and demo."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import typer

from guiderail.diagrams.guidance.registry import GUIDANCE
from guiderail.diagrams.stations.registry import STATIONS
from guiderail.diagrams.tasks.registry import TASKS, check_task_name
from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import did_you_mean, load_plugin
from guiderail.tools.cli import app as cli
from guiderail.tools.cli.app import argument, option, print_message, print_progress, print_result

EPISODES = 20  # default number of episodes of an evaluation: about a minute with the baselines


@dataclass(frozen=True)
class TrainOptions:
    """Options of train alone."""

    variants: Annotated[
        Path | None,
        option("YAML file with options of the environment by a variant's name: each episode is in another variant."),
    ] = None
    num_envs: Annotated[
        int | None,
        option(
            "Number of episodes simulated at once, each in a process of its own, while the main process learns; the "
            "result depends on it.  [default: 0, simulate and learn in turn]"
        ),
    ] = None
    log: Annotated[
        list[str] | None,
        option("Write a learning log into the run's logs/: {log_formats}; repeatable.", choices="log_formats"),
    ] = None
    pictures: Annotated[
        bool | None,
        option(
            "Draw the learning curve and a page of held-out episodes at the end; guiderail visualize RUN draws the "
            "page later. Not stored: give it again with --resume.  [default: yes]",
            "--pictures/--no-pictures",
        ),
    ] = None
    evaluate: Annotated[
        int | None,
        option(
            "Number of held-out episodes that evaluate the policy at the end; guiderail evaluate RUN also evaluates "
            "baselines.  [default: none]"
        ),
    ] = None
    human_in_the_loop: Annotated[
        bool,
        option("A supervisor in the browser corrects the policy, stops and labels episodes.", "--human-in-the-loop"),
    ] = False


@cli.command("train NarrowPassage --guidance skgrl --episodes 60 --out runs/passage")
def train(
    run: cli.RunOptions,
    environment: cli.EnvironmentOptions,
    options: TrainOptions,
    tasks: Annotated[
        list[str] | None,
        argument(
            "Task to learn: {tasks}. With several, each episode is in the environment of another.", "TASK...", "tasks"
        ),
    ] = None,
) -> None:
    """Train a policy and write a run folder.

    With several tasks or variants, every episode is in another environment of this set, in a random order in which each
    occurs equally often. The environments need equal observations, actions, rewards and guidance.

    The folder contains the configuration, a table with one row per episode, a log with one row per control step,
    a checkpoint, the policy, a learning curve and a page that shows held-out episodes. An interrupted run is resumed
    with --resume and ends in the same result.
    """
    if options.evaluate is not None and options.evaluate < 1:
        raise InputError(f"--evaluate is the number of held-out episodes: give at least 1, not {options.evaluate}")
    found = [cli.find_task(task, run.imports) for task in tasks or ()]
    names, modules = [name for name, _ in found], [*(folder for _, each in found for folder in each)]
    modules += run.imports or ()
    chosen: dict[str, Any] = environment.parse()
    choices: Any = run.choices()
    if not modules and not run.resume:
        _check_early(names, run, options, chosen)
    if options.num_envs is not None:
        number = str(options.num_envs)
        cli.check_same("num_envs", choices["settings"].setdefault("num_envs", number), number)
    out = run.folder
    cli.refuse_robot(chosen.get("station"), "guiderail train-on-robot TASK --out RUN")
    open_supervision = None
    if options.human_in_the_loop:
        wait_for_browser = load_plugin("supervision", "browser", sibling="hardware")

        def open_supervision() -> Any:
            return wait_for_browser(print_progress)

    from guiderail.tools.learning.train import Training

    trained = Training(
        out,
        names,
        chosen,
        choices,
        variants=options.variants,
        imports=modules,
        resume=run.resume,
        log=options.log or (),
        pictures=options.pictures is not False,
        open_supervision=open_supervision,
    ).start()
    held_out: dict[str, Any] = {}
    if options.evaluate is not None:
        from guiderail.tools.evaluation.evaluate import evaluate_trained
        from guiderail.tools.evaluation.evaluation import statistics
        from guiderail.tools.learning.run_folder import RunFolder

        rows = evaluate_trained(RunFolder(trained.path), trained.config, options.evaluate)
        held_out = {"held_out_episodes": len(rows), **statistics(rows, "held_out_")}
    print_result(trained.summary | held_out, run.as_json)


def _check_early(names: list[str], run: cli.RunOptions, options: TrainOptions, environment: Mapping[str, Any]) -> None:
    """Raise an InputError for an unknown name or an existing folder, before anything slow is imported."""
    from guiderail.tools.files import refuse_existing_run
    from guiderail.tools.learning.learner import LEARNERS, check_log_formats
    from guiderail.tools.learning.learner_config import PRESETS

    for name in names:
        check_task_name(name)
    refuse_existing_run(run.folder)
    check_log_formats(options.log or ())
    if run.preset is not None and run.preset not in PRESETS:
        raise InputError(f"there is no preset {run.preset!r}: {did_you_mean(run.preset, PRESETS)}")
    for registry, chosen in (
        (GUIDANCE, environment.get("guidance")),
        (STATIONS, environment.get("station")),
        (LEARNERS, run.algorithm),
    ):
        if chosen is not None and all(map(TASKS.is_packaged, names)) and chosen not in registry.names():
            registry.get(chosen)  # raises an InputError


@cli.command("demo --out demo")
def demo(
    out: Annotated[Path, option("Folder of the run; an earlier demo in it is replaced.")] = Path("demo"),
    episodes: Annotated[int, option("Number of training episodes.")] = 22,
    seed: Annotated[int, option("Seed of all random numbers.")] = 0,
) -> None:
    """Train sKGRL to avoid an obstacle, in about a minute, and show the result."""
    from guiderail.tools.cli.demo import run_demo

    run_demo(out, episodes=episodes, seed=seed)


@dataclass(frozen=True)
class EvaluateOptions:
    """Options of evaluate alone."""

    episodes: Annotated[
        int, option("Number of held-out episodes; with 100 the confidence interval is half as wide.")
    ] = EPISODES
    baselines: cli.Baselines = None
    resample_offsets: Annotated[
        bool, option("Resample the fixture offset of the run in every episode.", "--resample-offsets")
    ] = False
    save: Annotated[
        Path | None, option("Write the successful episodes as demonstrations, .npz or .csv; the file must not exist.")
    ] = None
    signal: Annotated[str, option("Poses that --save writes: commanded or measured.")] = "commanded"
    steps: Annotated[
        Path | None,
        option("Write every control step of the policy into this folder, as train does; it must not exist."),
    ] = None
    processes: cli.Processes = None


@dataclass(frozen=True)
class PolicyOptions:
    """Options of evaluate and visualize about the policy and its task."""

    policy: Annotated[str | None, option("Policy that acts in a TASK: scripted, {baselines}.")] = None
    seed: cli.Seed = cli.SEED
    trust_policy: cli.TrustPolicy = False
    imports: cli.TaskImports = None
    trust_imports: cli.TrustImports = False


@cli.command("evaluate runs/passage --episodes 100 --json")
def evaluate(
    subject: cli.Subject,
    acting: PolicyOptions,
    options: EvaluateOptions,
    environment: cli.EnvironmentOptions,
    task: cli.PolicyTasks = None,
    as_json: cli.Json = False,
) -> None:
    """Evaluate a policy on held-out episodes, together with baseline policies.

    With several --task, or for a run over a set of environments, the policy is evaluated in each environment.
    With --task, POLICY is the folder of a policy, a .zip of Stable-Baselines3, an ONNX or TorchScript file, or
    module:function (FILE.py:function), which returns an action for an observation. The policy acts deterministically,
    on initial conditions from random numbers that training never uses. The demonstration alone, random actions and the
    scripted policy of the task run on the same episodes: if they succeed as well, the task is too easy to show
    learning. The policy's result is printed first, with the time that the baselines will take; --baselines none leaves
    them out. The row evaluation_scope states the conditions that the result is valid for. The last line is the result
    in one sentence.
    """
    chosen = environment.parse()
    name = cli.find_task(subject, acting.imports)[0]  # before the next line, because an import may register the station
    cli.refuse_robot(chosen.get("station"), "guiderail deploy RUN --episodes N")
    policy = acting.policy
    if policy is not None and (task or Path(name).is_dir()):
        raise InputError("--policy is evaluated in a task: name the task instead of a folder, or give --baselines")
    from guiderail.tools.evaluation.evaluate import evaluate as evaluate_policy

    given: dict[str, Any] = vars(options) | {"baselines": cli.split_names(options.baselines)}
    evaluation = evaluate_policy(
        policy or name,
        name if policy is not None else [cli.find_task(each)[0] for each in task] if task else None,
        seed=acting.seed,
        environment=chosen,
        trust_policy=acting.trust_policy,
        **given,
    )
    result = dict(evaluation)
    environments = {} if as_json else result.pop("environments", {})
    for skipped in result.pop("skipped_baselines"):
        print_message(f"{skipped} is left out: its observation or action does not match this environment")
    if result.get("saved") == 0:
        print_message(f"no episode succeeded: {options.save} is not written")
    print_result(result | ({"sentence": evaluation.sentence} if as_json else {}), as_json)
    if not as_json:
        for line in _table_of(environments):
            typer.echo(line)
        typer.echo(evaluation.sentence)


def _table_of(environments: Mapping[str, Mapping[str, float | None]]) -> Iterator[str]:
    """Yield the lines of a table of success rates, with a row for each environment and a column for each policy."""
    if not environments:
        return
    from guiderail.tools.evaluation.evaluation import LABELS

    columns = list(next(iter(environments.values())))
    width = max(len("environment"), *map(len, environments))
    yield "  ".join(
        [f"{'environment':<{width}}", *(f"{LABELS.get(name, name):<{cli.COLUMN}}" for name in columns)]
    ).rstrip()
    for name, rates in environments.items():
        cells = ("–" if rates[column] is None else f"{rates[column]:.0%}" for column in columns)
        yield "  ".join([f"{name:<{width}}", *(f"{text:<{cli.COLUMN}}" for text in cells)]).rstrip()


@dataclass(frozen=True)
class VisualizeOptions:
    """Files that visualize writes."""

    html: Annotated[
        Path | None,
        option(
            "Page to write, .html.  [default: replay.html, or replay-STATION.html with a station, in the run or the "
            "current folder; none with --image or --video]"
        ),
    ] = None
    image: Annotated[Path | None, option("Picture of six camera frames to write: {pictures}.")] = None
    video: Annotated[Path | None, option("Animated camera image to write: {videos}.")] = None
    episodes: Annotated[int | None, option("Number of held-out episodes on the page.  [default: 4]")] = None
    overwrite: Annotated[
        bool, option("Replace existing files; those in the run's own folder are always replaced.", "--overwrite")
    ] = False


@cli.command("visualize runs/passage --html replay.html")
def visualize(
    subject: cli.Subject,
    output: VisualizeOptions,
    acting: PolicyOptions,
    env: cli.Env = None,
    station: cli.Station = None,
    task: cli.PolicyTask = None,
) -> None:
    """Show held-out episodes as a page that any browser opens, and redraw the learning curve of a run.

    The page compares episodes before and after learning on one time axis: robots in motion, demonstrations, paths,
    constraints, and plots of force, violation, action and phase. It is self-contained. "Before" is the demonstration
    alone if the guidance has one, and random actions otherwise.
    """
    from guiderail.tools.evaluation.subject import EpisodeSpec
    from guiderail.tools.files import check_picture, check_video
    from guiderail.tools.visualization.camera import write_image, write_video
    from guiderail.tools.visualization.figures import plot_run
    from guiderail.tools.visualization.replay import default_page, write_page

    environment = cli.parse_environment(env, station=station)
    html, image, video = output.html, output.image, output.video
    name, policy = cli.find_task(subject, acting.imports)[0], acting.policy
    if policy is not None and (task is not None or Path(name).is_dir()):
        raise InputError("--policy acts in a task: name the task instead of a folder, or leave --policy out")
    if task is not None:
        task = cli.find_task(task)[0]
    elif not Path(name).is_dir() and name in cli.CHOICES["tasks"]():
        name, task = policy or "scripted", name
    episode = EpisodeSpec.of_policy(name, environment, acting.seed, task=task, trust_policy=acting.trust_policy)
    if output.episodes is not None and html is None and (image is not None or video is not None):
        raise InputError("--episodes are those of the page: add --html, or leave --episodes out")
    if image is not None:
        check_picture(image)
    if video is not None:
        check_video(video)
    if html is None and image is None and video is None:
        html = default_page(Path(subject) if episode.run is None else episode.run, environment)
    own = None if episode.run is None else episode.run.resolve()
    for path in (html, image, video):
        if path is not None and path.exists() and not output.overwrite and path.resolve().parent != own:
            raise InputError(f"{path} exists already: name another file, or give --overwrite")
    if html is not None:
        write_page(html, episode, episodes=output.episodes)
        if episode.run is not None:
            typer.echo(plot_run(episode.run))
        typer.echo(html)
    for path, write in ((image, write_image), (video, write_video)):
        if path is not None:
            write(path, episode)
            typer.echo(path)


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
    from guiderail.diagrams.tasks.registry import IMPORT_HINT
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

        metrics = [("episode: ", *column) for column in COLUMNS]
        metrics += [("episodes: ", m.name, m.unit, m.description) for m in statistics_of().values()]
        text = {prefix + name: meaning + (f" [{unit}]" if unit else "") for prefix, name, unit, meaning in metrics}
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
        from guiderail.tools.learning.learner_config import config_values, resolve_preset

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
