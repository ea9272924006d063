"""`guiderail evaluate`."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated

import typer

from guiderail.models.common.errors import InputError
from guiderail.tools.cli import app as cli
from guiderail.tools.cli.app import option, print_message, print_result

EPISODES = 20  # default number of episodes: about a minute with the baselines
SEED = 1_000_000  # default seed of the first held-out episode


@cli.command("evaluate runs/passage --episodes 100 --json")
def evaluate(
    subject: cli.Subject,
    episodes: Annotated[
        int, option("Number of held-out episodes; with 100 the confidence interval is half as wide.")
    ] = EPISODES,
    seed: cli.Seed = SEED,
    task: cli.PolicyTasks = None,
    trust_policy: cli.TrustPolicy = False,
    processes: cli.Processes = None,
    policy: Annotated[
        str | None,
        option("Policy to evaluate in a TASK: scripted, {baselines}."),
    ] = None,
    env: cli.Env = None,
    guidance: cli.Guidance = None,
    difficulty: cli.Difficulty = None,
    action_repeat: cli.ActionRepeat = None,
    reward: cli.Reward = None,
    observation: cli.Observation = None,
    fixture_offset: cli.FixtureOffset = None,
    station: cli.Station = None,
    baselines: cli.Baselines = None,
    resample_offsets: cli.Offsets = False,
    save: Annotated[
        Path | None, option("Write the successful episodes as demonstrations, .npz or .csv; the file must not exist.")
    ] = None,
    signal: Annotated[str, option("Poses that --save writes: commanded or measured.")] = "commanded",
    steps: Annotated[
        Path | None,
        option("Write every control step of the policy into this folder, as train does; it must not exist."),
    ] = None,
    imports: cli.TaskImports = None,
    trust_imports: cli.TrustImports = False,
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
    name = cli.find_task(subject, imports)[0]  # before the next line, because an import may register the station
    cli.refuse_robot(environment.get("station"), "guiderail deploy RUN --episodes N")
    if policy is not None and (task or Path(name).is_dir()):
        raise InputError("--policy is evaluated in a task: name the task instead of a folder, or give --baselines")
    from guiderail.tools.evaluation.evaluate import evaluate as evaluate_policy

    evaluation = evaluate_policy(
        policy or name,
        name if policy is not None else [cli.find_task(each)[0] for each in task] if task else None,
        episodes,
        seed=seed,
        environment=environment,
        baselines=split_names(baselines),
        resample_offsets=resample_offsets,
        save=save,
        signal=signal,
        steps=steps,
        processes=processes,
        trust_policy=trust_policy,
    )
    result = dict(evaluation)
    environments = {} if as_json else result.pop("environments", {})
    for skipped in result.pop("skipped_baselines"):
        print_message(f"{skipped} is left out: its observation or action does not match this environment")
    if result.get("saved") == 0:
        print_message(f"no episode succeeded: {save} is not written")
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


def split_names(names: str | None) -> list[str] | None:
    """Split comma-separated names of baseline policies; "none" is an empty list, and None means the default set."""
    if names is None:
        return None
    return [] if names == "none" else [name.strip() for name in names.split(",")]
