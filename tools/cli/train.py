"""`guiderail train` and `guiderail demo`."""

from pathlib import Path
from typing import Annotated, Any

from guiderail.diagrams.tasks.registry import check_task_name
from guiderail.models.common.errors import InputError
from guiderail.models.common.plugins import load_plugin
from guiderail.tools.cli import app as cli
from guiderail.tools.cli.app import argument, option, print_message, print_progress, print_result


@cli.command("train NarrowPassage --guidance skgrl --episodes 60 --out runs/passage")
def train(
    tasks: Annotated[
        list[str] | None,
        argument(
            "Task to learn: {tasks}. With several, each episode is in the environment of another.", "TASK...", "tasks"
        ),
    ] = None,
    out: Annotated[Path | None, option("Folder of the run; it must not exist, except with --resume.")] = None,
    variants: Annotated[
        Path | None,
        option("YAML file with options of the environment by a variant's name: each episode is in another variant."),
    ] = None,
    guidance: cli.Guidance = None,
    algorithm: cli.Algorithm = None,
    episodes: Annotated[
        int | None,
        option("Total number of episodes; --resume can change it, but not below the episodes done.  [default: 60]"),
    ] = None,
    seed: Annotated[int | None, option("Seed of all random numbers.  [default: 0]")] = None,
    preset: cli.Preset = None,
    setting: cli.Settings = None,
    num_envs: Annotated[
        int | None,
        option(
            "Number of episodes simulated at once, each in a process of its own, while the main process learns; the "
            "result depends on it.  [default: 0, simulate and learn in turn]"
        ),
    ] = None,
    env: cli.Env = None,
    difficulty: cli.Difficulty = None,
    action_repeat: cli.ActionRepeat = None,
    reward: cli.Reward = None,
    observation: cli.Observation = None,
    fixture_offset: cli.FixtureOffset = None,
    station: cli.Station = None,
    step_log: cli.WriteStepLog = None,
    log: Annotated[
        list[str] | None,
        option("Write a learning log into the run's logs/: {log_formats}; repeatable.", choices="log_formats"),
    ] = None,
    pictures: Annotated[
        bool | None,
        option(
            "Draw the learning curve and a page of held-out episodes at the end; guiderail visualize RUN draws the "
            "page later. Not stored: give it again with --resume.  [default: yes]",
            "--pictures/--no-pictures",
        ),
    ] = None,
    evaluate: Annotated[
        int | None,
        option(
            "Number of held-out episodes that evaluate the policy at the end; guiderail evaluate RUN also evaluates "
            "baselines.  [default: none]"
        ),
    ] = None,
    human_in_the_loop: Annotated[
        bool,
        option("A supervisor in the browser corrects the policy, stops and labels episodes.", "--human-in-the-loop"),
    ] = False,
    resume: Annotated[bool, option("Resume the run in --out.", "--resume")] = False,
    imports: cli.Imports = None,
    trust_imports: cli.TrustImports = False,
    as_json: cli.Json = False,
) -> None:
    """Train a policy and write a run folder.

    With several tasks or variants, every episode is in another environment of this set, in a random order in which each
    occurs equally often. The environments need equal observations, actions, rewards and guidance.

    The folder contains the configuration, a table with one row per episode, a log with one row per control step,
    a checkpoint, the policy, a learning curve and a page that shows held-out episodes. An interrupted run is resumed
    with --resume and ends in the same result.
    """
    if evaluate is not None and evaluate < 1:
        raise InputError(f"--evaluate is the number of held-out episodes: give at least 1, not {evaluate}")
    found = [cli.find_task(task, imports) for task in tasks or ()]
    names, folders = [name for name, _ in found], tuple(folder for _, each in found for folder in each)
    modules = (*folders, *(imports or ()))
    is_checked_early = bool(names) and not modules and not resume
    for name in names if is_checked_early else ():
        check_task_name(name)  # before anything slow is imported
    if imports:
        from guiderail.tools.imports import import_modules

        modules = import_modules(modules)  # before the options are read, because a module may register the station
    environment = cli.parse_environment(
        env,
        guidance=guidance,
        difficulty=difficulty,
        action_repeat=action_repeat,
        reward=reward,
        observation=observation,
        fixture_offset=fixture_offset,
        station=station,
    )
    settings = cli.parse_pairs(setting, "--set", "batch_size=128")
    choices: dict[str, Any] = {"algorithm": algorithm, "preset": preset, "episodes": episodes, "seed": seed}
    if num_envs is not None:
        cli.check_same("num_envs", settings.setdefault("num_envs", str(num_envs)), str(num_envs))
    if out is None:
        raise InputError("the run needs a folder: name one with --out RUN")
    if is_checked_early:
        from guiderail.tools.environments import check_declared_options
        from guiderail.tools.files import refuse_existing_run
        from guiderail.tools.learning.config import check_choices
        from guiderail.tools.learning.learner import check_log_formats

        refuse_existing_run(out)
        check_log_formats(log or ())
        kinds = {name: environment.get(name) for name in ("guidance", "station")}
        for name in names:
            check_choices(name, settings=settings, **kinds, **choices)
            check_declared_options(name, environment)
    if (folders or "demonstrations" in environment) and len(names) == 1 and not resume:
        from guiderail.tools.environments import warn_of_deviation

        if (warning := warn_of_deviation(names[0], environment)) is not None:
            print_message(warning)
    cli.refuse_robot(environment.get("station"), "guiderail train-on-robot TASK --out RUN")
    open_supervision = None
    if human_in_the_loop:
        wait_for_browser = load_plugin("supervision", "browser", sibling="hardware")

        def open_supervision() -> Any:
            return wait_for_browser(print_progress)

    from guiderail.tools.learning.train import start_or_resume

    run = start_or_resume(
        names,
        out,
        variants=variants,
        environment=environment,
        settings=settings,
        resume=resume,
        imports=modules,
        step_log=step_log,
        log=log or (),
        pictures=pictures is not False,
        open_supervision=open_supervision,
        **choices,
    )
    held_out: dict[str, Any] = {}
    if evaluate is not None:
        from guiderail.tools.evaluation.evaluate import evaluate_trained
        from guiderail.tools.evaluation.evaluation import statistics
        from guiderail.tools.learning.run_folder import RunFolder

        rows = evaluate_trained(RunFolder(run.path), run.config, evaluate)
        held_out = {"held_out_episodes": len(rows), **statistics(rows, "held_out_")}
    print_result(run.summary | held_out, as_json)


@cli.command("demo --out demo")
def demo(
    out: Annotated[Path, option("Folder of the run; an earlier demo in it is replaced.")] = Path("demo"),
    episodes: Annotated[int, option("Number of training episodes.")] = 22,
    seed: Annotated[int, option("Seed of all random numbers.")] = 0,
) -> None:
    """Train sKGRL to avoid an obstacle, in about a minute, and show the result."""
    from guiderail.tools.cli.demo import run_demo

    run_demo(out, episodes=episodes, seed=seed)
