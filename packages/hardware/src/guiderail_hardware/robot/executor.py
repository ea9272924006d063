"""Execution of a policy on a robot: `guiderail deploy`."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from guiderail.diagrams.envs.assemble import SkillDiagram
from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_skill
from guiderail.diagrams.envs.options import Options, choices_of, option_fields
from guiderail.diagrams.envs.trace import EpisodeTrace
from guiderail.diagrams.stations.options import Disturbances
from guiderail.diagrams.stations.registry import STATIONS
from guiderail.diagrams.tasks.insertion import InsertionTask
from guiderail.diagrams.tasks.registry import TASKS
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import DEGREE, MM
from guiderail.models.policy import Policy
from guiderail.tools.environments import task_named
from guiderail.tools.evaluation.step_log import step_log_file, table, write_step_log
from guiderail.tools.evaluation.subject import find_subject
from guiderail.tools.files import check_writable, write_atomically
from guiderail.tools.learning.run_folder import RunConfig, RunFolder
from guiderail.tools.pretrained import PRETRAINED, find_run
from guiderail_hardware.drivers.clock import Clock, garbage_collection_disabled, set_realtime_priority
from guiderail_hardware.drivers.driver import describe_stop
from guiderail_hardware.models.joint_status import Fault
from guiderail_hardware.robot.connection import (
    NO_REALTIME_PRIORITY,
    DriverEndedError,
    Log,
    RobotConnection,
    watch_process,
)
from guiderail_hardware.robot.operator import operator_keys
from guiderail_hardware.robot.preflight import (
    SPEED,
    PreflightChecks,
    advance_to_rest,
    confirm_checks,
    describe_distance,
    is_near,
    make_holding_simulator,
    pose_distance,
    slow_approach,
    start_simulator,
)
from guiderail_hardware.robot.records import check_room, write_record
from guiderail_hardware.station import HardwareStation
from guiderail_hardware.systems.torque_safety_limiter import STOPPED, ArmState

# Recorded signals of a control step and their sizes.
SIGNALS = {
    "wrench": 6,
    "saturation": 1,
    "command_timed_out": 1,
    "fallback": 1,
    "commanded_violation": 1,
    "fault": 1,
    "arm_state": 1,
}
# Recorded signals of the joints, of size n each.
JOINT_SIGNALS = ("position_measured", "velocity_estimated", "torque_external", "torque_commanded")
MAX_WARM_UP_TIME = 0.1  # longest duration of the warm-up [s]
MAX_JOINTS = 7  # largest number of joints, for the estimated size of a recording
BLEND_TIMEOUT = 5.0  # longest time until the controller has full authority [s]
COMPLETED = "executed to its end"


@dataclass(frozen=True)
class Outcome:
    """Outcome of an execution."""

    fault: Fault  # fault that stopped the arm, or NONE
    description: str  # the outcome in words
    steps: int  # number of executed control steps of the skill

    @property
    def exit_code(self) -> int:
        """Exit code of the program: 0 if the skill was executed to its end, otherwise 1."""
        return 0 if self.description == COMPLETED else 1


class SkillExecutor:
    """Executes a skill on a robot: pre-flight checks, approach, execution, recording.

    Attributes:
        preflight: Pre-flight checks of the arm.
        trace: Trace of the executed control steps.
    """

    def __init__(self, task: InsertionTask, skill: SkillDiagram, clock: Clock, is_stop_requested: Callable[[], bool]):
        """Connect to the robot.

        Args:
            task: Task of the skill.
            skill: Skill with a `HardwareStation`.
            clock: Clock of the station.
            is_stop_requested: Function called in each control step; True stops the arm.

        Raises:
            InputError: If no robot answers.
        """
        self._task, self._skill, self._clock, self._is_stop_requested = task, skill, clock, is_stop_requested
        self._diagram = skill.diagram
        self._skill_station: HardwareStation = skill.diagram.GetSubsystemByName("station")
        # The guidance begins its motion when its diagram is first advanced. The approach therefore uses a clone of the
        # station, on the same driver.
        self._station = self._skill_station.clone(task.workcell())
        self._steps = round(skill.control_period / self._skill_station.period)
        self._start = task.start_pose(np.random.default_rng(0))
        # The approach has the force bound of the skill's first step.
        context = self._skill_station.GetMyContextFromRoot(skill.diagram.CreateDefaultContext())
        self._max_wrench = self._skill_station.read_max_wrench(context)
        self.preflight = PreflightChecks(self._station, clock, self._start, self._steps, self._max_wrench)
        self._simulator = self.preflight.simulator
        self.trace = EpisodeTrace(skill.num_steps, 6, skill.control_period, SIGNALS)
        self._joints: dict[str, list[np.ndarray]] = {name: [] for name in JOINT_SIGNALS}

    def run(self, log: Log) -> Outcome:
        """Take control of the arm, approach the skill's start slowly, execute the skill, and damp the arm to rest.

        The arm is brought to rest after any exception too, for example if a policy returns no action. An exception of
        the driver stops the arm as a fault does. The outcome reports a failure of commands that bring the arm to rest.

        Raises:
            InputError: If no robot answers.
        """
        self._warm_up()
        self._simulator = start_simulator(self._station, self._clock, self._max_wrench)
        log(f"taking over, and approaching the start at {SPEED / MM:.0f} mm/s")
        try:
            outcome = self._approach(log)
            if outcome is None:
                log(f"executing {self._task.name}")
                outcome = self._execute()
        except BaseException:
            self._return_control()
            if failure := self._rest():
                log(failure)
            raise
        if failure := self._rest():
            fault = outcome.fault or Fault.COMMAND_FAILED
            return replace(outcome, fault=fault, description=f"{outcome.description}; {failure}")
        return outcome

    def _warm_up(self) -> None:
        """Run every code path of the skill once: first calls (imports, caches) would miss the control deadline.

        The skill's station receives statuses, but for less than the settling time, after which it sends commands.
        """
        duration = min(MAX_WARM_UP_TIME, 0.5 * self._skill_station.status_limits.settling_time)
        simulator = Simulator(self._diagram)
        self._skill_station.start(simulator, self._clock.check_robot)
        self._clock.begin()
        self._clock.advance(simulator, self._skill_station, round(duration / self._skill_station.period))

    def _rest(self) -> str:
        """Damp the arm to rest; return a message about commands that could not be sent, or an empty text."""
        station, context = self._active_station()
        station.stop(context)
        return advance_to_rest(self._clock, self._simulator, station)

    def _return_control(self) -> None:
        """Control the arm by the approach's station in a new simulator.

        Drake cannot continue a simulator that raised within a step.
        """
        station, root_context = self._active_station()
        context = station.GetMyContextFromRoot(root_context)
        simulator = make_holding_simulator(self._station, self._max_wrench)
        self._station.take_over(simulator, station, context)
        self._simulator = simulator
        self._clock.begin()

    def _active_station(self) -> tuple[HardwareStation, Context]:
        """Return the station that controls the arm, and the root context."""
        is_skill = self._simulator.get_system() is self._diagram
        return (self._skill_station if is_skill else self._station), self._simulator.get_mutable_context()

    def _step(self) -> Outcome | None:
        """Advance by a control step; return the outcome if the arm is stopped or must be stopped.

        The `steps` of the outcome are 0.
        """
        station, root_context = self._active_station()
        self._clock.advance(self._simulator, station, self._steps)
        context = station.GetMyContextFromRoot(root_context)
        arm_state, fault = (int(station.GetOutputPort(name).Eval(context)[0]) for name in ("arm_state", "fault"))
        force, limit = float(station.get_impedance_force_output_port().Eval(context)[0]), self._task.collision.above
        if arm_state in STOPPED:
            return Outcome(Fault(fault), describe_stop(Fault(fault), station.driver), 0)
        if self._is_stop_requested():
            return Outcome(Fault.USER_STOP, Fault.USER_STOP.description, 0)
        if force > limit:
            return Outcome(Fault.FORCE_LIMIT, f"pushed with {force:.0f} N, more than the task's {limit:.0f} N", 0)
        return None

    def _approach(self, log: Log) -> Outcome | None:
        """Take control where the arm is, and move to the start; return the outcome if the arm was stopped."""
        station, context = self._station, self._simulator.get_mutable_context()
        desired_pose = station.get_desired_pose_input_port()
        elapsed = 0.0
        # Before RUNNING, the station holds the arm. No pose is commanded, because a single status may be wrong.
        while station.get_arm_state_output_port().Eval(context)[0] != ArmState.RUNNING:
            elapsed += self._skill.control_period
            if (outcome := self._step()) is not None:
                return outcome
            if elapsed > BLEND_TIMEOUT:
                fault = Fault(int(station.get_fault_output_port().Eval(context)[0]))
                return Outcome(fault, f"could not take over: {describe_stop(fault, station.driver)}", 0)
        if text := station.describe_round_trip():
            log(text)
        pose = station.get_pose_output_port().Eval(context).copy()
        for command in slow_approach(pose, self._start, self._skill.control_period):
            desired_pose.FixValue(context, command)
            if (outcome := self._step()) is not None:
                return outcome
        reached = station.get_pose_output_port().Eval(context)
        if not is_near(reached, self._start):
            return Outcome(Fault.NONE, describe_distance(reached, self._start), 0)
        return None

    def _execute(self) -> Outcome:
        approach_context = self._simulator.get_context()
        station = self._skill_station
        simulator = Simulator(self._diagram)
        station.take_over(simulator, self._station, approach_context)
        context = simulator.get_mutable_context()
        self._simulator = simulator
        while len(self.trace) < self._skill.num_steps:
            outcome = self._step()
            self._record(context)
            if outcome is not None:
                return replace(outcome, steps=len(self.trace))  # the step in which the arm was stopped counts
        return Outcome(Fault.NONE, COMPLETED, len(self.trace))

    def _record(self, context: Context) -> None:
        station, guidance = self._skill_station, self._diagram.GetSubsystemByName("guidance")
        station_context, guidance_context = (system.GetMyContextFromRoot(context) for system in (station, guidance))
        guidance_ports = {"fallback": "fallback", "commanded_violation": "constraint_violation"}
        signals = {
            name: guidance.GetOutputPort(guidance_ports[name]).Eval(guidance_context)
            if name in guidance_ports
            else station.GetOutputPort(name).Eval(station_context)
            for name in SIGNALS
        }
        # Joint signals are appended first: an interruption in between leaves them with one sample more than the trace,
        # never with one sample less.
        for name, values in self._joints.items():
            values.append(station.GetOutputPort(f"{station.driver.name}.{name}").Eval(station_context).copy())
        self.trace.append(
            guidance.GetOutputPort("desired_pose").Eval(guidance_context),
            station.get_pose_output_port().Eval(station_context),
            float(station.get_impedance_force_output_port().Eval(station_context)[0]),
            np.nan,  # no reward is computed on hardware
            signals,
        )

    def save(self, folder: Path, outcome: Outcome, metadata: Mapping[str, Any], log: Log) -> None:
        """Write the recording with its outcome and further metadata, and log its path."""
        metadata = {**metadata, "outcome": outcome.description, "fault": outcome.fault.name, "steps": outcome.steps}
        distance_text = ""
        if outcome.steps:
            distance, angle = pose_distance(self.trace.measured[-1], np.zeros(6))
            metadata |= {"millimeters_from_target": distance / MM, "degrees_from_target": angle / DEGREE}
            metadata["peak_force"] = float(self.trace.force.max())
            distance_text = f"ended {distance / MM:.1f} mm and {angle / DEGREE:.1f} degrees from the nominal target"
        # The recording is written before messages are logged, because SIGHUP closes the terminal.
        path, failure = self.write(folder, metadata)
        if distance_text:
            log(distance_text)
        log(f"{outcome.description}, after {outcome.steps} control steps: {path}")
        if failure:
            log(f"the motion was executed, but {failure}")

    def write(self, folder: Path, metadata: Mapping[str, Any]) -> tuple[Path, str]:
        """Write the control steps with joint signals as Parquet, and the metadata as JSON.

        Returns:
            The path of the Parquet file, and a message if it is in another folder, as `write_record` returns them.
        """
        number = _next_number(folder)
        steps = table(self.trace, number)
        num_joints = self._station.controller_plant.plant.num_positions()
        for name, values in self._joints.items():
            columns = np.reshape(values[: len(self.trace)], (len(self.trace), num_joints)).T
            for joint, column in enumerate(columns):
                steps = steps.append_column(f"{name}_{joint}", pa.array(column))
        # JSON has no NaN and infinite numbers, such as statistics of zero statuses: they become null.
        values = json.loads(json.dumps(dict(metadata)), parse_constant=lambda name: None)

        def write(path: Path) -> None:
            write_step_log(path, steps)
            write_atomically(path.with_suffix(".json"), json.dumps(values, indent=2).encode() + b"\n")

        return write_record(step_log_file(folder, number), write)


def record_size(num_steps: int) -> int:
    """Return an upper estimate of the size of the recording of `num_steps` control steps [bytes]."""
    columns = 16 + sum(SIGNALS.values()) + len(JOINT_SIGNALS) * MAX_JOINTS
    return 200_000 + 10 * columns * num_steps


def _next_number(folder: Path) -> int:
    """Return a number above those of all recordings in a folder; one of a recording's two files may be missing."""
    with suppress(OSError):
        matches = (re.match(r"episode-(\d+)\.", file.name) for file in folder.iterdir())
        return max((int(match.group(1)) for match in matches if match), default=-1) + 1
    return 0


def deploy(
    run: Path,
    connection: RobotConnection,
    *,
    task: str | None = None,
    station: str = "hardware",
    force_limit: float | None = None,
    assume_yes: bool = False,
    out: Path | None = None,
    log: Log = print,
) -> int:
    """Execute the policy of a run on a robot.

    Args:
        run: Run folder, or `pretrained:NAME`.
        connection: Connection to the robot driver.
        task: Task or task folder in which a policy without a run acts; None for a run.
        station: Name of a hardware station.
        force_limit: Contact force above which the arm is stopped [N], by default the limit of the training. A lower
            limit makes the first motion on a robot safer; a higher limit is refused.
        assume_yes: Do not ask for confirmation of the pre-flight checks.
        out: Folder of the recording; `recordings_folder` by default.
        log: Function that shows a message.

    Returns:
        The exit code: 0 if the skill was executed to its end, 1 if it was stopped or did not reach the start.

    Raises:
        InputError: If the task is no insertion, the policy cannot be executed or recorded, the folder has no room for
            the recording, the force limit is above the limit of the training, no robot answers, a check fails or is not
            confirmed, or a signal arrives before the arm may move.
    """
    config, policy = configuration(run, task), Policy.load(find_run(run))
    recordings = out or recordings_folder(run)
    check_writable(step_log_file(recordings, 0))
    environment = hardware_environment(config.task, config.environment, station)
    environment |= connection.environment_options(station)
    resolved = EnvConfig.resolve(config.task, environment)
    declared = resolved.declared
    if not isinstance(declared, InsertionTask):
        raise InputError(f"{config.task} has no start pose for an arm: deploy the policy of an insertion")
    check_room(step_log_file(recordings, 0), record_size(resolved.num_steps))
    if force_limit is not None:
        if not force_limit <= declared.largest_force_limit:
            raise InputError(
                f"the policy was learned with a force limit of {declared.largest_force_limit:g} N: give a lower one"
            )
        name = "force_limit" if environment.get("force_limit_range") is None else "force_limit_range"
        environment[name] = force_limit if name == "force_limit" else (force_limit, force_limit)
        declared = EnvConfig.resolve(config.task, environment).declared
        assert isinstance(declared, InsertionTask)
    skill = make_skill(config.task, policy, **environment)
    skill_station: HardwareStation = skill.diagram.GetSubsystemByName("station")
    with (
        connection.simulated_driver(config.task, environment["robot_url"], config.imports) as process,
        operator_keys() as keys,
    ):
        clock, wall_clock = connection.clocks(skill_station)
        watch_process(clock, process)
        log(f"waiting for {connection.robot} on {skill_station.driver}")
        executor = SkillExecutor(declared, skill, clock, keys.is_stop_requested)
        checks = confirm_checks(executor.preflight, log, assume_yes=assume_yes)
        if not connection.synchronous and not set_realtime_priority():
            log(NO_REALTIME_PRIORITY)
        log(keys.describe())
        metadata: dict[str, Any] = {
            "task": config.task,
            "run": find_run(run).name,
            "robot": connection.robot,
            "sim": connection.sim,
            "checks": {check.name: check.description for check in checks},
        }
        keys.is_moving = True
        with garbage_collection_disabled():
            try:
                outcome = executor.run(log)
            except DriverEndedError as error:
                outcome = Outcome(Fault.STALE, str(error), len(executor.trace))
            except BaseException as error:
                outcome = Outcome(Fault.NONE, f"failed: {type(error).__name__}: {error}", len(executor.trace))
                raise
            finally:
                executor.save(recordings, outcome, {**metadata, **connection.timing(skill_station, wall_clock)}, log)
    return outcome.exit_code


def configuration(run: Path, task: str | None) -> RunConfig:
    """Return the configuration of a run, or that of `task`, a task or its folder, for a policy without a run.

    Raises:
        InputError: If there is no such run, policy or task, or the task of the run has changed.
    """
    if task is None:
        folder = RunFolder(find_run(run))
        config = folder.config()
        config.refuse_changed_task(folder.path)
        return config
    name, imports = task_named(task)
    of_task = find_subject(run, name).config
    assert of_task is not None
    return replace(of_task, imports=imports)


def recordings_folder(run: Path) -> Path:
    """Return the folder of recordings: `hardware` in the run's folder; NAME/hardware for `pretrained:NAME`."""
    return Path(str(run).removeprefix(PRETRAINED)) / "hardware"


def hardware_environment(task: str, environment: Mapping[str, Any], station: str) -> dict[str, Any]:
    """Return a run's environment options without those of the station that it was trained on and its disturbances.

    A real robot has disturbances of its own; only `sensing` and the tare remain. A reward that needs simulation state
    is replaced by the task's first reward without it; no policy uses rewards.

    Raises:
        InputError: If `station` is unknown or simulated.
    """
    if STATIONS.get(station).is_simulated:
        raise InputError(f"station {station!r} is a simulation: watch the policy there with guiderail visualize")
    config = EnvConfig.resolve(task, environment)
    disturbances = {name for name, field in option_fields(Disturbances).items() if field not in ("sensing", "tare")}
    simulated_options = disturbances | option_fields(config.station_kind.options or Options).keys()
    options = {name: value for name, value in environment.items() if name not in simulated_options}
    task_class = TASKS.get(config.task)
    simulated = getattr(task_class, "simulated_rewards", ())
    if environment.get("reward") in simulated:
        options["reward"] = next(each for each in choices_of(task_class, "reward") if each not in simulated)
    return options
