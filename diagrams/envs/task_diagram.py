"""What a task has to build, so that one environment class runs them all."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context, Diagram, OutputPort

from guiderail.diagrams.envs.scene import View
from guiderail.models.common.errors import InputError

_GRID = 2.0**-40

PORTS = (
    "observation",
    "reward",
    "termination",
    "commanded_violation",
    "measured_violation",
    "contact_force",
    "desired_pose",
    "pose",
    "fallback",
)
"""The output ports that every task's diagram exports, beside one per reward term."""


def round_period(seconds: float) -> float:
    """The period nearest to `seconds` (a picosecond away at most) whose multiples are exact in double precision.

    Drake triggers two events together only where their times are the same number, and fl(10 k · 0.002),
    fl(0.02 + k · 0.02) and fl(k · 0.02) often differ in the last bit: a plant would then step once more or once less
    between two control steps, or a history shift after the command it should have taken in. Take the plant's period
    from here and the control period as an integer multiple of it.

    Args:
        seconds: the period that is wanted, positive.

    Raises:
        InputError: if it is not positive and finite.
    """
    if not (np.isfinite(seconds) and seconds > _GRID):
        raise InputError(f"a period must be positive, not {seconds} s")
    return round(seconds / _GRID) * _GRID


def _nothing_to_randomize(context: Context, rng: np.random.Generator, options: Mapping[str, Any]) -> dict[str, Any]:
    return {}


@dataclass(frozen=True)
class Symmetry:
    """Turns and mirrors under which a task stays what it is, up to small things such as demonstrations' means.

    Args:
        observations: K sides from which an observation can be seen, (K, n, n): each exchanges numbers or their signs.
        actions: and an action, (K, A, A).
    """

    observations: np.ndarray
    actions: np.ndarray

    def __post_init__(self) -> None:
        if len(self.observations) != len(self.actions):
            raise ValueError("a symmetry has as many sides of the action as of the observation")
        for side in (*self.observations, *self.actions):
            exchanged = np.abs(side)
            if not (
                np.isin(side, (-1, 0, 1)).all() and (exchanged.sum(0) == 1).all() and (exchanged.sum(1) == 1).all()
            ):
                raise ValueError("a symmetry exchanges numbers or their signs")

    @classmethod
    def of_signs(cls, observation: ArrayLike, action: ArrayLike) -> Symmetry:
        """One other side, from which each observed number (n,) and each action (A,) is multiplied by 1 or −1."""
        return cls(np.diag(np.asarray(observation, float))[None], np.diag(np.asarray(action, float))[None])


@dataclass(frozen=True)
class TaskDiagram:
    """A task, wired and built: what `GuidedEnv` needs to know of it.

    The diagram exports the input ``action`` (A,), in [-1, 1], and these outputs:

    ======================= ================================================================================
    ``observation``         what the policy sees: a vector, or an abstract `ImageRgba8U`
    ``reward``              (1,) of the control step that is just over
    one per reward term     (1,) each, named as in `reward_terms`
    ``termination``         (1,) an index into `guiderail.systems.episode_monitor.TERMINATIONS`
    ``commanded_violation`` (1,) max over the constraints of c - G y of the commanded output; negative is slack
    ``measured_violation``  (1,) the same of the measured one
    ``contact_force``       (1,) N
    ``desired_pose``        (O,) what is commanded
    ``pose``                (O,) what is measured
    ``fallback``            (1,) 1 where guidance commanded something safe instead of what was asked for
    ``wrench``              of the surroundings on the tool, where the diagram has one; as are the next three
    ``saturation``          (A,) the demand on each actuator beyond its limit
    ``collision``           (1,) positive while the robot touches what it must not
    ``command_timed_out``             (1,) 1 while the last safe pose is held, as commands stopped or are no numbers
    ``rgb_image``           an abstract `ImageRgba8U`; only where the task was built with a camera
    ======================= ================================================================================

    The environment reads them at the end of each control step, before the events of that instant. For a system that
    samples a plant at control steps to see the same numbers, the plant must be built with
    ``use_sampled_output_ports=False``: with sampled output ports its step is an unrestricted update, which Drake does
    before the discrete updates of the same instant, so that they see the plant one of its steps later.

    Args:
        diagram: the root diagram.
        control_period: seconds between control steps; best an integer multiple of the plant's `round_period`.
        num_steps: control steps after which an episode is truncated.
        observation_space: the space of observations; its dtype is what the environment returns.
        reward_terms: names of the reward's terms, which are ports of the diagram and keys of `info`.
        randomize: called at every reset with the root context (just restored to how the diagram was built), the
            environment's own random generator and the reset's options; draws the episode's conditions, writes them
            into the context and returns what `info` should say about them. Refuses an unknown option by `InputError`.
        push: called with the root context and a displacement; moves the measured pose by it, as a person would who
            pushes the robot. None where a task has no such thing.
        query: of the scene, for a browser view.
        view: the browser view of an environment made with `render_mode="human"`.
        symmetry: of task and guidance, where they have one; what was seen may be learned from as seen from other sides.
        near_symmetry: the same, with sides from which only most of an episode stays what it is.
        declaration: the `Task` that this was assembled of, where it was.
    """

    diagram: Diagram
    control_period: float
    num_steps: int
    observation_space: gymnasium.spaces.Box
    reward_terms: tuple[str, ...]
    randomize: Callable[[Context, np.random.Generator, Mapping[str, Any]], dict[str, Any]] = _nothing_to_randomize
    push: Callable[[Context, np.ndarray], None] | None = None
    query: OutputPort | None = None
    view: View | None = None
    symmetry: Symmetry | None = None
    near_symmetry: Symmetry | None = None
    declaration: Any = None

    @property
    def meshcat(self) -> Meshcat | None:
        """The page of the browser view, where there is one."""
        return None if self.view is None else self.view.meshcat

    def __post_init__(self) -> None:
        missing = [name for name in (*PORTS, *self.reward_terms) if not self.diagram.HasOutputPort(name)]
        if not self.diagram.HasInputPort("action"):
            missing.append("action")
        if missing:
            raise ValueError(f"the task's diagram '{self.diagram.get_name()}' exports no port {', '.join(missing)}")
        if self.num_steps < 1 or not self.control_period > 0:
            raise ValueError(f"a task can't last {self.num_steps} steps of {self.control_period} s")
        for symmetry in (self.symmetry, self.near_symmetry):
            if symmetry is not None and (
                symmetry.observations.shape[1:] != 2 * self.observation_space.shape
                or symmetry.actions.shape[1:] != 2 * (self.diagram.GetInputPort("action").size(),)
            ):
                raise ValueError("a symmetry is of every observed number and of every action")
