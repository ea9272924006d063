"""Adversary: a search for action sequences that bring a primitive as close to its certified bounds as possible.

A third of the sequences are the signs of impulse responses, which reach a bound exactly if no constraint is active. A
third are actions of ±1 that change sign periodically or at random. A third are variations of one of the worst sequences
so far. A sequence with a larger value replaces the worst one.
"""

from dataclasses import dataclass, field

import numpy as np

from guiderail_studies.certificate.loop import CertifiedLoop, reach

QUANTITIES = ("pose", "speed", "acceleration")
DWELLS = (1, 1, 2, 3, 5, 10, 20, 50, 100)  # steps between two changes of sign


@dataclass
class AttackResult:
    """Worst values that an adversary reached.

    In `excess` and `residue`, the first row is the largest value at one step, the second row the largest sum over a
    sequence.
    """

    # Largest value of each quantity at every step (N, O): distance from the motion without actions, speed and
    # acceleration in the outputs' units per s and s².
    largest: dict[str, np.ndarray]
    lower: np.ndarray  # smallest commands (N, O)
    upper: np.ndarray  # largest commands (N, O)
    excess: np.ndarray  # (2, A), excess over ±1 of the actions that lead to the corrected commands without a correction
    # (2, O), difference between the corrected commands and the commands of these actions, in outputs that no action
    # moves.
    residue: np.ndarray
    steps: int = 0  # number of executed steps
    corrected: int = 0  # number of steps with a correction
    # Worst value, its actions (N, A) and its start (O,). The key is the quantity, the index of the output (of the
    # action for "excess"), and True for steps at which a constraint can be active, False for all other steps.
    worst: dict[tuple[str, int, bool], tuple[float, np.ndarray, np.ndarray]] = field(default_factory=dict)


class Adversary:
    """Search for the worst action sequences of a loop.

    Args:
        loop: Loop to attack.
        can_be_corrected: Mask (N,) of the steps at which a constraint can be active. Worst values are recorded
            separately for these steps and for all other steps.
        seed: Seed of all random numbers.
        attacks_budgets: If True, variations start from sequences with the largest excess or residue only.
    """

    def __init__(self, loop: CertifiedLoop, can_be_corrected: np.ndarray, seed: int = 0, attacks_budgets: bool = False):
        primitive = loop.primitive
        self._loop, self._rng, self._attacks_budgets = loop, np.random.default_rng(seed), attacks_budgets
        self._moved = np.flatnonzero(loop.gains)
        self._past = primitive.history
        self._middle, self._generators = reach(loop)
        self._responses = [primitive.linear_response(n) for n in range(primitive.num_steps)]
        self._masks = {True: can_be_corrected, False: ~can_be_corrected}
        self._targets = [
            self._farthest_target(order, o, steps)
            for order in range(len(QUANTITIES))
            for o in range(primitive.num_outputs)
            for steps in map(np.flatnonzero, self._masks.values())
            if len(steps)
        ]
        shape = (primitive.num_steps, primitive.num_outputs)
        self.result = AttackResult(
            {name: np.zeros(shape) for name in QUANTITIES},
            np.full(shape, np.inf), np.full(shape, -np.inf), np.zeros((2, len(self._moved))), np.zeros((2, shape[1])),
        )  # fmt: skip

    @property
    def middle(self) -> np.ndarray:
        """Motion without actions (N, O)."""
        return self._middle[self._loop.rest :]

    def attack(self, steps: int) -> AttackResult:
        """Execute sequences for at least `steps` further steps; return the result of all calls."""
        goal = self.result.steps + steps
        turn = 0
        while self.result.steps < goal:
            actions, start = (self._impulse_signs, self._switching_actions, self._variation)[turn % 3]()
            self._execute(actions, start)
            turn += 1
        return self.result

    def _execute(self, actions: np.ndarray, start: np.ndarray) -> None:
        """Execute a sequence (N, A) from a start (O,) and record its worst values."""
        loop, primitive, moved, result = self._loop, self._loop.primitive, self._moved, self.result
        history = np.tile(start, (self._past, 1))
        commands = np.zeros((primitive.num_steps, primitive.num_outputs))
        excess, residue = np.zeros((2, len(moved))), np.zeros((2, primitive.num_outputs))
        for n, action in enumerate(actions):
            raw = np.zeros(primitive.num_outputs)
            raw[moved] = action * loop.gains[moved]
            prediction = primitive.predict(n, raw, history if self._past else None)
            commands[n] = prediction.output
            if prediction.constrained:
                result.corrected += 1
                history_map, action_map, offset = self._responses[n]
                by_action = action_map[:, moved] * loop.gains[moved]
                correction = commands[n] - history_map @ history.ravel() - action_map @ raw - offset
                equivalent = np.linalg.solve(by_action[moved], correction[moved])
                _accumulate(excess, np.maximum(np.abs(action + equivalent) - 1.0, 0.0))
                _accumulate(residue, np.where(loop.gains == 0.0, np.abs(correction - by_action @ equivalent), 0.0))
            if self._past:
                history = np.concatenate([history[1:], commands[n : n + 1]])
        result.steps += len(actions)
        np.minimum(result.lower, commands, out=result.lower)
        np.maximum(result.upper, commands, out=result.upper)
        for name, largest, values in (("excess", result.excess, excess), ("residue", result.residue, residue)):
            for o, value in enumerate(values[1]):
                if value > largest[1, o]:
                    result.worst[name, o, True] = (float(value), actions, start)
            np.maximum(largest, values, out=largest)
        for name, values in self._measure(commands, start).items():
            np.maximum(result.largest[name], values, out=result.largest[name])
            for is_corrected, steps in self._masks.items():
                for o, value in enumerate(values[steps].max(axis=0, initial=0.0)):
                    previous = result.worst.get((name, o, is_corrected))
                    if previous is None or value > previous[0]:
                        result.worst[name, o, is_corrected] = (float(value), actions, start)

    def _measure(self, commands: np.ndarray, start: np.ndarray) -> dict[str, np.ndarray]:
        """Compute the quantities (N, O) of commands (N, O)."""
        motion = np.concatenate([np.tile(start, (2, 1)), commands])
        first, second = (np.abs(np.diff(motion, order, axis=0)) / self._loop.period**order for order in (1, 2))
        return {"pose": np.abs(commands - self.middle), "speed": first[1:], "acceleration": second}

    def _sample_start(self) -> np.ndarray:
        """Sample a corner of the box of starts; with a history, sample inside the box with probability 0.5."""
        loop, rng = self._loop, self._rng
        offset = rng.choice([-1.0, 1.0], len(loop.start))
        if self._past and loop.start_within.any() and rng.uniform() < 0.5:
            offset = rng.uniform(-1.0, 1.0, len(loop.start))
        return loop.start + offset * loop.start_within

    def _switching_actions(self) -> tuple[np.ndarray, np.ndarray]:
        """Sample actions of ±1 that change sign: periodically in all entries at once, or at random in each entry."""
        steps, size = self._loop.primitive.num_steps, len(self._moved)
        dwell = self._rng.choice(DWELLS)
        if self._rng.uniform() < 0.5:
            sides = 1.0 - 2.0 * ((np.arange(steps) + self._rng.integers(2 * dwell)) // dwell % 2)
            return np.outer(sides, self._rng.choice([-1.0, 1.0], size)), self._sample_start()
        turns = np.cumsum(self._rng.uniform(size=(steps, size)) < 1.0 / dwell, axis=0) % 2
        return (1.0 - 2.0 * turns) * self._rng.choice([-1.0, 1.0], size), self._sample_start()

    def _impulse_signs(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the actions and the start that are worst without constraints, for one quantity at one step."""
        rng, steps, size = self._rng, self._loop.primitive.num_steps, len(self._moved)
        if self._targets:
            order, o, n, side = self._targets.pop()
        else:
            order, o = int(rng.integers(3)), int(rng.integers(self._generators.shape[1]))
            n, side = int(rng.integers(steps)), float(rng.choice([-1.0, 1.0]))
        row = self._loop.rest + n
        direction = side * np.diff(self._generators[row - order : row + 1, o], order, axis=0)[0]
        signs = np.sign(direction[: steps * size].reshape(steps, size))
        fill, start = self._switching_actions()
        start = np.where(
            direction[steps * size :],
            self._loop.start + np.sign(direction[steps * size :]) * self._loop.start_within,
            start,
        )
        return np.where(signs == 0.0, fill, signs), start

    def _farthest_target(self, order: int, o: int, steps: np.ndarray) -> tuple[int, int, int, float]:
        """Return derivative order, output, step and sign of the largest value without constraints among `steps`."""
        rows = self._loop.rest + steps - order
        middle = np.diff(self._middle[:, o], order)[rows] * (order > 0)
        size = np.abs(np.diff(self._generators[:, o], order, axis=0)).sum(axis=1)[rows]
        best = int(np.argmax(np.abs(middle) + size))
        return order, o, int(steps[best]), -1.0 if middle[best] < 0.0 else 1.0

    def _variation(self) -> tuple[np.ndarray, np.ndarray]:
        """Return one of the worst sequences so far, with parts negated or resampled, and sometimes shifted in time."""
        worst, rng = self.result.worst, self._rng
        keys = [key for key in worst if key[0] not in QUANTITIES or not self._attacks_budgets]
        if not keys or not len(self._moved):
            return self._switching_actions()
        _, actions, start = worst[keys[rng.integers(len(keys))]]
        actions = actions.copy()
        for _ in range(rng.integers(1, 4)):
            first = rng.integers(len(actions))
            stretch = slice(first, first + rng.choice(DWELLS)), rng.integers(actions.shape[1])
            kind = rng.uniform()
            if kind < 0.5:
                actions[stretch] *= -1.0
            elif kind < 0.8:
                actions[stretch] = rng.choice([-1.0, 1.0])
            else:
                actions[stretch] = rng.uniform(-1.0, 1.0)
        return (np.roll(actions, rng.integers(-3, 4), axis=0) if rng.uniform() < 0.2 else actions), start


def _accumulate(largest_and_total: np.ndarray, values: np.ndarray) -> None:
    """Update the rows of (2, n), the largest values and the totals, by the values (n,) of one step."""
    np.maximum(largest_and_total[0], values, out=largest_and_total[0])
    largest_and_total[1] += values
