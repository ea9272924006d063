"""Task diagram: a wired task with the ports that `DiagramEnv` reads."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import Meshcat
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context, Diagram, OutputPort

from guiderail.diagrams.envs.scene import View
from guiderail.models.common.errors import InputError

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
"""Output ports of every task diagram, in addition to one port per reward term."""


@dataclass(frozen=True)
class Symmetry:
    """Rotations and reflections under which a task is invariant, except for details such as the demonstrated mean.

    Raises:
        ValueError: If the numbers of matrices differ, or a matrix is not a signed permutation.
    """

    observations: np.ndarray  # signed permutation of the observation for each of K symmetries, (K, n, n)
    actions: np.ndarray  # signed permutation of the action, (K, A, A)
    # Signed permutation of the privileged observation, (K, m, m); None if it is not declared.
    privileged: np.ndarray | None = None

    def __post_init__(self) -> None:
        privileged = () if self.privileged is None else self.privileged
        if len(self.observations) != len(self.actions) or len(privileged) not in (0, len(self.actions)):
            raise ValueError(
                "a symmetry needs equally many matrices for observation, action and privileged observation"
            )
        for matrix in (*self.observations, *self.actions, *privileged):
            magnitudes = np.abs(matrix)
            if not (
                np.isin(matrix, (-1, 0, 1)).all() and (magnitudes.sum(0) == 1).all() and (magnitudes.sum(1) == 1).all()
            ):
                raise ValueError("each matrix of a symmetry must be a signed permutation")

    def pad(self, count: int) -> Symmetry:
        """Return the symmetry for observations with `count` additional entries at the end, which it does not change."""
        if count == 0:
            return self
        size = self.observations.shape[1]
        observations = np.tile(np.eye(size + count), (len(self.observations), 1, 1))
        observations[:, :size, :size] = self.observations
        return Symmetry(observations, self.actions, self.privileged)

    def restrict(self, outputs: Sequence[int]) -> Symmetry | None:
        """Return the symmetry for actions that move some `outputs`; None if it moves other outputs as well."""
        actions = self.actions[:, list(outputs)][:, :, list(outputs)]
        if (np.abs(actions).sum(axis=1) != 1).any():
            return None
        return Symmetry(self.observations, actions, self.privileged)

    @classmethod
    def of_signs(cls, observation: ArrayLike, action: ArrayLike, privileged: ArrayLike | None = None) -> Symmetry:
        """Return the symmetry that multiplies each entry of observation (n,), action (A,) and privileged (m,) by ±1."""
        signs = (observation, action) if privileged is None else (observation, action, privileged)
        return cls(*(np.diag(np.asarray(each, float))[None] for each in signs))


def plant_steps(diagram: Diagram) -> list[float]:
    """Return the time steps of all discrete plants in a diagram, nested ones included [s]."""
    steps = []
    for system in diagram.GetSystems():
        if isinstance(system, Diagram):
            steps += plant_steps(system)
        elif isinstance(system, MultibodyPlant) and system.time_step() > 0.0:
            steps.append(system.time_step())
    return steps


@dataclass(frozen=True)
class TaskDiagram:
    """Built diagram of a task, with the data that `DiagramEnv` needs to run it.

    The diagram exports the input ``action`` (A,), in [-1, 1], and these outputs:

    ======================= ================================================================================
    ``observation``         observation of the policy: a vector, or an abstract `ImageRgba8U`
    ``reward``              (1,) reward of the control step that has just ended
    one per reward term     (1,) each, named as in `reward_terms`
    ``termination``         (1,) index of a `guiderail.models.common.termination.Termination`
    ``commanded_violation`` (1,) max(c - G y) over all constraints G y ≥ c for the commanded pose y; negative is slack
    ``measured_violation``  (1,) max(c - G y) for the measured pose y
    ``contact_force``       (1,) magnitude of the contact force [N]
    ``desired_pose``        (O,) commanded pose
    ``pose``                (O,) measured pose
    ``fallback``            (1,) 1 if guidance commanded a safe pose instead of the requested one
    ``wrench``              (W,) contact wrench on the tool; this port and all following ports are optional
    ``impedance_force``     (1,) magnitude of the force of the impedance [N]
    ``saturation``          nonzero while an actuator is at its limit; its size depends on the station
    ``collision``           (1,) positive during a collision
    ``privileged``          (m,) observation for a privileged critic; the policy does not receive it
    ``command_timed_out``   (1,) 1 while the last safe pose is held because commands stopped or are not finite
    ``rgb_image``           an abstract `ImageRgba8U`; only if the diagram was built with a camera
    ======================= ================================================================================

    The environment reads the outputs at the end of each control step, before the events of that instant. Build the
    plant with ``use_sampled_output_ports=False``. Systems that sample the plant at control steps then read the same
    numbers as the environment. With sampled output ports, the plant's step would be an unrestricted update, which Drake
    runs before the discrete updates of the same instant. The sampling systems would then read the plant's state one
    plant step later than the environment.

    Attributes:
        diagram: Root diagram.
        control_period: Control period [s]; an integer multiple of the plant's time step.
        num_steps: Control steps after which an episode is truncated.
        observation_space: Space of observations, in the dtype that the environment returns.
        reward_terms: Names of the reward terms, which are ports of the diagram and keys of `info`.
        randomize: Function that samples the episode's conditions, writes them into the root context and returns them
            for `info`. Its arguments are the root context (just restored to the default), the environment's random
            generator and the options of the reset. It raises an `InputError` for an unknown option.
        query: Query port of the scene, for a browser view.
        contact_results: Port of the plant's contact results, for a browser view.
        view: Browser view of an environment made with `render_mode="human"`.
        symmetry: Symmetry of task and guidance for data augmentation, if there is one.
        near_symmetry: `symmetry`, extended by symmetries that hold only for most of an episode.
        task: `Task` that the diagram was built from, if there is one.
        config: Configuration of the environment, if there is one.

    Raises:
        InputError: If the diagram lacks a port, or `control_period` is no multiple of a discrete plant's time step.
    """

    diagram: Diagram
    control_period: float
    num_steps: int
    observation_space: gymnasium.spaces.Box
    reward_terms: tuple[str, ...]
    randomize: Callable[[Context, np.random.Generator, Mapping[str, Any]], dict[str, Any]] = lambda *_: {}
    query: OutputPort | None = None
    contact_results: OutputPort | None = None
    view: View | None = None
    symmetry: Symmetry | None = None
    near_symmetry: Symmetry | None = None
    task: Any = None
    config: Any = None

    @property
    def meshcat(self) -> Meshcat | None:
        """Meshcat page of the browser view, if there is one."""
        return None if self.view is None else self.view.meshcat

    def __post_init__(self) -> None:
        missing = [name for name in (*PORTS, *self.reward_terms) if not self.diagram.HasOutputPort(name)]
        if missing:
            raise InputError(f"the task's diagram {self.diagram.get_name()!r} exports no port {', '.join(missing)}")
        for step in plant_steps(self.diagram):
            number = round(self.control_period / step)
            if number < 1 or abs(number * step - self.control_period) > 1e-6:
                raise InputError(
                    f"the control period of {self.control_period:g} s is no whole multiple of a plant's time step of "
                    f"{step:g} s: choose another time step"
                )
