"""Who tries to make a primitive leave its bounds: sequences of actions that nobody would send, straight through it.

A third of the sequences are the signs of impulse responses, which reach a bound exactly where no constraint is active;
a third are full deflections that turn at random; a third change a stretch of what came farthest so far, and are kept
where that comes farther.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from guiderail.models.certificate.loop import SharedControlTemplate, reach

QUANTITIES = ("pose", "speed", "acceleration")
DWELLS = (1, 1, 2, 3, 5, 10, 20, 50, 100)  # steps that a full deflection lasts


@dataclass
class Found:
    """The worst that was found.

    Attributes:
        most: of each quantity, the largest at every step (N, O): the distance from the motion without actions, speed
            and acceleration in the outputs' units per s and s².
        lower, upper: (N, O), the least and greatest commands.
        excess: (2, A), how far corrections went beyond what actions of ±1 can do, in actions: at one step, and added up
            over a sequence.
        residue: (2, O), what corrections did to outputs that no action moves, beyond what the action does that moves
            the others as far: at one step, and added up over a sequence.
        steps, corrected, fallback_steps: how many there were.
    """

    most: dict[str, np.ndarray]
    lower: np.ndarray
    upper: np.ndarray
    excess: np.ndarray
    residue: np.ndarray
    steps: int = 0
    corrected: int = 0
    best: dict[tuple[str, int, bool], tuple[float, np.ndarray, np.ndarray]] = field(default_factory=dict)


class Adversary:
    """Looks for the worst sequences of actions of a skill."""

    def __init__(self, skill: SharedControlTemplate, constrained: np.ndarray, seed: int = 0, spends: bool = False):
        """
        Args:
            skill: what is attacked.
            constrained: (N,), at which steps a constraint can be active; the worst is looked for with and without.
            seed: of all that is drawn.
            spends: whether it changes what spent most of the budgets of corrections, rather than what came farthest.
        """
        primitive = skill.primitive
        self._skill, self._rng, self._spends = skill, np.random.default_rng(seed), spends
        self._moved = np.flatnonzero(skill.gains)
        self._past = primitive.history
        self._middle, self._generators = reach(skill)
        self._responses = [primitive.linear_response(n) for n in range(primitive.num_steps)]
        self._where = {True: constrained, False: ~constrained}
        self._farthest = [
            self._far(order, o, steps)
            for order in range(len(QUANTITIES))
            for o in range(primitive.num_outputs)
            for steps in map(np.flatnonzero, self._where.values())
            if len(steps)
        ]
        shape = (primitive.num_steps, primitive.num_outputs)
        self.found = Found(
            {name: np.zeros(shape) for name in QUANTITIES},
            np.full(shape, np.inf), np.full(shape, -np.inf), np.zeros((2, len(self._moved))), np.zeros((2, shape[1])),
        )  # fmt: skip

    @property
    def middle(self) -> np.ndarray:
        """The motion without actions, (N, O)."""
        return self._middle[self._past :]

    def attack(self, steps: int) -> Found:
        """Tries sequences until so many steps were executed, and goes on where the last call ended."""
        goal = self.found.steps + steps
        turn = 0
        while self.found.steps < goal:
            actions, start = (self._signs, self._deflections, self._changed)[turn % 3]()
            self._execute(actions, start)
            turn += 1
        return self.found

    def _execute(self, actions: np.ndarray, start: np.ndarray) -> None:
        """A sequence (N, A) from a start (O,): what it comes to is kept."""
        skill, primitive, moved, found = self._skill, self._skill.primitive, self._moved, self.found
        history = np.tile(start, (self._past, 1))
        commands = np.zeros((primitive.num_steps, primitive.num_outputs))
        excess, residue = np.zeros((2, len(moved))), np.zeros((2, primitive.num_outputs))
        for n, action in enumerate(actions):
            raw = np.zeros(primitive.num_outputs)
            raw[moved] = action * skill.gains[moved]
            predicted = primitive.predict(n, raw, history if self._past else None)
            commands[n] = predicted.output
            if predicted.constrained:
                found.corrected += 1
                of_history, of_action, offset = self._responses[n]
                by = of_action[:, moved] * skill.gains[moved]
                correction = commands[n] - of_history @ history.ravel() - of_action @ raw - offset
                worth = np.linalg.solve(by[moved], correction[moved])
                _spend(excess, np.maximum(np.abs(action + worth) - 1.0, 0.0))
                _spend(residue, np.where(skill.gains == 0.0, np.abs(correction - by @ worth), 0.0))
            if self._past:
                history = np.concatenate([history[1:], commands[n : n + 1]])
        found.steps += len(actions)
        np.minimum(found.lower, commands, out=found.lower)
        np.maximum(found.upper, commands, out=found.upper)
        for name, most, spent in (("excess", found.excess, excess), ("residue", found.residue, residue)):
            for o, value in enumerate(spent[1]):
                if value > most[1, o]:
                    found.best[name, o, True] = (float(value), actions, start)
            np.maximum(most, spent, out=most)
        for name, values in self._measured(commands, start).items():
            np.maximum(self.found.most[name], values, out=self.found.most[name])
            for constrained, steps in self._where.items():
                for o, value in enumerate(values[steps].max(axis=0, initial=0.0)):
                    before = self.found.best.get((name, o, constrained))
                    if before is None or value > before[0]:
                        self.found.best[name, o, constrained] = (float(value), actions, start)

    def _measured(self, commands: np.ndarray, start: np.ndarray) -> dict[str, np.ndarray]:
        before = np.concatenate([np.tile(start, (2 if self._past else 0, 1)), commands])
        first, second = (np.abs(np.diff(before, order, axis=0)) / self._skill.period**order for order in (1, 2))
        steps, outputs = commands.shape
        return {
            "pose": np.abs(commands - self._middle[self._past :]),
            "speed": np.concatenate([np.zeros((steps, outputs)), first])[-steps:],
            "acceleration": np.concatenate([np.zeros((steps, outputs)), second])[-steps:],
        }

    def _start(self) -> np.ndarray:
        """In a corner of all starts, or, every other time, anywhere among them where they make a difference."""
        skill, rng = self._skill, self._rng
        place = rng.choice([-1.0, 1.0], len(skill.start))
        if self._past and skill.start_within.any() and rng.uniform() < 0.5:
            place = rng.uniform(-1.0, 1.0, len(skill.start))
        return skill.start + place * skill.start_within

    def _deflections(self) -> tuple[np.ndarray, np.ndarray]:
        """Full deflections that turn; the outputs together, apart, or each when it likes."""
        steps, size = self._skill.primitive.num_steps, len(self._moved)
        dwell = self._rng.choice(DWELLS)
        if self._rng.uniform() < 0.5:
            sides = 1.0 - 2.0 * ((np.arange(steps) + self._rng.integers(2 * dwell)) // dwell % 2)
            return np.outer(sides, self._rng.choice([-1.0, 1.0], size)), self._start()
        turns = np.cumsum(self._rng.uniform(size=(steps, size)) < 1.0 / dwell, axis=0) % 2
        return (1.0 - 2.0 * turns) * self._rng.choice([-1.0, 1.0], size), self._start()

    def _signs(self) -> tuple[np.ndarray, np.ndarray]:
        """What goes farthest where no constraint is active, in one quantity at one step."""
        rng, steps, size = self._rng, self._skill.primitive.num_steps, len(self._moved)
        if self._farthest:
            order, o, n, side = self._farthest.pop()
        else:
            order, o = int(rng.integers(3)), int(rng.integers(self._generators.shape[1]))
            n, side = int(rng.integers(steps - order)) + order, float(rng.choice([-1.0, 1.0]))
        row = self._past + n
        along = side * np.diff(self._generators[row - order : row + 1, o], order, axis=0)[0]
        signs = np.sign(along[: steps * size].reshape(steps, size))
        fill, start = self._deflections()
        if len(along) > steps * size:
            start = self._skill.start + np.sign(along[steps * size :]) * self._skill.start_within
        return np.where(signs == 0.0, fill, signs), start

    def _far(self, order: int, o: int, steps: np.ndarray) -> tuple[int, int, int, float]:
        """Where, of some steps, an output can go farthest while it is free, and to which side."""
        steps = steps[steps >= order] if (steps >= order).any() else np.array([order])
        middle = np.diff(self._middle[:, o], order)[self._past + steps - order] * (order > 0)
        size = np.abs(np.diff(self._generators[:, o], order, axis=0)).sum(axis=1)[self._past + steps - order]
        best = int(np.argmax(np.abs(middle) + size))
        return order, o, int(steps[best]), -1.0 if middle[best] < 0.0 else 1.0

    def _changed(self) -> tuple[np.ndarray, np.ndarray]:
        """A stretch of the worst so far of some quantity, turned over, moved in time or drawn anew."""
        best, rng = self.found.best, self._rng
        names = [name for name in best if (name[0] not in QUANTITIES) or not self._spends]
        if not names or not len(self._moved):
            return self._deflections()
        _, actions, start = best[names[rng.integers(len(names))]]
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


def _spend(account: np.ndarray, amount: np.ndarray) -> None:
    """Adds an amount to what was spent: (2, n), the most at once and in all."""
    np.maximum(account[0], amount, out=account[0])
    account[1] += amount
