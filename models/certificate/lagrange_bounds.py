"""Bounds on commands whose corrections keep a budget, lowered by what the constraints say of other steps.

The largest value of a direction over a zonotope is the sum of its generators' sizes along it. A command at another step
is along the way, and within its own constraints: taking a multiple of it, its price, off the direction, and adding the
price times the room that its constraint leaves, can only leave a smaller bound. Any prices prove one (they are the
multipliers of a linear program that nobody has to solve); good ones are found greedily.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from guiderail.models.certificate.loop import Bounds, SharedControlTemplate, caps

ROUNDS = 4  # commands at other steps that a bound is lowered by
AWAY, STRIDE = 48, 3  # how far away these are at most, and how many steps apart
TRIED = 6  # of them, those most along the way
PARTS = np.array([0.15, 0.3, 0.5, 0.75, 1.0])  # of the price that takes most off in the sense of least squares


@dataclass(frozen=True)
class Budget:
    """What corrections may be worth: at one step, and added up over a sequence.

    Attributes:
        excess: (2, A), at once and in all, beyond actions of ±1, in actions.
        residue: (2, O), at once and in all, in outputs that no action moves.
    """

    excess: np.ndarray
    residue: np.ndarray


@dataclass(frozen=True)
class Budgeted:
    """What holds while corrections keep a budget.

    Attributes:
        budget: the assumption.
        bounds: on commands, speeds and accelerations.
        steps, outputs, prices: of each direction (order of the difference 3, sign 2, N, O, R): at which steps which
            outputs' constraints lower its bound, at what price; positive of an upper, negative of a lower constraint.
    """

    budget: Budget
    bounds: Bounds
    steps: np.ndarray
    outputs: np.ndarray
    prices: np.ndarray


def budgeted(
    skill: SharedControlTemplate, free: Bounds, middle: np.ndarray, generators: np.ndarray, first: int, budget: Budget
) -> Budgeted:
    """The bounds while corrections, which there are from a step `first` on, keep a budget."""
    primitive, past = skill.primitive, skill.primitive.history
    steps, outputs = primitive.num_steps, primitive.num_outputs
    generators = np.concatenate([generators, _of_residue(skill, first)], axis=2)
    market = _Market(skill, middle, generators, first, budget)
    at, of, prices = (np.zeros((3, 2, steps, outputs, ROUNDS), kind) for kind in (int, int, float))
    most = np.zeros((3, 2, steps, outputs))
    for order in range(3):
        of_middle, of_generators = np.diff(middle, order, axis=0), np.diff(generators, order, axis=0)
        for n in range(first, steps):
            market.open(n)
            for side, sign in enumerate((1.0, -1.0)):
                chosen, row = (order, side, n), past + n - order
                at[chosen], of[chosen], prices[chosen] = market.chosen(sign * of_generators[row])
                value = market.worst(sign * of_generators[row], at[chosen], of[chosen], prices[chosen])
                most[chosen] = sign * of_middle[row] + value
    low, high = caps(skill)
    found = [values.copy() for values in (free.lower, free.upper, free.speed, free.acceleration)]
    found[0][first:] = np.maximum(-most[0, 1], low)[first:]
    found[1][first:] = np.minimum(most[0, 0], high)[first:]
    for order in (1, 2):
        found[order + 1][first:] = most[order].max(axis=0)[first:] / skill.period**order
    return Budgeted(budget, Bounds(*found), at, of, prices)


def _of_residue(skill: SharedControlTemplate, first: int) -> np.ndarray:
    """What a residue of one, of every output that no action moves at every step from `first` on, does to commands."""
    primitive, past = skill.primitive, skill.primitive.history
    steps, others = primitive.num_steps, np.flatnonzero(skill.gains == 0.0)
    response = np.zeros((past + steps, primitive.num_outputs, (steps - first) * len(others)))
    for n in range(first, steps):
        of_history = primitive.linear_response(n)[0]
        response[past + n] = of_history @ response[n : past + n].reshape(of_history.shape[1], response.shape[2])
        response[past + n, others, (n - first) * len(others) + np.arange(len(others))] = 1.0
    return response


class _Market:
    """Where prices are found, and what a direction is worth at some."""

    def __init__(
        self, skill: SharedControlTemplate, middle: np.ndarray, generators: np.ndarray, first: int, budget: Budget
    ):
        self._generators, self._first, self._past = generators, first, skill.primitive.history
        self._steps, outputs = skill.primitive.num_steps, skill.primitive.num_outputs
        moved = skill.gains != 0.0
        self._actions = self._steps * int(moved.sum())
        self._free = self._actions + outputs  # generators that no budget limits: actions, then the start
        low, high = caps(skill)
        self._rooms = np.stack([middle[self._past :] - low, high - middle[self._past :]])
        self._capped = np.flatnonzero(np.isfinite(low).any(axis=0) | np.isfinite(high).any(axis=0))
        self._budgets = budget.excess, budget.residue[:, ~moved]

    def open(self, n: int) -> None:
        """Looks at the commands around a step."""
        near = np.arange(max(n % STRIDE, n - AWAY // STRIDE * STRIDE), min(n + AWAY, self._steps - 1) + 1, STRIDE)
        self._at, self._of = (x.ravel() for x in np.meshgrid(near, self._capped))
        self._rows = self._generators[self._past + self._at, self._of, : self._free]
        self._sizes = np.maximum((self._rows**2).sum(axis=1), 1e-300)

    def chosen(self, along: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Steps, outputs and prices (O, R) that lower what directions (O, ·) are worth."""
        outputs = len(along)
        left, everyone = along[:, : self._free].copy(), np.arange(outputs)
        at, of, prices = np.zeros((outputs, ROUNDS), int), np.zeros((outputs, ROUNDS), int), np.zeros((outputs, ROUNDS))
        for r in range(ROUNDS if len(self._at) else 0):
            products = left @ self._rows.T
            tried = np.argsort(-np.abs(products) / np.sqrt(self._sizes), axis=1)[:, :TRIED]
            price = (products / self._sizes)[everyone[:, None], tried][..., None] * PARTS
            room = self._rooms[(price > 0.0).astype(int), self._at[tried][..., None], self._of[tried][..., None]]
            paid = np.where(np.isfinite(room), np.abs(price) * np.where(np.isfinite(room), room, 0.0), np.inf)
            worth = np.abs(left[:, None, None] - price[..., None] * self._rows[tried][:, :, None]).sum(axis=3) + paid
            best = worth.reshape(outputs, -1).argmin(axis=1)
            better = worth.reshape(outputs, -1)[everyone, best] < np.abs(left).sum(axis=1)
            row = tried[everyone, best // len(PARTS)]
            at[:, r], of[:, r] = self._at[row], self._of[row]
            prices[:, r] = np.where(better, price.reshape(outputs, -1)[everyone, best], 0.0)
            left -= prices[:, r, None] * self._rows[row]
        return at, of, prices

    def worst(self, along: np.ndarray, at: np.ndarray, of: np.ndarray, prices: np.ndarray) -> np.ndarray:
        """(O,), how far commands can go along directions at such prices."""
        left = along - np.einsum("or,orc->oc", prices, self._generators[self._past + at, of])
        room = np.where(prices == 0.0, 0.0, self._rooms[(prices > 0.0).astype(int), at, of])
        value = np.abs(left[:, : self._free]).sum(axis=1) + (np.abs(prices) * room).sum(axis=1)
        late = self._steps - self._first
        excess = left[:, self._actions - late * self._budgets[0].shape[1] : self._actions]
        for response, (at_once, in_all) in zip((excess, left[:, self._free :]), self._budgets, strict=True):
            spent = np.clip(in_all - np.arange(late)[:, None] * at_once, 0.0, at_once)
            sizes = np.sort(np.abs(response).reshape(len(left), late, len(in_all)), axis=1)[:, ::-1]
            value += (sizes * spent).sum(axis=(1, 2))
        return value
