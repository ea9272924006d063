"""Commands `study`, `ensemble`, `robustness`, `converge`, `passport`, `certify`, `report` and `benchmark`."""

from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer

from guiderail.models.common.errors import InputError, RunsFailedError
from guiderail.tools.cli import app as cli
from guiderail.tools.cli.app import argument, option, print_message, print_result, to_json

cli.CHOICES["methods"] = lambda: [*import_module("guiderail_studies.benchmark.protocol").shipped_methods()]
cli.CHOICES["axes"] = lambda: [axis.name for axis in import_module("guiderail_studies.robustness").AXES]


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
    from guiderail.tools.imports import import_stored
    from guiderail_studies import declaration
    from guiderail_studies.engines.engine import make_engine
    from guiderail_studies.study import study_command

    declared = declaration.load_study(file)
    import_stored(declared.imports, file)
    names = None if methods is None else [name.strip() for name in methods.split(",")]
    chosen = declared.subset(names, cli.parse_integers(seeds, "--seeds"))
    running = make_engine(engine or "process", processes, address)
    result = study_command(chosen, out, running, declared.subset_name(chosen), file=file)
    print_result(result, as_json)
    if "failed" in result:
        raise RunsFailedError(result["failed"], None)


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
    from guiderail_studies.ensemble import write_ensemble

    members = write_ensemble(runs, out).members
    print_result({"policy": str(out), "networks": len(members)}, as_json)


@cli.command("robustness runs/connector --env station=mujoco --episodes 50")
def robustness(
    policies: Annotated[
        list[str],
        argument("Runs of one task, which are compared; or policies of any origin, with --task.", "RUN|POLICY..."),
    ],
    task: cli.PolicyTask = None,
    episodes: Annotated[int, option("Number of held-out episodes of each policy at each value.")] = 30,
    seed: cli.Seed = cli.SEED,
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
    from guiderail_studies.robustness import robustness as evaluate_robustness
    from guiderail_studies.robustness import values_below

    result = evaluate_robustness(
        policies,
        task=None if task is None else cli.find_task(task, imports)[0],
        episodes=episodes,
        seed=seed,
        environment=cli.parse_environment(env),
        axes=axes,
        baselines=cli.split_names(baselines),
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


@cli.command("converge runs/connector --steps 10,5,2.5,1.25 --engines drake,mujoco")
def converge(
    run: Annotated[
        str,
        argument("Folder of a run. With --out also pretrained:NAME ({pretrained}), or any policy with --task.", "RUN"),
    ],
    task: cli.PolicyTask = None,
    steps: Annotated[str, option("Plant steps in Drake [ms], comma-separated.")] = "10,5,2.5,1.25",
    engines: Annotated[str, option("Engines: drake, mujoco, pybullet and sapien, comma-separated.")] = "drake",
    episodes: Annotated[int, option("Number of held-out episodes of each step and engine.")] = 40,
    seed: cli.Seed = cli.SEED,
    env: cli.Env = None,
    out: Annotated[Path | None, option("Folder to write.  [default: converge in the run]")] = None,
    processes: cli.Processes = None,
    trust_policy: cli.TrustPolicy = False,
    imports: cli.TaskImports = None,
    trust_imports: cli.TrustImports = False,
    as_json: cli.Json = False,
) -> None:
    """Check that a policy's success does not depend on the plant's time step or on the physics engine.

    The same held-out episodes run at every step. The table has success rates with intervals, the number of episodes
    that agree with the shortest step, peak forces, and the contact on the rim: drag over normal force at 20 and 40
    mm/s, lever arm, capture, and CPU time per simulated time. Evaluated episodes are stored, so the same command
    resumes an interrupted evaluation.
    """
    from guiderail_studies.converge import converge as evaluate_convergence
    from guiderail_studies.converge import parse_steps

    result = evaluate_convergence(
        run,
        task=None if task is None else cli.find_task(task, imports)[0],
        steps=parse_steps(steps),
        engines=engines,
        episodes=episodes,
        seed=seed,
        environment=cli.parse_environment(env),
        out=out,
        processes=processes,
        trust_policy=trust_policy,
    )
    if as_json:
        typer.echo(to_json(result | {"table": str(result["table"])}))
        return
    typer.echo(result["table"].with_suffix(".md").read_text(encoding="utf-8"))
    if result["coarsest"] is not None:
        typer.echo(f"coarsest step that agrees with the finest: {result['coarsest']:g} ms")
    if result["warning"]:
        typer.echo(f"warning: {result['warning']}")
    typer.echo(result["table"])


@cli.command("passport runs/connector")
def passport(
    run: Annotated[
        str,
        argument("Folder of a run. With --out also pretrained:NAME ({pretrained}), or any policy with --task.", "RUN"),
    ],
    task: cli.PolicyTask = None,
    engines: Annotated[
        str | None,
        option("Engines: drake, mujoco, pybullet and sapien, comma-separated.  [default: those that are installed]"),
    ] = None,
    episodes: Annotated[int, option("Number of held-out episodes of each condition.")] = 20,
    seed: cli.Seed = cli.SEED,
    env: cli.Env = None,
    out: Annotated[Path | None, option("Folder to write.  [default: passport in the run]")] = None,
    processes: cli.Processes = None,
    trust_policy: cli.TrustPolicy = False,
    imports: cli.TaskImports = None,
    trust_imports: cli.TrustImports = False,
    as_json: cli.Json = False,
) -> None:
    """Evaluate a policy in several physics engines, at finer time steps, and with other friction and clearance.

    The same held-out episodes run under every condition. The table has success rates with intervals, and the largest
    forces of impedance and contact. The success in each engine is also predicted from the other engines. Evaluated
    episodes are stored, so the same command resumes an interrupted evaluation.
    """
    from guiderail_studies.passport import passport as evaluate_passport

    result = evaluate_passport(
        run,
        task=None if task is None else cli.find_task(task, imports)[0],
        engines=engines,
        episodes=episodes,
        seed=seed,
        environment=cli.parse_environment(env),
        out=out,
        log=print_message,
        processes=processes,
        trust_policy=trust_policy,
    )
    if as_json:
        typer.echo(to_json(result | {"table": str(result["table"])}))
        return
    typer.echo(result["table"].with_suffix(".md").read_text(encoding="utf-8"))
    for row in result["predictions"]:
        typer.echo(
            f"{row['left_out']}: {row['predicted']:.0%} predicted from the other engines ({row['low']:.0%} to "
            f"{row['high']:.0%}), {row['measured']:.0%} measured"
        )
    typer.echo(f"weakest condition: {result['weakest']}")
    typer.echo(result["table"])


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
    from guiderail_studies.certify import certify_skill, verify_certificate

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


@cli.command("report studies --out report.html")
def report(
    runs: Annotated[list[Path], argument("Folders of runs, or of a study.", "RUN...")],
    out: Annotated[Path, option("Page to write, .html.")] = Path("report.html"),
    episodes: Annotated[
        int, option("Held-out episodes for each run that no study evaluated; evaluated episodes are used again.")
    ] = 0,
    trust_imports: cli.TrustImports = False,
    as_json: cli.Json = False,
) -> None:
    """Write the results of runs or of a study as one self-contained page.

    It contains learning curves with bootstrap bands, episodes to convergence, held-out success together with baseline
    policies, safety statistics of every control step, configuration, versions, and the commands that reproduce it.
    """
    from guiderail_studies.report import write_report

    page = write_report(runs, out, episodes=episodes)
    typer.echo(to_json({"page": str(page)}) if as_json else page)


benchmark = cli.command_group("benchmark", "Compare methods on the benchmark's tasks by the rules of a protocol.")
Version = Annotated[int, option("Version of the protocol.")]
Tasks = Annotated[str | None, option("Tasks of the protocol, comma-separated.  [default: all]")]
Processes = Annotated[int, option("Number of runs in parallel.")]


@cli.command("benchmark run residual --protocol 1 --task clamp --seeds 0,1,2 --out runs/residual", "run", benchmark)
def benchmark_run(
    method: Annotated[
        str, argument("Method of this package ({methods}), or a YAML file of a method.", "METHOD", "methods")
    ],
    out: Annotated[Path, option("Folder of the method's runs; the same command continues interrupted runs.")],
    protocol: Version = 1,
    task: Tasks = None,
    seeds: Annotated[str | None, option("Seeds of the protocol, comma-separated.  [default: all]")] = None,
    processes: Processes = 1,
    as_json: cli.Json = False,
) -> None:
    """Train and evaluate a method by the rules of a protocol.

    The expected cost in core-hours is printed before anything is run. A method's YAML file names the options of the
    environment and the learner that it chooses; see docs/benchmark.md.
    """
    from guiderail_studies.benchmark.protocol import load_method, load_protocol
    from guiderail_studies.benchmark.run import run_method
    from guiderail_studies.engines.engine import make_engine

    result = run_method(
        load_protocol(protocol),
        load_method(method),
        out,
        tasks=cli.split_names(task),
        seeds=cli.parse_integers(seeds, "--seeds"),
        engine=make_engine("process", processes),
        log=print_message,
    )
    print_result(result, as_json)


@cli.command("benchmark floors --protocol 1 --task clamp --out floors", "floors", benchmark)
def benchmark_floors(
    out: Annotated[Path, option("Folder of the evaluated episodes; the same command continues.")],
    protocol: Version = 1,
    task: Tasks = None,
    episodes: Annotated[int | None, option("Episodes of each policy.  [default: the protocol's]")] = None,
    processes: Processes = 1,
    as_json: cli.Json = False,
) -> None:
    """Measure the success of policies without learning, and check the protocol's bounds on them.

    Uniform random actions must fail in most episodes, and the scripted policy must succeed in most; the exit code is 1
    otherwise.
    """
    from guiderail_studies.benchmark.protocol import load_protocol
    from guiderail_studies.benchmark.run import check_floors
    from guiderail_studies.engines.engine import make_engine

    engine = make_engine("process", processes)
    rows, failures = check_floors(
        load_protocol(protocol), out, tasks=cli.split_names(task), episodes=episodes, engine=engine
    )
    rates = {f"{row['task']}, {row['policy']}": row["success_rate"] for row in rows}
    print_result(rates | {"bounds not met": len(failures)}, as_json)
    if failures:
        raise RunsFailedError(failures, None)


@cli.command("benchmark submit runs/residual --out submissions/residual", "submit", benchmark)
def benchmark_submit(
    runs: Annotated[Path, argument("Folder that guiderail benchmark run wrote.", "RUNS")],
    out: Annotated[Path, option("Folder of the submission to write; it must not exist.")],
    as_json: cli.Json = False,
) -> None:
    """Write the finished runs of a method as a submission: policies, episodes, digests, versions and the table."""
    from guiderail_studies.benchmark.submission import submit

    print_result(submit(runs, out), as_json)


@cli.command("benchmark verify submissions/residual --episodes 5", "verify", benchmark)
def benchmark_verify(
    folder: Annotated[Path, argument("Folder of a submission.", "FOLDER")],
    episodes: Annotated[int, option("Number of held-out episodes of each run that are repeated.")] = 5,
    seed: Annotated[int | None, option("Seed of the sample.  [default: another sample each time]")] = None,
    as_json: cli.Json = False,
) -> None:
    """Repeat a sample of a submission's held-out episodes, and refuse it if any number differs.

    The table is computed again from all episodes. Nothing of the submission is executed: its policies are arrays.
    """
    from guiderail_studies.benchmark.submission import verify

    log = (lambda text: None) if as_json else print_message
    print_result(verify(folder, episodes=episodes, seed=seed, log=log), as_json)


@cli.command("benchmark page submissions", "page", benchmark)
def benchmark_page(
    folder: Annotated[Path, argument("Folder of submissions.", "FOLDER")],
    out: Annotated[Path | None, option("Path without ending.  [default: leaderboard in the folder]")] = None,
    as_json: cli.Json = False,
) -> None:
    """Write the leaderboard of all submissions in a folder, as Markdown and HTML."""
    from guiderail_studies.benchmark.page import write_page

    print_result(write_page(folder, out), as_json)
