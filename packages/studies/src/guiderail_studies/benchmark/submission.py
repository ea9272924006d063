"""Submissions: folders of policies and tables that others can verify without executing anything of them."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pydantic import Field, ValidationError

from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.files import read_bytes, write_atomically
from guiderail.models.policy import Policy
from guiderail.tools.environments import check_environment, flat_environment, make_environment
from guiderail.tools.evaluation.policies import check_compatible
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.files import atomic_folder, check_new
from guiderail.tools.learning.run_folder import installed_versions
from guiderail.tools.tables import read_table, table_text
from guiderail_studies.benchmark.protocol import (
    EVALUATED_FILE,
    BenchmarkMethod,
    Protocol,
    check_method_name,
    load_protocol,
)
from guiderail_studies.benchmark.run import check_digests, finished_runs, run_row, stored_method
from guiderail_studies.declaration import Strict

FORMAT = "guiderail benchmark submission 1"
SUBMISSION, TABLE, TRAINING_FILE = "submission.json", "table.csv", "training.csv"
WEIGHTS = "policy.safetensors"
POLICY_FILES = ("policy.json", WEIGHTS)
RUN_FILES = (*POLICY_FILES, TRAINING_FILE, EVALUATED_FILE)
MAX_SIZE = 2_000_000  # largest size of `submission.json` [bytes]
MAX_FILE_SIZE = 200_000_000  # largest size of a file of a run [bytes]
SAMPLE = 5  # default number of episodes of each run that are repeated


class Submission(Strict):
    """Content of a submission's `submission.json`."""

    format: str
    protocol: int
    digests: dict[str, str]  # digest of each task's rules, by task
    method: BenchmarkMethod
    versions: dict[str, str]  # versions of the packages that the episodes depend on
    files: dict[str, str]  # digest of every other file, by its path
    processor: str = Field("", max_length=200)  # processors of other types round differently


def file_digest(path: Path) -> str:
    """Return the digest of a file of a submission; raise an InputError if it is missing or too large."""
    return hashlib.blake2b(read_bytes(path, "file", MAX_FILE_SIZE), digest_size=16).hexdigest()


def submit(runs: Path, out: Path) -> dict[str, Any]:
    """Write the submission of the finished runs of a method.

    Args:
        runs: Folder that `guiderail benchmark run` wrote.
        out: Folder to write; it must not exist.

    Returns:
        `submission`, the folder, and the numbers of runs by task.

    Raises:
        InputError: If no run is finished, or the folder cannot be written.
    """
    check_new(out, "submission")
    protocol, method, digests = stored_method(runs)
    rows: list[dict[str, Any]] = []
    with atomic_folder(out) as folder:
        for run in finished_runs(protocol, method, runs):
            target = folder / run.task / str(run.seed)
            target.mkdir(parents=True)
            for name in POLICY_FILES:
                shutil.copyfile(run.policy / name, target / name)
            for name, table in ((TRAINING_FILE, run.training), (EVALUATED_FILE, run.evaluated)):
                write_atomically(target / name, table_text(table).encode())
            rows.append(run.row)
        if not rows:
            raise InputError(f"{runs} has no finished run: finish guiderail benchmark run first")
        write_atomically(folder / TABLE, table_text(rows).encode())
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        submission = Submission(
            format=FORMAT,
            protocol=protocol.version,
            digests={name: digests[name] for name in dict.fromkeys(row["task"] for row in rows)},
            method=method.model_copy(update={"imports": ()}),
            versions=installed_versions(),
            files={path.relative_to(folder).as_posix(): file_digest(path) for path in files},
            processor=processor(),
        )
        write_atomically(folder / SUBMISSION, submission.model_dump_json(indent=1).encode())
    counts = pd.Series([row["task"] for row in rows]).value_counts(sort=False)
    return {"submission": str(out), **{f"{task}, runs": int(number) for task, number in counts.items()}}


def processor() -> str:
    """Return the name of this machine's processor."""
    import platform

    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def read_submission(folder: Path) -> tuple[Submission, Protocol]:
    """Return a submission and its protocol, after checking that its files are those that it was written with.

    Nothing is executed: `submission.json` and tables are text, and policies are arrays of numbers.

    Raises:
        InputError: If a file is missing, damaged, a link or not part of the submission, the protocol is unknown, the
            method has the name of another one of this package, or two seeds have the same policy.
    """
    file = folder / SUBMISSION
    if not folder.is_dir() or not file.is_file():
        raise InputError(f"there is no {SUBMISSION} in {folder}: name a folder that guiderail benchmark submit wrote")
    for path in folder.rglob("*"):
        if path.is_symlink():
            raise InputError(f"{path} is a link: replace it by the file")
    try:
        submission = Submission.model_validate(json.loads(read_bytes(file, "submission", MAX_SIZE)))
    except (ValueError, ValidationError, RecursionError) as error:
        raise InputError(f"{file} is damaged or of another version: submit again") from error
    if submission.format != FORMAT:
        raise InputError(f"{file} has another format than {FORMAT!r}: submit again with this version of guiderail")
    protocol = load_protocol(submission.protocol)
    check_method_name(submission.method, file)
    check_digests(protocol, submission.digests, folder)
    found = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()} - {SUBMISSION}
    runs = _runs(submission, protocol)
    if not runs:
        raise InputError(f"{file} names no run of protocol {protocol.version}: submit again")
    expected = {TABLE, *(f"{task}/{seed}/{name}" for task, seed in runs for name in RUN_FILES)}
    if missing := sorted((expected | set(submission.files)) - found):
        raise InputError(f"{folder} lacks the file {brief(missing[0])}: submit again")
    if further := sorted(found - expected) or sorted(found - set(submission.files)):
        raise InputError(f"{folder} has a file that is not part of it, {brief(further[0])}: submit again")
    if different := sorted({*submission.digests} ^ {task for task, _ in runs}):
        raise InputError(f"{file} has runs or rules, but not both, of the task {brief(different[0])}: submit again")
    for name, digest in submission.files.items():
        if file_digest(folder / name) != digest:
            raise InputError(f"{folder / name} was changed after the submission was written: submit again")
    policies: dict[tuple[str, str], int] = {}
    for task, seed in runs:
        other = policies.setdefault((task, submission.files[f"{task}/{seed}/{WEIGHTS}"]), seed)
        if other != seed:
            raise InputError(f"{folder} has the same policy of {task} for seeds {other} and {seed}: train each seed")
    return submission, protocol


def _runs(submission: Submission, protocol: Protocol) -> list[tuple[str, int]]:
    """Return task and seed of each run that a submission names."""
    runs = []
    for task in protocol.tasks:
        for seed in protocol.seeds:
            if any(name.startswith(f"{task}/{seed}/") for name in submission.files):
                runs.append((task, seed))
    return runs


def read_table_of(folder: Path, submission: Submission, protocol: Protocol) -> pd.DataFrame:
    """Return the table of a submission, after computing it again from the episodes.

    Raises:
        InputError: If the numbers of episodes are not those of the protocol, or the table has other values.
    """
    stored = read_table(folder / TABLE)
    rows = []
    seconds = stored["core_seconds"].tolist() if "core_seconds" in stored else []
    runs = _runs(submission, protocol)
    if len(seconds) != len(runs):
        raise InputError(f"{folder / TABLE} has {len(seconds)} rows for {len(runs)} runs: submit again")
    for (task, seed), duration in zip(runs, seconds, strict=True):
        training, evaluated = (read_table(folder / task / str(seed) / name) for name in (TRAINING_FILE, EVALUATED_FILE))
        for table, number, kind in (
            (training, protocol.tasks[task].episodes, "training"),
            (evaluated, protocol.episodes, "held-out"),
        ):
            if len(table) != number:
                raise InputError(
                    f"{task}, seed {seed}, has {len(table)} {kind} episodes instead of {number}: finish the run"
                )
        rows.append(run_row(task, seed, training, evaluated, float(duration)))
    for name, values in pd.DataFrame(rows).items():
        if name not in stored or [*map(_key, stored[name])] != [*map(_key, values)]:
            raise InputError(f"{folder / TABLE} has other values of {name} than its episodes: submit again")
    return pd.DataFrame(rows)


def _key(value: Any) -> Any:
    """Return a number for exact comparison, in which NaN equals NaN."""
    if isinstance(value, str):
        return value
    return "nan" if value is None or math.isnan(value) else float(value)


def verify(
    folder: Path, *, episodes: int = SAMPLE, seed: int | None = None, log: Callable[[str], object] = print
) -> dict[str, Any]:
    """Repeat a sample of a submission's held-out episodes, which must agree bit for bit, and compute its table again.

    The training episodes cannot be repeated without the learner's code, which is not executed: only the table's
    agreement with them is checked.

    Args:
        folder: Submission.
        episodes: Number of held-out episodes of each run that are repeated.
        seed: Seed of the sample; by default another sample in each call.
        log: Function that prints the progress.

    Returns:
        `verified`, the number of repeated episodes; `runs`, the number of runs.

    Raises:
        InputError: If a file or a choice is refused, or a repeated episode differs.
    """
    submission, protocol = read_submission(folder)
    table = read_table_of(folder, submission, protocol)
    if not 1 <= episodes <= protocol.episodes:
        raise InputError(f"--episodes is from 1 to {protocol.episodes}, not {episodes}")
    rng = np.random.default_rng(seed)
    for task, run_seed in _runs(submission, protocol):
        sample = sorted(rng.choice(protocol.episodes, episodes, replace=False).tolist())
        environment = submission_environment(protocol, submission.method, task)
        where = folder / task / str(run_seed)
        stored = read_table(where / EVALUATED_FILE).to_dict("records")
        for row in repeat_episodes(protocol, task, environment, Policy.load(where), run_seed, sample):
            expected = stored[row["episode"]]
            if changed := _differences(row, expected):
                name = changed[0]
                raise InputError(
                    f"{task}, seed {run_seed}, episode {row['episode']} has {name} {brief(row.get(name))}, and the "
                    f"submission states {brief(expected.get(name))}: it is refused{_other_origin(submission)}"
                )
        log(f"{task}, seed {run_seed}: episodes {', '.join(map(str, sample))} agree")
    return {"verified": episodes * len(table), "runs": len(table)}


def _other_origin(submission: Submission) -> str:
    """Return the versions and the processor of a submission that differ here, because they can change the episodes."""
    here = installed_versions() | {"processor": processor()}
    there = submission.versions | {"processor": submission.processor}
    other = [f"{name} {brief(there.get(name))}" for name, value in here.items() if there.get(name) != value]
    return f"; it was run with {', '.join(other)}, unlike here" if other else ""


def submission_environment(protocol: Protocol, method: BenchmarkMethod, task: str) -> dict[str, Any]:
    """Return all options of the environment of a method on a task; raise an InputError if a choice is not allowed."""
    name = protocol.resolve_task(task)[0]
    choices = protocol.check_choices(task, method.environment(task))
    return check_environment(name, flat_environment(name, protocol.tasks[task].env) | choices)


def repeat_episodes(
    protocol: Protocol, task: str, environment: Mapping[str, Any], policy: Policy, seed: int, sample: list[int]
) -> Iterator[dict[str, Any]]:
    """Yield the rows of held-out episodes of a run, given by their numbers."""
    with closing(make_environment(protocol.resolve_task(task)[0], environment)) as env:
        env.reset(seed=seed)  # samples the hidden values of the run, as training does
        act = check_compatible(policy, env)
        for number in sample:
            yield rollout(env, act, index=number, seed=protocol.first_seed + number, held_out=True)


def _differences(row: Mapping[str, Any], expected: Mapping[Any, Any]) -> list[str]:
    """Return the names of the columns in which an episode differs from the stored one."""
    names = [*row, *(name for name in expected if name not in row)]
    return [name for name in names if name not in expected or _key(row.get(name)) != _key(expected[name])]
