"""What an episode did to the robot and its surroundings."""

import numpy as np
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    EventStatus,
    InputPort,
    LeafSystem,
    OutputPort,
)

from guiderail.systems.sampling import check_period

_INPUTS = ("commanded_violation", "measured_violation", "contact_force", "collision", "saturation", "fallback")

# The state: worst commanded and measured violation, peak force, sum of forces, collisions, steps in collision,
# saturations, fallbacks, steps, and whether the last step was in collision.
_FRESH = np.array([-np.inf, -np.inf, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])


class SafetyLedger(LeafSystem):
    """Keeps, over all control steps of an episode, what must be known about its safety.

    Every control step counts once: the output already counts the step that is just over, the state takes it in at the
    event of that instant, and initialization empties the ledger.

    .. pydrake_system::

        name: SafetyLedger
        input_ports:
        - commanded_violation
        - measured_violation
        - contact_force
        - collision
        - saturation
        - fallback
        output_ports:
        - ledger

    Inputs are (1,): the violations are max(c - G y), ``contact_force`` is in N; ``collision`` and ``fallback`` say by a
    positive number that the robot touches what it must not touch, and that the last safe command was repeated.
    ``saturation`` (A,) is what was asked of each actuator beyond its limit, zero within it. ``ledger`` is named by
    `FIELDS`: a collision is one that lasts from the first control step in contact to the last; ``collision_steps``
    counts those steps.
    """

    FIELDS = (
        "worst_commanded_violation",
        "worst_measured_violation",
        "peak_force",
        "mean_force",
        "collisions",
        "collision_steps",
        "saturations",
        "fallbacks",
        "steps",
    )

    def __init__(self, period: float, num_actuators: int = 1):
        """
        Args:
            period: seconds between control steps, positive.
            num_actuators: A, at least 1.

        Raises:
            ValueError: if an argument is out of range.
        """
        super().__init__()
        check_period(period)
        if num_actuators < 1:
            raise ValueError(f"a robot has at least one actuator, not {num_actuators}")
        self._ports = [
            self.DeclareVectorInputPort(name, num_actuators if name == "saturation" else 1) for name in _INPUTS
        ]
        self._state = self.DeclareDiscreteState(_FRESH)
        self._ledger_port = self.DeclareVectorOutputPort(
            "ledger",
            len(self.FIELDS),
            self._calc_ledger,
            prerequisites_of_calc={
                self.discrete_state_ticket(self._state),
                *(port.ticket() for port in self._ports),
            },
        )
        self.DeclareInitializationDiscreteUpdateEvent(self._reset)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def get_ledger_output_port(self) -> OutputPort:
        """The ledger so far, named by `FIELDS`."""
        return self._ledger_port

    def get_record_input_port(self, name: str) -> InputPort:
        """The input of this name, (1,); (A,) for "saturation"."""
        return self._ports[_INPUTS.index(name)]

    def _next(self, context: Context) -> np.ndarray:
        signals = [port.Eval(context) for port in self._ports]
        commanded, measured, force, collision, _, fallback = (float(signal[0]) for signal in signals)
        state = context.get_discrete_state(self._state).value().copy()
        # A comparison with NaN is false, so the new value is asked first: a NaN must not hide behind an old maximum.
        for i, value in enumerate((commanded, measured, force)):
            if not value <= state[i]:
                state[i] = value
        state[3] += force
        if collision > 0:
            state[4] += state[9] == 0
            state[5] += 1
        state[6] += signals[4].any()
        state[7] += fallback > 0
        state[8] += 1
        state[9] = collision > 0
        return state

    def _calc_ledger(self, context: Context, output: BasicVector) -> None:
        state = self._next(context)
        state[3] /= state[8]
        output.SetFromVector(state[:9])

    def _reset(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        discrete_state.set_value(_FRESH)
        return EventStatus.Succeeded()

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        # At time zero no step is over yet; an offset of one period would not fall on k * period exactly.
        if context.get_time() > 0:
            discrete_state.set_value(self._next(context))
        return EventStatus.Succeeded()
