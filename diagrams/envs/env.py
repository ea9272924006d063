"""The Gymnasium environment of every task."""

import re
import weakref
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
from pydrake.gym import DrakeGymEnv
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, PortDataType

from guiderail.diagrams.envs.scene import View
from guiderail.diagrams.envs.task_diagram import TaskDiagram
from guiderail.diagrams.envs.trace import EpisodeTrace
from guiderail.models.common.errors import InputError, brief
from guiderail.systems.episode_monitor import TERMINATIONS
from guiderail.systems.policy_system import PolicyError

RECORDED = (
    "commanded_violation",
    "measured_violation",
    "wrench",
    "saturation",
    "collision",
    "command_timed_out",
    "fallback",
    "state",
)
"""Ports whose values the trace has for every control step, where a task's diagram has them."""

SAID = (
    "is_success",
    "termination",
    "constraint_violation",
    "measured_violation",
    "contact_force",
    "fallback",
    "control_steps",
    "simulation_failure",
)
"""What `info` says of every task: no reward term and nothing that a reset draws can have one of these names."""

_TIME_LIMIT = TERMINATIONS.index("time_limit")

# What Drake, or a system with another engine, says when the physics, and not the wiring, went wrong. Drake's own
# assertions arrive in Python as SystemExit.
_SIMULATION_FAILURE = re.compile(
    r"failed to converge|\bnan\b|not finite|diverg|simulation failed|AllFinite|isfinite", re.IGNORECASE
)


class GuidedEnv(DrakeGymEnv):
    """Runs a `TaskDiagram` as a Gymnasium environment that can be trusted with a reset.

    It keeps `DrakeGymEnv`'s interface and replaces its `reset` and `step`. The diagram is built once. A reset restores
    the context to how it was built, lets the task randomize it from `self.np_random`, writes the neutral action and
    initializes. A step checks the action before anything moves, advances `action_repeat` control steps by an integer count, and
    reads every port at the end of each of them, before the events of that instant.

    `info` has at every step, and at a reset, `is_success`, `termination` (one of `TERMINATIONS`),
    `constraint_violation` and `measured_violation` (the worst of the step; negative is slack), `contact_force` (the
    largest of the step, N), `fallback` (whether guidance fell back to something safe in it), every reward term by name
    (summed over the step), and `control_steps` since the reset. A reset's `info` also has what the task drew.

    An episode that lasts as long as the task allows is truncated with `termination` "time_limit". Where the simulation
    itself fails (a solver that doesn't converge, NaN), the episode is truncated with the last sound observation, and
    `info["simulation_failure"]` says what Drake said; every other error is a bug and propagates.

    Attributes:
        task: the `TaskDiagram`.
        hold: control steps for which an action is held.
        trace: the `EpisodeTrace` of the current episode.
        drawn: what the task drew for it.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 50}  # noqa: RUF012 (Gymnasium's own convention)

    def __init__(
        self,
        task: TaskDiagram,
        *,
        action_repeat: int = 1,
        render_mode: str | None = None,
        release: Callable[[], None] | None = None,
    ):
        """
        Args:
            task: what to run.
            hold: control steps per decision, at least 1.
            render_mode: None, "human" (Meshcat) or "rgb_array" (a camera).
            release: called once, when the environment is closed or nobody has it any more.

        Raises:
            InputError: if `action_repeat` is no positive integer, or the task can't be rendered that way.
        """
        if isinstance(action_repeat, bool) or not isinstance(action_repeat, int | np.integer) or action_repeat < 1:
            raise InputError(
                f"action_repeat is the number of control steps of an action: give an integer from 1, not {action_repeat}"
            )
        diagram = task.diagram
        _check_view(task, render_mode)
        view = None if render_mode != "human" or task.query is None else View(task.query)
        self.task = task = replace(task, view=view)
        self.action_repeat = int(action_repeat)
        # The parent class writes into whatever `metadata` it finds; this one is our own, not every environment's.
        self.metadata = {
            "render_modes": ["human", "rgb_array"],
            "render_fps": round(1 / (action_repeat * task.control_period)),
        }
        super().__init__(
            simulator=Simulator(diagram),
            time_step=action_repeat * task.control_period,
            action_space=gymnasium.spaces.Box(-1.0, 1.0, (diagram.GetInputPort("action").size(),), np.float32),
            observation_space=task.observation_space,
            reward="reward",
            action_port_id="action",
            observation_port_id="observation",
            render_rgb_port_id="rgb_image" if render_mode == "rgb_array" else None,
        )
        self.metadata["render_modes"] = ["human", "rgb_array"]
        self.render_mode = render_mode
        if view is not None:
            self.simulator.set_target_realtime_rate(1.0)
            self.simulator.set_monitor(view.follow)

        context = self.simulator.get_mutable_context()
        self._neutral = np.zeros(self.action_space.shape)
        self._action_value = self.action_port.FixValue(context, self._neutral)
        self._pristine = diagram.CreateDefaultContext()
        self._image_observation = self.observation_port.get_data_type() == PortDataType.kAbstractValued
        self._reward_port = diagram.GetOutputPort("reward")
        self._term_ports = [(name, diagram.GetOutputPort(name)) for name in task.reward_terms]
        self._termination_port = diagram.GetOutputPort("termination")
        self._recorded = [(name, diagram.GetOutputPort(name)) for name in RECORDED if diagram.HasOutputPort(name)]
        self._force_port = diagram.GetOutputPort("contact_force")
        self._desired_pose_port = diagram.GetOutputPort("desired_pose")
        self._pose_port = diagram.GetOutputPort("pose")
        sizes = {name: port.size() for name, port in self._recorded}
        self.trace = EpisodeTrace(task.num_steps, self._pose_port.size(), task.control_period, sizes)
        self.drawn: dict[str, Any] = {}
        self._control_steps = 0
        self._running = False
        self._observation: np.ndarray | None = None
        self._violations = (-np.inf, -np.inf)
        self._closed = False
        self._release = weakref.finalize(self, release or _nothing)
        self._release.atexit = False

    def close(self) -> None:
        """Ends the environment and its view; what it recorded stays."""
        self._running, self._closed = False, True
        self.simulator.clear_monitor()
        self.task = replace(self.task, view=None)
        self._release()

    def __reduce_ex__(self, protocol: Any) -> Any:
        """A simulation in progress is not to be copied."""
        made = "gymnasium.make" if self.spec is None else f"gymnasium.make({self.spec.id!r}, ...)"
        raise InputError(f"an environment holds a simulation and cannot be pickled: call {made} in the worker instead")

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: of everything that the episodes from here on draw; what was drawn before goes on unless given.
            options: the task's own, by name (its `Reset`).

        Raises:
            InputError: for an option that the task doesn't have, a value out of range, or a closed environment.
        """
        if self._closed:
            raise InputError("the environment is closed: make another one")
        if options is not None and not isinstance(options, Mapping):
            raise InputError(
                f"the options of a reset are values by name, such as {{'held_out': True}}, not {brief(options)}"
            )
        # Not the parent's reset: it initializes before the state is set, and refuses options.
        gymnasium.Env.reset(self, seed=seed)
        self._running = False
        context = self.simulator.get_mutable_context()
        context.SetTimeStateAndParametersFrom(self._pristine)
        self._action_value.GetMutableData().set_value(self._neutral)
        self.drawn = self.task.randomize(context, self.np_random, dict(options or {}))
        self.simulator.Initialize()
        return self._begun()

    def _begun(self) -> tuple[np.ndarray, dict[str, Any]]:
        """What a reset returns, with an initialized simulator."""
        context = self.simulator.get_context()
        self._control_steps = 0
        self.trace.clear()
        self._running = True
        self._observation = self._observe(context)
        now = {name: port.Eval(context) for name, port in self._recorded}
        self._violations = float(now["commanded_violation"][0]), float(now["measured_violation"][0])
        info = self._info(0, *self._violations, 0.0, False, dict.fromkeys(self.task.reward_terms, 0.0))
        info.update(self.drawn)
        return self._observation, info

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Holds `action` for `action_repeat` control steps, or until the episode ends.

        Raises:
            InputError: if the action is not finite or of the wrong shape; finite ones outside [-1, 1] are clipped. If
                a term of the reward or the observation is not finite where the simulation itself went well.
        """
        action = self._checked(action)
        if not self._running:
            raise gymnasium.error.ResetNeeded("the episode is over, or none has begun: call reset() first")
        simulator = self.simulator
        context = simulator.get_context()
        self._action_value.GetMutableData().set_value(action)

        total = peak_force = 0.0
        commanded_violation = measured_violation = -np.inf
        terms = dict.fromkeys(self.task.reward_terms, 0.0)
        termination = 0
        fallback, failure = False, None
        first_step = self._control_steps
        for _ in range(self.action_repeat):
            try:
                self._advance()
                pose = self._pose_port.Eval(context)
                if not np.isfinite(pose).all():
                    failure = "the measured pose is not finite"
            except PolicyError:
                raise  # a policy inside the diagram, and not the simulation
            except (RuntimeError, SystemExit) as error:
                if not _SIMULATION_FAILURE.search(str(error)):
                    raise
                failure = str(error)
            if failure is not None:
                break
            self._control_steps += 1
            reward = float(self._reward_port.Eval(context)[0])
            force = float(self._force_port.Eval(context)[0])
            total += reward
            peak_force = max(peak_force, force)
            now = {name: port.Eval(context) for name, port in self._recorded}
            commanded_violation = max(commanded_violation, float(now["commanded_violation"][0]))
            measured_violation = max(measured_violation, float(now["measured_violation"][0]))
            fallback = fallback or bool(now["fallback"][0])
            for name, port in self._term_ports:
                terms[name] += float(port.Eval(context)[0])
            self.trace.append(self._desired_pose_port.Eval(context), pose, force, reward, now)
            termination = int(self._termination_port.Eval(context)[0])
            if termination or self._control_steps == self.task.num_steps:
                break

        terminated = termination != 0
        truncated = not terminated and (failure is not None or self._control_steps >= self.task.num_steps)
        if truncated and failure is None:
            termination = _TIME_LIMIT
        if self._control_steps == first_step:
            # It failed before there was anything new to read.
            commanded_violation, measured_violation = self._violations
        self._violations = commanded_violation, measured_violation
        info = self._info(termination, commanded_violation, measured_violation, peak_force, fallback, terms)
        if failure is not None:
            info["simulation_failure"] = failure
        else:
            self._observation = self._observe(context)
        self._running = not (terminated or truncated)
        return self._observation, total, terminated, truncated, info

    def _advance(self) -> None:
        """One control step. By an integer count: a sum of periods would drift across the plant's steps."""
        self.simulator.AdvanceTo((self._control_steps + 1) * self.task.control_period)

    def render(self) -> Any:
        """An (h, w, 3) image of uint8 for "rgb_array"; publishes to Meshcat for "human"."""
        if self.render_mode is None:
            gymnasium.logger.warn("nothing to render: make the environment with render_mode='human' or 'rgb_array'")
            return None
        if self.render_mode == "rgb_array":
            return self.render_rgb_port.Eval(self.simulator.get_context()).data[:, :, :3].copy()
        if self.task.view is not None:
            self.task.view.publish(self.simulator.get_context())
        return None

    def push(self, displacement: np.ndarray) -> None:
        """Moves the robot, as a person would who pushes it between two control steps.

        Args:
            displacement: (O,), in the units of a pose.

        Raises:
            InputError: if the task has no robot that can be pushed, or these are not O finite numbers.
        """
        if self.task.push is None:
            raise InputError("this task has no robot that can be pushed")
        displacement = np.asarray(displacement, dtype=float)
        if displacement.shape != (self._pose_port.size(),) or not np.isfinite(displacement).all():
            raise InputError(f"a push is {self._pose_port.size()} finite numbers, not {displacement}")
        self.task.push(self.simulator.get_mutable_context(), displacement)

    def _checked(self, action: Any) -> np.ndarray:
        try:
            if np.iscomplexobj(action):
                raise TypeError
            action = np.asarray(action, dtype=float)
        except (TypeError, ValueError):
            raise InputError(f"an action is {self._neutral.size} numbers in [-1, 1], not {action!r}") from None
        if action.shape != self._neutral.shape:
            raise InputError(f"an action is an array of shape {self._neutral.shape}, not {action.shape}")
        if not np.isfinite(action).all():
            raise InputError(f"an action must be finite, not {action}: the robot was not moved")
        return np.clip(action, -1.0, 1.0)

    def _observe(self, context: Context) -> np.ndarray:
        if self._image_observation:
            return self.observation_port.Eval(context).data[:, :, :3].copy()
        observation = self.observation_port.Eval(context).astype(self.observation_space.dtype)
        # A learner that takes this in diverges, and is blamed for it episodes later.
        if not np.isfinite(observation).all():
            of = "" if self.task.declaration is None else f" of {self.task.declaration.name}"
            raise InputError(f"the observation{of} is not finite, but {brief(observation.tolist())}")
        return observation

    def _info(
        self,
        termination: int,
        commanded_violation: float,
        measured_violation: float,
        force: float,
        fallback: float,
        terms: Any,
    ) -> dict[str, Any]:
        return {
            "is_success": TERMINATIONS[termination] == "success",
            "termination": TERMINATIONS[termination],
            "constraint_violation": commanded_violation,
            "measured_violation": measured_violation,
            "contact_force": force,
            "fallback": fallback,
            "control_steps": self._control_steps,
            **terms,
        }


def _nothing() -> None:
    """Nobody waits for the environment's diagram."""


def check_render_mode(render_mode: str | None) -> None:
    """Refuses a word that is no render mode, before anything is built.

    Raises:
        InputError: naming those that there are.
    """
    if render_mode not in (None, "human", "rgb_array"):
        raise InputError(f"there is no render mode '{render_mode}': use None, 'human' or 'rgb_array'")


def _check_view(task: TaskDiagram, render_mode: str | None) -> None:
    check_render_mode(render_mode)
    if render_mode == "human" and task.query is None:
        raise InputError("this environment has no scene for Meshcat to show: leave render_mode out")
    if render_mode == "rgb_array" and not task.diagram.HasOutputPort("rgb_image"):
        raise InputError("this environment has no camera: make it with render_mode='rgb_array'")
