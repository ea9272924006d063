"""`guiderail train` and `guiderail demo`."""

from pathlib import Path
from typing import Annotated, Any

from guiderail.diagrams.tasks.registry import check_task_name
from guiderail.models.common.errors import InputError
from guiderail.tools.cli import app as cli
from guiderail.tools.cli.app import argument, option, print_message, print_progress, print_result


@cli.command("train NarrowPassage --guidance skgrl --episodes 60 --out runs/passage")
def train(
    task: Annotated[str | None, argument("Task to learn: {tasks}.", "TASK", "tasks")] = None,
    out: Annotated[Path | None, option("Folder of the run; it must not exist, except with --resume.")] = None,
    guidance: cli.Guidance = None,
    algorithm: Annotated[
        str | None, option("Learning algorithm: {learners}.  [default: the task's]", choices="learners")
    ] = None,
    episodes: Annotated[
        int | None,
        option("Total number of episodes; --resume can change it, but not below the episodes done.  [default: 60]"),
    ] = None,
    seed: Annotated[int | None, option("Seed of all random numbers.  [default: 0]")] = None,
    preset: Annotated[
        str | None, option("Settings of the learner: {presets}.  [default: the task's]", choices="presets")
    ] = None,
    setting: Annotated[
        list[str] | None,
        option("Setting of the learner, such as batch_size=128; repeatable.", "--set", metavar="name=value"),
    ] = None,
    num_envs: Annotated[
        int | None,
        option(
            "Number of episodes simulated at once, each in a process of its own, while the main process learns; the "
            "result depends on it.  [default: 0, simulate and learn in turn]"
        ),
    ] = None,
    env: cli.Env = None,
    action_repeat: Annotated[int | None, option("Control steps per action.")] = None,
    reward: Annotated[
        str | None, option("Reward: {rewards}; guiderail list TASK lists those of a task.", choices="rewards")
    ] = None,
    observation: Annotated[
        str | None,
        option("Observation: {observations}; guiderail list TASK lists those of a task.", choices="observations"),
    ] = None,
    fixture_offset: Annotated[
        str | None, option("When the offset of the fixture is sampled: per_run, per_episode or none.")
    ] = None,
    station: Annotated[str | None, option("Station: {stations}.  [default: the task's]", choices="stations")] = None,
    step_log: Annotated[
        bool | None,
        option("Write every control step into the run's steps/.  [default: yes]", "--step-log/--no-step-log"),
    ] = None,
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
    robot_url: cli.RobotUrl = None,
    robot: cli.Robot = None,
    driver: cli.Driver = None,
    sim: cli.Sim = False,
    synchronous: cli.Synchronous = False,
    rate: cli.Rate = None,
    scenario: cli.Scenario = None,
    yes: cli.Yes = False,
    resume: Annotated[
        bool, option("Resume the run in --out; a run with a simulated driver needs --sim again.", "--resume")
    ] = False,
    imports: cli.Imports = None,
    trust_imports: cli.TrustImports = False,
    as_json: cli.Json = False,
) -> None:
    """Train a policy and write a run folder.

    The folder contains the configuration, a table with one row per episode, a log with one row per control step,
    a checkpoint, the policy, a learning curve and a page that shows held-out episodes. An interrupted run is resumed
    with --resume and ends in the same result.
    """
    if evaluate is not None and evaluate < 1:
        raise InputError(f"--evaluate is the number of held-out episodes: give at least 1, not {evaluate}")
    task, folders = (None, ()) if task is None else cli.find_task(task, imports)
    modules = (*folders, *(imports or ()))
    if task is not None and not modules and not resume:
        check_task_name(task)  # before anything slow is imported
    if imports:
        from guiderail.tools.imports import import_modules

        modules = import_modules(modules)  # before the options are read, because a module may register the station
    environment = cli.parse_environment(
        env,
        guidance=guidance,
        action_repeat=action_repeat,
        reward=reward,
        observation=observation,
        fixture_offset=fixture_offset,
        station=station,
        robot=robot,
        robot_url=robot_url,
        driver=driver,
    )
    if resume and out is not None:
        environment = _with_stored_robot(out, environment)
    settings = cli.parse_pairs(setting, "--set", "batch_size=128")
    choices: dict[str, Any] = {"algorithm": algorithm, "preset": preset, "episodes": episodes, "seed": seed}
    if num_envs is not None:
        cli.check_same("num_envs", settings.setdefault("num_envs", str(num_envs)), str(num_envs))
    if out is None:
        raise InputError("the run needs a folder: name one with --out RUN")
    if task is not None and not modules and not resume:
        from guiderail.tools.environments import check_declared_options
        from guiderail.tools.files import refuse_existing_run
        from guiderail.tools.learning.config import check_choices
        from guiderail.tools.learning.learner import check_log_formats

        refuse_existing_run(out)
        check_log_formats(log or ())
        kinds = {name: environment.get(name) for name in ("guidance", "station")}
        check_choices(task, settings=settings, **kinds, **choices)
        check_declared_options(task, environment)
    if (folders or "demonstrations" in environment) and task is not None and not resume:
        from guiderail.tools.datasets.validate import warn_of_deviation

        if (warning := warn_of_deviation(task, environment)) is not None:
            print_message(warning)
    if cli.is_hardware(environment.get("station")):
        if human_in_the_loop:
            raise InputError("training on hardware has no human in the loop: leave --human-in-the-loop out")
        if log:
            raise InputError("training on hardware writes no learning log: leave --log out")
        if evaluate is not None:
            raise InputError("after training on hardware, use guiderail evaluate RUN: leave --evaluate out")
        if settings.get("num_envs", "0") != "0":
            raise InputError("there is one robot: leave --num-envs out")
        from guiderail.tools.hardware.train import train_on_robot

        given = choices | {"step_log": step_log, "imports": modules}
        result = train_on_robot(
            task,
            out,
            cli.connect(environment, scenario, sim=sim, synchronous=synchronous, rate=rate),
            environment=environment,
            given={name: value for name, value in given.items() if value is not None},
            settings=settings,
            resume=resume,
            assume_yes=yes,
            log=print_message,
        )
        print_result(result, as_json)
        return
    cli.refuse_hardware_options(sim=sim, synchronous=synchronous, rate=rate, scenario=scenario, yes=yes)
    from guiderail.tools.learning.train import start_or_resume

    run = start_or_resume(
        task,
        out,
        environment=environment,
        settings=settings,
        resume=resume,
        imports=modules,
        step_log=step_log,
        log=log or (),
        pictures=pictures is not False,
        make_supervisor=_wait_for_supervisor if human_in_the_loop else None,
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


def _with_stored_robot(out: Path, environment: dict[str, Any]) -> dict[str, Any]:
    """Return the given options, completed by the station, the robot and the driver of a run on hardware."""
    from guiderail.tools.learning.run_folder import RunFolder

    stored = RunFolder(out).config().environment
    if not cli.is_hardware(stored.get("station")):
        return environment
    names = ("station", "robot", "driver")
    return {name: stored[name] for name in names if stored.get(name) is not None} | environment


def _wait_for_supervisor() -> Any:
    """Block until a browser connects; return the supervisor."""
    from guiderail.tools.teleop.teleoperator import MeshcatSupervisor

    supervisor = MeshcatSupervisor(print_progress)
    supervisor.wait()
    return supervisor


@cli.command("demo --out demo")
def demo(
    out: Annotated[Path, option("Folder of the run; an earlier demo in it is replaced.")] = Path("demo"),
    episodes: Annotated[int, option("Number of training episodes.")] = 22,
    seed: Annotated[int, option("Seed of all random numbers.")] = 0,
) -> None:
    """Train sKGRL to avoid an obstacle, in about a minute, and show the result."""
    from guiderail.tools.cli.demo import run_demo

    run_demo(out, episodes=episodes, seed=seed)
