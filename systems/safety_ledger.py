"""Statistics of an episode's safety: violations, forces, collisions, saturation, fallback_steps."""

from collections.abc import Mapping

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

from guiderail.models.common.errors import InputError
from guiderail.systems.support.sampling import check_period
from guiderail.systems.support.signal_ports import SignalPorts

# The state: worst commanded and measured violation, peak force, sum of forces, collisions, steps in collision,
# saturated_steps, fallback_steps, steps, and whether the last step was in collision.
_INITIAL_STATE = np.array([-np.inf, -np.inf, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])


class SafetyLedger(LeafSystem):
    """Accumulates the statistics of an episode's safety over its control steps.

    Every control step counts once: the output already counts the step that is just over, the state at the event of that
    instant. Initialization resets them.

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

    Inputs are (1,): the violations are max(c − G y), ``contact_force`` is in N; ``collision`` is positive while the
    robot touches what it must not touch, ``fallback`` while the last safe command is repeated. ``saturation`` (A,) is
    the demand on each actuator beyond its limit, zero within it. ``ledger`` is named by `FIELDS`: a collision lasts
    from the first control step in contact to the last, and ``collision_steps`` counts those steps.
    """

    FIELDS = (
        "max_commanded_violation",
        "max_measured_violation",
        "peak_force",
        "mean_force",
        "collisions",
        "collision_steps",
        "saturated_steps",
        "fallback_steps",
        "steps",
    )

    @staticmethod
    def counts(signals: Mapping[str, np.ndarray]) -> dict[str, float]:
        """The counts of steps whose signals are known, (n, size) each: for an episode that ended without its ledger."""
        touches = np.append(False, signals["collision"][:, 0] > 0)
        return {
            "collisions": float((touches[1:] & ~touches[:-1]).sum()),
            "collision_steps": float(touches.sum()),
            "saturated_steps": float(signals["saturation"].any(axis=1).sum()),
            "fallback_steps": float((signals["fallback"][:, 0] > 0).sum()),
        }

    def __init__(self, period: float, num_actuators: int = 1):
        """
        Args:
            period: between two control steps [s], positive.
            num_actuators: A, at least 1.

        Raises:
            InputError: if an argument is out of range.
        """
        super().__init__()
        check_period(period)
        if num_actuators < 1:
            raise InputError(f"a robot has at least one actuator, not {num_actuators}")
        self._signals = SignalPorts(
            self,
            {
                "commanded_violation": 1,
                "measured_violation": 1,
                "contact_force": 1,
                "collision": 1,
                "saturation": num_actuators,
                "fallback": 1,
            },
        )
        self._state = self.DeclareDiscreteState(_INITIAL_STATE)
        self._ledger_port = self.DeclareVectorOutputPort(
            "ledger",
            len(self.FIELDS),
            self._calc_ledger,
            prerequisites_of_calc=self._signals.tickets | {self.discrete_state_ticket(self._state)},
        )
        self.DeclareInitializationDiscreteUpdateEvent(self._reset)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def get_ledger_output_port(self) -> OutputPort:
        """The statistics so far, named by `FIELDS`."""
        return self._ledger_port

    def get_record_input_port(self, name: str) -> InputPort:
        """The input of this name, (1,); (A,) for "saturation".

        Raises:
            InputError: if there is none.
        """
        return self._signals.port(name)

    def _next(self, context: Context) -> np.ndarray:
        signals = self._signals.eval(context)
        force = float(signals["contact_force"][0])
        collision = signals["collision"][0] > 0
        state = context.get_discrete_state(self._state).value().copy()
        # A comparison with NaN is false, so the new value is asked first: a NaN must not hide behind an old maximum.
        worst = float(signals["commanded_violation"][0]), float(signals["measured_violation"][0]), force
        for i, value in enumerate(worst):
            if not value <= state[i]:
                state[i] = value
        state[3] += force
        if collision:
            state[4] += state[9] == 0
            state[5] += 1
        state[6] += signals["saturation"].any()
        state[7] += signals["fallback"][0] > 0
        state[8] += 1
        state[9] = collision
        return state

    def _calc_ledger(self, context: Context, output: BasicVector) -> None:
        state = self._next(context)
        state[3] /= state[8]
        output.SetFromVector(state[:9])

    def _reset(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        discrete_state.set_value(_INITIAL_STATE)
        return EventStatus.Succeeded()

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        # At time zero no step is over yet; an offset of one period would not fall on k * period exactly.
        if context.get_time() > 0:
            discrete_state.set_value(self._next(context))
        return EventStatus.Succeeded()
