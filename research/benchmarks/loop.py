"""Timing of the control loop of a robot: `python -m research.benchmarks loop`.

The results are the duration of each part of the loop, compared with the part's period, and the jitter of LCM messages
on localhost. Both are measured without added load and with a busy process on every core. Durations are wall-clock
times, and the largest one is reported as well.
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
from guiderail.diagrams.stations.station import CONTROL_PERIOD
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.policy import FORMAT, Policy
from guiderail_hardware.drivers.clock import set_realtime_priority
from guiderail_hardware.drivers.lcm import IiwaDriver
from guiderail_hardware.drivers.lcm_simulated import SimulatedIiwa
from guiderail_hardware.station import HardwareStation
from research.benchmarks import with_progress

TASK, ACTION_REPEAT = "BncConnector", 10
UNITS = 128  # units in each hidden layer of the policy
START = np.array([0.0, 0.0, 0.02, np.pi / 2, 0.0, 0.0])  # start pose of the tool [m, rad]
SECONDS = 6.0  # robot time for each of the two loads [s]
PERIOD = IiwaDriver.period
Row = dict[str, Any]


def measure() -> dict[str, list[Row]]:
    """Measure durations and jitter without added load ("as it is") and with a busy process on every core ("busy")."""
    results = {}
    for load in with_progress(("as it is", "busy"), "load"):
        with _busy(load == "busy"):
            results[load] = [*_parts(), *_transport()]
    return results


def _row(part: str, period: float, seconds: np.ndarray) -> Row:
    # The latency of a missing answer is infinite; method="higher" does not interpolate between infinity and a number.
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
    return seconds[number // 20 :]  # without the first calls: on hardware, they are made before the robot moves


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
    config = make_prior_knowledge(TASK, guidance="skgrl").primitive
    assert config is not None
    rows = [_row("policy", ACTION_REPEAT * CONTROL_PERIOD, _timed(lambda index: policy(observation), number))]
    rng = np.random.default_rng(0)
    primitive = config.primitive(history=True)
    history = np.tile(primitive.reference.means[0], (primitive.history, 1))
    actions = rng.uniform(-1e-4, 1e-4, (number, primitive.num_outputs))
    steps = primitive.num_steps - 1
    predictions = _timed(lambda index: primitive.predict(index % steps, actions[index], history), number)
    rows.append(_row("primitive", CONTROL_PERIOD, predictions))
    lcm = DrakeLcm("memq://")
    station = HardwareStation(BncWorkcell(), IiwaDriver(lcm))
    rows.append(_row("station with its monitors", PERIOD, _stepped(lcm, station, number)))
    return rows


def _stepped(lcm: DrakeLcm, station: HardwareStation, number: int) -> np.ndarray:
    """Measure the duration [s] of a station's step per status message of a simulated robot in the same process."""
    robot = SimulatedIiwa(BncWorkcell(), lcm)
    simulator, robot_simulator = Simulator(station), robot.simulator()
    robot.set_pose(robot_simulator.get_mutable_context(), START)
    robot_simulator.Initialize()
    station.get_desired_pose_input_port().FixValue(simulator.get_mutable_context(), START)
    station.start(simulator)
    seconds = np.empty(number)
    for index in range(number):
        robot_simulator.AdvanceTo((index + 1) * PERIOD)
        started = time.perf_counter()
        simulator.AdvancePendingEvents()
        station.receive(simulator.get_mutable_context())
        simulator.AdvanceTo((index + 1) * PERIOD)
        seconds[index] = time.perf_counter() - started
    return seconds[number // 20 :]


def _transport() -> list[Row]:
    """Measure the interval between received messages and the round trip over LCM.

    A second process sends at the rate of a robot; this process answers immediately.

    Raises:
        EOFError: If the second process ends without a result.
    """
    url = f"udpm://239.255.76.67:{20000 + os.getpid() % 20000}?ttl=0"
    context = multiprocessing.get_context("spawn")
    pipe, sender_pipe = context.Pipe()
    sender = context.Process(target=_send_statuses, args=(sender_pipe, url), daemon=True)
    lcm = DrakeLcm(url)
    received: list[float] = []

    def answer(message: bytes) -> None:
        received.append(time.perf_counter())
        lcm.Publish("ANSWER", message)

    lcm.Subscribe("STATUS", answer)
    sender.start()
    sender_pipe.close()  # the second process has a copy; without this, its end would not close the pipe
    with _realtime_priority():
        while not pipe.poll():
            lcm.HandleSubscriptions(10)
    answered = pipe.recv()
    sender.join()
    rows = [_row("from a status to the next", PERIOD, np.diff(received)[20:])]
    return [*rows, _row("round trip over LCM", PERIOD, np.array(answered)[20:])]


class _Answers:
    """Times of messages and of their answers, matched by number."""

    def __init__(self) -> None:
        self._sent: list[float] = []
        self._answered: dict[int, float] = {}

    def send(self, now: float) -> bytes:
        """Return the next message, sent at time `now` [s]."""
        self._sent.append(now)
        return (len(self._sent) - 1).to_bytes(8)

    def receive(self, message: bytes, now: float) -> None:
        """Record an answer at time `now` [s]; a duplicate is ignored."""
        self._answered.setdefault(int.from_bytes(message), now)

    def is_answered(self) -> bool:
        """Return True if the last message has been answered."""
        return len(self._sent) - 1 in self._answered

    def seconds(self) -> list[float]:
        """Return the duration until each answer [s]; infinite without an answer."""
        return [self._answered.get(number, np.inf) - sent for number, sent in enumerate(self._sent)]


def _send_statuses(pipe: Connection, url: str) -> None:
    """Send status messages from the second process, and put the round-trip durations [s] into the pipe."""
    lcm, answers = DrakeLcm(url), _Answers()
    lcm.Subscribe("ANSWER", lambda message: answers.receive(message, time.perf_counter()))
    with _realtime_priority():
        due = time.perf_counter() + 0.5
        for _ in range(round(SECONDS / PERIOD)):
            time.sleep(max(due - time.perf_counter(), 0.0))
            due += PERIOD
            lcm.Publish("STATUS", answers.send(time.perf_counter()))
            while not answers.is_answered() and time.perf_counter() < due:
                lcm.HandleSubscriptions(1)
    pipe.send(answers.seconds())


@contextmanager
def _realtime_priority() -> Iterator[None]:
    """Run with real-time priority if the system allows it."""
    has_priority = set_realtime_priority()
    try:
        yield
    finally:
        if has_priority:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@contextmanager
def _busy(is_busy: bool) -> Iterator[None]:
    """Run a busy process on every core if `is_busy`."""
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=_work, daemon=True) for _ in range((os.cpu_count() or 1) * is_busy)]
    for process in processes:
        process.start()
    try:
        yield
    finally:
        for process in processes:
            process.terminate()
            process.join()


def _work() -> None:
    matrix = np.random.default_rng(0).standard_normal((200, 200))
    while True:
        np.linalg.svd(matrix)


def show(results: dict[str, list[Row]]) -> None:
    """Print a table for each load."""
    columns = ("period_ms", "median_ms", "p99_ms", "worst_ms")
    for load, rows in results.items():
        print(f"{'the machine ' + load:<34}{'period':>9}{'median':>9}{'99 %':>9}{'worst':>9} [ms]   over")
        for row in rows:
            numbers = "".join(f"{row[name]:>9.2f}" for name in columns)
            print(f"{row['part']:<34}{numbers}   {row['over']} of {row['number']}")
