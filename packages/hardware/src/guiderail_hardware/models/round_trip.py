"""Round trip from a torque command to the message that reports its arrival, and the longest one that gains tolerate."""

import math
from collections import deque
from collections.abc import Collection

import numpy as np

PHASE_MARGIN = math.radians(15.0)  # phase that remains at the crossover frequency at the longest round trip [rad]
WINDOW = 4  # number of measurements of which the smallest counts, so that a late message is no latency
MAX_PENDING = 400  # largest number of commands whose arrival is awaited
EXPIRY = 0.1  # time after the last command from which the round trip is unknown [s]


def max_round_trip(frequencies: np.ndarray, damping_ratio: float, decay_time: float, *, period: float) -> float:
    """Return the longest round trip [s] at which the impedance and the damping of a stop keep `PHASE_MARGIN`.

    A mode of the impedance with the natural frequency ω and the damping ratio ζ has, relative to its inertia, the loop
    transfer function

        L(s) = (ω² + 2 ζ ω s) / s² · exp(−s T).

    T is the round trip plus half a period of the zero-order hold. With u = (ω_c / ω)², |L(j ω_c)| = 1 is
    u² = 1 + 4 ζ² u, so that u = 2 ζ² + √(4 ζ⁴ + 1). The phase margin is atan(2 ζ √u) − ω_c T. The damping of a stop
    with the decay time T_d is L(s) = exp(−s T) / (s T_d), with the margin π / 2 − T / T_d. Each margin decreases with
    T, and the first that reaches `PHASE_MARGIN` gives the bound. For a mode of 35 rad/s with ζ = 1, the loop is
    unstable from T = 18.5 ms on.

    Assumptions: the arm is in free motion, because a passive contact only adds stiffness and friction without delay;
    the inertia is that of the model. Gains that depend on the velocity only are at most those of the impedance.

    Args:
        frequencies: Natural frequencies (m,) of the impedance's modes, the roots of the eigenvalues of Λ⁻¹ K [rad/s].
        damping_ratio: Damping ratio of every mode.
        decay_time: Decay time of the joint velocities in a stop [s].
        period: Period of the commands [s].
    """
    u = 2.0 * damping_ratio**2 + math.sqrt(4.0 * damping_ratio**4 + 1.0)
    crossover = math.sqrt(u) * float(np.max(frequencies))
    impedance = (math.atan(2.0 * damping_ratio * math.sqrt(u)) - PHASE_MARGIN) / crossover
    return min(impedance, (0.5 * math.pi - PHASE_MARGIN) * decay_time) - 0.5 * period


def to_microseconds(stamp: float) -> int:
    """Return a command's time stamp [µs] from seconds; −1 for one that is not finite."""
    return round(1e6 * stamp) if math.isfinite(stamp) else -1


class RoundTrip:
    """Measurement of the time from sending a command to the receipt of a message that reports its arrival.

    A message reports the time stamp of the newest command that has arrived. If a command is not reported yet, the time
    since it was sent is a lower bound. The smallest of the last `WINDOW` measurements counts. The round trip is unknown
    `EXPIRY` after the last command, and before the first command is reported once a message reports a time stamp of no
    pending command.

    Attributes:
        seconds: Round trip [s]; NaN if it is unknown.
        longest: Longest known round trip so far [s]; NaN without one.
    """

    def __init__(self) -> None:
        self.seconds = self.longest = np.nan
        self._pending: deque[tuple[int, float]] = deque(maxlen=MAX_PENDING)  # time stamp [µs] and local time [s]
        self._measured: deque[float] = deque(maxlen=WINDOW)
        self._is_reported = False  # True after the first report of a command
        self._stamps = frozenset[int]()  # reported time stamps when no command was pending

    def add_command(self, stamp: float, now: float) -> None:
        """Add a command that is sent with a time stamp [s] at the local time [s]."""
        self._pending.append((to_microseconds(stamp), now))

    def update(self, stamps: Collection[int], now: float) -> None:
        """Update the measurement at the local time [s].

        Args:
            stamps: Reported time stamps of the newest command that arrived [µs], one of each message.
            now: Local time [s].
        """
        if self._pending and now - self._pending[-1][1] > EXPIRY:
            self._pending.clear()
            self._measured.clear()
            self.seconds = np.nan
        if not self._pending:
            self._stamps = frozenset(stamps)
        # The newest match: two stations may use the same time stamps one after the other.
        index = next((i for i in reversed(range(len(self._pending))) if self._pending[i][0] in stamps), None)
        if index is not None:
            self._is_reported = True
            sent = self._pending[index][1]
            for _ in range(index + 1):
                self._pending.popleft()
        elif self._pending and (self._is_reported or (self._stamps and self._stamps.issuperset(stamps))):
            sent = self._pending[0][1]
        else:
            return
        self._measured.append(now - sent)
        if index is not None or len(self._measured) == WINDOW:
            self.seconds = min(self._measured)
            self.longest = float(np.nanmax([self.longest, self.seconds]))
