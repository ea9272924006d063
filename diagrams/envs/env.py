"""The Gymnasium environment of every task, saved states of its episodes, and a reset for Drake's own environment."""

import math
import re
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import gymnasium
import numpy as np
from pydrake.gym import DrakeGymEnv
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import InitializeParams, Simulator
from pydrake.systems.framework import Context, Diagram, PortDataType

from guiderail.diagrams.envs.scene import View
from guiderail.diagrams.envs.task_diagram import TaskDiagram
from guiderail.diagrams.envs.trace import EpisodeTrace
from guiderail.models.common.arrays import is_finite
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.termination import TERMINATIONS, Termination

RECORDED_SIGNALS = (
    "commanded_violation",
    "measured_violation",
    "contact_force",
    "wrench",
    "saturation",
    "collision",
    "command_timed_out",
    "fallback",
    "state",
)
"""Ports whose values the trace records in every control step, if a task's diagram has them."""

INFO_KEYS = (
    "is_success",
    "termination",
    "constraint_violation",
    "measured_violation",
    "impedance_force",
    "contact_force",
    "cost",
    "fallback",
    "control_steps",
    "simulation_failure",
)
"""Reserved keys of `info`; reward terms and the values that a task's reset samples must have other names."""

_EPISODE_FIELDS = (
    "sampled",
    "privileged",
    "_control_steps",
    "_running",
    "_observation",
    "_failure",
    "_violations",
)
"""Attributes of a `DiagramEnv` that belong to the episode; the context holds everything else."""

# Error messages of Drake, or of a system with another physics engine, that report failed physics and not wrong wiring.
# A failed assertion of Drake is a SystemExit in Python.
_SIMULATION_FAILURE = re.compile(
    r"failed to converge|\bnan\b|not finite|diverg|simulation failed|AllFinite|isfinite", re.IGNORECASE
)

# A simulation has failed if a coordinate of the robot's position [m] or a joint speed [m/s], [rad/s] exceeds its limit.
# A ball that falls for the longest episode reaches a third of the speed limit.
MAX_POSITION, MAX_JOINT_SPEED = 10.0, 1e3


@dataclass(frozen=True)
class EpisodeState:
    """Everything on which the rest of an episode and the next resets depend; `DiagramEnv.restore` does not change it.

    It holds a context of the environment's diagram, so it exists in this process only and fits environments that run
    this diagram.
    """

    diagram: Diagram  # diagram that the context belongs to
    context: Context  # time, state and parameters
    action: np.ndarray  # last action, (A,)
    rng: Mapping[str, Any]  # state of the random generator that resets draw from
    trace: EpisodeTrace  # copy of the trace
    fields: Mapping[str, Any]  # attributes of the environment by name


class DiagramEnv(DrakeGymEnv):
    """Gymnasium environment that runs a `TaskDiagram`.

    It keeps `DrakeGymEnv`'s interface and replaces its `reset` and `step`. The diagram is built once. A reset restores
    the default context, writes the neutral action, lets the task randomize the context with `self.np_random`, and
    initializes the simulator. A step checks the action before anything moves, and advances `action_repeat` control
    steps, which are counted by an integer. The ports are read at the end of each control step, before the events of
    that instant; the observation is read at the end of the last control step only.

    `info` has, at every step and at a reset, `is_success`, `termination` (a `Termination`),
    `constraint_violation` and `measured_violation` (maxima of the step; negative is slack), `impedance_force` and
    `contact_force` (maxima of the step [N]; the first is 0 without an impedance), `cost` (number of unsafe control
    steps of the step, see `EpisodeTrace.unsafe`), `fallback` (True if guidance fell back to a safe command), every
    reward term by name (summed over the step), and `control_steps` since the reset. Here a step is a call of `step`,
    with all its control steps. The `info` of a reset also has the values that the task sampled.

    An episode that reaches the task's number of control steps is truncated with `termination` "time_limit".

    The simulation fails if Drake reports NaN or a solver that does not converge while it advances the diagram or
    evaluates a port, or if a pose or a joint speed is implausible. The failed control step is dropped, the episode is
    truncated with the last valid observation, and `info["simulation_failure"]` is the message. After a failed reset,
    the first step truncates the episode. A failure before the first valid observation is raised, and so is every other
    error.

    `RobotEnv` of packages/hardware overrides `_advance`, whose stop checks it adds, and uses `_begin_episode`, `_info`,
    `_running`, `_failure`, `_neutral`, `_observation` and `_action_value`: change them together.

    Attributes:
        diagram: The `TaskDiagram`.
        action_repeat: Control steps per action.
        trace: `EpisodeTrace` of the current episode.
        sampled: Values that the task sampled for the current episode, by name.
        observes_privileged: True if `privileged` is updated with each observation; False by default.
        privileged: Privileged observation (m,) that belongs to the last observation, or None.
        privileged_space: Space of the privileged observation; None if the task has no privileged terms.
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
        """Construct the environment.

        Args:
            task: Task diagram to run.
            action_repeat: Control steps per action, at least 1.
            render_mode: None, "human" (Meshcat) or "rgb_array" (camera).
            release: Function that is called once, when the environment is closed or garbage-collected.

        Raises:
            InputError: If the task cannot be rendered in this mode.
        """
        diagram = task.diagram
        _check_view(task, render_mode)
        view = (
            None
            if render_mode != "human" or task.query is None
            else View(task.query, contact_results=task.contact_results)
        )
        self.diagram = task = replace(task, view=view)
        self.action_repeat = int(action_repeat)
        self.metadata = {}  # the parent class would write its render modes into the class attribute
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
        frames_per_second = max(round(1 / (action_repeat * task.control_period)), 1)  # a video needs at least 1
        self.metadata = {**type(self).metadata, "render_fps": frames_per_second}
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
        recorded = filter(diagram.HasOutputPort, RECORDED_SIGNALS)
        self._recorded = [(name, diagram.GetOutputPort(name)) for name in recorded]
        self._has_impedance = diagram.HasOutputPort("impedance_force")
        self._force_port = diagram.GetOutputPort("impedance_force" if self._has_impedance else "contact_force")
        self._desired_pose_port = diagram.GetOutputPort("desired_pose")
        self._plants = list(_plants(diagram))
        self._pose_port = diagram.GetOutputPort("pose")
        sizes = {name: port.size() for name, port in self._recorded}
        self.trace = EpisodeTrace(task.num_steps, self._pose_port.size(), task.control_period, sizes)
        self.sampled: dict[str, Any] = {}
        self._privileged_port = diagram.GetOutputPort("privileged") if diagram.HasOutputPort("privileged") else None
        self.privileged_space = (
            None
            if self._privileged_port is None
            else gymnasium.spaces.Box(-np.inf, np.inf, (self._privileged_port.size(),), np.float32)
        )
        self.observes_privileged = False
        self.privileged: np.ndarray | None = None
        self._control_steps = 0
        self._running = False
        self._observation: np.ndarray | None = None  # last valid observation
        self._failure: str | None = None  # message of the failed simulation
        self._violations = (-np.inf, -np.inf)
        self._closed = False
        self._release = weakref.finalize(self, release or (lambda: None))
        self._release.atexit = False

    def close(self) -> None:
        """Close the environment and its view; the trace stays readable."""
        self._running, self._closed = False, True
        self.simulator.clear_monitor()
        self.diagram = replace(self.diagram, view=None)
        self._release()

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Raise an `InputError`, because a simulation cannot be pickled."""
        call = "gymnasium.make" if self.spec is None else f"gymnasium.make({self.spec.id!r}, ...)"
        raise InputError(f"an environment runs a simulation and cannot be pickled: call {call} in the worker instead")

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; return its first observation and `info`.

        Args:
            seed: Seed of this and all later episodes; default: continue the random stream.
            options: Options of the task's `Reset` by name.

        Raises:
            InputError: If an option is unknown, a value is out of range, the environment is closed, the first reset
                puts the robot more than `MAX_POSITION` away, or the observation is not finite although the simulation
                did not fail.
        """
        self._check_open()
        # The parent class's reset would initialize the simulator before the state is set, and accepts no options.
        gymnasium.Env.reset(self, seed=seed)
        self._running = False
        context = self.simulator.get_mutable_context()
        context.SetTimeStateAndParametersFrom(self._pristine)
        self._action_value.GetMutableData().set_value(self._neutral)
        self.sampled, self._failure = {}, None
        with self._record_failure():
            self.sampled = self.diagram.randomize(context, self.np_random, dict(options or {}))
            self.simulator.Initialize()
        return self._begin_episode()

    def save(self) -> EpisodeState:
        """Return the state of the episode, from which `restore` continues any number of times.

        Raises:
            ResetNeeded: If no episode has begun.
            InputError: If the environment is closed.
        """
        self._check_open()
        if self._observation is None:
            raise gymnasium.error.ResetNeeded("no episode has begun: call reset() first")
        context = self._pristine.Clone()  # without the values in the caches, which are computed again
        context.SetTimeStateAndParametersFrom(self.simulator.get_context())
        return EpisodeState(
            diagram=self.diagram.diagram,
            context=context,
            action=self.action_port.Eval(self.simulator.get_context()).copy(),
            rng=self.np_random.bit_generator.state,
            trace=deepcopy(self.trace),
            fields=deepcopy({name: getattr(self, name) for name in _EPISODE_FIELDS}),
        )

    def restore(self, state: EpisodeState) -> np.ndarray:
        """Continue from a saved state of this environment's diagram; return the observation then, (n,) or (h, w, 3).

        Equal actions then give equal observations, rewards and `info`, bit for bit. Later resets without a seed are
        equal as well, because the state includes the random generator.

        Raises:
            InputError: If `state` belongs to another diagram, or the environment is closed.
        """
        self._check_open()
        if state.diagram is not self.diagram.diagram:
            raise InputError("this state was saved by an environment with another diagram: save it in this one")
        self.simulator.get_mutable_context().SetTimeStateAndParametersFrom(state.context)
        self._action_value.GetMutableData().set_value(state.action)
        # The events of this instant follow in the next step, as they would have without the interruption.
        self.simulator.Initialize(InitializeParams(suppress_initialization_events=True))
        self.np_random.bit_generator.state = state.rng
        self.trace.assign(state.trace)
        for name, value in deepcopy(state.fields).items():
            setattr(self, name, value)
        assert self._observation is not None
        return self._observation

    def _check_open(self) -> None:
        if self._closed:
            raise InputError("the environment is closed: make another one")

    def _begin_episode(self) -> tuple[np.ndarray | None, dict[str, Any]]:
        """Return observation and info of a reset, after the simulator was initialized or has failed."""
        context = self.simulator.get_context()
        self._control_steps = 0
        self.trace.clear()
        self._running = True
        self._violations = -np.inf, -np.inf
        if self._failure is None:
            with self._record_failure():
                pose = self._pose_port.Eval(context)
                if self._observation is None:
                    self._check_start(pose)
                self._check_plausible(context, pose)
                observation = self._observe(context)
                now = {name: port.Eval(context) for name, port in self._recorded}
                self._violations = float(now["commanded_violation"][0]), float(now["measured_violation"][0])
                self._observation = observation
        info = self._info(0, 0, dict.fromkeys(self.diagram.reward_terms, 0.0))
        return self._observation, info | self.sampled

    @contextmanager
    def _record_failure(self) -> Iterator[None]:
        """Store the message of a failed simulation in `_failure`; every other error propagates."""
        try:
            yield
        except (RuntimeError, SystemExit) as error:
            from guiderail.systems.policy_system import PolicyError

            if isinstance(error, PolicyError):  # a policy inside the diagram failed, not the simulation
                raise
            if self._observation is None or not _SIMULATION_FAILURE.search(str(error)):
                raise
            self._failure = str(error)

    def _check_start(self, pose: np.ndarray) -> None:
        """Raise an `InputError` if a coordinate of the first start position (3,) exceeds `MAX_POSITION`."""
        if np.abs(pose[:3]).max() > MAX_POSITION:
            of = "" if self.diagram.task is None else f" of {self.diagram.task.name}"
            raise InputError(
                f"reset{of} puts the robot at {pose[:3]} m, and at most {MAX_POSITION:g} m are allowed: give poses in "
                "meters"
            )

    def _check_plausible(self, context: Context, pose: np.ndarray) -> None:
        """Raise a `RuntimeError` if the measured pose (O,) or a joint speed is not finite or exceeds its limit."""
        if not is_finite(pose):
            raise RuntimeError("the measured pose is not finite")
        if max(map(abs, pose[:3].tolist())) > MAX_POSITION:
            raise RuntimeError(f"the simulation failed: the robot is at {pose[:3]} m")
        for plant in self._plants:
            speed = np.abs(plant.GetVelocities(plant.GetMyContextFromRoot(context))).max()
            if not speed <= MAX_JOINT_SPEED:
                raise RuntimeError(f"the simulation failed: a joint moves at {speed:g} m/s or rad/s")

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Apply `action`, (A,), for `action_repeat` control steps, or until the episode ends.

        Raises:
            ResetNeeded: If the episode is over, or none has begun.
            InputError: If the action is not finite or has the wrong shape, or if a reward term or the observation is
                not finite although the simulation did not fail. A finite action outside [-1, 1] is clipped.
        """
        action = self._check_action(action)
        if not self._running:
            raise gymnasium.error.ResetNeeded("the episode is over, or none has begun: call reset() first")
        context = self.simulator.get_context()
        self._action_value.GetMutableData().set_value(action)

        total, termination, terms = 0.0, 0, dict.fromkeys(self.diagram.reward_terms, 0.0)
        first_step, last_step = (
            self._control_steps,
            min(self._control_steps + self.action_repeat, self.diagram.num_steps),
        )
        while self._failure is None and not termination and self._control_steps < last_step:
            with self._record_failure():
                self._advance()
                pose = self._pose_port.Eval(context)
                self._check_plausible(context, pose)
                reward = float(self._reward_port.Eval(context)[0])
                force = float(self._force_port.Eval(context)[0])
                now = {name: port.Eval(context) for name, port in self._recorded}
                gained = [(name, float(port.Eval(context)[0])) for name, port in self._term_ports]
                desired_pose = self._desired_pose_port.Eval(context)
                reason = int(self._termination_port.Eval(context)[0])
                if reason or self._control_steps + 1 == last_step:
                    self._observation = self._observe(context)
            if self._failure is not None:
                break  # this control step is dropped
            self._control_steps += 1
            total += reward
            for name, value in gained:
                terms[name] += value
            self.trace.append(desired_pose, pose, force, reward, now)
            termination = reason

        if not math.isfinite(total):
            raise InputError(f"the reward of {self._control_steps - first_step} control steps overflows: scale it down")
        terminated = termination != 0
        truncated = not terminated and (self._failure is not None or self._control_steps >= self.diagram.num_steps)
        if truncated and self._failure is None:
            termination = Termination.TIME_LIMIT.index
        info = self._info(termination, first_step, terms)
        self._running = not (terminated or truncated)
        return self._observation, total, terminated, truncated, info

    def _advance(self) -> None:
        """Advance to the end of the next control step, at a multiple of the period: a sum of periods would drift."""
        end, time = (self._control_steps + 1) * self.diagram.control_period, self.simulator.get_context().get_time()
        if time > end:  # Drake would end the process
            raise InputError(f"the simulator was advanced by hand to {time:g} s: advance it by step() only")
        self.simulator.AdvanceTo(end)

    def render(self) -> Any:
        """Return an (h, w, 3) image of uint8 for "rgb_array"; publish to Meshcat for "human"."""
        if self.render_mode is None:
            gymnasium.logger.warn("nothing to render: make the environment with render_mode='human' or 'rgb_array'")
            return None
        if self.render_mode == "rgb_array":
            return self.render_rgb_port.Eval(self.simulator.get_context()).data[:, :, :3].copy()
        if self.diagram.view is not None:
            self.diagram.view.publish(self.simulator.get_context())
        return None

    def _check_action(self, action: Any) -> np.ndarray:
        try:
            if np.iscomplexobj(action):
                raise TypeError
            action = np.asarray(action, dtype=float)
        except (TypeError, ValueError, OverflowError):  # a Python integer can exceed the range of a double
            raise InputError(f"an action is {self._neutral.size} numbers in [-1, 1], not {brief(action)}") from None
        if action.shape != self._neutral.shape:
            raise InputError(f"an action is an array of shape {self._neutral.shape}, not {action.shape}")
        if not np.isfinite(action).all():
            raise InputError(f"an action must be finite, not {action}: the robot was not moved")
        return np.clip(action, -1.0, 1.0)

    def _observe(self, context: Context) -> np.ndarray:
        if self.observes_privileged and self._privileged_port is not None:
            self.privileged = self._privileged_port.Eval(context).astype(np.float32)
        if self._image_observation:
            return self.observation_port.Eval(context).data[:, :, :3].copy()
        observation = self.observation_port.Eval(context).astype(self.observation_space.dtype)
        # Without this check a learner would diverge several episodes later.
        if not np.isfinite(observation).all():
            of = "" if self.diagram.task is None else f" of {self.diagram.task.name}"
            raise InputError(f"the observation{of} is not finite, but {brief(observation.tolist())}")
        return observation

    def _info(self, termination: int, first: int, terms: Mapping[str, float]) -> dict[str, Any]:
        """Return `info` of the control steps from number `first` on; a maximum of values that contain NaN is NaN.

        Without such a control step, because the simulation failed in the first one, the violations are the last ones.
        """
        signals = {name: values[first:, 0] for name, values in self.trace.signals.items()}
        if len(self.trace) > first:
            commanded, measured = (float(signals[f"{name}_violation"].max()) for name in ("commanded", "measured"))
            self._violations = commanded, measured
        failure = {} if self._failure is None else {"simulation_failure": self._failure}
        return {
            "is_success": TERMINATIONS[termination] == Termination.SUCCESS,
            "termination": TERMINATIONS[termination].value,
            "constraint_violation": self._violations[0],
            "measured_violation": self._violations[1],
            "impedance_force": float(self.trace.force[first:].max(initial=0.0)) if self._has_impedance else 0.0,
            "contact_force": float(signals["contact_force"].max(initial=0.0)),
            "cost": float(self.trace.unsafe(first).sum()),
            "fallback": bool(signals["fallback"].any()),
            "control_steps": self._control_steps,
            **terms,
            **failure,
        }


def _plants(diagram: Diagram) -> Iterator[MultibodyPlant]:
    """Yield the plants in a diagram that have joints."""
    for system in diagram.GetSystems():
        if isinstance(system, Diagram):
            yield from _plants(system)
        elif isinstance(system, MultibodyPlant) and system.num_velocities():
            yield system


def check_render_mode(render_mode: str | None) -> None:
    """Raise an InputError if `render_mode` is not None, "human" or "rgb_array"."""
    if render_mode not in (None, "human", "rgb_array"):
        raise InputError(f"there is no render mode {brief(render_mode)}: use None, 'human' or 'rgb_array'")


def _check_view(task: TaskDiagram, render_mode: str | None) -> None:
    check_render_mode(render_mode)
    if render_mode == "human" and task.query is None:
        raise InputError("this environment has no scene for Meshcat to show: leave render_mode out")
    if render_mode == "rgb_array" and not task.diagram.HasOutputPort("rgb_image"):
        raise InputError("the diagram of this environment has no camera: build it with render_mode='rgb_array'")


def drake_gym_reset(
    set_start: Callable[[Simulator, Context, int | None], object] | None = None,
) -> Callable[[Simulator, Context, int | None], None]:
    """Return a `reset_handler` of `pydrake.gym.DrakeGymEnv` for diagrams with systems of this package.

    Drake initializes the simulator and then replaces the context by its defaults or by random values. The commands of
    these systems begin at the measured pose of an initialization, and without one they are refused. The handler
    therefore initializes again after the start is set.

    Args:
        set_start: Function of simulator, root context and seed that sets the start, such as joint positions; None: the
            defaults of the diagram.
    """

    def reset(simulator: Simulator, context: Context, seed: int | None) -> None:
        if set_start is not None:
            set_start(simulator, context, seed)
        simulator.Initialize()

    return reset
