"""Job of a study: trains and evaluates one method with one seed, in a folder of its own.

The state of a job is in its folder: an interrupted job resumes from it, and a finished job only reads its tables. Each
attempt of a worker is logged.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import re
import socket
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pandas as pd

from guiderail.diagrams.envs.options import flat_options, validate_options
from guiderail.diagrams.tasks.registry import TASKS
from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.environments import (
    changed_environment,
    check_environment,
    flat_environment,
    make_environment,
    task_content,
)
from guiderail.tools.evaluation.baselines import constant_policy, make_baseline
from guiderail.tools.evaluation.episode import PolicyFn
from guiderail.tools.evaluation.evaluate import evaluate_run
from guiderail.tools.evaluation.evaluation import load_or_compute, read_complete
from guiderail.tools.evaluation.metrics import summary
from guiderail.tools.evaluation.policies import check_compatible
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.files import write_atomically
from guiderail.tools.imports import import_modules
from guiderail.tools.learning.run_folder import RunConfig, RunFolder, as_arguments, configure, installed_versions
from guiderail_studies.declaration import LEARNED, EvalSet, Study
from guiderail_studies.engines.engine import Outcome

BEST_CONSTANT = "best_constant"
CPU_TIME = " CPU time "  # begins the line with the CPU time of an attempt in the log of a job
BEGIN = " begins on "  # marks each attempt of a worker in the log of a job
RUN_FILES = ("config.yaml", "episodes.csv", "policy.json", "policy.safetensors", "checkpoint", "steps", "logs")
SELECTION_EPISODES = 10  # training episodes of each constant action, to select the best action

# Statistics of the training episodes in the table; their columns begin with `training_`.
TRAINING = (
    "episodes", "success_rate", "success_rate_last_10", "episodes_to_convergence", "mean_return_last_10", "mean_force",
    "mean_squared_force", "mean_squared_force_since_converged", "peak_force", "max_commanded_violation",
    "max_measured_violation", "violating_episodes", "measured_violating_episodes", "collisions",
    "ended_in_success", "ended_in_collision", "ended_in_spill", "fallback_steps", "jerk_commanded_linear_first_10",
    "jerk_commanded_angular_first_10", "jerk_measured_linear_first_10", "total_steps", "wall_time",
)  # fmt: skip
# Statistics of the evaluated episodes in the table.
EVALUATED = (
    "episodes", "success_rate", "success_low", "success_high", "mean_return", "mean_steps", "mean_force",
    "mean_squared_force", "peak_force", "max_commanded_violation", "violating_episodes", "collisions",
    "ended_in_collision", "ended_in_spill",
)  # fmt: skip


@dataclass(frozen=True)
class Job:
    """One method of a study with one seed."""

    study: Study
    method: str  # name of the method
    seed: int  # seed of training
    out: Path  # folder of the study

    @property
    def learns(self) -> bool:
        """True if the job trains a policy; False for a baseline policy."""
        return self.study.methods[self.method].policy == LEARNED

    @property
    def after_episodes(self) -> list[int]:
        """Numbers of training episodes after which the policy is evaluated; [0] without training."""
        if not self.learns:
            return [0]
        own, common = self.study.methods[self.method].learner.episodes, self.study.learner.episodes
        episodes = own or common or max(self.study.after_episodes, default=0)
        if not episodes:
            raise InputError(
                f"{self.method} needs a number of training episodes: give after_episodes or learner episodes"
            )
        return sorted({number for number in self.study.after_episodes if number < episodes} | {episodes})

    def config(self, episodes: int) -> RunConfig:
        """Return the configuration of the run with a number of episodes; raise an InputError as `configure` does."""
        study, method = self.study, self.study.methods[self.method]
        choices = [study.learner, method.learner]
        chosen = {k: getattr(c, k) for c in choices for k in ("algorithm", "preset") if k in c.model_fields_set}
        given: dict[str, Any] = {k: v for k, v in chosen.items() if v is not None}
        settings = flat_options(study.learner.settings) | flat_options(method.learner.settings)
        if "init_from" in settings:  # the run of another method of the study
            settings["init_from"] = str(self.out / settings["init_from"].format(seed=self.seed))
        given["settings"] = settings
        of_study, of_method = (flat_environment(study.task, env) for env in (study.env, method.env))
        environment, given = {**of_study, **of_method}, given
        given |= {"imports": study.imports, "seed": self.seed}
        config = configure(study.task, environment, episodes=max(episodes, 1), **given)
        if config.learner.stop_after_successes:
            raise InputError("the runs of a study have equal lengths: leave the setting stop_after_successes out")
        return config

    @cached_property
    def folder(self) -> RunFolder:
        """Folder of the run and of its evaluated episodes."""
        config = self.config(self.after_episodes[-1])
        name = self.study.folder.format(
            method=self.method, seed=self.seed, episodes=config.episodes, algorithm=config.learner.algorithm
        )
        return RunFolder(self.out / name)

    @cached_property
    def source(self) -> RunFolder | None:
        """Run from which training starts (`init_from`); None without such a run."""
        path = getattr(self.config(1).learner, "init_from", "") if self.learns else ""
        return RunFolder(path) if path else None

    @cached_property
    def source_job(self) -> Job | None:
        """Job that trains the source run, also if the study is a subset without its method; None without such a job."""
        if self.source is None:
            return None
        whole = self.study.model_copy(update={"methods": self.study.all_methods})
        for name, method in whole.methods.items():
            for seed in dict.fromkeys((self.seed, *(method.seeds or whole.seeds))):
                job = Job(whole, name, seed, self.out)
                if job.learns and job.folder.path.resolve() == self.source.path:
                    return job
        return None

    @property
    def log(self) -> Path:
        """Log file of the workers that ran the job."""
        return self.out / "logs" / f"{self.study.name}-{self.method}-{self.seed}.txt"

    def policy_folder(self, episodes: int) -> Path:
        """Return the folder with a copy of the policy after a number of episodes."""
        return self.folder.path / "after_episodes" / str(episodes)


def check_job(job: Job) -> None:
    """Raise an InputError if the declaration of a job is invalid for its task, or its folder holds another run."""
    config, policy = job.config(job.after_episodes[-1]), job.study.methods[job.method].policy
    if policy not in (LEARNED, BEST_CONSTANT):
        make_baseline(job.study.task, policy)
    for eval_set in job.study.eval_sets:
        environment = changed_environment(config.task, config.environment, eval_set.env)
        for end in (0, 1) if eval_set.sampled else (0,):
            sampled = {name: ends[end] for name, ends in eval_set.sampled.items()}
            configure(job.study.task, environment | sampled, episodes=1)
        _check_reset(job.study.task, eval_set.options)
    contents: dict[Path, str] = {}
    for episodes, eval_set in itertools.product(job.after_episodes, job.study.eval_sets):
        file, content = _evaluated_file(job, episodes, eval_set)
        if (first_part := file.relative_to(job.folder.path).parts[0]) in RUN_FILES:
            raise InputError(
                f"the evaluation set {eval_set.name!r} names {first_part}, which is reserved for the run: name another "
                "file"
            )
        if contents.setdefault(file, content) != content:
            raise InputError(
                f"the evaluation set {eval_set.name!r} has the same file, {file.name}, as other evaluated episodes: "
                "write {name}, {after_episodes} and {digest} into the file's name"
            )
        _refuse_other_rows(file, content, eval_set)
    if (job.folder.path / "config.yaml").exists():
        refuse_another(job.folder, config)
        for episodes in job.after_episodes:
            if not all(_is_evaluated(job, episodes, eval_set) for eval_set in job.study.eval_sets):
                _refuse_lost_policy(job, episodes)
    elif job.learns:
        job.folder.refuse_existing()


def refuse_another(folder: RunFolder, config: RunConfig) -> None:
    """Raise an InputError if the run of a folder has another task, environment, learner, seed or other task files.

    The path in `init_from` may differ if the state of that run is stored, because a study's folder may be moved.
    """
    stored = folder.config()
    stored.refuse_changed_task(folder.path)
    # An option that is missing in the stored configuration has its default.
    stored = replace(stored, environment=as_arguments(check_environment(stored.task, stored.environment)))
    learner: Any = stored.learner
    if stored.source and (path := getattr(config.learner, "init_from", "")):
        stored = replace(stored, learner=replace(learner, init_from=path))
    for key in ("task", "environment", "learner", "seed", "members"):
        if getattr(stored, key) != getattr(config, key):
            raise InputError(f"{folder.path} holds a run with another {key}: name another folder with --out")


def _check_reset(task: str, options: Mapping[str, Any]) -> None:
    """Raise an InputError if a reset option of a guiderail task is invalid; other tasks are not checked."""
    if task in TASKS.names():
        validate_options(TASKS.get(task).Reset, options, f"a reset of {task}")


def check_source(job: Job, *, is_source_selected: bool = False) -> str:
    """Return the state of the run that a job starts from; "" if there is no such run, or the job needs no training.

    With `is_source_selected`, that run may be unfinished, because the study trains it before the job.

    Raises:
        InputError: If that run is not finished, or its state differs from that at the start of the job's training.
    """
    if job.source is None:
        return ""
    stored = job.folder.config().source if (job.folder.path / "config.yaml").exists() else ""
    name, source = f"{job.method}, seed {job.seed}, starts from the run in {job.source.path}", job.source
    done = _num_episodes(source)
    episodes = done if job.source_job is None else job.source_job.after_episodes[-1]
    state = f"{source.path.name}, {episodes} episodes, "
    if done == episodes and (source.path / "policy.json").exists():
        state = source.state
    elif not (is_source_selected and done <= episodes):
        if not any(_needs_training(job, number) for number in job.after_episodes):
            return ""
        if done > episodes:
            raise InputError(f"{name}, which has {done} episodes instead of {episodes}: name another folder with --out")
        missing = f"has {done} of its {episodes} episodes" if done < episodes else "is missing or not finished"
        raise InputError(f"{name}, which {missing}: train that run first, with the same --out")
    if stored and not stored.startswith(state):
        raise InputError(
            f"{name}, which differs from the run that it was trained from ({stored}): name another folder with --out"
        )
    return state


def is_done(job: Job) -> bool:
    """Return True if a job is trained and evaluated, so that only its rows need to be read."""
    pairs = itertools.product(job.after_episodes, job.study.eval_sets)
    is_evaluated = all(_is_evaluated(job, *pair) for pair in pairs)
    return is_evaluated and not any(_needs_training(job, episodes) for episodes in job.after_episodes)


def run_job(job: Job) -> list[dict[str, Any]]:
    """Complete the training and evaluation of a job, and return its rows."""
    import_modules(job.study.imports)
    source, rows = check_source(job), []
    for episodes in job.after_episodes:
        trained = _train(job, episodes, source).iloc[:episodes]
        row = {
            "method": job.method,
            "policy": job.study.methods[job.method].policy,
            "algorithm": job.config(episodes).learner.algorithm if job.learns else "",
            "seed": job.seed,
            "after_episodes": episodes,
        }
        training = summary(trained, (*TRAINING, *job.study.statistics), "training_", job.study.task)
        training["folder"] = str(job.folder.path)
        for eval_set in job.study.eval_sets:
            evaluated = summary(_load_or_evaluate(job, episodes, eval_set), EVALUATED)
            rows.append(row | {"eval_set": eval_set.name} | evaluated | training)
        if not job.study.eval_sets:
            rows.append(row | {"eval_set": ""} | training)
    return rows


def _needs_training(job: Job, episodes: int) -> bool:
    """Return True if training must run to reach a number of episodes, or to write the policy after that number."""
    folder = job.folder
    if not job.learns:
        return False
    done = _num_episodes(folder)
    if (job.policy_folder(episodes) / "policy.json").exists():  # only rows of the table can be missing
        return done < episodes <= folder.num_saved_episodes()
    if done != episodes:
        return done < episodes
    return folder.config().episodes != done or not (folder.path / "policy.json").exists()


def _num_episodes(folder: RunFolder) -> int:
    """Return the number of training episodes in a run's table; 0 without a table."""
    return len(folder.episodes()) if (folder.path / "episodes.csv").exists() else 0


def _train(job: Job, episodes: int, source: str) -> pd.DataFrame:
    """Train the run to at least a number of episodes, copy its policy, and return its episodes.

    `source` is the state of the run that a new run starts from; see `check_source`.
    """
    if not job.learns:
        return pd.DataFrame()
    folder, copy = job.folder, job.policy_folder(episodes)
    if _needs_training(job, episodes):
        from guiderail.tools.learning.episodes import make_demonstrator
        from guiderail.tools.learning.trainer import run_training

        is_resumed = (folder.path / "config.yaml").exists()
        config = job.config(max(episodes, folder.num_saved_episodes()))
        config = replace(config, source=folder.config().source if is_resumed else source)
        run_training(folder, config, resume=is_resumed, demonstrator=make_demonstrator(config))
    rows = folder.episodes()
    if len(rows) < episodes:
        raise InputError(
            f"{folder.path / 'episodes.csv'} has {len(rows)} of {episodes} episodes: restore it, or name another "
            "folder with --out"
        )
    if len(rows) == episodes and not (copy / "policy.json").exists():
        for name in ("policy.safetensors", "policy.json"):
            write_atomically(copy / name, (folder.path / name).read_bytes())
    return rows


def _refuse_lost_policy(job: Job, episodes: int) -> None:
    """Raise an InputError if the run was trained beyond a number of episodes without a copy of its policy."""
    table = job.folder.path / "episodes.csv"
    if table.exists() and len(job.folder.episodes()) > episodes and not job.policy_folder(episodes).exists():
        raise InputError(
            f"the run in {job.folder.path} was trained for more than {episodes} episodes, and its policy after "
            f"{episodes} is lost: leave {episodes} out of after_episodes, or train again in another folder"
        )


def digest(job: Job, eval_set: EvalSet | None = None, episodes: int = 0) -> str:
    """Return the digest of everything that evaluated episodes depend on, for the name of their file.

    It contains the resolved environment, because the options that a difficulty sets may change. It does not contain the
    learner, because a run's folder has a run of one learner only. It contains the seed and the number of training
    episodes only if the names of folder and file do not contain them.
    """
    method = job.study.methods[job.method].model_dump_json(include={"policy", "grid"})
    evaluation = "" if eval_set is None else eval_set.model_dump_json(exclude={"name", "file"})
    environment = job.config(1).environment
    if eval_set is not None and "difficulty" in eval_set.env:
        environment = changed_environment(job.study.task, environment, eval_set.env)
    content = task_content(job.study.task, environment, job.study.imports)
    text = evaluation + method + json.dumps(environment, sort_keys=True, default=str) + content + job.study.task
    if eval_set is not None and episodes and "{after_episodes}" not in eval_set.file:
        text += f"after_episodes {episodes}"
    if "{seed}" not in job.study.folder:
        text += f"seed {job.seed}"
    return hashlib.blake2b(text.encode(), digest_size=4).hexdigest()


def _load_or_evaluate(job: Job, episodes: int, eval_set: EvalSet) -> pd.DataFrame:
    """Return the rows of held-out episodes from their file, or evaluate and write them."""
    file, content = _evaluated_file(job, episodes, eval_set)
    _refuse_other_rows(file, content, eval_set)

    def evaluate() -> pd.DataFrame:
        rows = _evaluate(job, episodes, eval_set)
        if "{digest}" not in eval_set.file:
            write_atomically(_digest_file(file), content.encode())
        return rows

    return load_or_compute(file, evaluate, eval_set.episodes)


def _evaluated_file(job: Job, episodes: int, eval_set: EvalSet) -> tuple[Path, str]:
    """Return the file and the digest of the episodes that evaluate a policy after `episodes` training episodes."""
    name = re.sub(r"[ /\\\0]", "_", eval_set.name).lstrip(".")  # one path component, inside the run's folder
    values = {"name": name, "after_episodes": episodes, "episodes": eval_set.episodes}
    content = digest(job, eval_set, episodes)
    return job.folder.path / eval_set.file.format(**values, digest=content), content


def _is_evaluated(job: Job, episodes: int, eval_set: EvalSet) -> bool:
    """Return True if all episodes of an evaluation set are stored, or their table is damaged: reading refuses it."""
    file = _evaluated_file(job, episodes, eval_set)[0]
    try:
        return read_complete(file, eval_set.episodes) is not None
    except InputError:
        return True


def _digest_file(file: Path) -> Path:
    """Return the hidden file with the digest of a table whose name does not contain it."""
    return file.with_name(f".{file.name}.digest")


def _refuse_other_rows(file: Path, content: str, eval_set: EvalSet) -> None:
    """Raise an InputError if a file of evaluated episodes was stored with a digest other than `content`."""
    stored = _digest_file(file)
    if "{digest}" not in eval_set.file and stored.exists() and stored.read_text() != content:
        raise InputError(
            f"{file} holds episodes of another study, of other settings or after other training: name another folder "
            "with --out, or write {after_episodes} and {digest} into the file's name"
        )


def _evaluate(job: Job, episodes: int, eval_set: EvalSet) -> pd.DataFrame:
    """Evaluate a policy after a number of training episodes, and return the rows of the evaluated episodes."""
    config, policy = job.config(episodes), _policy(job, episodes)
    environment = as_arguments(changed_environment(config.task, config.environment, eval_set.env))
    every, tables = eval_set.every if eval_set.sampled else eval_set.episodes, []
    for done in range(0, eval_set.episodes, every):
        rng, number = np.random.default_rng([eval_set.first_seed, done]), min(every, eval_set.episodes - done)
        sampled = {name: float(rng.uniform(low, high)) for name, (low, high) in eval_set.sampled.items()}
        seed = eval_set.first_seed + done
        kwargs: dict[str, Any] = {"episodes": number, "seed": seed, "options": eval_set.options}
        # `first_number=0`: a baseline's random actions do not depend on `first_seed`, as in the published tables.
        rows = evaluate_run(config, policy, environment | sampled, **kwargs, first_number=0)
        tables.append(rows.assign(episode=rows["episode"] + done, **sampled))
    return pd.concat(tables, ignore_index=True)


def _policy(job: Job, episodes: int) -> Callable[[gymnasium.Env], PolicyFn]:
    """Return a function from the environment to the policy."""
    name = job.study.methods[job.method].policy
    if name == LEARNED:
        _refuse_lost_policy(job, episodes)
        return partial(check_compatible, Policy.load(job.policy_folder(episodes)))
    if name == BEST_CONSTANT:
        best = _best_constant(job)
        return lambda env: constant_policy(env, best)
    return make_baseline(job.study.task, name, job.seed)


def _best_constant(job: Job) -> np.ndarray:
    """Return the constant action (A,) with the most successes, then the highest return, in training episodes."""
    file = job.folder.path / f"best_constant-{digest(job)}.csv"

    def compare() -> pd.DataFrame:
        config, grid = job.config(1), job.study.methods[job.method].grid
        env = make_environment(config.task, config.environment)
        rows = []
        for action in itertools.product(grid, repeat=int(np.prod(env.action_space.shape or ()))):
            env.reset(seed=config.seed)
            policy = constant_policy(env, np.array(action))
            episodes = pd.DataFrame([rollout(env, policy) for _ in range(SELECTION_EPISODES)])
            components = {f"action_{i}": value for i, value in enumerate(action)}
            rows.append(components | summary(episodes, ("success_rate", "mean_return")))
        env.close()
        return pd.DataFrame(rows).sort_values(["success_rate", "mean_return"], ascending=False, kind="stable")

    return load_or_compute(file, compare).iloc[0].filter(like="action_").to_numpy(float)


def attempt(
    job: Job, *, work: Callable[[Job], list[dict[str, Any]]], versions: Mapping[str, str], call: str
) -> Outcome:
    """Run `work` on a job and log the attempt; return its rows, or one sentence on its failure, and raise nothing.

    A worker with other package versions than `versions` is refused, because results depend on them. `call` identifies
    the call of `run_study` in the log.
    """
    host = socket.gethostname()
    if not job.log.parent.is_dir():
        return Outcome(failure=f"{host} has no {job.log.parent}: --out must be a folder that all workers share")
    installed = installed_versions()
    for name, version in versions.items():
        if installed.get(name) != version:
            return Outcome(
                failure=f"{host} has {name} {installed.get(name)} instead of {version}: install the same versions "
                "everywhere, because results depend on them"
            )
    _append(job, f" attempt of study call {call}{BEGIN}{host}, process {os.getpid()}\n")
    started = _process_times()
    try:
        rows = work(job)
    except (Exception, SystemExit) as error:  # Drake's own assertions arrive as SystemExit
        return log_failure(job, error)
    finally:
        _append(job, f"{CPU_TIME}{_process_times() - started:.1f} s\n")
    _append(job, " is done\n")
    return Outcome(tuple(rows))


def cpu_time(log: Path) -> float:
    """Return the CPU time of all attempts in the log of a job that ended [s]; that of killed attempts is unknown."""
    text = log.read_text(encoding="utf-8", errors="replace") if log.exists() else ""
    return sum(float(number) for number in re.findall(rf"{CPU_TIME}([0-9.]+) s$", text, re.MULTILINE))


def _process_times() -> float:
    """Return the CPU time of this process and of its child processes that have ended [s]."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def log_failure(job: Job, error: BaseException) -> Outcome:
    """Append an error to the log of its job, and return the outcome of the job: one sentence on the failure."""
    if isinstance(error, InputError):
        _append(job, f" failed: {error}\n")
        return Outcome(failure=str(error))
    _append(job, f" failed:\n{''.join(traceback.format_exception(error))}")
    message = " ".join(str(error).split())[:200]
    return Outcome(failure=f"{type(error).__name__}: {message} (the traceback is in {job.log})")


def count_attempts(log: Path, call: str) -> int:
    """Return the number of workers that started a job in the call `call` of a study; 0 while it waits."""
    try:
        return log.read_bytes().count(f"{call}{BEGIN}".encode())
    except FileNotFoundError:
        return 0


def _append(job: Job, text: str) -> None:
    """Append a line with a time to the log; if the disk is full, the job continues without it."""
    with suppress(OSError), job.log.open("a", encoding="utf-8") as file:
        file.write(f"{datetime.now(UTC):%Y-%m-%d %H:%M:%S}{text}")
