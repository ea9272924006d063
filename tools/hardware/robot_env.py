"""A task on a robot as an environment, in which a reset is a motion and an episode can be cut short."""

from __future__ import annotations

import gc
import math
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from guiderail.diagrams.envs.env import GuidedEnv
from guiderail.diagrams.envs.task_diagram import TaskDiagram
from guiderail.diagrams.hardware.clock import Clock
from guiderail.diagrams.hardware.lcm.driver import MessageCounter
from guiderail.diagrams.hardware.station import HardwareStation
from guiderail.models.common.errors import InputError
from guiderail.models.common.units import MM
from guiderail.models.control.joint_status import FAULT_DESCRIPTIONS, Fault
from guiderail.systems.torque_safety_limiter import ArmState
from guiderail.tools.hardware.preflight import LISTENING, Check, check_robot
from guiderail.tools.hardware.slow_motion import back, crawl, distance, is_near
from guiderail.tools.teleop.teleoperator import Keys

PULL, GIVES_WAY, LEAST_PULL = 3.0 * MM, 1.0 * MM, 1.5  # [m] commanded, [m] followed at most, [N] felt at least
PULL_STEPS = 25  # control steps
LEVER = 0.1  # [m/rad] for which a turn counts where the nearest of several poses is looked for
PATIENCE = 10.0  # [s] until an arm that was told to go on does

Say = Callable[[str], None]


class RobotStoppedError(Exception):
    """The arm is being stopped: a limit, a fault or a person."""

    def __init__(self, fault: Fault):
        super().__init__(FAULT_DESCRIPTIONS[fault])
        self.fault = fault


class RobotEnv(GuidedEnv):
    """Runs a `TaskDiagram` whose station is a robot.

    A reset moves the arm: back along the way that it came, and to the start at a crawl. Where something stops the arm,
    in an episode or a reset, it comes to rest and `go_on` is asked; then it goes on from where it is. An episode that
    was cut short so is truncated with `termination` "stopped", and `info["stopped"]` says why: nobody should learn from
    it.
    A success that the pose tells is believed when the workpiece also holds against a pull; otherwise `termination` is
    "did_not_hold", and nobody should learn from that either.

    Attributes:
        fault: that ended the last episode.
    """

    def __init__(
        self,
        task: TaskDiagram,
        station: HardwareStation,
        elsewhere: HardwareStation,
        start: np.ndarray,
        pace: Clock,
        *,
        action_repeat: int,
        keys: Keys,
        go_on: Callable[[str], None],
        say: Say,
        places: Callable[[np.random.Generator, Mapping[str, Any]], dict[str, Any]] | None = None,
    ):
        """
        Args:
            task: what to run.
            station: its station.
            elsewhere: another station of the same arm on the same bus, for the motions between episodes.
            start: pose at which an episode begins, (6,).
            pace: how time passes.
            hold: control steps per decision.
            keys: of a person.
            go_on: called with why the arm is at rest; returns when it may move again, or raises.
            say: what a person is told.
            places: called with random numbers and a reset's options when the arm is at the start: where the parts
                are is drawn anew, as in a simulation, and returned.
        """
        super().__init__(task, action_repeat=action_repeat)
        self._places = places
        self._skills, self._elsewhere, self._start, self._pace = station, elsewhere, start, pace
        self._keys, self._go_on, self._say = keys, go_on, say
        self._steps = round(task.control_period / station.period)
        self._acting, self._is_in_step = elsewhere, False
        self._moving = self._initialized()
        # A deputy may need a status or two to be heard; nothing is sent so soon.
        self._heard = MessageCounter(self._elsewhere.lcm, self._elsewhere.driver.command_channel)
        self._pass(LISTENING)
        self._way_back: list[np.ndarray] = []
        self.fault = Fault.NONE

    # Whose turn it is.

    @property
    def _root(self) -> Context:
        return (self.simulator if self._acting is self._skills else self._moving).get_mutable_context()

    @property
    def _mine(self) -> Context:
        return self._acting.GetMyMutableContextFromRoot(self._root)

    @property
    def pose(self) -> np.ndarray:
        """Where the tool is, (6,)."""
        return self._acting.get_pose_output_port().Eval(self._mine).copy()

    def checks(self) -> list[Check]:
        """What the robot's first statuses say, and what is assumed of it: before anything moves."""
        return check_robot(self._elsewhere, self._moving.get_context(), self._start, self._heard.count)

    def checks_again(self) -> list[Check]:
        """The same of now, after a person took their time, in which nobody listened."""
        self._pace.begin()
        self._pass(self._steps)
        # A simulator that knew where the arm was would not believe at once where somebody moved it meanwhile.
        self._moving = self._initialized()
        self._pass(LISTENING)
        return self.checks()

    def _initialized(self) -> Simulator:
        simulator = Simulator(self._elsewhere)
        self._elsewhere.get_desired_pose_input_port().FixValue(simulator.get_mutable_context(), np.full(6, np.nan))
        self._elsewhere.start(simulator)
        self._pace.begin()
        return simulator

    def _hand_over(self, simulator: Simulator, station: HardwareStation) -> None:
        before = self._mine
        station.start(simulator)
        station.copy_state_from(station.GetMyMutableContextFromRoot(simulator.get_mutable_context()), before)
        if station is self._skills:
            self.simulator = simulator
        else:
            self._moving = simulator
        self._acting, self._is_in_step = station, False

    def _elsewhere_acts(self) -> None:
        if self._acting is self._skills:
            here, simulator = self.pose, Simulator(self._elsewhere)
            self._elsewhere.get_desired_pose_input_port().FixValue(simulator.get_mutable_context(), here)
            self._hand_over(simulator, self._elsewhere)

    # What an episode is.

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Moves the arm to the start.

        Raises:
            InputError: if it doesn't get there, or options are given where nothing can be drawn.
        """
        if options and self._places is None:
            raise InputError("a reset of a robot takes no options: nothing of it can be drawn")
        gymnasium.Env.reset(self, seed=seed)
        self._running = False
        self._return()
        drawn = {} if self._places is None else self._places(self.np_random, options or {})
        simulator = Simulator(self.task.diagram)
        self._action_value = self.action_port.FixValue(simulator.get_mutable_context(), self._neutral)
        self._hand_over(simulator, self._skills)
        self.fault, self.drawn = Fault.NONE, drawn
        return self._begun()

    def step(self, action):
        """As `GuidedEnv.step`; where the arm is stopped, the episode is truncated."""
        begun = len(self.trace)
        try:
            following, reward, terminated, truncated, info = super().step(action)
        except RobotStoppedError as stopped:
            self._way_back.extend(back(self.trace.measured, self.task.control_period)[::-1])
            self._running, self.fault = False, stopped.fault
            self._come_to_rest()
            terms = dict.fromkeys(self.task.reward_terms, 0.0)
            info = self._info(0, *self._since(begun), terms)
            info |= {"termination": "stopped", "stopped": str(stopped)}
            return self._observation, 0.0, False, True, info
        if terminated or truncated:
            self._way_back.extend(back(self.trace.measured, self.task.control_period)[::-1])
            if info["is_success"] and not self._holds():
                info |= {"is_success": False, "termination": "did_not_hold"}
        return following, reward, terminated, truncated, info

    def _since(self, begun: int) -> tuple[float, float, float, bool]:
        """Worst commanded and measured violation, largest force and fallback of the control steps from that one on."""
        signals = {name: values[begun:, 0] for name, values in self.trace.signals.items()}
        if not len(self.trace) > begun:
            return *self._violations, 0.0, False
        commanded, measured = (float(signals[name].max()) for name in ("commanded_violation", "measured_violation"))
        return commanded, measured, float(self.trace.force[begun:].max()), bool(signals["fallback"].any())

    def pause(self) -> None:
        """Brings the arm to rest between two episodes where somebody asked for it; the next reset asks to go on."""
        if self._keys.wants_pause:
            self._keys.wants_pause = False
            self.rest()

    def idle(self) -> None:
        """Holds the arm for a control step, so that whoever calls this between other work isn't missed."""
        self._elsewhere_acts()
        self._try(lambda: self._hold(1))

    def rest(self) -> None:
        """Brings the arm to rest because somebody asks for it, or because something was raised in whatever it did."""
        if self._is_in_step:
            # Drake goes on with no simulator that was left in the midst of a step.
            here, simulator = self.pose, Simulator(self._elsewhere)
            self._elsewhere.get_desired_pose_input_port().FixValue(simulator.get_mutable_context(), here)
            self._hand_over(simulator, self._elsewhere)
        self._acting.stop(self._root)
        self._come_to_rest()

    def _pass(self, steps: int) -> None:
        """So many statuses."""
        self._is_in_step = True
        self._pace.advance(self.simulator if self._acting is self._skills else self._moving, self._acting, steps)
        self._is_in_step = False

    def _advance(self) -> None:
        self._pass(self._steps)
        mine = self._mine
        arm_state, fault = (int(self._acting.GetOutputPort(name).Eval(mine)[0]) for name in ("arm_state", "fault"))
        if arm_state in (ArmState.DAMPING, ArmState.OFF):
            raise RobotStoppedError(Fault(fault))
        if self._keys.stops():
            self._acting.stop(self._root)
            raise RobotStoppedError(Fault.USER_STOP)

    # Motions between episodes.

    def _command(self, pose: np.ndarray) -> None:
        self._elsewhere.get_desired_pose_input_port().FixValue(self._moving.get_mutable_context(), pose)
        self._advance()

    def _hold(self, steps: int) -> None:
        for _ in range(steps):
            self._advance()

    def _holds(self) -> bool:
        """Whether the workpiece stays where it is when it is pulled up."""
        self._elsewhere_acts()
        before = self.pose
        felt = 0.0
        try:
            for step in range(1, PULL_STEPS + 1):
                self._command(before + [0.0, 0.0, PULL * step / PULL_STEPS, 0.0, 0.0, 0.0])
            felt = float(-self._acting.get_wrench_output_port().Eval(self._mine)[2])
        except RobotStoppedError as stopped:
            self.fault = stopped.fault
            self._come_to_rest()
            return False
        return bool(self.pose[2] - before[2] < GIVES_WAY and felt > LEAST_PULL)

    def _return(self) -> None:
        """Back along the way, and to the start."""
        self._elsewhere_acts()
        self._try(self._take_over)
        while self._way_back:
            # What is stopped on its way goes on with the rest of it.
            self._try(lambda: self._command(self._way_back[-1]))
            self._way_back.pop()
        self._try(self._crawl_to_start)
        if not is_near(self.pose, self._start):
            away, turned = distance(self.pose, self._start)
            raise InputError(
                f"the arm did not reach the start: {away / MM:.1f} mm and {np.rad2deg(turned):.1f} degrees are left; "
                "is something in its way?"
            )
        gc.collect()

    def _find_the_way(self) -> None:
        """At a crawl to the way back, where it is nearest, if the arm was moved by hand meanwhile."""
        here = self.pose
        if not self._way_back or is_near(here, self._way_back[-1]):
            return
        apart = [away + LEVER * turned for away, turned in (distance(here, pose) for pose in self._way_back)]
        nearest = int(np.argmin(apart))
        del self._way_back[nearest + 1 :]
        there = self._way_back[nearest]
        away, turned = distance(here, there)
        self._say(
            f"the arm was moved: back to its way, {away / MM:.0f} mm and {np.rad2deg(turned):.0f} degrees, at a crawl"
        )
        self._way_back.extend(crawl(here, there, self.task.control_period)[::-1])

    def _crawl_to_start(self) -> None:
        for pose in crawl(self.pose, self._start, self.task.control_period):
            self._command(pose)

    def _take_over(self) -> None:
        """Until the arm follows."""
        self._elsewhere_acts()
        if self._elsewhere.get_arm_state_output_port().Eval(self._mine)[0] == ArmState.WAITING:
            self._pace.begin()  # nothing was sent yet: how long nobody listened is no gap between statuses
        here, waited = self.pose, 0.0
        while self._elsewhere.get_arm_state_output_port().Eval(self._mine)[0] != ArmState.RUNNING:
            self._command(here)
            waited += self.task.control_period
            if waited > PATIENCE:
                fault = Fault(int(self._elsewhere.get_fault_output_port().Eval(self._mine)[0]))
                raise InputError(f"the arm can't be taken over: {FAULT_DESCRIPTIONS[fault]}")

    def _try(self, motion: Callable[[], Any]) -> None:
        """Does it until nothing stops the arm meanwhile."""
        while True:
            try:
                self._resume()
                motion()
                return
            except RobotStoppedError as stopped:
                self.fault = stopped.fault
                self._come_to_rest()

    def _come_to_rest(self) -> None:
        """Hears statuses until the arm has no torque."""
        self._pass(round((self._acting.limits.damping_time + 0.1) / self._acting.period))

    def _resume(self) -> None:
        """Asks, and goes on, if the arm is at rest."""
        if self._acting.get_arm_state_output_port().Eval(self._mine)[0] != ArmState.OFF:
            return
        fault = Fault(int(self._acting.get_fault_output_port().Eval(self._mine)[0]))
        self._go_on(FAULT_DESCRIPTIONS[fault])
        # Nobody listened while the person thought: what is judged is a status of now, once statuses are believed again,
        # which those of an arm that was moved meanwhile are only after the settling time.
        self._pace.begin()
        self._pass(self._steps + math.ceil(self._acting.status_limits.settling_time / self._acting.period))
        self._keys.take_back()
        self._find_the_way()
        if self._acting is self._elsewhere:
            self._elsewhere.get_desired_pose_input_port().FixValue(self._moving.get_mutable_context(), self.pose)
        for _ in range(round(PATIENCE / self.task.control_period)):
            try:
                self._acting.resume(self._root)
            except InputError as error:
                words = str(error)
                self._pass(self._steps)
            else:
                break
        else:
            raise InputError(words)
        self._say("going on from here")
        self._elsewhere_acts()
        self._take_over()
