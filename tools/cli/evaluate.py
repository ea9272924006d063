"""`guiderail evaluate`, `guiderail robustness` and `guiderail certify`."""

from pathlib import Path
from typing import Annotated

import typer

from guiderail.models.common.errors import InputError
from guiderail.tools.cli import app as cli
from guiderail.tools.cli.app import argument, option, print_message, print_result, to_json

QUICK = 20  # episodes of a quick evaluation
SEED = 1_000_000  # default seed of the first held-out episode


@cli.command("evaluate runs/passage --episodes 100 --json")
def evaluate(
    subject: cli.Subject,
    episodes: Annotated[int | None, option("Number of held-out episodes.  [default: 100]")] = None,
    quick: Annotated[
        bool, option(f"Evaluate {QUICK} episodes instead of 100; the confidence interval is wider.", "--quick")
    ] = False,
    seed: cli.Seed = SEED,
    task: cli.PolicyTask = None,
    trust_policy: cli.TrustPolicy = False,
    processes: cli.Processes = None,
    policy: Annotated[
        str | None,
        option("Policy to evaluate in a TASK, or on hardware instead of the run's: scripted, {baselines}."),
    ] = None,
    env: cli.Env = None,
    station: Annotated[str | None, option("Station: {stations}.  [default: the run's]", choices="stations")] = None,
    baselines: cli.Baselines = None,
    resample_offsets: cli.Offsets = False,
    save: Annotated[
        Path | None, option("Write the successful episodes as demonstrations, .npz or .csv; the file must not exist.")
    ] = None,
    signal: Annotated[str, option("Poses that --save writes: commanded or measured.")] = "commanded",
    robot_url: cli.RobotUrl = None,
    robot: cli.Robot = None,
    driver: cli.Driver = None,
    sim: cli.Sim = False,
    synchronous: cli.Synchronous = False,
    rate: cli.Rate = None,
    scenario: cli.Scenario = None,
    yes: cli.Yes = False,
    out: Annotated[
        Path | None,
        option("Hardware: folder of the episodes' table.  [default: RUN/hardware; NAME/hardware for pretrained:NAME]"),
    ] = None,
    imports: cli.TaskImports = None,
    trust_imports: cli.TrustImports = False,
    as_json: cli.Json = False,
) -> None:
    """Evaluate a policy on held-out episodes, together with baseline policies.

    With --task, POLICY is the folder of a policy, a .zip of Stable-Baselines3, an ONNX or TorchScript file, or
    module:function (FILE.py:function), which returns an action for an observation. The policy acts deterministically,
    on initial conditions from random numbers that training never uses. The demonstration alone, random actions and the
    scripted policy of the task run on the same episodes: if they succeed as well, the task is too easy to show
    learning. The row evaluation_scope states the conditions that the result is valid for. The last line is the result
    in one sentence.
    """
    if quick and episodes is not None:
        raise InputError("--quick sets the number of episodes: leave --episodes out")
    episodes = QUICK if quick else 100 if episodes is None else episodes
    environment = cli.parse_environment(env, station=station, robot=robot, robot_url=robot_url, driver=driver)
    name = cli.find_task(subject, imports)[0]  # before the next line, because an import may register the station
    if cli.is_hardware(environment.get("station")):
        given = environment.keys() - {"station", "robot", "robot_url", "driver"} or task or baselines or save
        if given or resample_offsets or seed != SEED or signal != "commanded" or processes is not None or trust_policy:
            raise InputError(
                "on hardware a single policy is evaluated in the run's own environment: leave --env, --task, "
                "--baselines, --save, --signal, --processes, --trust-policy, --seed and --resample-offsets out"
            )
        from guiderail.tools.hardware.evaluate import evaluate_on_robot

        connection = cli.connect(environment, scenario, sim=sim, synchronous=synchronous, rate=rate)
        on_robot = evaluate_on_robot(
            Path(subject),
            connection,
            episodes,
            station=str(environment["station"]),
            policy=policy,
            assume_yes=yes,
            out=out,
            log=print_message,
        )
        print_result(on_robot, as_json)
        return
    cli.refuse_hardware_options(sim=sim, synchronous=synchronous, rate=rate, scenario=scenario, yes=yes, out=out)
    if policy is not None and (task is not None or Path(name).is_dir()):
        raise InputError("--policy is evaluated in a task: name the task instead of a folder, or give --baselines")
    from guiderail.tools.evaluation.evaluate import evaluate as evaluate_policy

    evaluation = evaluate_policy(
        policy or name,
        name if policy is not None else task if task is None else cli.find_task(task)[0],
        episodes,
        seed=seed,
        environment=environment,
        baselines=_split(baselines),
        resample_offsets=resample_offsets,
        save=save,
        signal=signal,
        processes=processes,
        trust_policy=trust_policy,
    )
    result = dict(evaluation)
    for skipped in result.pop("skipped_baselines"):
        print_message(f"{skipped} is left out: its observation or action does not match this environment")
    if result.get("saved") == 0:
        print_message(f"no episode succeeded: {save} is not written")
    print_result(result | ({"sentence": evaluation.sentence} if as_json else {}), as_json)
    if not as_json:
        typer.echo(evaluation.sentence)


def _split(names: str | None) -> list[str] | None:
    """Split comma-separated names of baseline policies; "none" is an empty list, and None means the default set."""
    if names is None:
        return None
    return [] if names == "none" else [name.strip() for name in names.split(",")]


@cli.command("robustness runs/connector --env station=mujoco --episodes 50")
def robustness(
    policies: Annotated[
        list[str],
        argument("Runs of one task, which are compared; or policies of any origin, with --task.", "RUN|POLICY..."),
    ],
    task: cli.PolicyTask = None,
    episodes: Annotated[int, option("Number of held-out episodes of each policy at each value.")] = 30,
    seed: cli.Seed = SEED,
    axes: Annotated[str | None, option("Disturbances, comma-separated: {axes}.  [default: all]")] = None,
    env: cli.Env = None,
    baselines: cli.Baselines = None,
    processes: cli.Processes = None,
    trust_policy: cli.TrustPolicy = False,
    imports: cli.TaskImports = None,
    out: Annotated[
        Path | None,
        option(
            "Folder to write, required for several runs and for a policy without a run.  "
            "[default: robustness/STATION in the run]"
        ),
    ] = None,
    trust_imports: cli.TrustImports = False,
    as_json: cli.Json = False,
) -> None:
    """Evaluate policies under friction, stiffness, sensor, command and timing errors.

    One quantity is changed at a time. One table and one picture compare all runs. Evaluated episodes are stored, so the
    same command resumes an interrupted evaluation, and an additional run needs only its own episodes.
    """
    from guiderail.tools.evaluation.robustness import robustness as evaluate_robustness
    from guiderail.tools.evaluation.robustness import values_below

    result = evaluate_robustness(
        policies,
        task=None if task is None else cli.find_task(task, imports)[0],
        episodes=episodes,
        seed=seed,
        environment=cli.parse_environment(env),
        axes=axes,
        baselines=_split(baselines),
        out=out,
        log=print_message,
        processes=processes,
        trust_policy=trust_policy,
    )
    if as_json:
        typer.echo(to_json({"table": str(result["table"]), "picture": str(result["picture"]), "rows": result["rows"]}))
        return
    for line in result["table"].with_suffix(".md").read_text(encoding="utf-8").splitlines():
        typer.echo(line)
    for policy in result["policies"]:
        for name, values in values_below(result["rows"], policy).items():
            below = ", ".join(f"{value:.3g}" for value in values) or "no value"
            typer.echo(f"{policy}, {name}: success rate below 90 % at {below}")
    typer.echo(result["table"])
    typer.echo(result["picture"])


@cli.command("certify runs/passage --attack 1000000")
def certify(
    subject: Annotated[
        str,
        argument("Folder of a run. With --out also pretrained:NAME ({pretrained}) or a task: {tasks}.", "RUN or TASK"),
    ],
    env: cli.Env = None,
    out: Annotated[Path | None, option("Folder to write.  [default: certificate in the run]")] = None,
    start_within: Annotated[
        float | None,
        option(
            "Largest start offset of the robot, in the outputs' units.  [default: that of a reset, plus the error of "
            "the pose measurement]"
        ),
    ] = None,
    attack: Annotated[int, option("Number of steps in which an adversary tries to leave the bounds.")] = 0,
    verify: Annotated[Path | None, option("Folder of a certificate: check it and compare it with the skill.")] = None,
    key: Annotated[Path | None, option("Key that signs the certificate or, with --verify, has signed it.")] = None,
    imports: cli.TaskImports = None,
    trust_imports: cli.TrustImports = False,
    as_json: cli.Json = False,
) -> None:
    """Compute bounds on all commands of a skill, for any action, and check them with an independent program.

    The certificate lists its assumptions. It can be checked on any machine: python checker.py FOLDER needs NumPy alone.
    With --attack, a table compares the bounds with the worst commands that an adversary finds.
    """
    from guiderail.tools.certify import certify_skill, verify_certificate

    task, environment = cli.find_task(subject, imports)[0], cli.parse_environment(env)
    if verify is not None and (out is not None or attack):
        raise InputError("--verify only checks a certificate: give it without --out and --attack")
    if verify is not None:
        result = verify_certificate(task, environment, verify, start_within=start_within, key=key)
    else:
        result = certify_skill(task, environment, out=out, start_within=start_within, attack=attack, key=key)
    rows = result.get("attack", [])
    if as_json:
        typer.echo(to_json(result))
    else:
        for name, value in result.items():
            if name == "attack":
                continue
            text = ", ".join("–" if x is None else f"{x:.4g}" for x in value) if isinstance(value, list) else value
            typer.echo(f"{'accepted by the checker' if name == 'checker' else name.replace('_', ' ')}: {text}")
        if rows:
            typer.echo(Path(result["certificate"]).with_name("attack.md").read_text(encoding="utf-8"))
    if result["checker"] != "yes" or any(row["violations"] for row in rows):
        raise typer.Exit(1)
