"""Runs of the reproduction: their cost, and training that is resumed where it was interrupted.

A figure's runs are those of studies in `research/studies`. They are done seed by seed, so that an interrupted figure
has the same number of runs in every method.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import did_you_mean
from guiderail.tools.learning.run_folder import RunFolder
from guiderail_studies.declaration import load_study
from guiderail_studies.engines.engine import make_engine
from guiderail_studies.job import Job, is_done
from guiderail_studies.study import run_study
from research.studies import study_path

SUCCESSES = 10  # consecutive successes that end a run of pouring


@dataclass(frozen=True)
class Runs:
    """Runs of one study that a figure is made of.

    Attributes:
        study: Name of the study.
        seconds: Duration of one episode by method [s of one core], the key "" for all other methods. Those of TQC at
            pouring, of RL without a template there and of `kgrl_pixels` are estimates, the others are measured.
        stops: True if a run ends after `SUCCESSES` consecutive successes.
        methods: Names of the methods that the figure needs; empty for all methods.
        columns: Further columns of an episode that are stored.
    """

    study: str
    seconds: dict[str, float]
    stops: bool = False
    methods: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()


_PASSAGE = {"": 0.42}
_POURING = {"": 4.4, "rl_shaped": 4.0, "rl_sparse": 4.0}
_CONNECTOR = Runs(
    "connector_10hz",
    {"": 3.2},
    methods=("kgrl", "skgrl"),
    columns=("jerk_commanded_angular", "jerk_measured_linear", "jerk_measured_angular"),
)
_DEMONSTRATION = replace(_CONNECTOR, methods=("demonstration",))
FIGURES: dict[str, tuple[Runs, ...]] = {
    "3.5": (Runs("thesis_pouring_sac", _POURING, stops=True),),
    "3.6": (Runs("thesis_pouring_tqc", _POURING | {"": 6.0}, stops=True),),
    "3.8": (
        Runs("thesis_pouring_sac", _POURING, stops=True),
        Runs("thesis_pouring_tqc", _POURING | {"": 6.0}, stops=True),
    ),
    "3.10": (Runs("thesis_grid_clamp", {"": 0.45}),),
    "3.11": (Runs("thesis_grid_clamp", {"": 0.45}),),
    "4.1": (_DEMONSTRATION,),
    "4.5": (Runs("thesis_narrow_passage", _PASSAGE, methods=("kgrl", "residual", "safe_residual")),),
    "4.6": (Runs("thesis_narrow_passage", _PASSAGE, methods=("kgrl", "residual", "safe_residual")),),
    "4.7": (Runs("narrow_passage_images", {"": 4.1, "kgrl_pixels": 35.0}),),
    "4.8": (_CONNECTOR,),
    "5.1": (_DEMONSTRATION,),
    "5.6": (
        Runs(
            "thesis_narrow_passage",
            _PASSAGE,
            methods=("kgrl", "skgrl", "kgrl_constant", "skgrl_constant"),
        ),
    ),
    "5.9": (_CONNECTOR,),
    "5.10": (_CONNECTOR,),
    "hard": (Runs("pouring_hard_shield", {"": 2.4}),),
}
"""Runs by figure of the thesis; "hard" is pouring at difficulty hard, which the thesis does not have."""


def find_runs(figures: Iterable[str]) -> list[Runs]:
    """Return the runs of figures, each study once.

    Raises:
        InputError: If a figure has no runs of its own.
    """
    found: dict[str, Runs] = {}
    for figure in figures:
        if figure not in FIGURES:
            raise InputError(f"no runs belong to figure {figure!r}: {did_you_mean(figure, FIGURES)}")
        for runs in FIGURES[figure]:
            other = found.get(runs.study, runs)
            methods = () if not (runs.methods and other.methods) else tuple({*runs.methods, *other.methods})
            found[runs.study] = replace(runs, methods=methods)
    return list(found.values())


def jobs_of(runs: Runs, out: Path) -> list[Job]:
    """Return the jobs of a study seed by seed, first those of the first seed of each method."""
    study = load_study(study_path(runs.study))
    seeds = {name: method.seeds or study.seeds for name, method in study.methods.items()}
    names = [name for name in study.methods if not runs.methods or name in runs.methods]
    longest = max(len(seeds[name]) for name in names)
    return [Job(study, name, seeds[name][i], out) for i in range(longest) for name in names if i < len(seeds[name])]


def num_done(job: Job) -> int:
    """Return the number of finished training episodes of a job."""
    return len(job.folder.episodes()) if (job.folder.path / "episodes.csv").is_file() else 0


def has_ended(job: Job, *, stops: bool) -> bool:
    """Return True if nothing of a job remains to be done."""
    if stops and (job.folder.path / "policy.json").is_file():
        return num_done(job) > 0
    return is_done(job)


def remaining_hours(runs: Runs, out: Path) -> float:
    """Return the core-hours that the missing episodes of a study need if no run ends early."""
    total = 0.0
    for job in jobs_of(runs, out):
        if job.learns and not has_ended(job, stops=runs.stops):
            seconds = runs.seconds.get(job.method, runs.seconds[""])
            total += seconds * (job.after_episodes[-1] - num_done(job))
    return total / 3600


def train(runs: Runs, out: Path, report: Callable[[str], None] = print) -> Iterator[Job]:
    """Do the missing jobs of a study one after another, and yield each job when it has ended.

    An interrupted job continues from its last checkpoint.
    """
    for job in jobs_of(runs, out):
        if not has_ended(job, stops=runs.stops):
            report(f"{runs.study}: {job.method}, seed {job.seed}, from episode {num_done(job)}")
            if runs.stops and job.learns:
                _train_until_converged(job)
            else:
                method = job.study.methods[job.method].model_copy(update={"seeds": (job.seed,)})
                single = job.study.model_copy(update={"methods": {job.method: method}})
                run_study(single, out, make_engine("process", processes=1))
        yield job


def _train_until_converged(job: Job) -> None:
    """Train a run to its last episode, or until it ends with `SUCCESSES` consecutive successes."""
    from guiderail.tools.learning.trainer import run_training  # imports the learners, which takes seconds

    config = job.config(job.after_episodes[-1])
    config = replace(config, learner=replace(config.learner, stop_after_successes=SUCCESSES), step_log=False)
    run_training(RunFolder(job.folder.path), config, resume=(job.folder.path / "config.yaml").is_file())
