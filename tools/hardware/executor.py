"""`guiderail run`: a learned skill on a real arm, or on a simulated one that stands in for it in a rehearsal."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from guiderail.diagrams.envs.assemble import SkillDiagram
from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_skill
from guiderail.diagrams.envs.options import Options
from guiderail.diagrams.envs.trace import EpisodeTrace
from guiderail.diagrams.hardware.clock import Clock, set_realtime_priority
from guiderail.diagrams.hardware.lcm.driver import MessageCounter
from guiderail.diagrams.hardware.station import HardwareStation
from guiderail.diagrams.stations.registry import STATIONS
from guiderail.diagrams.tasks.insertion import InsertionTask
from guiderail.models.common.errors import InputError
from guiderail.models.common.units import DEGREE, MM
from guiderail.models.control.joint_status import FAULT_DESCRIPTIONS, Fault
from guiderail.models.policy import Policy
from guiderail.systems.torque_safety_limiter import ArmState
from guiderail.tools.evaluation.step_log import step_log_file, table, write_step_log
from guiderail.tools.files import check_writable, write_atomically
from guiderail.tools.hardware.connection import RobotConnection
from guiderail.tools.hardware.preflight import LISTENING, Check, check_robot, confirm_checks
from guiderail.tools.hardware.slow_motion import CRAWL, crawl, distance, is_near
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.teleop.teleoperator import listening, no_pauses

SIGNALS = {
    "wrench": 6,
    "saturation": 1,
    "command_timed_out": 1,
    "fallback": 1,
    "commanded_violation": 1,
    "fault": 1,
    "arm_state": 1,
}
JOINT_SIGNALS = ("position_measured", "velocity_estimated", "torque_external", "torque_commanded")
WARM_UP = 0.1  # [s], less than a driver's hold-off

Say = Callable[[str], None]


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


class SkillExecutor:
    """A skill on a robot: what is checked, the approach, the execution, and what was recorded of it.

    Attributes:
        trace: of the executed control steps.
    """

    def __init__(self, task: InsertionTask, skill: SkillDiagram, pace: Clock, is_stopped: Callable[[], bool]):
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
        self._station = self._skills_station.clone(task.workcell())
        self._steps = round(skill.control_period / self._skills_station.period)
        self._start = task.start_pose(np.random.default_rng(0))
        self._simulator = self._initialized()
        # A deputy may need a status or two to be heard; nothing is sent so soon.
        self._heard = MessageCounter(self._station.lcm, self._station.driver.command_channel)
        pace.advance(self._simulator, self._station, LISTENING)
        self.trace = EpisodeTrace(skill.num_steps, 6, skill.control_period, SIGNALS)
        self._joints: dict[str, list[np.ndarray]] = {name: [] for name in JOINT_SIGNALS}

    def _initialized(self) -> Simulator:
        simulator = Simulator(self._station)
        self._station.get_desired_pose_input_port().FixValue(simulator.get_mutable_context(), np.full(6, np.nan))
        self._station.start(simulator)
        self._pace.begin()
        return simulator

    def checks(self) -> list[Check]:
        """What the robot's first statuses say, and what is assumed of it."""
        return check_robot(self._station, self._simulator.get_context(), self._start, self._heard.count)

    def checks_again(self) -> list[Check]:
        """The same of now, after a person took their time, in which nobody listened."""
        self._pace.begin()
        self._pace.advance(self._simulator, self._station, self._steps)
        # A simulator that knew where the arm was would not believe at once where somebody moved it meanwhile.
        self._simulator = self._initialized()
        self._pace.advance(self._simulator, self._station, LISTENING)
        return self.checks()

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
            self._station.copy_state_from(self._simulator.get_mutable_context(), before)

    def _acting(self) -> tuple[HardwareStation, Context]:
        """The station that acts now, and the root context."""
        is_skill = self._simulator.get_system() is self._diagram
        return (self._skills_station if is_skill else self._station), self._simulator.get_mutable_context()

    def _step(self) -> Outcome | None:
        """Advances by a control step; how it ended, if it did."""
        station, root = self._acting()
        self._pace.advance(self._simulator, station, self._steps)
        context = station.GetMyContextFromRoot(root)
        arm_state, fault = (int(station.GetOutputPort(name).Eval(context)[0]) for name in ("arm_state", "fault"))
        force, limit = float(station.get_contact_force_output_port().Eval(context)[0]), self._task.collision.above
        if arm_state in (ArmState.DAMPING, ArmState.OFF):
            return Outcome(Fault(fault), FAULT_DESCRIPTIONS[Fault(fault)], len(self.trace))
        if self._is_stopped():
            return Outcome(Fault.USER_STOP, FAULT_DESCRIPTIONS[Fault.USER_STOP], len(self.trace))
        if force > limit:
            return Outcome(
                Fault.FORCE_LIMIT, f"pushed with {force:.0f} N, more than the task's {limit:.0f} N", len(self.trace)
            )
        return None

    def _approach(self, here: np.ndarray) -> Outcome | None:
        station, context = self._station, self._simulator.get_mutable_context()
        desired = station.get_desired_pose_input_port()
        ready = 0.0
        while station.get_arm_state_output_port().Eval(context)[0] != ArmState.RUNNING:
            desired.FixValue(context, here)
            ready += self._skill.control_period
            if (stopped := self._step()) is not None:
                return stopped
            if ready > 5.0:
                fault = Fault(int(station.get_fault_output_port().Eval(context)[0]))
                return Outcome(fault, f"could not take over: {FAULT_DESCRIPTIONS[fault]}", 0)
        for pose in crawl(here, self._start, self._skill.control_period):
            desired.FixValue(context, pose)
            if (stopped := self._step()) is not None:
                return stopped
        there = station.get_pose_output_port().Eval(context)
        if not is_near(there, self._start):
            away, turned = distance(there, self._start)
            words = f"the arm did not reach the start: {away / MM:.1f} mm and {turned / DEGREE:.1f} degrees are left"
            return Outcome(Fault.NONE, words, 0)
        return None

    def _execute(self) -> Outcome:
        before = self._simulator.get_context()
        station = self._skills_station
        simulator = Simulator(self._diagram)
        station.start(simulator)
        context = simulator.get_mutable_context()
        station.copy_state_from(station.GetMyMutableContextFromRoot(context), before)
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
        # Before the trace: whoever is interrupted in between has a sample too many, and none too few.
        for name, values in self._joints.items():
            values.append(station.GetOutputPort(f"{station.driver.name}.{name}").Eval(mine).copy())
        self.trace.append(
            guidance.GetOutputPort("desired_pose").Eval(guiding),
            station.get_pose_output_port().Eval(mine),
            float(station.get_contact_force_output_port().Eval(mine)[0]),
            np.nan,  # nobody judges here
            signals,
        )

    def keep(self, folder: Path, outcome: Outcome, found: Mapping[str, Any], say: Say) -> None:
        """Writes what was recorded, however it ended, and says where; `found` is what else is known of it."""
        found = {**found, "outcome": outcome.words, "fault": outcome.fault.name, "steps": outcome.steps}
        if outcome.steps:
            away, turned = distance(self.trace.measured[-1], np.zeros(6))
            found |= {"millimetres_from_target": away / MM, "degrees_from_target": turned / DEGREE}
            found["peak_force"] = float(self.trace.force.max())
            say(f"ended {away / MM:.1f} mm and {turned / DEGREE:.1f} degrees from the nominal target")
        say(f"{outcome.words}, after {outcome.steps} control steps: {self.write(folder, found)}")

    def write(self, folder: Path, found: Mapping[str, Any]) -> Path:
        """Writes a step log of the control steps, the joints' too, and beside it what was found; returns its path."""
        folder.mkdir(parents=True, exist_ok=True)
        number = _next_number(folder)
        step_log = table(self.trace, number)
        joints = self._station.controller_plant.plant.num_positions()
        for name, values in self._joints.items():
            for joint, column in enumerate(np.reshape(values[: len(self.trace)], (len(self.trace), joints)).T):
                step_log = step_log.append_column(f"{name}_{joint}", pa.array(column))
        path = step_log_file(folder, number)
        write_step_log(path, step_log)
        write_atomically(path.with_suffix(".json"), json.dumps(dict(found), indent=2).encode() + b"\n")
        return path


def _next_number(folder: Path) -> int:
    """Of a recording: one above all that are there, whichever of their files somebody took away."""
    found = (re.match(r"episode-(\d+)\.", file.name) for file in folder.iterdir())
    return max((int(one.group(1)) for one in found if one), default=-1) + 1


def run_policy(
    run: Path,
    other: RobotConnection,
    *,
    station: str = "hardware",
    yes: bool = False,
    out: Path | None = None,
    say: Say = print,
) -> int:
    """Runs a run's policy on a robot; returns the exit code: 0 for done, 1 where something stopped it.

    Args:
        run: the folder of a run.
        other: the other end of the bus.
        station: a real one.
        yes: what is read out is confirmed.
        out: the folder of what is recorded; `hardware` in the run unless given.
        say: what a person is told.

    Raises:
        InputError: for what can't be run, or recorded there, where no robot answers, or a check fails or isn't
            confirmed.
    """
    folder, recorded = RunFolder(run), out or run / "hardware"
    config, policy = folder.config(), Policy.load(folder.path)
    check_writable(step_log_file(recorded, 0))
    environment = on_a_robot(config.task, config.environment, station) | other.environment(station)
    task = EnvConfig.resolve(config.task, environment).make_task()
    if not isinstance(task, InsertionTask):
        raise InputError(f"{config.task} has no pose that an arm could approach to begin: run an insertion")
    skill = make_skill(config.task, policy, **environment)
    bus: HardwareStation = skill.diagram.GetSubsystemByName("station")
    with other.standing_in(config.task, environment["lcm_url"], config.imports), listening() as keys:
        pace, clock = other.paces(bus)
        say(f"waiting for {other.robot} on {environment['lcm_url'] or 'LCM'}, channel {bus.driver.status_channel}")
        operation = SkillExecutor(task, skill, pace, keys.stops)
        checks = operation.checks()
        confirm_checks(checks, say, again=operation.checks_again, is_confirmed=yes)
        if not other.synchronous and not set_realtime_priority():
            say("the system serves this process as any other: on a busy machine the arm will be stopped as late")
        say(keys.words())
        found: dict[str, Any] = {
            "task": config.task,
            "run": folder.path.name,
            "robot": other.robot,
            "rehearsal": other.sim,
            "checks": {check.name: check.words for check in checks},
        }
        with no_pauses():
            try:
                outcome = operation.run(say)
            except BaseException as error:
                outcome = Outcome(Fault.NONE, f"failed: {type(error).__name__}: {error}", len(operation.trace))
                raise
            finally:
                operation.keep(recorded, outcome, {**found, **other.timing(bus, clock)}, say)
    return outcome.exit_code


def on_a_robot(task: str, environment: Mapping[str, Any], station: str) -> dict[str, Any]:
    """An environment's options without those of the station that it was learned on."""
    kind = STATIONS.get(station)
    if kind.is_simulated:
        raise InputError(f"station {station!r} is a simulation: watch the policy there by guiderail replay")
    learned_on = STATIONS.get(EnvConfig.resolve(task, environment).station).options or Options
    return {name: value for name, value in environment.items() if name not in learned_on.model_fields}
