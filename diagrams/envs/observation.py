"""Diagram of a policy's observation: concatenated signals, each centered, scaled and clipped.

Tasks declare it in `Task.observe`, and `assemble.py` builds it. Order and scales are fixed by trained policies, by
`Task.symmetries` and by scripted policies, which index the observation. packages/cpp exports them (`skill.py`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gymnasium
import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import AffineSystem, Multiplexer, Saturation, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial
from scipy.linalg import block_diag

from guiderail.diagrams.envs.scene import Camera
from guiderail.diagrams.wiring import add_system
from guiderail.models.common.errors import InputError, brief

CLOCKS = ("time", "phase")
"""Signals that every observation can have: time of the episode [s], and this time scaled to −1 … 1."""
MOTION_TIME = "motion_time"
"""Output of guidance whose motion waits for the robot: time of the motion [s], from which `CLOCKS` are computed."""


@dataclass(frozen=True)
class ObservationTerm:
    """Signal in an observation, as (value − center) / scale.

    Attributes:
        signal: Name of a port of station, guidance or task, or one of `CLOCKS`.
        center: Finite number, or one per entry (n,), in the signal's unit.
        scale: Finite number, or one per entry (n,), in the signal's unit; not 0.
        entries: Indices of the observed entries of the signal; negative indices count from its end; default: all.
    """

    signal: str
    center: Sequence[float] | np.ndarray | float = 0.0
    scale: Sequence[float] | np.ndarray | float = 1.0
    entries: tuple[int, ...] | None = None


@dataclass(frozen=True)
class Observed:
    """Observation of a task: terms, a camera, or an image followed by terms (see `ImageObservation`).

    Attributes:
        terms: Terms of the policy's observation.
        camera: Camera of the policy's image.
        privileged: Terms that only a privileged critic observes in simulation, such as hidden values. In addition to
            the signals of other terms, they can name `exact_wrench`, the wrench without sensor errors.
    """

    terms: Sequence[ObservationTerm] = ()
    camera: Camera | None = None
    privileged: Sequence[ObservationTerm] = ()

    @classmethod
    def of(cls, declared: Sequence[ObservationTerm] | Observed) -> Observed:
        """Return what `Task.observe` declares, which may be a list of terms.

        Raises:
            InputError: If an entry is no `ObservationTerm`.
        """
        observed = declared if isinstance(declared, Observed) else cls(declared)
        for term in (*observed.terms, *observed.privileged):
            if not isinstance(term, ObservationTerm):
                raise InputError(f"observe returns terms, such as ObservationTerm('pose'), not {brief(term)}")
        return observed


class ImageAndStateSpace(gymnasium.spaces.Box):
    """Space of vectors [image / 255, state] of float32, with the image channel by channel (see `ImageObservation`).

    Attributes:
        image_shape: Height, width and number of channels of the image.
    """

    def __init__(self, image_shape: tuple[int, int, int], state: gymnasium.spaces.Box):
        """Construct the space for images of a shape (height, width, channels) and states of a space (n,)."""
        self.image_shape = image_shape
        pixels = np.zeros(math.prod(image_shape), np.float32)
        low, high = np.concatenate([pixels, state.low]), np.concatenate([pixels + 1, state.high])
        super().__init__(low, high, dtype=np.float32)


class Observation(Diagram):
    """Diagram from signals to an observation.

    .. pydrake_system::

        name: Observation
        input_ports:
        - one per signal that is not a clock
        - motion_time (if the motion waits for the robot)
        output_ports:
        - observation

    ``observation`` is (n,), its entries in the order of the terms, clipped to ±`clip`.
    """

    def __init__(
        self,
        terms: Sequence[ObservationTerm],
        sizes: Mapping[str, int],
        duration: float,
        clip: float,
        task_name: str = "",
        *,
        waits: bool = False,
    ):
        """Construct the diagram.

        Args:
            terms: Terms of the observation, at least one.
            sizes: Sizes of the signals by name, without `CLOCKS`.
            duration: Duration of an episode [s].
            clip: Largest absolute value of an entry, positive.
            task_name: Name of the task, for error messages.
            waits: True if `CLOCKS` are computed from the input `motion_time` instead of the simulation time.

        Raises:
            InputError: If there is no entry, or a center or a scale would not map finite signals to finite numbers.
        """
        super().__init__()
        builder = DiagramBuilder()
        sizes = {**sizes, **dict.fromkeys(CLOCKS, 1)}
        of_task = f" of {task_name}" if task_name else ""
        rows = [_rows(term, sizes[term.signal], of_task) for term in terms]
        self.size = sum(len(scale) for _, _, scale in rows)
        if not self.size:
            raise InputError(f"the observation{of_task} is empty: let observe() list a signal")
        multiplexer = builder.AddNamedSystem("observed", Multiplexer([sizes[term.signal] for term in terms]))
        clocks: dict[str, OutputPort] = {}
        exported = set()
        if waits:
            motion_time = builder.AddNamedSystem(MOTION_TIME, Saturation(np.zeros(1), np.full(1, duration)))
            builder.ExportInput(motion_time.get_input_port(), MOTION_TIME)
            exported.add(MOTION_TIME)
        for index, term in enumerate(terms):
            if term.signal in CLOCKS:
                if term.signal not in clocks:
                    clocks[term.signal] = _add_clock(builder, term.signal, duration, motion_time if waits else None)
                builder.Connect(clocks[term.signal], multiplexer.get_input_port(index))
            elif term.signal in exported:
                builder.ConnectInput(term.signal, multiplexer.get_input_port(index))
            else:
                builder.ExportInput(multiplexer.get_input_port(index), term.signal)
                exported.add(term.signal)
        scale = np.concatenate([scale for _, _, scale in rows])
        center = np.concatenate([center for _, center, _ in rows])
        D = block_diag(*(selection for selection, _, _ in rows)) / scale[:, None]
        scaled = add_system(builder, "scaled", affine(D, -center / scale), multiplexer.get_output_port())
        limit = np.full(self.size, clip)
        clipped = add_system(builder, "clipped", Saturation(-limit, limit), scaled.get_output_port())
        builder.ExportOutput(clipped.get_output_port(), "observation")
        builder.BuildInto(self)
        self.space = gymnasium.spaces.Box(-clip, clip, (self.size,), np.float32)

    def get_observation_output_port(self) -> OutputPort:
        """Return the port of the observation, (n,)."""
        return self.GetOutputPort("observation")


def affine(D: np.ndarray, y0: np.ndarray | Sequence[float]) -> AffineSystem:
    """Return the system y = D u + y0 with D (n, m) and y0 (n,), which is evaluated in C++."""
    outputs, inputs = D.shape
    return AffineSystem(
        A=np.zeros((0, 0)), B=np.zeros((0, inputs)), f0=np.zeros(0), C=np.zeros((outputs, 0)), D=D, y0=np.asarray(y0)
    )


def _add_clock(
    builder: DiagramBuilder, name: str, duration: float, motion_time: Saturation | None = None
) -> OutputPort:
    """Add a clock of simulation time, or of `motion_time` if it is given; return the clock's port."""
    if motion_time is not None:
        scale, offset = (1.0, 0.0) if name == "time" else (2.0 / duration, -1.0)
        clock = affine(np.array([[scale]]), [offset])
        return add_system(builder, name, clock, motion_time.get_output_port()).get_output_port()
    ends = np.array([[0.0, duration]]) if name == "time" else np.array([[-1.0, 1.0]])
    clock = TrajectorySource(PiecewisePolynomial.FirstOrderHold([0.0, duration], ends))
    return builder.AddNamedSystem(name, clock).get_output_port()


def _rows(term: ObservationTerm, size: int, of_task: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the matrix (n, size) that selects a term's entries, and their centers (n,) and scales (n,)."""
    selection = np.eye(size) if term.entries is None else np.eye(size)[list(term.entries)]
    try:
        center, scale = (np.broadcast_to(values, len(selection)).astype(float) for values in (term.center, term.scale))
    except ValueError:
        raise InputError(
            f"the observed signal {term.signal!r}{of_task} has {len(selection)} entries: center and scale are one "
            "number or as many numbers"
        ) from None
    with np.errstate(all="ignore"):
        is_usable = np.isfinite(1.0 / scale).all() and np.isfinite([center, scale, center / scale]).all()
    if not is_usable:
        raise InputError(
            f"the observed signal {term.signal!r}{of_task} has a center and a scale that are finite, and a scale that "
            f"is not 0, unlike {brief(term.center)} and {brief(term.scale)}"
        )
    return selection, center, scale
