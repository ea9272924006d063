"""Study of `guiderail calibrate`: coverage of its intervals, its predictions, and robots outside of the model.

    python -m research.calibration --run RUN --out DIR [--draws N] [--faulty N] [--robots N] [--mujoco N]

Robots are draws of the prior. Every draw is also a hidden robot: its posterior is fitted to the draws of the other
folds. The simulations are stored in DIR, so that the same command resumes. The table is DIR/calibration.csv.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.tools.environments import changed_environment
from guiderail.tools.evaluation.episode import EnvCallback, Transition
from guiderail.tools.evaluation.subject import find_subject
from guiderail.tools.tables import write_table
from guiderail_calibration.calibrate import EPISODES_OF_PREDICTION, fit
from guiderail_calibration.inference import FALSE_ALARMS, Posterior
from guiderail_calibration.parameters import select_parameters
from guiderail_calibration.prediction import LEVEL, predict
from guiderail_calibration.probe import probe_options, write_probe
from guiderail_calibration.simulations import EPISODES, Simulated, Simulator, draw_prior, simulate_all
from guiderail_calibration.summaries import summarize

FOLDS = 3
FAULTY_SEED, ROBOT_SEED, MUJOCO_SEED = 21, 31, 41
MEASURED = 30  # measured episodes of a policy on a hidden robot
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


def row(quantity: str, value: float, number: int) -> dict[str, Any]:
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
    recorded = Simulator(config.task, {**base, **probe_options(probe)}, parameters)
    num_steps = EnvConfig.resolve(config.task, dict(recorded.environment)).make_task().num_steps
    prior = simulate_all(recorded, given.out / "prior", draw_prior(given.draws, size), processes=processes)
    rows, covered, p_values, errors = [], [], [], []
    tail = 0.5 * (1.0 - LEVEL)
    identifiable = np.zeros(size)
    for robots, posterior in folds(prior, num_steps):
        identifiable += posterior.identifiable / FOLDS
        for index in robots:
            observed = summarize(prior[index].episodes, num_steps)
            draws = posterior.sample(observed, 500)
            low, high = (np.quantile(draws, p, axis=0) for p in (tail, 1.0 - tail))
            covered.append((low <= prior[index].quantiles) & (prior[index].quantiles <= high))
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
    probing = replace(recorded, environment={**own, **probe_options(given.out / "probe.npz")})
    robots = simulate_all(probing, folder / "recorded", drawn, seed=seed, processes=processes, label="recorded")
    policy = Simulator(subject.config.task, base, recorded.parameters, subject.make_policy, str(subject.digest))
    measured = simulate_all(
        replace(policy, environment=own), folder / "measured", drawn, episodes=MEASURED, seed=seed + 1,
        processes=processes, label="measured",
    )  # fmt: skip
    inside, close, alarms = [], [], []
    for index, (robot, truth) in enumerate(zip(robots, measured, strict=True)):
        observed = summarize(robot.episodes, num_steps)
        alarms.append(not posterior.explains(observed)[0])
        draws = posterior.sample(observed, 30)
        simulated = simulate_all(
            policy, folder / f"predicted-{index:03d}", draws, episodes=EPISODES_OF_PREDICTION, seed=seed + 2 + index,
            processes=processes, label=f"predicted {index}",
        )  # fmt: skip
        predicted, rate = predict(simulated), float(truth.success.mean())
        print(
            f"{engine} {index}: predicted {predicted.success:.2f} [{predicted.low:.2f}, {predicted.high:.2f}], measured {rate:.2f}"
        )
        inside.append(predicted.low <= rate <= predicted.high)
        close.append(abs(predicted.success - rate) <= 0.07)
    return [
        row(f"{engine}: interval contains the measured success", np.mean(inside), number),
        row(f"{engine}: prediction within 7 points of the measured success", np.mean(close), number),
        row(f"{engine}: not explained by the model", np.mean(alarms), number),
    ]


if __name__ == "__main__":
    main()
