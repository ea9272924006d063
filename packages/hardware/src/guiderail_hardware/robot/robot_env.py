"""Environment of a task on a robot: a reset is a motion, and a stop truncates the episode."""

from __future__ import annotations

import gc
import math
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from guiderail.diagrams.envs.env import DiagramEnv
from guiderail.diagrams.envs.task_diagram import TaskDiagram
from guiderail.diagrams.tasks.insertion import HoldTest, InsertionTask
from guiderail.models.common.errors import InputError
from guiderail.models.common.termination import Termination
from guiderail.models.common.transforms import MM
from guiderail_hardware.drivers.clock import Clock
from guiderail_hardware.drivers.driver import describe_stop
from guiderail_hardware.models.joint_status import Fault
from guiderail_hardware.robot.connection import Log
from guiderail_hardware.robot.operator import OperatorKeys
from guiderail_hardware.robot.preflight import (
    PreflightChecks,
    advance_to_rest,
    describe_distance,
    is_near,
    make_holding_simulator,
    pose_distance,
    retrace,
    slow_approach,
)
from guiderail_hardware.station import HardwareStation
from guiderail_hardware.systems.torque_safety_limiter import STOPPED, ArmState

MIN_HOLD_FORCE = 1.5  # smallest measured force with which an inserted workpiece resists a push [N]
HOLD_STEPS = 25  # control steps of a push
ANGLE_WEIGHT = 0.1  # weight of an angle in the distance to the return path [m/rad]
RESUME_TIMEOUT = 10.0  # longest time until the arm has resumed [s]
NO_POSE = np.full(6, np.nan)  # invalid command: the station holds the arm at the pose where it took control


class RobotStoppedError(Exception):
    """Error raised when a limit, a fault or the operator stops the arm.

    Attributes:
        fault: Reason of the stop.
    """

    def __init__(self, fault: Fault):
        super().__init__(fault.description)
        self.fault = fault


class RobotEnv(DiagramEnv):
    """Environment of a `TaskDiagram` with a hardware station.

    A reset moves the arm: back along its path, and slowly to the start. If the arm is stopped, in an episode or a
    reset, it comes to rest, `confirm_resume` is called, and the motion continues from where the arm is. An episode that
    was stopped is truncated with `termination` "stopped", and `info["stopped"]` has the reason.

    Motions between episodes have the force bound of the episode's last step. The first approach has the force bound of
    an episode's first step.

    A success by pose is confirmed by the task's `hold_tests`; if the workpiece gives way, `termination` is
    "did_not_hold". Episodes that end as "stopped" or "did_not_hold" must not be learned from.

    If the motion back does not release the workpiece, or the workpiece has snapped in, the arm comes to rest, and
    `free_workpiece` asks the operator to release it by hand.

    Attributes:
        fault: Reason of the newest stop since the episode began, or NONE.
        preflight: Pre-flight checks, to be run before anything moves.
    """

    def __init__(
        self,
        task: TaskDiagram,
        station: HardwareStation,
        clock: Clock,
        *,
        action_repeat: int,
        keys: OperatorKeys,
        confirm_resume: Callable[[str], None],
        free_workpiece: Callable[[str], None],
        log: Log,
        randomize_parts: Callable[[np.random.Generator, Mapping[str, Any]], dict[str, Any]] | None = None,
    ):
        """Connect to the robot.

        Args:
            task: Diagram of an insertion, built from its declaration.
            station: Hardware station of the diagram; its clone controls the motions between episodes.
            clock: Clock of both stations.
            action_repeat: Control steps per action.
            keys: The operator's keys.
            confirm_resume: Function called with the reason of a stop; returns when the arm may move again, or raises.
            free_workpiece: Function called with the reason why a workpiece has to be released by hand; returns when
                the workpiece is released and the arm may move again, or raises.
            log: Function that shows a message.
            randomize_parts: Function called at the start pose with a random number generator and the reset's options;
                moves the parts as a reset in simulation does, and returns the sampled values. None for a real robot.

        Raises:
            InputError: If no robot answers.
        """
        super().__init__(task, action_repeat=action_repeat)
        declared: InsertionTask = task.task
        self._start, self._randomize_parts = declared.start_pose(np.random.default_rng(0)), randomize_parts
        self._task_station, self._transfer_station, self._clock = station, station.clone(declared.workcell()), clock
        self._keys, self._confirm_resume, self._free_workpiece, self._log = keys, confirm_resume, free_workpiece, log
        self._hold_tests, self._snaps_in = declared.hold_tests, declared.snaps_in
        self._steps = round(task.control_period / station.period)
        self._station, self._is_stepping = self._transfer_station, False
        # The first approach has the force bound of an episode's first step.
        max_wrench = station.read_max_wrench(station.GetMyContextFromRoot(task.diagram.CreateDefaultContext()))
        self.preflight = PreflightChecks(self._transfer_station, clock, self._start, self._steps, max_wrench)
        self._last_transfer: Simulator | None = None
        self._return_path: list[np.ndarray] = []  # poses (6,) of the motion back; the last is next
        self._has_shown_round_trip = False
        self._must_be_freed = ""  # reason why the workpiece has to be released by hand before the arm resumes
        self.fault = Fault.NONE

    # The two stations.

    @property
    def pose(self) -> np.ndarray:
        """Measured pose of the tool, (6,) [m, rad]."""
        return self._station.get_pose_output_port().Eval(self._context).copy()

    @property
    def _transfer_simulator(self) -> Simulator:
        return self._last_transfer or self.preflight.simulator

    @property
    def _active_simulator(self) -> Simulator:
        return self.simulator if self._station is self._task_station else self._transfer_simulator

    @property
    def _root_context(self) -> Context:
        return self._active_simulator.get_mutable_context()

    @property
    def _context(self) -> Context:
        return self._station.GetMyMutableContextFromRoot(self._root_context)

    @property
    def _arm_state(self) -> int:
        return int(self._station.get_arm_state_output_port().Eval(self._context)[0])

    @property
    def _active_fault(self) -> Fault:
        return Fault(int(self._station.get_fault_output_port().Eval(self._context)[0]))

    def _switch_station(self, simulator: Simulator, station: HardwareStation) -> None:
        """Transfer control of the arm to another station, without a gap in the commands."""
        station.take_over(simulator, self._station, self._context)
        if station is self._task_station:
            self.simulator = simulator
        else:
            self._last_transfer = simulator
        self._station, self._is_stepping = station, False

    def _switch_to_new_transfer(self) -> None:
        """Transfer control to the transfer station in a new simulator, with the present pose and force bound."""
        simulator = make_holding_simulator(self._transfer_station, self._station.read_max_wrench(self._context))
        self._transfer_station.get_desired_pose_input_port().FixValue(simulator.get_mutable_context(), self.pose)
        self._switch_station(simulator, self._transfer_station)

    def _switch_to_transfer(self) -> None:
        if self._station is self._task_station:
            self._switch_to_new_transfer()

    # Episodes.

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Move the arm to the start, and begin an episode.

        Raises:
            InputError: If the start is not reached, the arm does not resume after a stop, or options are given for a
                real robot.
        """
        if options and self._randomize_parts is None:
            raise InputError("a reset of a robot takes no options: software cannot move its parts")
        gymnasium.Env.reset(self, seed=seed)
        self._running = False
        self._return_to_start()
        sampled = {} if self._randomize_parts is None else self._randomize_parts(self.np_random, options or {})
        simulator = Simulator(self.diagram.diagram)
        self._action_value = self.action_port.FixValue(simulator.get_mutable_context(), self._neutral)
        self._switch_station(simulator, self._task_station)
        self.fault, self.sampled, self._failure = Fault.NONE, sampled, None
        return self._begin_episode()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advance by one action; truncate the episode if the arm is stopped."""
        first = len(self.trace)
        try:
            observation, reward, terminated, truncated, info = super().step(action)
        except RobotStoppedError as stop:
            self._extend_return_path()
            self._running, self.fault = False, stop.fault
            self._come_to_rest()
            terms = dict.fromkeys(self.diagram.reward_terms, 0.0)
            info = self._info(0, first, terms)
            info |= {"termination": Termination.STOPPED.value, "stopped": str(stop)}
            return self._observation, 0.0, False, True, info
        if terminated or truncated:
            self._extend_return_path()
            if info["is_success"] and not self._holds():
                info |= {"is_success": False, "termination": Termination.DID_NOT_HOLD.value}
            if info["is_success"] and self._snaps_in:
                self._must_be_freed = "the workpiece has snapped in"
        return observation, reward, terminated, truncated, info

    def _extend_return_path(self) -> None:
        """Extend the return path by the motion back along the measured poses of the episode."""
        self._return_path.extend(retrace(self.trace.measured, self.diagram.control_period)[::-1])

    def pause(self) -> None:
        """Bring the arm to rest between episodes if the operator has requested a pause; the next reset resumes."""
        if self._keys.is_pause_requested:
            self._keys.is_pause_requested = False
            self.rest()

    def idle(self) -> None:
        """Hold the arm for a control step, so that work between episodes does not exceed the command timeout."""
        self._switch_to_transfer()
        self._retry_until_ok(self._advance)

    def rest(self) -> None:
        """Bring the arm to rest, also after an exception within a step."""
        if self._is_stepping:
            # Drake cannot continue a simulator that raised within a step.
            self._switch_to_new_transfer()
        self._station.stop(self._root_context)
        self._come_to_rest()

    def _advance_statuses(self, steps: int) -> None:
        """Advance by `steps` status periods."""
        self._is_stepping = True
        self._clock.advance(self._active_simulator, self._station, steps)
        self._is_stepping = False

    def _advance(self) -> None:
        """Advance by a control step.

        Raises:
            RobotStoppedError: If the arm is being stopped.
        """
        self._advance_statuses(self._steps)
        if self._arm_state in STOPPED:
            raise RobotStoppedError(self._active_fault)
        if self._keys.is_stop_requested():
            self._station.stop(self._root_context)
            raise RobotStoppedError(Fault.USER_STOP)

    # Motions between episodes.

    def _command(self, pose: np.ndarray) -> None:
        """Command a pose (6,) to the transfer station for one control step."""
        self._transfer_station.get_desired_pose_input_port().FixValue(
            self._transfer_simulator.get_mutable_context(), pose
        )
        self._advance()

    def _holds(self) -> bool:
        """Return True if the workpiece resists every push of the hold tests; the arm moves back after each push."""
        self._switch_to_transfer()
        start = self.pose
        try:
            return all(self._resists(test, start) for test in self._hold_tests(start))
        except RobotStoppedError as stop:
            self.fault = stop.fault
            self._come_to_rest()
            return False

    def _resists(self, test: HoldTest, start: np.ndarray) -> bool:
        """Push the workpiece from the pose `start` (6,) and move back; return True if it resists."""
        push = np.array([*test.displacement, 0.0, 0.0, 0.0])
        direction = push[:3] / np.linalg.norm(push)
        fractions = np.arange(1, HOLD_STEPS + 1) / HOLD_STEPS
        for fraction in fractions:
            self._command(start + fraction * push)
        motion = float(direction @ (self.pose - start)[:3])
        force = float(-direction @ self._station.get_wrench_output_port().Eval(self._context)[:3])
        for fraction in fractions[::-1]:
            self._command(start + fraction * push)
        return motion < test.max_motion and force > MIN_HOLD_FORCE

    def _return_to_start(self) -> None:
        """Move back along the return path, and slowly to the start.

        If friction leaves a bayonet locked after the first return, the arm repeats the path, forward and back. If the
        second return fails too, the operator releases the workpiece.
        """
        self._switch_to_transfer()
        if self._must_be_freed:
            self.rest()
        self._retry_until_ok(self._take_control)
        path = self._return_path.copy()
        self._follow_return_path()
        if path and not self._is_at_start():
            self._log("the arm did not reach the start; it repeats its path once")
            self._return_path = path + path[::-1]
            self._follow_return_path()
        if path and not self._is_at_start():
            self._must_be_freed = describe_distance(self.pose, self._start)
            self.rest()
            self._return_path = path
            self._follow_return_path()
        if not self._is_at_start():
            raise InputError(f"{describe_distance(self.pose, self._start)}; is an object in its way?")
        gc.collect()

    def _is_at_start(self) -> bool:
        return is_near(self.pose, self._start)

    def _follow_return_path(self) -> None:
        self._switch_to_new_transfer()  # the energy tank is full; the last motion may have emptied it against friction
        while self._return_path:
            # After a stop the motion continues with the rest of the path.
            self._retry_until_ok(lambda: self._command(self._return_path[-1]))
            self._return_path.pop()
        self._retry_until_ok(self._approach_start)

    def _rejoin_return_path(self) -> None:
        """If the arm was moved by hand, start the return path with a slow motion to the path's nearest pose."""
        pose = self.pose
        if not self._return_path or is_near(pose, self._return_path[-1]):
            return
        distances = [
            distance + ANGLE_WEIGHT * angle
            for distance, angle in (pose_distance(pose, waypoint) for waypoint in self._return_path)
        ]
        nearest = int(np.argmin(distances))
        del self._return_path[nearest + 1 :]
        target = self._return_path[nearest]
        distance, angle = pose_distance(pose, target)
        self._log(
            f"the arm was moved; it returns slowly to its path: {distance / MM:.0f} mm and "
            f"{np.rad2deg(angle):.0f} degrees"
        )
        self._return_path.extend(slow_approach(pose, target, self.diagram.control_period)[::-1])

    def _approach_start(self) -> None:
        for pose in slow_approach(self.pose, self._start, self.diagram.control_period):
            self._command(pose)

    def _take_control(self) -> None:
        """Hold the arm until the transfer station has full authority."""
        self._switch_to_transfer()
        if self._arm_state == ArmState.WAITING:
            self._clock.begin()  # before the first command, the time since the last status is no gap
        elapsed = 0.0
        while self._arm_state != ArmState.RUNNING:
            self._command(NO_POSE)  # not the measured pose: a single status may be wrong
            elapsed += self.diagram.control_period
            if elapsed > RESUME_TIMEOUT:
                reason = describe_stop(self._active_fault, self._station.driver)
                raise InputError(f"the arm can't be taken over: {reason}")
        if not self._has_shown_round_trip and (text := self._station.describe_round_trip()):
            self._log(text)
            self._has_shown_round_trip = True

    def _retry_until_ok(self, motion: Callable[[], Any]) -> None:
        """Retry `motion` until it completes without a stop."""
        while True:
            try:
                self._resume()
                motion()
                return
            except RobotStoppedError as stop:
                self.fault = stop.fault
                self._come_to_rest()

    def _come_to_rest(self) -> None:
        """Advance until the arm is at rest and its commanded torque is zero."""
        self._is_stepping = True
        failure = advance_to_rest(self._clock, self._active_simulator, self._station)
        self._is_stepping = False
        if failure:
            self._log(failure)

    def _resume(self) -> None:
        """If the arm is at rest after a stop, wait for the operator's confirmation, and resume.

        Raises:
            InputError: If the arm does not resume.
            RobotStoppedError: If a stop is requested after the confirmation.
        """
        if self._arm_state != ArmState.OFF:
            return
        if self._must_be_freed:
            self._free_workpiece(self._must_be_freed)
            self._must_be_freed = ""
        else:
            self._confirm_resume(describe_stop(self._active_fault, self._station.driver))
        self._keys.clear_stop()
        self._station.driver.guard.recover()
        # No status was received during the operator's confirmation. If the arm was moved meanwhile, statuses are
        # accepted only after the settling time.
        self._clock.begin()
        settling_steps = math.ceil(self._station.status_limits.settling_time / self._station.period)
        self._advance_statuses(self._steps + settling_steps)
        if self._station is self._transfer_station:
            self._transfer_station.get_desired_pose_input_port().FixValue(
                self._transfer_simulator.get_mutable_context(), NO_POSE
            )
        for _ in range(round(RESUME_TIMEOUT / self.diagram.control_period)):
            if self._keys.is_stop_requested():
                raise RobotStoppedError(Fault.USER_STOP)
            try:
                self._station.resume(self._root_context)
            except InputError as error:
                reason = str(error)
                self._advance_statuses(self._steps)
            else:
                break
        else:
            raise InputError(reason)
        self._rejoin_return_path()
        self._log("resuming from here")
        self._switch_to_transfer()
        self._take_control()
