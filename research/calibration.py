"""Study of `guiderail calibrate`: coverage of its intervals, its predictions, and robots outside of the model.

    python -m research.calibration --run RUN --out DIR [--draws N] [--faulty N] [--robots N] [--mujoco N] [--remedied N]

Robots are draws of the prior. Every draw is also a hidden robot: its posterior is fitted to the draws of the other
folds. With `--remedied`, training of RUN, a run with a checkpoint, continues on draws of the posterior of robots in
Drake on which the policy loses at least `LOSS`. The simulations are stored in DIR, so that the same command resumes.
The table is DIR/calibration.csv, and DIR/robots_drake.csv and DIR/robots_mujoco.csv have a row for each robot whose
success is predicted.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.tools.environments import changed_environment
from guiderail.tools.evaluation.episode import EnvCallback, Transition
from guiderail.tools.evaluation.subject import find_subject
from guiderail.tools.learning.train import train
from guiderail.tools.tables import write_table
from guiderail_calibration.calibrate import EPISODES_OF_PREDICTION, VARIANTS, fit, variants
from guiderail_calibration.inference import FALSE_ALARMS, Posterior
from guiderail_calibration.parameters import select_parameters
from guiderail_calibration.prediction import LEVEL, predict
from guiderail_calibration.probe import probe_options, write_probe
from guiderail_calibration.simulations import EPISODES, Simulated, Simulator, draw_prior, simulate_all
from guiderail_calibration.summaries import summarize
from research.stored import continue_run

FOLDS = 3
FAULTY_SEED, ROBOT_SEED, MUJOCO_SEED = 21, 31, 41
MEASURED = 100  # measured episodes of a policy on a hidden robot
PREDICTED = 30  # draws of the posterior for which the policy is simulated
LOSS = 0.1  # smallest loss of success on a robot for which training continues
REMEDY = 40  # episodes of training that continues
TILT = np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.radians(4.0)])  # of a bent workpiece, as a pose
SLIP_SPEED, SLIP_FORCE = 5e-3, 2.0  # speed of a workpiece in a slipping grasp [m/s], and force above which it slips [N]


class Fault(EnvCallback):
    """Callback that displaces the workpiece in the grasp, which no parameter of the calibration describes."""

    def __init__(self, env: Any, kind: str):
        """Construct the fault "bent" or "slip"."""
        super().__init__(env)
        self._kind = kind

    def on_episode_start(self) -> None:
        """Tilt a bent workpiece."""
        if self._kind == "bent":
            self._displace(TILT)

    def on_step(self, transition: Transition) -> None:
        """Move a slipping workpiece along the force that presses on it."""
        force = float(self.base.trace.signals["wrench"][-1, 2])
        if self._kind == "slip" and force > SLIP_FORCE:
            duration = self.base.action_repeat * self.base.trace.period
            self._displace(np.array([0.0, 0.0, -SLIP_SPEED * duration, 0.0, 0.0, 0.0]))

    def _displace(self, pose: np.ndarray) -> None:
        station = self.base.diagram.diagram.GetSubsystemByName("station")
        for name, sign in (("calibration_of_commands", -1.0), ("calibration_of_poses", 1.0)):
            source = station.GetSubsystemByName(name)
            value = source.get_mutable_source_value(
                source.GetMyMutableContextFromRoot(self.base.simulator.get_mutable_context())
            )
            value.SetFromVector(value.value() + sign * pose)


def folds(prior: list[Simulated], num_steps: int) -> Iterator[tuple[np.ndarray, Posterior]]:
    """Yield the indices of the hidden robots of each fold, and the posterior that is fitted to the other draws."""
    at = np.arange(len(prior)) % FOLDS
    for fold in range(FOLDS):
        rest = [draw for index, draw in enumerate(prior) if at[index] != fold]
        yield np.flatnonzero(at == fold), fit(rest, num_steps, EPISODES)


def row(quantity: str, value: Any, number: int) -> dict[str, Any]:
    """Return a row of the table: a quantity, its value, and the number of robots."""
    print(f"{quantity}: {value:.3g} (n = {number})", flush=True)
    return {"quantity": quantity, "value": round(float(value), 4), "n": number}


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", default="pretrained:connector")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--draws", type=int, default=240)
    parser.add_argument("--faulty", type=int, default=20, help="robots of each fault")
    parser.add_argument("--robots", type=int, default=0, help="robots in Drake whose success is predicted")
    parser.add_argument("--mujoco", type=int, default=0, help="robots in MuJoCo whose success is predicted")
    parser.add_argument("--remedied", type=int, default=0, help="robots in Drake for which training continues")
    parser.add_argument("--processes", type=int, default=2)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    subject = find_subject(given.run, None)
    config = subject.config
    assert config is not None
    base = changed_environment(config.task, config.environment, {"station": "gantry"})
    probe = write_probe(config.task, base, given.out / "probe.npz")
    parameters, _ = select_parameters(config.task, base)
    size, processes = len(parameters), given.processes
    recorded = Simulator(config.task, {**base, **probe_options(probe, base)}, parameters)
    num_steps = EnvConfig.resolve(config.task, dict(recorded.environment)).num_steps
    prior = simulate_all(recorded, given.out / "prior", draw_prior(given.draws, size), processes=processes)
    rows, covered, p_values, errors = [], [], [], []
    tail = 0.5 * (1.0 - LEVEL)
    identifiable = np.zeros(size)
    for robots, posterior in folds(prior, num_steps):
        identifiable += posterior.identifiable / FOLDS
        for index in robots:
            observed = summarize(prior[index].episodes, num_steps)
            draws = posterior.sample(observed, 500)
            low, high, truth = (
                np.array([parameter.value(q) for parameter, q in zip(parameters, quantiles, strict=True)])
                for quantiles in (*np.quantile(draws, (tail, 1.0 - tail), axis=0), prior[index].quantiles)
            )
            covered.append((low <= truth) & (truth <= high))
            errors.append(np.abs(np.median(draws, axis=0) - prior[index].quantiles))
            p_values.append(posterior.explains(observed)[1])
    for i, parameter in enumerate(parameters):
        name = parameter.name + ("" if identifiable[i] > 0.99 else " (not identified)")
        rows.append(row(f"coverage of 90 % intervals, {name}", np.mean(covered, axis=0)[i], len(covered)))
        rows.append(
            row(f"mean error of the median, as a quantile of the prior, {name}", np.mean(errors, 0)[i], len(errors))
        )
    rows.append(row("false alarms", np.mean(np.array(p_values) <= FALSE_ALARMS), len(p_values)))
    whole = fit(prior, num_steps, EPISODES) if given.faulty or given.robots or given.mujoco else None
    for kind in ("bent", "slip") if given.faulty else ():
        faulty = replace(recorded, prepare=lambda env, index, kind=kind: Fault(env, kind))
        drawn = draw_prior(given.faulty, size, FAULTY_SEED)
        simulated = simulate_all(faulty, given.out / kind, drawn, seed=FAULTY_SEED, processes=processes, label=kind)
        assert whole is not None
        alarms = [not whole.explains(summarize(robot.episodes, num_steps))[0] for robot in simulated]
        rows.append(row(f"robots outside of the model that are detected, {kind}", np.mean(alarms), len(alarms)))
    for engine, number, seed in (("Drake", given.robots, ROBOT_SEED), ("MuJoCo", given.mujoco, MUJOCO_SEED)):
        if number:
            assert whole is not None
            rows += predictions(engine, number, seed, given, subject, base, recorded, whole, num_steps)
    print(write_table(given.out / "calibration", rows))


def predictions(
    engine: str, number: int, seed: int, given: Any, subject: Any, base: Any, recorded: Simulator, posterior: Posterior,
    num_steps: int,
) -> list[dict[str, Any]]:  # fmt: skip
    """Return rows on the predicted and the measured success of the policy on hidden robots of an engine."""
    own = base if engine == "Drake" else changed_environment(subject.config.task, base, {"station": "mujoco"})
    drawn = draw_prior(number, len(recorded.parameters), seed)
    folder, processes = given.out / engine, given.processes
    probing = replace(recorded, environment={**own, **probe_options(given.out / "probe.npz", own)})
    robots = simulate_all(probing, folder / "recorded", drawn, seed=seed, processes=processes, label="recorded")
    policy = Simulator(subject.config.task, base, recorded.parameters, subject.make_policy, str(subject.digest))
    measured = simulate_all(
        replace(policy, environment=own), folder / "measured", drawn, episodes=MEASURED, seed=seed + 1,
        processes=processes, label="measured",
    )  # fmt: skip
    nominal = simulate_all(
        Simulator(subject.config.task, base, (), subject.make_policy, str(subject.digest)), given.out / "nominal",
        np.zeros((1, 0)), episodes=MEASURED, seed=seed + 1, processes=1, label="nominal",
    )  # fmt: skip
    nominal_rate = float(nominal[0].success.mean())
    robots_of_engine: list[dict[str, Any]] = []
    regained: list[float] = []
    for index, (robot, truth) in enumerate(zip(robots, measured, strict=True)):
        observed = summarize(robot.episodes, num_steps)
        draws = posterior.sample(observed, PREDICTED)
        simulated = simulate_all(
            policy, folder / f"predicted-{index:03d}", draws, episodes=EPISODES_OF_PREDICTION, seed=seed + 2 + index,
            processes=processes, label=f"predicted {index}",
        )  # fmt: skip
        predicted, rate = predict(simulated), float(truth.success.mean())
        about: dict[str, Any] = {
            "engine": engine, "robot": index, "explained": posterior.explains(observed)[0], "measured": rate,
            "predicted": round(predicted.success, 3), "low": round(predicted.low, 3), "high": round(predicted.high, 3),
        }  # fmt: skip
        if engine == "Drake" and nominal_rate - rate >= LOSS and len(regained) < given.remedied:
            run = continue_training(given, subject, base, recorded, draws, folder / f"remedy-{index:03d}")
            after = simulate_all(
                replace(policy, environment=own, make_policy=find_subject(run, None).make_policy),
                folder / f"after-{index:03d}", drawn[index][None], episodes=MEASURED, seed=seed + 1, processes=1,
                label=f"after {index}",
            )[0]  # fmt: skip
            about["after"] = float(after.success.mean())
            regained.append((float(after.success.mean()) - rate) / (nominal_rate - rate))
        print(about, flush=True)
        robots_of_engine.append(about)
        write_table(given.out / f"robots_{engine.lower()}", robots_of_engine)
    table = pd.DataFrame(robots_of_engine)
    inside = table["measured"].between(table["low"], table["high"])
    close = (table["predicted"] - table["measured"]).abs() <= 0.07
    rows = [
        row(f"{engine}: interval contains the measured success", inside.mean(), number),
        row(f"{engine}: prediction within 7 points of the measured success", close.mean(), number),
        row(f"{engine}: not explained by the model", 1.0 - table["explained"].mean(), number),
    ]
    if regained:
        rows.append(
            row("fraction of the lost success that is regained, median", float(np.median(regained)), len(regained))
        )
    return rows


def continue_training(given: Any, subject: Any, base: Any, recorded: Simulator, draws: np.ndarray, run: Path) -> Path:
    """Continue the training on draws (n, d) of a robot's posterior, or the interrupted run; return its folder."""
    task = subject.config.task
    if not continue_run(run, REMEDY):
        environments = variants(task, base, recorded.parameters, draws[-VARIANTS:])
        learner = subject.config.learner
        settings = {
            "init_from": str(given.run), "symmetry": learner.symmetry, "privileged_critic": learner.privileged_critic
        }  # fmt: skip
        train(
            task, out=run, episodes=REMEDY, seed=subject.config.seed, settings=settings, variants=environments,
            pictures=False,
        )  # fmt: skip
    return run


if __name__ == "__main__":
    main()
