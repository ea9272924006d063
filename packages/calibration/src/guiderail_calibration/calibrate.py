"""Calibration: posterior of a robot's parameters, prediction, and variants of the environment to continue training."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.models.common.arrays import as_whole
from guiderail.models.common.files import write_atomically
from guiderail.tools.evaluation.forks import check_processes
from guiderail.tools.tables import write_table
from guiderail_calibration.inference import Posterior
from guiderail_calibration.parameters import Parameter, options_of, select_parameters
from guiderail_calibration.prediction import LEVEL, Prediction, predict
from guiderail_calibration.probe import probe_options
from guiderail_calibration.recordings import Episode, load_recordings
from guiderail_calibration.report import render
from guiderail_calibration.simulations import (
    EPISODES,
    POSTERIOR_SEED,
    Simulated,
    Simulator,
    draw_prior,
    simulate_all,
)
from guiderail_calibration.summaries import summarize
from guiderail_studies.converge import find_run

DRAWS = 240  # default number of simulated draws of the prior
MIN_DRAWS = 40
SAMPLES = 2000  # draws of the posterior
PREDICTED = 40  # default number of draws of the posterior for which the policy is simulated
EPISODES_OF_PREDICTION = 4  # episodes of each of these draws
VARIANTS = 10  # default number of variants of the environment


@dataclass(frozen=True)
class Calibration:
    """Result of a calibration."""

    parameters: tuple[Parameter, ...]
    left_out: Mapping[str, str]  # reasons why other parameters are not calibrated, by name
    sensitivities: np.ndarray  # fraction of each parameter's variance that the summaries explain, (d,)
    identifiable: np.ndarray  # True for each identifiable parameter, (d,)
    quantiles: np.ndarray  # draws of the posterior, as quantiles of the priors, (`SAMPLES`, d)
    p_value: float  # p-value of the check that the model explains the recordings
    is_explained: bool
    prediction: Prediction | None  # None if it was not asked for
    recordings: Sequence[Episode]
    simulated: Sequence[Episode]  # an episode of each of a few draws of the posterior

    def intervals(self) -> list[dict[str, Any]]:
        """Return a row for each parameter: prior, median and interval with probability `LEVEL`, and sensitivity."""
        tail = 0.5 * (1.0 - LEVEL)
        low, middle, high = np.quantile(self.quantiles, (tail, 0.5, 1.0 - tail), axis=0)
        return [
            {
                "parameter": parameter.name,
                "meaning": parameter.axis.label,
                "prior_low": parameter.low,
                "prior_high": parameter.high,
                "low": float(parameter.value(low[i])),
                "median": float(parameter.value(middle[i])),
                "high": float(parameter.value(high[i])),
                "sensitivity": round(float(self.sensitivities[i]), 3),
                "identifiable": "yes" if self.identifiable[i] else "no",
            }
            for i, parameter in enumerate(self.parameters)
        ]

    def result(self) -> dict[str, Any]:
        """Return the result as a dictionary of numbers and texts."""
        unidentified = [p.name for p, known in zip(self.parameters, self.identifiable, strict=True) if not known]
        return {
            "recordings": len(self.recordings),
            "explained": self.is_explained,
            "p": self.p_value,
            "parameters": self.intervals(),
            "not_identified": unidentified,
            "left_out": dict(self.left_out),
            "prediction": None if self.prediction is None else asdict(self.prediction),
        }


def calibrate(
    run: Path | str,
    recordings: Path,
    *,
    probe: Path | None = None,
    environment: Mapping[str, Any] | None = None,
    parameters: Sequence[str] | None = None,
    draws: int = DRAWS,
    predicted: int = PREDICTED,
    number: int = VARIANTS,
    out: Path | None = None,
    processes: int | None = None,
    log: Callable[[str], None] = lambda sentence: None,
) -> dict[str, Any]:
    """Infer the parameters of a robot from recorded episodes, and predict a policy's success on it.

    All simulations are stored in `out`, so that the same call resumes an interrupted calibration, and other recordings
    need no new simulations of the prior.

    Args:
        run: Folder of a run, or `pretrained:NAME`.
        recordings: Folder of recorded episodes; see `load_recordings`.
        probe: File of the probing motion that was recorded; None for episodes of the run's policy.
        environment: Options of the environment that differ from training, such as the station.
        parameters: Names of the parameters; None for all that the environment has.
        draws: Number of simulated draws of the prior, at least `MIN_DRAWS`.
        predicted: Number of draws of the posterior for which the policy is simulated; 0 for no prediction.
        number: Number of variants of the environment.
        out: Folder to write; by default `calibration` in the run.
        processes: Largest number of processes; None for the number of cores. The results do not depend on it.
        log: Function called with sentences on sensitivities.

    Returns:
        `Calibration.result`, with the paths `page`, `posterior` (table of draws) and `variants` (file for training).

    Raises:
        InputError: If an argument or a recording is invalid, or the run has no folder and `out` is None.
    """
    draws = as_whole(draws, "the number of draws of the prior", MIN_DRAWS)
    predicted = as_whole(predicted, "the number of draws of a prediction", 0)
    number = as_whole(number, "the number of variants", 1, SAMPLES)
    processes = check_processes(processes)
    subject, out = find_run(run, environment, out, "calibration")
    config = subject.config
    assert config is not None  # a run has one
    base = subject.changed_environment(dict(environment or {}))
    selected, left_out = select_parameters(config.task, base, parameters)
    policy = Simulator(config.task, base, selected, subject.make_policy, str(subject.digest))
    recorded = policy if probe is None else Simulator(config.task, {**base, **probe_options(probe, base)}, selected)
    resolved = EnvConfig.resolve(config.task, dict(recorded.environment))
    num_steps, reference = resolved.num_steps, None if probe is None else resolved.reference()
    episodes = load_recordings(recordings, None if reference is None else reference.means)
    prior = simulate_all(
        recorded, out / f"prior-{recorded.key()}", draw_prior(draws, len(selected)), processes=processes, label="prior"
    )
    posterior = fit(prior, num_steps, min(len(episodes), EPISODES))
    for parameter, sensitivity, known in zip(selected, posterior.sensitivities, posterior.identifiable, strict=True):
        note = "" if known else ": cannot be identified from these recordings, and keeps its prior"
        log(f"{parameter.name}: the summaries explain {sensitivity:.0%} of its variance{note}")
    for name, reason in left_out.items():
        log(f"{name} is left out: {reason}")
    observed = summarize(episodes, num_steps)
    is_explained, p_value = posterior.explains(observed)
    quantiles = posterior.sample(observed, SAMPLES)
    shown = [recorded.simulate(q, POSTERIOR_SEED + i, 1)[0][0] for i, q in enumerate(quantiles[:3])]
    prediction = None
    if predicted:
        folder = out / f"posterior-{policy.key()}-{_digest(quantiles)}"
        prediction = predict(
            simulate_all(
                policy, folder, quantiles[:predicted], episodes=EPISODES_OF_PREDICTION, seed=POSTERIOR_SEED,
                processes=processes, label="prediction",
            )
        )  # fmt: skip
    calibration = Calibration(
        selected, left_out, posterior.sensitivities, posterior.identifiable, quantiles, p_value, is_explained,
        prediction, episodes, shown,
    )  # fmt: skip
    return calibration.result() | _write(out, config.task, base, calibration, number)


def write_prior_variants(
    run: Path | str,
    number: int,
    *,
    environment: Mapping[str, Any] | None = None,
    parameters: Sequence[str] | None = None,
    out: Path | None = None,
) -> Path:
    """Write variants of a run's environment with draws of the prior, to train for robots without recordings.

    Args:
        run: Folder of a run, or `pretrained:NAME`.
        number: Number of variants.
        environment: Options of the environment that differ from training, such as the station.
        parameters: Names of the parameters; None for all that the environment has.
        out: Folder to write; by default `calibration` in the run.

    Returns:
        Path of the file of variants.

    Raises:
        InputError: If an argument is invalid, or the run has no folder and `out` is None.
    """
    number = as_whole(number, "the number of variants", 1, SAMPLES)
    subject, out = find_run(run, environment, out, "calibration")
    config = subject.config
    assert config is not None  # a run has one
    base = subject.changed_environment(dict(environment or {}))
    selected, _ = select_parameters(config.task, base, parameters)
    return _write_variants(out, config.task, base, selected, draw_prior(number, len(selected)))


def fit(simulated: Sequence[Simulated], num_steps: int, episodes: int) -> Posterior:
    """Return the posterior of robots with as many recorded `episodes`, from simulated draws of the prior."""
    summaries = np.stack([summarize(draw.episodes[:episodes], num_steps) for draw in simulated])
    return Posterior(np.stack([draw.quantiles for draw in simulated]), summaries)


def variants(
    task: str, environment: Mapping[str, Any], parameters: Sequence[Parameter], quantiles: np.ndarray
) -> dict[str, dict[str, Any]]:
    """Return variants of an environment, one for each draw (n, d) of posterior or prior, for `train --variants`.

    A variant has the disturbances of one draw; all draws are equally likely.
    """
    return {
        f"draw {number}": {**environment, **options_of(task, environment, parameters, row)}
        for number, row in enumerate(quantiles)
    }


def _digest(quantiles: np.ndarray) -> str:
    return hashlib.blake2b(np.round(quantiles, 6).tobytes(), digest_size=4).hexdigest()


def _write(
    out: Path, task: str, environment: Mapping[str, Any], calibration: Calibration, number: int
) -> dict[str, str]:
    """Write the results into a folder; return the paths of page, table of draws and variants."""
    columns = {p.name: p.value(calibration.quantiles[:, i]) for i, p in enumerate(calibration.parameters)}
    rows = [dict(zip(columns, map(float, values), strict=True)) for values in zip(*columns.values(), strict=True)]
    table = write_table(out / "posterior", rows).with_suffix(".csv")
    file = _write_variants(out, task, environment, calibration.parameters, calibration.quantiles[-number:])
    write_atomically(out / "calibration.json", json.dumps(calibration.result(), indent=1).encode())
    write_atomically(out / "calibration.html", render(task, calibration).encode())
    return {"page": str(out / "calibration.html"), "posterior": str(table), "variants": str(file)}


def _write_variants(
    out: Path, task: str, environment: Mapping[str, Any], parameters: Sequence[Parameter], quantiles: np.ndarray
) -> Path:
    made = variants(task, environment, parameters, quantiles)
    plain = json.loads(json.dumps(made, default=np.generic.item))  # YAML has neither tuples nor numbers of NumPy
    file = out / "variants.yaml"
    write_atomically(file, yaml.safe_dump(plain, sort_keys=False).encode())
    return file
