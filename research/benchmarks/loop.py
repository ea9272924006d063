"""Whether the loop of a robot is in time on this machine: `guiderail bench loop`.

The time that each part takes of its period, and how regularly a robot is heard over LCM on localhost: once with the
machine as it is, and once with a process on every core that has nothing else to do. Wall clock, worst case included:
what else runs here counts, as it would for the robot.
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.envs.make import make_prior_knowledge
from guiderail.diagrams.hardware.clock import set_realtime_priority
from guiderail.diagrams.hardware.station import IIWA_DRIVER, HardwareStation, SimulatedIiwa
from guiderail.diagrams.stations.station import CONTROL_PERIOD
from guiderail.diagrams.tasks.bnc_connector.workcell import BncWorkcell
from guiderail.models.policy import FORMAT, Policy
from research.benchmarks import with_progress

TASK, HOLD = "BncConnector", 10
UNITS = 128
START = np.array([0.0, 0.0, 0.02, np.pi / 2, 0.0, 0.0])
SECONDS = 6.0  # of the robot's time, for each of the two loads
PERIOD = IIWA_DRIVER.period
Row = dict[str, Any]


def measure() -> dict[str, list[Row]]:
    """Rows for the machine as it is, and for a busy one."""
    found = {}
    for load in with_progress(("as it is", "busy"), "load"):
        with _busy(load == "busy"):
            found[load] = [*_parts(), *_transport()]
    return found


def _row(part: str, period: float, seconds: np.ndarray) -> Row:
    # An answer that never came took infinitely long, and between a number and infinity nothing is interpolated.
    median, p99, worst = 1000.0 * np.quantile(seconds, (0.5, 0.99, 1.0), method="higher")
    return {
        "part": part,
        "period_ms": 1000.0 * period,
        "median_ms": float(median),
        "p99_ms": float(p99),
        "worst_ms": float(worst),
        "over": int((seconds > period).sum()),
        "number": len(seconds),
    }


def _timed(call: Callable[[int], object], number: int) -> np.ndarray:
    seconds = np.empty(number)
    for index in range(number):
        started = time.perf_counter()
        call(index)
        seconds[index] = time.perf_counter() - started
    return seconds[number // 20 :]  # what is called for the first time is called before a robot moves


def _policy(observations: int, actions: int) -> Policy:
    rng, sizes = np.random.default_rng(0), (observations, UNITS, UNITS, actions)
    layers = [
        (0.1 * rng.standard_normal((out, into)).astype(np.float32), np.zeros(out, np.float32))
        for into, out in itertools.pairwise(sizes)
    ]
    bounds = {"action_low": [-1.0] * actions, "action_high": [1.0] * actions}
    return Policy(layers, {"format": FORMAT, "observation_shape": [observations], **bounds})


def _parts() -> list[Row]:
    number = round(SECONDS / PERIOD)
    policy, observation = _policy(13, 2), np.zeros(13, np.float32)
    skill = make_prior_knowledge(TASK, guidance="skgrl").demonstrations
    assert skill is not None
    rows = [_row("policy", HOLD * CONTROL_PERIOD, _timed(lambda index: policy(observation), number))]
    rng = np.random.default_rng(0)
    primitive = skill.primitive(history=True)
    history = np.tile(primitive.reference.means[0], (primitive.history, 1))
    actions = rng.uniform(-1e-4, 1e-4, (number, primitive.num_outputs))
    steps = primitive.num_steps - 1
    predictions = _timed(lambda index: primitive.predict(index % steps, actions[index], history), number)
    rows.append(_row("primitive", CONTROL_PERIOD, predictions))
    lcm = DrakeLcm("memq://")
    station = HardwareStation(BncWorkcell(), lcm)
    rows.append(_row("station, with what guards it", PERIOD, _stepped(lcm, station, number)))
    return rows


def _stepped(lcm: DrakeLcm, station: HardwareStation, number: int) -> np.ndarray:
    """How long a station needs for each status of a robot in the same process."""
    robot = SimulatedIiwa(BncWorkcell(), lcm)
    simulator, other = Simulator(station), robot.simulator()
    robot.set_pose(other.get_mutable_context(), START)
    other.Initialize()
    station.get_desired_pose_input_port().FixValue(simulator.get_mutable_context(), START)
    station.start(simulator)
    seconds = np.empty(number)
    for index in range(number):
        other.AdvanceTo((index + 1) * PERIOD)
        started = time.perf_counter()
        simulator.AdvanceTo((index + 1) * PERIOD)
        seconds[index] = time.perf_counter() - started
    return seconds[number // 20 :]


def _transport() -> list[Row]:
    """A process that speaks as often as a robot does, and this one, which answers at once."""
    url = f"udpm://239.255.76.67:{20000 + os.getpid() % 20000}?ttl=0"
    os.environ.setdefault("DRAKE_ALLOW_NETWORK", "lcm")
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    speaker = context.Process(target=_speak, args=(there, url), daemon=True)
    lcm = DrakeLcm(url)
    heard: list[float] = []

    def answer(message: bytes) -> None:
        heard.append(time.perf_counter())
        lcm.Publish("ANSWERED", message)

    lcm.Subscribe("SPOKEN", answer)
    speaker.start()
    with _in_a_hurry():
        while not here.poll():
            lcm.HandleSubscriptions(10)
    answered = here.recv()
    speaker.join()
    rows = [_row("from a status to the next", PERIOD, np.diff(heard)[20:])]
    return [*rows, _row("there and back over LCM", PERIOD, np.array(answered)[20:])]


class _Answers:
    """When each message was sent, and when its own answer came: one that is late is not the next message's."""

    def __init__(self) -> None:
        self._said: list[float] = []
        self._came: dict[int, float] = {}

    def say(self, now: float) -> bytes:
        """The next message, which is sent now [s]."""
        self._said.append(now)
        return (len(self._said) - 1).to_bytes(8)

    def hear(self, message: bytes, now: float) -> None:
        """An answer, which came now [s]; one that comes twice counts once."""
        self._came.setdefault(int.from_bytes(message), now)

    def is_answered(self) -> bool:
        """Whether the last message is."""
        return len(self._said) - 1 in self._came

    def seconds(self) -> list[float]:
        """How long each answer took [s]; infinite where none came."""
        return [self._came.get(number, np.inf) - said for number, said in enumerate(self._said)]


def _speak(pipe: Connection, url: str) -> None:
    """The other process: how long each answer took."""
    lcm, answers = DrakeLcm(url), _Answers()
    lcm.Subscribe("ANSWERED", lambda message: answers.hear(message, time.perf_counter()))
    with _in_a_hurry():
        due = time.perf_counter() + 0.5
        for _ in range(round(SECONDS / PERIOD)):
            time.sleep(max(due - time.perf_counter(), 0.0))
            due += PERIOD
            lcm.Publish("SPOKEN", answers.say(time.perf_counter()))
            while not answers.is_answered() and time.perf_counter() < due:
                lcm.HandleSubscriptions(1)
    pipe.send(answers.seconds())


@contextmanager
def _in_a_hurry() -> Iterator[None]:
    """As a process that a robot waits for, where the system allows it."""
    is_served_first = set_realtime_priority()
    try:
        yield
    finally:
        if is_served_first:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@contextmanager
def _busy(is_busy: bool) -> Iterator[None]:
    """A process on every core that has nothing else to do."""
    context = multiprocessing.get_context("spawn")
    others = [context.Process(target=_work, daemon=True) for _ in range((os.cpu_count() or 1) * is_busy)]
    for other in others:
        other.start()
    try:
        yield
    finally:
        for other in others:
            other.terminate()
            other.join()


def _work() -> None:
    matrix = np.random.default_rng(0).standard_normal((200, 200))
    while True:
        np.linalg.svd(matrix)


def show(found: dict[str, list[Row]]) -> None:
    """Prints a table for each load."""
    columns = ("period_ms", "median_ms", "p99_ms", "worst_ms")
    for load, rows in found.items():
        print(f"{'the machine ' + load:<34}{'period':>9}{'median':>9}{'99 %':>9}{'worst':>9} [ms]   over")
        for row in rows:
            numbers = "".join(f"{row[name]:>9.2f}" for name in columns)
            print(f"{row['part']:<34}{numbers}   {row['over']} of {row['number']}")
