"""`guiderail study`: trains where it has to, judges after every mark, and writes a row for each.

Each seed has rows of its own: what failed on one is not averaged away. A study that was interrupted goes on where it
was, and figures use the same runs. An engine runs the jobs; the rows are the same from each.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
from rich.console import Console

from guiderail.models.common.errors import InputError, RunsFailedError
from guiderail.models.common.registry import did_you_mean
from guiderail.models.policy import Policy
from guiderail.tools.environments import (
    changed_environment,
    check_reset,
    import_modules,
    make_environment,
    task_content,
)
from guiderail.tools.evaluation.baselines import constant_policy, make_baseline
from guiderail.tools.evaluation.cache import load_or_compute
from guiderail.tools.evaluation.evaluate import evaluate_run
from guiderail.tools.evaluation.metrics import summary
from guiderail.tools.evaluation.rollout import PolicyFn, check_compatible, rollout
from guiderail.tools.experiments.declaration import LEARNED, EvalSet, Ratio, Study
from guiderail.tools.experiments.engines.engine import Engine, Outcome, make_engine
from guiderail.tools.experiments.progress import Board
from guiderail.tools.experiments.sweep import broken, draw_sweeps
from guiderail.tools.experiments.worker import Attempt
from guiderail.tools.files import write_atomically
from guiderail.tools.learning.run_folder import RunConfig, RunFolder, as_arguments, installed_versions
from guiderail.tools.learning.train import configure, with_defaults
from guiderail.tools.tables import write_table
from research.thesis import describe_differences

BEST_CONSTANT = "best_constant"
SELECTION_EPISODES = 10  # of each constant, not held out, before the best one is judged

TRAINING = (
    "episodes", "success_rate", "success_rate_last_10", "episodes_to_convergence", "mean_return_last_10", "mean_force",
    "mean_squared_force", "mean_squared_force_since_converged", "peak_force", "max_commanded_violation",
    "max_measured_violation", "violating_episodes", "measured_violating_episodes", "collisions",
    "ended_in_success", "ended_in_collision", "ended_in_spill", "fallback_steps", "jerk_commanded_linear_first_10",
    "jerk_commanded_angular_first_10", "jerk_measured_linear_first_10", "total_steps", "wall_time",
)  # fmt: skip
JUDGED = (
    "episodes", "success_rate", "success_low", "success_high", "mean_return", "mean_steps", "mean_force",
    "mean_squared_force", "peak_force", "max_commanded_violation", "violating_episodes", "collisions",
    "ended_in_collision", "ended_in_spill",
)  # fmt: skip


@dataclass(frozen=True)
class Job:
    """One method of a study, one seed."""

    study: Study
    method: str
    seed: int
    out: Path

    @property
    def learns(self) -> bool:
        """Whether there is a run at all."""
        return self.study.methods[self.method].policy == LEARNED

    @property
    def after_episodes(self) -> list[int]:
        """Training episodes after which it is judged; 0 for what doesn't learn.

        Raises:
            InputError: if nobody says how many.
        """
        if not self.learns:
            return [0]
        own, common = self.study.methods[self.method].learner.episodes, self.study.learner.episodes
        episodes = own or common or max(self.study.after_episodes, default=0)
        if not episodes:
            raise InputError(f"how long does {self.method} learn? give the study marks, or its learner episodes")
        return sorted({mark for mark in self.study.after_episodes if mark < episodes} | {episodes})

    def config(self, episodes: int) -> RunConfig:
        """Its run of so many episodes.

        Raises:
            InputError: for an unknown name or a number out of range.
        """
        study, method = self.study, self.study.methods[self.method]
        choices = [study.learner, method.learner]
        given = {k: v for c in choices for k in ("algorithm", "preset") if (v := getattr(c, k)) is not None}
        given["settings"] = {**study.learner.settings, **method.learner.settings}
        environment, given = {**study.env, **method.env}, with_defaults(study.task, given)
        given |= {"imports": study.imports, "seed": self.seed}
        return configure(study.task, environment, episodes=max(episodes, 1), **given)

    @cached_property
    def folder(self) -> RunFolder:
        """Where its run is, and what was evaluated of it."""
        config = self.config(self.after_episodes[-1])
        words = {"method": self.method, "seed": self.seed, "episodes": config.episodes}
        return RunFolder(self.out / self.study.folder.format(**words, algorithm=config.learner.algorithm))

    @property
    def log(self) -> Path:
        """Who worked on it, and why it failed."""
        return self.out / "logs" / f"{self.study.name}-{self.method}-{self.seed}.txt"


def run_study(study: Study, out: Path, engine: Engine | None = None, console: Console | None = None) -> pd.DataFrame:
    """Runs what is not there yet and returns a row for each method, seed, mark and what is judged on, in this order.

    Args:
        study: what to run.
        out: the folder; runs in it are used again, and those that were interrupted go on.
        engine: what runs them; two processes unless given.
        console: is told how far it is; standard error unless given.

    Raises:
        InputError: before anything is written, if something makes no sense or a folder holds another run.
        RunsFailedError: at the end, if some failed.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file: name a folder with --out")
    # Workers may be elsewhere: what is relative to this process is made absolute.
    study, out = study.model_copy(update={"imports": import_modules(study.imports)}), out.absolute()
    jobs = [
        Job(study, name, seed, out) for name, method in study.methods.items() for seed in method.seeds or study.seeds
    ]
    _check_ratios(study)
    for job in jobs:
        _check(job)
    _refuse_shared_folders(jobs)
    outcomes = _outcomes(jobs, engine or make_engine(), console)
    rows = pd.DataFrame([row for index in range(len(jobs)) for row in outcomes[index].rows], dtype=object)
    failed = [
        f"{job.method}, seed {job.seed}, failed: {outcomes[index].failure}"
        for index, job in enumerate(jobs)
        if outcomes[index].failure
    ]
    if failed:
        raise RunsFailedError(failed, rows)
    return rows


def study_command(study: Study, out: Path, engine: Engine | None = None, table: str | None = None) -> dict[str, Any]:
    """Runs a study, writes a table, `.csv` and `.md`, and says what the rows come to, each seed by itself.

    The table has the study's name unless another is given, as to a part of a study.

    `differs_from_thesis` says in what, by the methods that do.

    Where runs failed, the table has the others, and `failed` says what became of these.
    """
    result: dict[str, Any] = {}
    try:
        rows = run_study(study, out, engine)
    except RunsFailedError as error:
        rows, result["failed"] = error.rows, error.sentences
        if not len(rows):
            return result
    result["table"] = str(write_table(out / (table or study.name), rows.drop(columns="folder")))
    if study.sweeps:
        result["picture"] = str(draw_sweeps(study, rows, out / f"{table or study.name}.png"))
        result |= broken(study, rows)
    for (method, mark, judged), group in rows.groupby(["method", "after_episodes", "eval_set"], sort=False):
        after = f" after {mark} episodes" if mark else ""
        if judged:
            result[f"{method}{after}, {judged}, success of each seed"] = each(group, "success_rate", "{:.0%}")
        if mark:
            result[f"{method}{after}, converged after, each seed"] = each(group, "training_episodes_to_convergence")
    for one in study.ratios:
        result |= ratio(rows, one)
    result["differs_from_thesis"] = differing(study)
    return result


ALL = "all methods"


def differing(study: Study) -> dict[str, list[str]]:
    """In what methods differ from the thesis: first all of them, then those that differ in the same things besides."""
    told = {method: differences_of(study, method) for method in study.methods}
    first, *others = told.values()
    common = [words for words in first if all(words in other for other in others)]
    own: dict[tuple[str, ...], list[str]] = {}
    for method, words in told.items():
        own.setdefault(tuple(one for one in words if one not in common), []).append(method)
    found = {ALL: common} if common else {}
    return found | {", ".join(methods): list(words) for words, methods in own.items() if words}


def differences_of(study: Study, method: str) -> list[str]:
    """In what a method differs from the thesis, in words; without a learner's settings where nobody learns."""
    job = Job(study, method, study.seeds[0], Path())
    return describe_differences(job.config(job.after_episodes[-1]), learns=job.learns)


def each(rows: pd.DataFrame, column: str, form: str = "{}") -> str:
    """A column of every seed: failures of single seeds are not averaged away."""
    return ", ".join("never" if pd.isna(value) else form.format(value) for value in rows[column])


def ratio(rows: pd.DataFrame, wanted: Ratio) -> dict[str, str]:
    """A column of one method as a part of another's, each seed and all together; nothing where any is missing."""
    of, against = (rows[rows["method"] == method] for method in (wanted.method, wanted.against))
    if not len(of) or of["seed"].tolist() != against["seed"].tolist():
        return {}
    part, whole = (one[wanted.of].to_numpy(float) for one in (of, against))
    words = f"{wanted.of.replace('_', ' ')} of {wanted.method} as a part of {wanted.against}'s"
    return {
        f"{words}, each seed": ", ".join(f"{value:.2f}" for value in part / whole),
        f"{words}, all seeds together": f"{part.sum() / whole.sum():.2f}",
    }


def _check_ratios(study: Study) -> None:
    known = {*JUDGED, *(f"training_{name}" for name in (*TRAINING, *study.statistics))}
    for one in study.ratios:
        if one.of not in known:
            raise InputError(f"the study {study.name} has no column {one.of!r}: {did_you_mean(one.of, known)}")


def _outcomes(jobs: list[Job], engine: Engine, console: Console | None) -> dict[int, Outcome]:
    """What became of each job; those that only have to be read are read here."""
    done = {index: job for index, job in enumerate(jobs) if _is_done(job)}
    to_run = {index: job for index, job in enumerate(jobs) if index not in done}
    outcomes: dict[int, Outcome] = {}
    with Board(to_run, len(jobs), console) as board:
        for index, job in done.items():
            try:
                outcomes[index] = Outcome(tuple(run_job(job)))
            except InputError as error:
                outcomes[index] = Outcome(failure=str(error))
            board.end(index, job, outcomes[index])
        if to_run:
            with engine:
                _make_log_folder(jobs[0])
                for index, outcome in engine.run(Attempt(run_job, installed_versions()), to_run):
                    outcomes[index] = outcome
                    board.end(index, jobs[index], outcome)
    return outcomes


def _make_log_folder(job: Job) -> None:
    try:
        job.log.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{job.out} cannot be written ({error.strerror}): name another folder with --out") from error


def _check(job: Job) -> None:
    """Refuses what makes no sense before anything runs."""
    config, policy = job.config(job.after_episodes[-1]), job.study.methods[job.method].policy
    if policy not in (LEARNED, BEST_CONSTANT):
        make_baseline(job.study.task, policy)
    for judged in job.study.judgements:
        sampled = {name: low for name, (low, _) in judged.sampled.items()}
        where = changed_environment(config.task, config.environment, judged.env)
        configure(job.study.task, where | sampled, episodes=1)
        check_reset(job.study.task, judged.options)
    for mark, judged in itertools.product(job.after_episodes, job.study.judgements):
        _refuse_other_rows(job, _evaluated_file(job, mark, judged), judged, mark)
    if (job.folder.path / "config.yaml").exists():
        job.folder.refuse_another(config)
        for mark in job.after_episodes:
            if not all(_evaluated_file(job, mark, judged).exists() for judged in job.study.judgements):
                _refuse_gone(job, mark)
    elif job.learns:
        job.folder.refuse_existing()


def _refuse_shared_folders(jobs: list[Job]) -> None:
    """Two workers that write one run would each destroy what the other did."""
    known: dict[Path, Job] = {}
    for job in jobs:
        other = known.setdefault(job.folder.path, job)
        if other is not job:
            raise InputError(
                f"{job.folder.path} would hold both runs of {other.method}, seed {other.seed} and of {job.method}, "
                f"seed {job.seed}: write the study's folder with {{method}} and {{seed}}"
            )


def _refuse_gone(job: Job, mark: int) -> None:
    """A policy that was learned on, and of which no copy was made, can't be judged any more."""
    table = job.folder.path / "episodes.csv"
    if table.exists() and len(job.folder.episodes()) > mark and not _policy_folder(job, mark).exists():
        raise InputError(
            f"the run in {job.folder.path} went on learning after episode {mark}, and its policy of then is gone: "
            "leave that mark out, or train anew in another folder"
        )


def run_job(job: Job) -> list[dict[str, Any]]:
    """The rows of a job; it is trained and judged where it isn't yet."""
    import_modules(job.study.imports)
    rows = []
    for mark in job.after_episodes:
        trained = _train(job, mark).iloc[:mark]
        algorithm = job.config(mark).learner.algorithm if job.learns else ""
        policy = job.study.methods[job.method].policy
        row = {"method": job.method, "policy": policy, "algorithm": algorithm, "seed": job.seed, "after_episodes": mark}
        training = summary(trained, (*TRAINING, *job.study.statistics), "training_", job.study.task)
        training["folder"] = str(job.folder.path)
        for judged in job.study.judgements:
            rows.append(row | {"eval_set": judged.name} | summary(_evaluated(job, mark, judged), JUDGED) | training)
        if not job.study.judgements:
            rows.append(row | {"eval_set": ""} | training)
    return rows


def _is_done(job: Job) -> bool:
    """Whether its rows only have to be read."""
    evaluated = (_evaluated_file(job, mark, judged) for mark in job.after_episodes for judged in job.study.judgements)
    return all(file.exists() for file in evaluated) and not any(_is_to_train(job, mark) for mark in job.after_episodes)


def _is_to_train(job: Job, mark: int) -> bool:
    """Whether a run has not come as far as a mark."""
    folder = job.folder
    if not job.learns or (_policy_folder(job, mark) / "policy.json").exists():
        return False
    done = len(folder.episodes()) if (folder.path / "episodes.csv").exists() else 0
    complete = done == mark == folder.config().episodes and (folder.path / "policy.json").exists() if done else False
    return done <= mark and not complete


def _train(job: Job, mark: int) -> pd.DataFrame:
    """The episodes of a run that has come at least as far as a mark, whose policy is copied."""
    if not job.learns:
        return pd.DataFrame()
    folder, copy = job.folder, _policy_folder(job, mark)
    if _is_to_train(job, mark):
        from guiderail.tools.learning.trainer import run_training

        config = job.config(mark)
        shows = make_baseline(config.task, "scripted") if config.learner.demonstration_episodes else None
        run_training(folder, config, resume=(folder.path / "config.yaml").exists(), demonstrator=shows)
    rows = folder.episodes()
    if len(rows) == mark and not (copy / "policy.json").exists():
        for name in ("policy.safetensors", "policy.json"):
            write_atomically(copy / name, (folder.path / name).read_bytes())
    return rows


def _policy_folder(job: Job, mark: int) -> Path:
    return job.folder.path / "after_episodes" / str(mark)


def _digest(job: Job, judged: EvalSet | None = None, mark: int = 0) -> str:
    """What a file was evaluated with: other episodes of the same name, another method's, or those of a policy that
    learned longer, are not taken for these.
    """
    method = job.study.methods[job.method].model_dump_json(include={"policy", "grid"})
    said = "" if judged is None else judged.model_dump_json(exclude={"name", "file"})
    # As resolved: what a difficulty stands for may change, and what was evaluated before is then another task.
    where = job.config(1).environment
    if judged is not None and "difficulty" in judged.env:
        where = changed_environment(job.study.task, where, judged.env)
    content = task_content(job.study.task, where, job.study.imports)
    environment = json.dumps(where, sort_keys=True, default=str) + content
    told = said + method + environment + job.study.task
    if judged is not None and mark and "{after_episodes}" not in judged.file:
        told += f"mark {mark}"
    if "{seed}" not in job.study.folder:
        told += f"seed {job.seed}"
    return hashlib.blake2b(told.encode(), digest_size=4).hexdigest()


def _evaluated(job: Job, mark: int, judged: EvalSet) -> pd.DataFrame:
    """Rows of held-out episodes, from the file where they are known already."""
    file = _evaluated_file(job, mark, judged)
    _refuse_other_rows(job, file, judged, mark)

    def evaluated() -> pd.DataFrame:
        rows = _evaluate(job, mark, judged)
        if "{digest}" not in judged.file:
            write_atomically(_says_of_what(file), _digest(job, judged, mark).encode())
        return rows

    return load_or_compute(file, evaluated)


def _says_of_what(file: Path) -> Path:
    """What stands beside a table of episodes whose name doesn't say which they are."""
    return file.with_name(f".{file.name}.digest")


def _refuse_other_rows(job: Job, file: Path, judged: EvalSet, mark: int) -> None:
    """Another study's rows of the same name are not taken for these."""
    says = _says_of_what(file)
    if "{digest}" not in judged.file and says.exists() and says.read_text() != _digest(job, judged, mark):
        raise InputError(
            f"{file} holds episodes of another study, of other settings or after other training: name another folder "
            "with --out, or write {after_episodes} and {digest} into the file's name"
        )


def _evaluated_file(job: Job, mark: int, judged: EvalSet) -> Path:
    words = {"name": judged.name.replace(" ", "_"), "after_episodes": mark, "episodes": judged.episodes}
    return job.folder.path / judged.file.format(**words, digest=_digest(job, judged, mark))


def _evaluate(job: Job, mark: int, judged: EvalSet) -> pd.DataFrame:
    config, policy = job.config(mark), _policy(job, mark)
    environment = as_arguments(changed_environment(config.task, config.environment, judged.env))
    every, tables = judged.every if judged.sampled else judged.episodes, []
    for done in range(0, judged.episodes, every):
        rng, number = np.random.default_rng([judged.first_seed, done]), min(every, judged.episodes - done)
        sampled = {name: float(rng.uniform(low, high)) for name, (low, high) in judged.sampled.items()}
        how: dict[str, Any] = {"episodes": number, "seed": judged.first_seed + done, "options": judged.options}
        rows = evaluate_run(config, policy, environment | sampled, **how)
        tables.append(rows.assign(episode=rows["episode"] + done, **sampled))
    return pd.concat(tables, ignore_index=True)


def _policy(job: Job, mark: int) -> Callable[[gymnasium.Env], PolicyFn]:
    """What acts, for an environment."""
    name = job.study.methods[job.method].policy
    if name == LEARNED:
        _refuse_gone(job, mark)
        learned = Policy.load(_policy_folder(job, mark))
        return partial(check_compatible, learned)
    if name == BEST_CONSTANT:
        best = _best_constant(job)
        return lambda env: constant_policy(env, best)
    return make_baseline(job.study.task, name, job.seed)


def _best_constant(job: Job) -> np.ndarray:
    """The constant action of a grid with the most successes, then the highest return, on what training would meet."""
    file = job.folder.path / f"best_constant-{_digest(job)}.csv"

    def tried() -> pd.DataFrame:
        config, grid = job.config(1), job.study.methods[job.method].grid
        env = make_environment(config.task, config.environment)
        rows = []
        for action in itertools.product(grid, repeat=int(np.prod(env.action_space.shape or ()))):
            env.reset(seed=config.seed)
            found = pd.DataFrame(
                [rollout(env, constant_policy(env, np.array(action))) for _ in range(SELECTION_EPISODES)]
            )
            numbers = {f"action_{i}": value for i, value in enumerate(action)}
            rows.append(numbers | summary(found, ("success_rate", "mean_return")))
        env.close()
        return pd.DataFrame(rows).sort_values(["success_rate", "mean_return"], ascending=False, kind="stable")

    best = load_or_compute(file, tried).iloc[0]
    return best.filter(like="action_").to_numpy(float)
