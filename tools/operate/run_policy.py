"""`guiderail run`: a learned skill on a real arm, or on a simulated one that stands in for it in a rehearsal."""

from __future__ import annotations

import gc
import io
import json
import os
import select
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from guiderail.diagrams.make import make_skill, resolve
from guiderail.diagrams.options import Options
from guiderail.diagrams.stations.hardware import HardwareStation
from guiderail.diagrams.stations.pace import Pace, RealTime, StepByStep, hurry
from guiderail.diagrams.stations.registry import STATIONS
from guiderail.diagrams.tasks.assemble import SkillDiagram
from guiderail.diagrams.tasks.insertion import InsertionTask
from guiderail.diagrams.trace import Trace
from guiderail.models.errors import InputError
from guiderail.models.joint_status import FAULTS, Fault
from guiderail.models.policy import Policy
from guiderail.models.robots.robot import DEFAULT_ROBOT
from guiderail.models.units import DEGREE, MM
from guiderail.systems.torque_guard import Phase
from guiderail.tools.files import write_atomically
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.rollouts.ledger import ledger_file, table

CRAWL, CRAWL_TURN = 0.02, 0.1  # [m/s], [rad/s] of the approach
FARTHEST, FARTHEST_TURN = 0.15, 1.0  # [m], [rad] from the skill's start, beyond which nobody wants to approach it alone
NEAR, NEAR_TURN = 3.0 * MM, 2.0 * DEGREE  # of the start, to begin there
SETTLE = 0.5  # [s], after the approach
STANDSTILL = 0.05  # [rad/s] of a joint
UNLOADED = 5.0  # [N]: what a robot feels at rest whose payload is known to it
SIGNALS = {"wrench": 6, "saturation": 1, "holding": 1, "fallback": 1, "commanded_violation": 1, "fault": 1, "phase": 1}
JOINT_SIGNALS = ("position_measured", "velocity_estimated", "torque_external", "torque_commanded")
# Contact takes a simulated robot with 1 kHz longer than the wall's clock would allow, on the machines that we know.
REHEARSAL_RATE = 0.2
WARM_UP = 0.1  # [s], less than a driver's hold-off
PATIENCE = 3.0  # [s] of wall clock that a rehearsal waits for a status

Say = Callable[[str], None]


@dataclass(frozen=True)
class Check:
    """What a person should know before the arm moves, and whether it is as it should be."""

    name: str
    words: str
    is_well: bool = True


@dataclass(frozen=True)
class Outcome:
    """How it ended: the fault that stopped the arm or NONE, in words, and at which step of the skill."""

    fault: Fault
    words: str
    steps: int

    @property
    def exit_code(self) -> int:
        """0 where the skill was executed to its end, 1 where something stopped it."""
        return 0 if self.words == "done" else 1


class Operation:
    """A skill on a robot: what is checked, the approach, the execution, and what was recorded of it.

    Attributes:
        trace: of the executed control steps.
    """

    def __init__(self, task: InsertionTask, skill: SkillDiagram, pace: Pace, is_stopped: Callable[[], bool]):
        """
        Args:
            task: whose skill it is.
            skill: with a `HardwareStation`.
            pace: how time passes.
            is_stopped: whether a person wants the arm to stop, asked at every control step.
        """
        self._task, self._skill, self._pace, self._is_stopped = task, skill, pace, is_stopped
        self._diagram = skill.diagram
        self._skills_station: HardwareStation = skill.diagram.GetSubsystemByName("station")
        # The guidance begins with its first control step. So another station on the same bus approaches the start.
        self._station = self._skills_station.alike(task.world())
        self._steps = round(skill.control_period / self._skills_station.period)
        self._start = task.start(np.random.default_rng(0))
        self._simulator = self._initialized()
        self.trace = Trace(skill.num_steps, 6, skill.control_period, SIGNALS)
        self._joints: dict[str, list[np.ndarray]] = {name: [] for name in JOINT_SIGNALS}

    def _initialized(self) -> Simulator:
        simulator = Simulator(self._station)
        self._station.get_desired_pose_input_port().FixValue(simulator.get_mutable_context(), np.full(6, np.nan))
        self._station.start(simulator)
        self._pace.begin()
        return simulator

    def checks(self) -> list[Check]:
        """What the robot's first status says, and what is assumed of it."""
        station, context = self._station, self._simulator.get_context()
        plant, arm = station.known.plant, station.known.arm
        pose = station.get_pose_output_port().Eval(context)
        away, turned = _distance(pose, self._start)
        name = station.driver.name
        positions, velocities = (
            station.GetOutputPort(f"{name}.{signal}").Eval(context)
            for signal in ("position_measured", "velocity_estimated")
        )
        external = station.GetOutputPort(f"{name}.torque_external").Eval(context)
        force = float(np.linalg.norm(station.force_of(positions, external)))
        fastest = float(np.abs(velocities).max())
        p_WT = arm.target.CalcPoseInWorld(plant.CreateDefaultContext()).translation()
        lower, upper = plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits()
        payload = sum(body.default_mass() for body in arm.tool)
        load = station.load_of_force(positions).max()
        limits = station.limits
        return [
            Check("robot", f"{name}, {len(positions)} joints, {station.driver.status_channel}"),
            Check(
                "joints",
                f"{np.rad2deg(positions).round(1).tolist()} degrees",
                bool((lower < positions).all() and (positions < upper).all()),
            ),
            Check("standstill", f"fastest joint {fastest:.3f} rad/s", fastest < STANDSTILL),
            Check("payload", f"{payload:.2f} kg bolted to the flange, as the robot must have been told"),
            Check("load", f"{force:.1f} N felt at rest", force < UNLOADED),
            Check("target", f"at {p_WT} m of the base"),
            Check("tool", f"at {pose[:3].round(4)} m and {np.rad2deg(pose[3:]).round(1)} degrees of the target"),
            Check(
                "start",
                f"{away / MM:.0f} mm and {turned / DEGREE:.0f} degrees away",
                away < FARTHEST and turned < FARTHEST_TURN,
            ),
            Check("force", f"at most {max(station.impedance.limits[:3]):.0f} N commanded, {limits.force:.0f} N felt"),
            Check("torques", f"at most {list(limits.torque)} Nm sent; the full force takes {load:.0%} of the nearest"),
            Check("workspace", f"from {limits.lower} to {limits.upper} m around the target"),
        ]

    def run(self, say: Say) -> Outcome:
        """Takes over where the arm is, approaches the skill's start at a crawl, executes it, and lets the arm rest.

        The arm is brought to rest whatever is raised, such as by a policy that returns no action.
        """
        self._warm_up()
        self._simulator = self._initialized()
        here = self._station.get_pose_output_port().Eval(self._simulator.get_context()).copy()
        say(f"taking over, and approaching the start at {CRAWL / MM:.0f} mm/s")
        try:
            stopped = self._approach(here)
            if stopped is None:
                say(f"executing {self._task.name}")
                stopped = self._execute()
        except BaseException:
            self._give_back()
            self._rest()
            raise
        self._rest()
        return stopped

    def _warm_up(self) -> None:
        """Whatever is called for the first time takes longer than the arm could wait between approach and skill.

        The skill's station hears statuses here, and is not yet settled enough to send anything.
        """
        simulator = Simulator(self._diagram)
        self._skills_station.start(simulator)
        self._pace.begin()
        self._pace.advance(simulator, self._skills_station, round(WARM_UP / self._skills_station.period))

    def _rest(self) -> None:
        station, context = self._acting()
        station.stop(context)
        self._pace.advance(self._simulator, station, round((station.limits.damping_time + 0.1) / station.period))

    def _give_back(self) -> None:
        """Lets the station that approached go on instead of the skill, which can't be advanced any more."""
        station, root = self._acting()
        if station is self._skills_station:
            before = station.GetMyContextFromRoot(root)
            self._simulator = self._initialized()
            self._station.take_over(self._simulator.get_mutable_context(), before)

    def _acting(self) -> tuple[HardwareStation, Context]:
        """The station that acts now, and the root context."""
        is_skill = self._simulator.get_system() is self._diagram
        return (self._skills_station if is_skill else self._station), self._simulator.get_mutable_context()

    def _step(self) -> Outcome | None:
        """Advances by a control step; how it ended, if it did."""
        station, root = self._acting()
        self._pace.advance(self._simulator, station, self._steps)
        context = station.GetMyContextFromRoot(root)
        phase, fault = (int(station.GetOutputPort(name).Eval(context)[0]) for name in ("phase", "fault"))
        force, limit = float(station.get_contact_force_output_port().Eval(context)[0]), self._task.collision.above
        if phase in (Phase.DAMPING, Phase.OFF):
            return Outcome(Fault(fault), FAULTS[Fault(fault)], len(self.trace))
        if self._is_stopped():
            return Outcome(Fault.ASKED, FAULTS[Fault.ASKED], len(self.trace))
        if force > limit:
            return Outcome(
                Fault.FORCE, f"pushed with {force:.0f} N, more than the task's {limit:.0f} N", len(self.trace)
            )
        return None

    def _approach(self, here: np.ndarray) -> Outcome | None:
        station, context = self._station, self._simulator.get_mutable_context()
        desired = station.get_desired_pose_input_port()
        away, turned = _distance(here, self._start)
        ready = 0.0
        while station.get_phase_output_port().Eval(context)[0] != Phase.RUNNING:
            desired.FixValue(context, here)
            ready += self._skill.control_period
            if (stopped := self._step()) is not None:
                return stopped
            if ready > 5.0:
                fault = Fault(int(station.get_fault_output_port().Eval(context)[0]))
                return Outcome(fault, f"could not take over: {FAULTS[fault]}", 0)
        moving = int(np.ceil(max(away / CRAWL, turned / CRAWL_TURN) / self._skill.control_period)) or 1
        change = _difference(self._start, here)
        for step in range(1, moving + round(SETTLE / self._skill.control_period)):
            desired.FixValue(context, here + min(step / moving, 1.0) * change)
            if (stopped := self._step()) is not None:
                return stopped
        away, turned = _distance(station.get_pose_output_port().Eval(context), self._start)
        if away > NEAR or turned > NEAR_TURN:
            words = f"the arm did not reach the start: {away / MM:.1f} mm and {turned / DEGREE:.1f} degrees are left"
            return Outcome(Fault.NONE, words, 0)
        return None

    def _execute(self) -> Outcome:
        before = self._simulator.get_context()
        station = self._skills_station
        simulator = Simulator(self._diagram)
        station.start(simulator)
        context = simulator.get_mutable_context()
        station.take_over(station.GetMyMutableContextFromRoot(context), before)
        self._simulator = simulator
        while len(self.trace) < self._skill.num_steps:
            stopped = self._step()
            self._record(context)
            if stopped is not None:
                return stopped
        return Outcome(Fault.NONE, "done", len(self.trace))

    def _record(self, context: Context) -> None:
        station, guidance = self._skills_station, self._diagram.GetSubsystemByName("guidance")
        mine, guiding = station.GetMyContextFromRoot(context), guidance.GetMyContextFromRoot(context)
        names = {"fallback": "fallback", "commanded_violation": "constraint_violation"}
        signals = {
            name: guidance.GetOutputPort(names[name]).Eval(guiding)
            if name in names
            else station.GetOutputPort(name).Eval(mine)
            for name in SIGNALS
        }
        self.trace.append(
            guidance.GetOutputPort("desired_pose").Eval(guiding),
            station.get_pose_output_port().Eval(mine),
            float(station.get_contact_force_output_port().Eval(mine)[0]),
            np.nan,  # nobody judges here
            signals,
        )
        for name, values in self._joints.items():
            values.append(station.GetOutputPort(f"{station.driver.name}.{name}").Eval(mine).copy())

    def write(self, folder: Path, found: Mapping[str, Any]) -> Path:
        """Writes a ledger of the control steps, the joints' too, and beside it what was found; returns its path."""
        folder.mkdir(parents=True, exist_ok=True)
        number = len(list(folder.glob("episode-*.json")))
        ledger = table(self.trace, number)
        joints = self._station.known.plant.num_positions()
        for name, values in self._joints.items():
            for joint, column in enumerate(np.reshape(values, (len(self.trace), joints)).T):
                ledger = ledger.append_column(f"{name}_{joint}", pa.array(column))
        file = io.BytesIO()
        pq.write_table(ledger, file, compression="NONE", use_dictionary=False)
        path = ledger_file(folder, number)
        write_atomically(path, file.getvalue())
        write_atomically(path.with_suffix(".json"), json.dumps(dict(found), indent=2).encode() + b"\n")
        return path


def run_policy(
    run: Path,
    *,
    station: str = "hardware",
    lcm_url: str = "",
    robot: str = DEFAULT_ROBOT,
    rehearse: bool = False,
    lockstep: bool = False,
    rate: float = REHEARSAL_RATE,
    yes: bool = False,
    out: Path | None = None,
    say: Say = print,
) -> int:
    """Runs a run's policy on a robot; returns the exit code: 0 for done, 1 where something stopped it.

    Args:
        run: the folder of a run.
        station: a real one.
        lcm_url: of the bus; LCM's own default where it is empty, and in a rehearsal one of this process alone.
        robot: which arm.
        rehearse: a simulated robot stands in, in a process of its own.
        lockstep: of a rehearsal: each side waits for the other instead of going by the wall's clock.
        rate: of a simulated robot's clock to the wall's.
        yes: what is read out is confirmed.
        out: the folder of what is recorded; `hardware` in the run unless given.
        say: what a person is told.

    Raises:
        InputError: for what can't be run, where no robot answers, or a check fails or isn't confirmed.
    """
    if lockstep and not rehearse:
        raise InputError("a real robot waits for nobody: --lockstep is for a rehearsal")
    folder = RunFolder(run)
    config, policy = folder.config(), Policy.load(folder.path)
    environment = _on_a_robot(config.task, config.environment, station)
    if rehearse:
        # With a time to live of zero no message leaves this machine.
        lcm_url = lcm_url or f"udpm://239.255.76.67:{20000 + os.getpid() % 20000}?ttl=0"
    environment |= {"station": station, "lcm_url": lcm_url, "robot": robot}
    if rehearse:
        environment["robot_timeout"] = 60.0  # it starts with this command
    task = resolve(config.task, environment).task
    if not isinstance(task, InsertionTask):
        raise InputError(f"{config.task} has no pose that an arm could approach to begin: run an insertion")
    skill = make_skill(config.task, policy, **environment)
    bus = skill.diagram.GetSubsystemByName("station")
    with (
        _stand_in(config.task, robot, lcm_url, None if lockstep else rate) if rehearse else _nothing(),
        _stop_key() as is_stopped,
    ):
        channel, period = bus.driver.status_channel, bus.period
        clock = RealTime(bus.lcm, channel, period, rate if rehearse else 1.0)
        pace: Pace = StepByStep(bus.lcm, PATIENCE, channel, period) if lockstep else clock
        say(f"waiting for a status of {robot} on {lcm_url or 'the default bus'}, channel {bus.driver.status_channel}")
        operation = Operation(task, skill, pace, is_stopped)
        checks = operation.checks()
        for check in checks:
            say(f"{'ok ' if check.is_well else 'NOT'}  {check.name:<12}{check.words}")
        wrong = [check for check in checks if not check.is_well]
        if wrong:
            raise InputError(f"the arm stays where it is: {wrong[0].name}: {wrong[0].words}")
        if not yes:
            _confirm()
        if not lockstep and not hurry():
            say("the system serves this process as any other: on a busy machine the arm will be stopped as late")
        say("Enter or Ctrl-C stops the arm")
        with _no_pauses():
            outcome = operation.run(say)
    found: dict[str, Any] = {
        "task": config.task,
        "run": folder.path.name,
        "robot": robot,
        "rehearsal": rehearse,
        "outcome": outcome.words,
        "fault": outcome.fault.name,
        "steps": outcome.steps,
        "checks": {check.name: check.words for check in checks},
    }
    if not lockstep:
        found["milliseconds_between_statuses"] = {
            "period": period / (rate if rehearse else 1.0) / MM,
            "99 %": clock.gaps.quantile(0.99) / MM,
            "longest": clock.gaps.longest / MM,
        }
    if outcome.steps:
        away, turned = _distance(operation.trace.measured[-1], np.zeros(6))
        found |= {"millimetres_from_target": away / MM, "degrees_from_target": turned / DEGREE}
        found["peak_force"] = float(operation.trace.force.max())
        say(f"ended {away / MM:.1f} mm and {turned / DEGREE:.1f} degrees from the nominal target")
    say(f"{outcome.words}, after {outcome.steps} control steps: {operation.write(out or run / 'hardware', found)}")
    return outcome.exit_code


def _on_a_robot(task: str, environment: Mapping[str, Any], station: str) -> dict[str, Any]:
    """An environment's options without those of the station that it was learned on."""
    kind = STATIONS.get(station)
    if kind.simulated:
        raise InputError(f"station {station!r} is a simulation: watch the policy there by guiderail replay")
    learned_on = STATIONS.get(resolve(task, environment).station.name).options or Options
    return {name: value for name, value in environment.items() if name not in learned_on.model_fields}


def _difference(to: np.ndarray, at: np.ndarray) -> np.ndarray:
    change = to - at
    change[3:] = (change[3:] + np.pi) % (2.0 * np.pi) - np.pi
    return change


def _distance(one: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Between two poses [m], and between the farthest of their angles [rad]."""
    change = _difference(one, other)
    return float(np.linalg.norm(change[:3])), float(np.abs(change[3:]).max())


def _confirm() -> None:
    if not sys.stdin.isatty():
        raise InputError("nobody is there to confirm this: read it, and say --yes")
    if input("Is all of this so, and is the workspace clear? Type yes: ").strip().lower() != "yes":
        raise InputError("not confirmed: nothing has moved")


@contextmanager
def _nothing() -> Iterator[None]:
    yield


@contextmanager
def _no_pauses() -> Iterator[None]:
    """A garbage collection takes longer than a robot waits for a command."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


@contextmanager
def _stop_key() -> Iterator[Callable[[], bool]]:
    """Whether Enter or Ctrl-C was pressed since; the second Ctrl-C ends the process."""
    pressed: list[int] = []

    def press(number: int, frame: object) -> None:
        pressed.append(number)
        signal.signal(signal.SIGINT, before)

    def is_stopped() -> bool:
        if not pressed and sys.stdin.isatty() and select.select([sys.stdin], [], [], 0.0)[0]:
            sys.stdin.readline()
            pressed.append(0)
        return bool(pressed)

    before = signal.signal(signal.SIGINT, press)
    try:
        yield is_stopped
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _stand_in(task: str, robot: str, lcm_url: str, rate: float | None) -> Iterator[None]:
    """A simulated robot in a process of its own."""
    if robot != DEFAULT_ROBOT:
        raise InputError(f"only the {DEFAULT_ROBOT} has a simulated driver to rehearse with, not {robot}")
    arguments = ["serve-iiwa", "--url", lcm_url, "--task", task, "--patience", "30"]
    arguments += [] if rate is None else ["--rate", str(rate)]
    call = f"from guiderail.tools.command import main; main({arguments!r})"
    # Ctrl-C is meant for us: a robot that ends can't come to rest.
    process = subprocess.Popen([sys.executable, "-c", call], start_new_session=True)
    try:
        yield
    finally:
        process.terminate()
        process.wait()
