"""Certified bounds hold against adversaries, and the checker rejects changed files."""

import ast
import hashlib
import io
import itertools
import json
import runpy
import sys
import warnings
import zipfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from guiderail.models.certificate import checker
from guiderail.models.certificate.adversary import Adversary
from guiderail.models.certificate.bounds import certify
from guiderail.models.certificate.files import (
    BUDGET,
    CERTIFICATE,
    OTHER_CLOCK,
    certificate_files,
    compare_subject,
    seal,
)
from guiderail.models.certificate.lagrange_bounds import Budget, MultiplierSearch, residue_generators
from guiderail.models.certificate.loop import CertifiedLoop, reach
from guiderail.models.common.errors import InputError
from guiderail.models.primitives import LcNsKmp, LinearConstraints, Matern52, ReferenceTrajectory
from guiderail.models.primitives.gains import authority_gains

PERIOD, STEPS = 0.02, 60
PHASE = np.linspace(0.0, 1.0, STEPS)


def skill(history, bound=None, tied=0.0):
    """Return a loop of two outputs; the first is explored, and constrained to ±bound if a bound is given."""
    means = np.column_stack([0.2 * np.sin(np.pi * PHASE), PHASE])
    width = 0.05 + 0.1 * np.sin(np.pi * PHASE)
    covariances = np.zeros((STEPS, 2, 2))
    covariances[:, 0, 0], covariances[:, 1, 1] = width**2, 0.04**2
    covariances[:, 0, 1] = covariances[:, 1, 0] = tied * 0.04 * width
    constraints = None if bound is None else LinearConstraints.box([-bound, -np.inf], [bound, np.inf])
    primitive = LcNsKmp(
        ReferenceTrajectory(PERIOD * np.arange(STEPS), means, covariances),
        horizon=10, history=history, history_variance=1e-6, constraints=constraints,
    )  # fmt: skip
    gains = authority_gains(primitive, outputs=np.array([0]))
    return CertifiedLoop(primitive, gains, PERIOD, means[0], np.array([0.01, 0.0]))


CASES = {
    "KGRL, free": (0, None),
    "sKGRL, free": (4, None),
    "KGRL, constrained": (0, 0.25),
    "sKGRL, constrained": (4, 0.25),
}


def certified(made):
    """Certify a loop with budgets of 1.5 times what an adversary used."""
    seen = Adversary(made, np.ones(STEPS, bool)).attack(30 * STEPS)
    return certify(made, Budget(1.5 * seen.excess + 0.01, 1.5 * seen.residue))


@cache
def constrained():
    """Return the constrained loop with a history, which takes longest, and its bounds."""
    loop = skill(*CASES["sKGRL, constrained"], tied=0.5)
    return loop, certified(loop)


@pytest.fixture(scope="module", params=CASES)
def case(request):
    if request.param == "sKGRL, constrained":
        return constrained()
    loop = skill(*CASES[request.param], tied=0.5)
    return loop, certified(loop)


def executed(made, actions, start):
    """Return the commands (N, O) for actions (N,) of the first output."""
    history = np.tile(start, (made.primitive.history, 1))
    commands = []
    for n, action in enumerate(actions):
        past = history if made.primitive.history else None
        commands.append(made.primitive.predict(n, action * made.gains, past).output)
        if made.primitive.history:
            history = np.vstack([history[1:], commands[-1]])
    return np.array(commands)


def adversaries(rng, number):
    """Yield sequences of ±1 with no, few or many changes of sign, or one at every step."""
    for i in range(number):
        turns = np.cumsum(rng.uniform(size=STEPS) < (0.0, 0.05, 0.3, 1.0)[i % 4]) % 2
        yield (2.0 * turns - 1.0) * rng.choice([-1.0, 1.0])


def test_random_sequences_stay_in_the_bounds_and_reach_them(case):
    loop, result = case
    rng, always = np.random.default_rng(0), result.always
    reached = {"position": 0.0, "speed": 0.0, "acceleration": 0.0}
    middle = executed(loop, np.zeros(STEPS), loop.start)[:, 0]
    for actions in adversaries(rng, 40):
        y = executed(loop, actions, loop.start + rng.uniform(-1.0, 1.0, 2) * loop.start_within)
        speed, acceleration = (np.abs(np.diff(y, order, axis=0)) / PERIOD**order for order in (1, 2))
        assert (y >= always.lower - 1e-7).all()
        assert (y <= always.upper + 1e-7).all()
        assert (speed <= always.speed[1:] + 1e-6).all()
        assert (acceleration <= always.acceleration[2:] + 1e-4).all()
        room = np.where(y[:, 0] > middle, always.upper[:, 0] - middle, middle - always.lower[:, 0])
        reached["position"] = max(reached["position"], np.max(np.abs(y[:, 0] - middle) / room))
        reached["speed"] = max(reached["speed"], speed[:, 0].max() / always.speed[:, 0].max())
    assert reached["position"] > 0.9
    if not result.can_be_active.any():
        assert reached["speed"] > 0.6


def test_free_bound_is_reached_by_its_worst_actions():
    """The signs of the impulse responses reach the support of the zonotope."""
    loop = skill(4)
    result = certify(loop)
    n = STEPS - 1
    still = executed(loop, np.zeros(STEPS), loop.start + loop.start_within)
    impulses = [executed(loop, np.eye(STEPS)[m], loop.start + loop.start_within)[n, 0] for m in range(STEPS)]
    worst = executed(loop, np.sign(np.array(impulses) - still[n, 0]), loop.start + loop.start_within)
    below = executed(loop, np.sign(np.array(impulses) - still[n, 0]), loop.start - loop.start_within)
    assert max(worst[n, 0], below[n, 0]) == pytest.approx(result.free.upper[n, 0], rel=1e-6)


def test_output_coupled_through_a_history_has_no_bound():
    tied, alone = certify(skill(4, 0.25, tied=0.5)).always, certify(skill(4, 0.25)).always
    assert np.isinf(tied.upper[-1, 1])
    assert np.isfinite(alone.upper).all()
    assert np.abs(tied.upper[:, 0]).max() <= 0.25 + 1e-9 or tied.upper[:, 0].max() < 0.3


def test_adversary_stays_in_the_bounds_within_the_budget():
    """With a history and constraints, all bounds exist and are at most twice what an adversary reaches."""
    loop, result = constrained()
    budget, bounds = result.budgeted.budget, result.budgeted.bounds
    seen = Adversary(loop, np.ones(STEPS, bool), seed=1).attack(80 * STEPS)
    assert seen.corrected > 100
    assert (seen.excess <= budget.excess).all()
    assert (seen.residue <= budget.residue).all()
    assert (seen.lower >= bounds.lower - 1e-9).all()
    assert (seen.upper <= bounds.upper + 1e-9).all()
    for quantity, claimed in (("speed", bounds.speed), ("acceleration", bounds.acceleration)):
        assert (seen.largest[quantity] <= claimed * (1.0 + 1e-6)).all()
        assert (claimed.max(axis=0) <= 2.0 * seen.largest[quantity].max(axis=0)).all()
    assert np.isinf(result.always.upper[:, 1]).any()


def test_budget_is_not_used_without_constraints():
    seen = Adversary(skill(4, None, tied=0.5), np.ones(STEPS, bool)).attack(10 * STEPS)
    assert seen.corrected == 0
    assert not seen.excess.any()
    assert not seen.residue.any()


def test_attack_samples_starts_in_corners_and_between():
    loop = skill(4)
    adversary = Adversary(loop, np.zeros(STEPS, bool))
    places = (np.array([adversary._sample_start() for _ in range(200)]) - loop.start)[:, 0] / loop.start_within[0]
    assert np.abs(places).max() == pytest.approx(1.0)
    assert {-1.0, 1.0} <= set(np.round(places, 9))
    assert 50 < (np.abs(places) < 0.999).sum() < 150


def test_attack_detects_a_start_that_was_not_certified():
    loop = skill(4)
    kept = certify(replace(loop, start_within=np.zeros(2))).free
    seen = Adversary(loop, np.zeros(STEPS, bool)).attack(20 * STEPS)
    assert (seen.upper[:2, 0] > kept.upper[:2, 0] + 1e-3).all()
    assert (seen.upper <= certify(loop).free.upper + 1e-9).all()


@pytest.mark.parametrize("change", [0.0, 0.3, -2.0])
def test_any_multiplier_proves_a_bound(change):
    """Bad multipliers only make a bound wider."""
    loop, result = constrained()
    worse = replace(
        result.budgeted, multipliers=result.budgeted.multipliers + change * (result.budgeted.multipliers != 0.0)
    )
    middle, generators = reach(loop)
    first = int(np.argmax(result.can_be_active))
    seen = Adversary(loop, np.ones(STEPS, bool), seed=2).attack(40 * STEPS)
    generators = np.concatenate([generators, residue_generators(loop, first)], axis=2)
    search = MultiplierSearch(loop, middle, generators, first, worse.budget)
    for n in range(first, STEPS):
        steps, outputs, multipliers = (a[0, 0, n] for a in (worse.steps, worse.outputs, worse.multipliers))
        highest = middle[4 + n] + search.bound(generators[4 + n], steps, outputs, multipliers)
        assert (seen.upper[n] <= highest + 1e-9).all()


IMPEDANCE = np.array([1500.0, 1500.0]), np.array([40.0, 40.0])
ABOUT = {"task": "none", "environment": {"guidance": "kgrl"}}
KEY = bytes(range(32))


def files(made, found, key=None):
    return certificate_files(made, found, *IMPEDANCE, ABOUT, key)


def write(folder, contents):
    for name, content in contents.items():
        (folder / name).write_bytes(content)
    return folder


def test_checker_accepts_computed_certificates(case, tmp_path):
    checker.check(write(tmp_path, files(*case)))


def signed(contents, **changed):
    """Return the files with changed claims and matching digests."""
    claims = json.loads(contents[CERTIFICATE])
    for name, content in contents.items():
        if name != CERTIFICATE:
            claims["digests"][name] = hashlib.sha256(content).hexdigest()
    for path, change in changed.items():
        *parents, last = path.split("__")
        inner = claims
        for parent in parents:
            inner = inner[parent]
        value = change(inner.get(last))
        if value is DROPPED:
            del inner[last]
        else:
            inner[last] = value
    return {**contents, CERTIFICATE: seal(claims)}


DROPPED = object()


def altered(contents, name, **changed):
    """Return the files with changed arrays in one of them."""
    with np.load(io.BytesIO(contents[name])) as arrays:
        values = {key: arrays[key].copy() for key in arrays.files}
    for key, change in changed.items():
        values[key] = change(values.get(key))
    written = io.BytesIO()
    np.savez(written, **values)
    return {**contents, name: written.getvalue()}


def at(index, factor=1.0, plus=0.0):
    """Return a function that changes one number."""

    def change(value):
        array = np.array(value, dtype=float)
        array[index] = factor * array[index] + plus
        return array if isinstance(value, np.ndarray) else array.tolist()

    return change


def faster(contents, factor, *left_out):
    """Return a consistent certificate with the period scaled by `factor`, without some of its assumptions."""
    claims = json.loads(contents[CERTIFICATE])
    claims["period"] *= factor
    for regime in ("free", "always"):
        for order, name in ((1, "speed"), (2, "acceleration")):
            rows = claims[regime][name]
            claims[regime][name] = [[None if x is None else x / factor**order for x in row] for row in rows]
    claims["assumes"] = [sentence for sentence in claims["assumes"] if sentence not in left_out]
    return {**contents, CERTIFICATE: seal(claims)}


def constrained_by_nothing(contents):
    """Return a certificate with a NaN constraint and the claims of an unconstrained loop."""
    none = altered(contents, "constraints.npz", c=lambda c: np.nan * c)
    none = altered(none, "witness.npz", active=np.zeros_like, multipliers=lambda alphas: alphas[:0])
    return signed(none, always=lambda _: json.loads(contents[CERTIFICATE])["free"])


def tightened(contents, share):
    """Return a certificate with all bounds tightened by a share of the largest."""
    claims = json.loads(contents[CERTIFICATE])
    for regime in ("free", "always", "budgeted"):
        for name in checker.QUANTITIES if claims[regime] else ():
            values = np.array(claims[regime][name], dtype=float)
            change = share * np.nan_to_num(np.abs(values)).max(axis=0) * (1 if name == "lower" else -1)
            rows = (values + change).tolist()
            claims[regime][name] = [[None if x != x else x for x in row] for row in rows]
    return {**contents, CERTIFICATE: seal(claims)}


def as_text(contents, change):
    """Return a certificate whose text is changed."""
    return {**contents, CERTIFICATE: change(contents[CERTIFICATE].decode()).encode()}


def every_step_active(contents):
    """Return a certificate that calls every step active, with multipliers of zero where there were none."""
    with np.load(io.BytesIO(contents["witness.npz"])) as witness:
        active, multipliers = witness["active"], witness["multipliers"]
    padded = np.zeros((STEPS, *multipliers.shape[1:]))
    padded[active] = multipliers
    changed = altered(contents, "witness.npz", active=np.ones_like, multipliers=lambda _: padded)
    return signed(changed)


def unlimited(impedance):
    return {**impedance, "limits": [1.0, 1.0], "force": 2**0.5, "rest_force": {"always": 2**0.5}}


TAMPERED = {
    "an upper bound": lambda c: signed(c, always__upper=at((30, 0), plus=-0.01)),
    "a lower bound": lambda c: signed(c, always__lower=at((30, 0), plus=0.01)),
    "a bound that is too wide": lambda c: signed(c, always__upper=at((10, 1), plus=0.1)),
    "a free bound": lambda c: signed(c, free__upper=at((40, 0), plus=-0.01)),
    "a speed": lambda c: signed(c, always__speed=at((20, 0), factor=0.9)),
    "an acceleration": lambda c: signed(c, free__acceleration=at((20, 0), factor=0.9)),
    "the period": lambda c: signed(c, period=lambda period: 2.0 * period),
    "a bound that is left out": lambda c: signed(c, always__upper=lambda rows: rows[:-1]),
    "the limits of force": lambda c: signed(c, impedance__limits=lambda limits: [0.5 * x for x in limits]),
    "the limits, left out": lambda c: signed(c, impedance__limits=lambda limits: DROPPED),
    "the limits, null": lambda c: signed(c, impedance__limits=lambda limits: None),
    "limits below zero": lambda c: signed(c, impedance__limits=lambda limits: [-40.0, -40.0]),
    "the force": lambda c: signed(c, impedance__force=lambda force: 0.9 * force),
    "the force, by a little": lambda c: signed(c, impedance__force=lambda force: (1 - 3e-5) * force),
    "the stiffness": lambda c: signed(c, impedance__stiffness=lambda stiffness: [0.01 * x for x in stiffness]),
    "the force at rest": lambda c: signed(c, impedance__rest_force__always=lambda force: 0.99 * force),
    "a force at rest of a regime without one": lambda c: signed(c, impedance__rest_force__free=lambda _: 1.0),
    "a force at rest in another place": lambda c: signed(c, free__rest_force=lambda _: 1.0),
    "an unknown claim": lambda c: signed(c, peak_force=lambda _: 1.0),
    "an unknown claim of a regime": lambda c: signed(c, always__jerk=lambda _: [[0.0, 0.0]] * STEPS),
    "a regime, left out": lambda c: signed(c, free=lambda _: DROPPED),
    "a budget without a claim": lambda c: signed(c, budgeted=lambda _: {"excess": [[0.0], [0.0]]}),
    "a number as text": lambda c: signed(c, period=lambda period: str(period)),
    "numbers as text": lambda c: signed(c, always__upper=lambda rows: [[str(x) for x in row] for row in rows]),
    "a number as a bool": lambda c: signed(c, always__upper=lambda rows: [[True, *rows[0][1:]], *rows[1:]]),
    "a whole number": lambda c: signed(c, always__upper=lambda rows: [[1, *rows[0][1:]], *rows[1:]]),
    "a bound replaced by null": lambda c: signed(c, always__upper=lambda rows: [[None, *rows[0][1:]], *rows[1:]]),
    "a key twice": lambda c: as_text(
        c, lambda text: text.replace('"about": ', '"about": {"task": "easy"}, "about": ', 1)
    ),
    "a claim twice": lambda c: as_text(c, lambda text: text.replace('"always": ', '"always": {}, "always": ', 1)),
    "another text of the same numbers": lambda c: as_text(c, lambda text: json.dumps(json.loads(text), indent=1)),
    "NaN": lambda c: as_text(c, lambda text: text.replace('"period": 0.02', '"period": NaN')),
    "everything, by less than a ten-thousandth": lambda c: tightened(c, 0.9e-4),
    "everything, by little more than rounding": lambda c: tightened(c, 2e-5),
    "every step active": every_step_active,
    "an active step that is not": lambda c: signed(altered(c, "witness.npz", active=lambda t: t[::-1].copy())),
    "a tiny row": lambda c: signed(altered(c, "constraints.npz", G=lambda G: 1e-9 * G, c=lambda c: 1e-9 * c)),
    "a tiny row with a large bound": lambda c: signed(
        altered(c, "constraints.npz", G=lambda G: 1e-9 * G, c=lambda c: 1e-9 * (c + 0.22))
    ),
    "a large row": lambda c: signed(altered(c, "constraints.npz", G=lambda G: 1e9 * G, c=lambda c: 1e9 * c)),
    "a row of zeros": lambda c: signed(altered(c, "constraints.npz", G=np.zeros_like)),
    "the clock": lambda c: signed(altered(c, "primitive.npz", clock=lambda clock: 1e-14 * clock)),
    "an uneven clock": lambda c: signed(altered(c, "primitive.npz", clock=lambda clock: clock * np.arange(STEPS))),
    "a clock without progress": lambda c: signed(altered(c, "primitive.npz", clock=np.zeros_like)),
    "an unknown array": lambda c: signed(altered(c, "primitive.npz", inputs=lambda _: np.arange(STEPS + 10.0))),
    "a history in fractions": lambda c: signed(altered(c, "primitive.npz", history=lambda h: h + 0.5)),
    "a covariance that is not symmetric": lambda c: signed(
        altered(c, "primitive.npz", covariances=at((30, 0, 1), plus=1e-6))
    ),
    "single precision": lambda c: signed(altered(c, "primitive.npz", means=lambda m: m.astype(np.float32))),
    "multipliers of other corners": lambda c: signed(
        altered(c, "witness.npz", multipliers=lambda a: a[:, ::-1].copy())
    ),
    "multipliers below zero": lambda c: signed(altered(c, "witness.npz", multipliers=lambda a: -a)),
    "the format": lambda c: signed(c, format=lambda _: "guiderail certificate 3"),
    "no task": lambda c: signed(c, about=lambda about: {"run": "?"}),
    "assumptions as text": lambda c: signed(c, assumes=lambda them: "\n".join(them)),
    "a mean": lambda c: signed(altered(c, "primitive.npz", means=at((30, 0), plus=0.02))),
    "a covariance": lambda c: signed(altered(c, "primitive.npz", covariances=at((30, 0, 0), factor=3.0))),
    "the gains": lambda c: signed(altered(c, "primitive.npz", gains=lambda gains: 1.1 * gains)),
    "beta": lambda c: signed(altered(c, "primitive.npz", beta=lambda beta: 1.2 * beta)),
    "the length scale": lambda c: signed(altered(c, "primitive.npz", length_scale=lambda length: 0.8 * length)),
    "the kernel": lambda c: signed(c, kernel=lambda _: "matern52"),
    "the constraint's bound": lambda c: signed(altered(c, "constraints.npz", c=lambda c: 1.2 * c)),
    "the constraint's matrix": lambda c: signed(altered(c, "constraints.npz", G=lambda G: G[:, ::-1].copy())),
    "which steps are touched": lambda c: signed(altered(c, "witness.npz", active=lambda t: np.zeros_like(t))),
    "a multiplier": lambda c: signed(altered(c, "witness.npz", multipliers=lambda a: 0.5 * a)),
    "a digest": lambda c: {**c, CERTIFICATE: c[CERTIFICATE].replace(b'"digest": "', b'"digest": "0')},
    "a constraint that is no number": constrained_by_nothing,
    "a mean that is no number": lambda c: signed(altered(c, "primitive.npz", means=at((30, 0), factor=np.nan))),
    "a start below zero": lambda c: signed(altered(c, "primitive.npz", start_within=lambda within: -within)),
    "the period, and the speeds with it": lambda c: faster(c, 2.0),
    "an infinite period": lambda c: faster(c, np.inf),
    "no list of assumptions": lambda c: signed(c, assumes=lambda sentences: []),
    "a sentence that is assumed": lambda c: signed(c, assumes=lambda sentences: sentences[:-1]),
    "the words of a sentence": lambda c: signed(c, assumes=lambda them: [them[0].replace("-1", "-2"), *them[1:]]),
    "an added sentence": lambda c: signed(c, assumes=lambda sentences: [*sentences, OTHER_CLOCK]),
    "a file, unsigned": lambda c: altered(c, "primitive.npz", gains=lambda gains: 1.0 * gains + 1e-9),
}


def test_certificate_refuses_a_kernel_without_a_checker():
    loop = skill(0)
    primitive = LcNsKmp(loop.primitive.reference, kernel=Matern52(0.5), horizon=10)
    loop = replace(loop, primitive=primitive)
    with pytest.raises(InputError, match="squared_exponential"):
        files(loop, certify(loop))


@pytest.fixture(scope="module")
def honest():
    loop = skill(0, 0.25, tied=0.5)
    return files(loop, certify(loop))


@pytest.fixture(scope="module")
def budgeted():
    return files(*constrained())


@pytest.mark.parametrize("what", TAMPERED)
def test_checker_rejects_a_changed_certificate(honest, tmp_path, what):
    with pytest.raises((checker.Rejected, ValueError)):
        checker.check(write(tmp_path, TAMPERED[what](honest)))


# Alterations that only a comparison with the skill detects.
SUBJECT = {
    "about": lambda c: signed(c, about=lambda _: {"task": "easier", "environment": {"guidance": "kgrl"}}),
    "limits": lambda c: signed(c, impedance=unlimited),
    "stiffness": lambda c: signed(c, impedance=lambda _: None),
}


@pytest.mark.parametrize("what", SUBJECT)
def test_comparison_with_the_skill_detects_what_a_checker_takes_as_given(honest, tmp_path, what):
    loop, contents = skill(0, 0.25, tied=0.5), honest
    assert compare_subject(contents, loop, *IMPEDANCE, ABOUT) is None
    assert compare_subject(SUBJECT[what](contents), loop, *IMPEDANCE, ABOUT) == what


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"gains": np.array([0.1, 0.0])}, "gains"),
        ({"start_within": np.zeros(2)}, "start_within"),
        ({"period": 0.03}, "period"),
        ({"primitive": skill(0, 0.26, tied=0.5).primitive}, "c"),
        ({"primitive": skill(0, 0.25, tied=0.4).primitive}, "covariances"),
    ],
)
def test_comparison_names_what_differs_from_the_skill(honest, change, name):
    assert compare_subject(honest, replace(skill(0, 0.25, tied=0.5), **change), *IMPEDANCE, ABOUT) == name


def without_budget(claims):
    return [[0.0 * x for x in row] for row in claims]


BUDGETED = {
    "a bound": lambda c: signed(c, budgeted__upper=at((50, 1), plus=-0.05)),
    "a speed": lambda c: signed(c, budgeted__speed=at((50, 0), factor=0.9)),
    "the force at rest": lambda c: signed(c, impedance__rest_force__budgeted=lambda force: 0.9 * force),
    "the excess": lambda c: signed(c, budgeted__excess=lambda rows: [[0.5 * x for x in row] for row in rows]),
    "the residue": lambda c: signed(c, budgeted__residue=lambda rows: [[0.5 * x for x in row] for row in rows]),
    "no excess": lambda c: signed(c, budgeted__excess=without_budget),
    "no residue": lambda c: signed(c, budgeted__residue=without_budget),
    "no budget": lambda c: signed(c, budgeted__excess=without_budget, budgeted__residue=without_budget),
    "a total below a step's": lambda c: signed(c, budgeted__excess=lambda rows: [[2.0 * rows[1][0]], rows[1]]),
    "the residue of an output that moves": lambda c: signed(c, budgeted__residue=at((1, 0), plus=1.0)),
    "a budget below zero": lambda c: signed(c, budgeted__residue=lambda rows: [[-x for x in row] for row in rows]),
    "a Lagrange multiplier": lambda c: signed(altered(c, "witness.npz", lagrange_multipliers=lambda p: 1.1 * p)),
    "a step before the first": lambda c: signed(altered(c, "witness.npz", lagrange_steps=lambda k: k - STEPS)),
    "a step past the last": lambda c: signed(altered(c, "witness.npz", lagrange_steps=lambda k: k + STEPS)),
    "what it assumes": lambda c: signed(c, assumes=lambda them: [one for one in them if one != BUDGET]),
    "the regime, left out": lambda c: signed(c, budgeted=lambda _: None),
    "the regime": lambda c: signed(
        c, budgeted=lambda claims: c and json.loads(c[CERTIFICATE])["always"] | claims_of(c)
    ),
}


def claims_of(contents):
    """Return the budgets of a certificate."""
    claims = json.loads(contents[CERTIFICATE])["budgeted"]
    return {name: claims[name] for name in ("excess", "residue")}


@pytest.mark.parametrize("what", BUDGETED)
def test_checker_rejects_a_changed_budgeted_regime(budgeted, tmp_path, what):
    with pytest.raises((checker.Rejected, ValueError)):
        checker.check(write(tmp_path, BUDGETED[what](budgeted)))


@pytest.mark.parametrize("largest", [1.0, 1.7e308])
def test_checker_rejects_a_claim_that_overflows(budgeted, tmp_path, largest):
    """A bound of NaN is neither tighter nor wider than a claim; 300 large multipliers make one from finite numbers."""
    with np.load(io.BytesIO(budgeted["witness.npz"])) as witness:
        steps, outputs, multipliers = (witness[f"lagrange_{name}"] for name in ("steps", "outputs", "multipliers"))
    pad = [(0, 0)] * 4 + [(0, 300 - multipliers.shape[-1])]
    large, last = np.pad(multipliers, pad), np.pad(steps, pad)
    large[0, 1, -1, 0], last[0, 1, -1, 0] = largest, STEPS - 1
    changed = altered(
        budgeted, "witness.npz", lagrange_steps=lambda _: last, lagrange_outputs=lambda _: np.pad(outputs, pad),
        lagrange_multipliers=lambda _: large,
    )  # fmt: skip
    changed = signed(changed, budgeted__excess=lambda rows: [rows[0], rows[0]])
    with pytest.raises(checker.Rejected, match="has no value" if largest > 1.0 else "tighter|wider"):
        checker.check(write(tmp_path, changed))


@pytest.mark.parametrize("largest", [1.0, 1.7e308])
def test_checker_rejects_a_correction_that_overflows(tmp_path, largest):
    """A correction of NaN must not count as none; multipliers of constraints on one side can make one."""
    contents = small(0, lower=(-0.02, -3.0), upper=(np.inf, np.inf))[2]
    checker.check(write(tmp_path, contents))
    with np.load(io.BytesIO(contents["witness.npz"])) as witness:
        multipliers = witness["multipliers"]
    multipliers[0] = np.array([1e-2, 1.0]) * largest
    changed = signed(altered(contents, "witness.npz", multipliers=lambda _: multipliers))
    with pytest.raises(checker.Rejected, match="too large" if largest > 1.0 else "violates a constraint"):
        checker.check(write(tmp_path, changed))


def test_checker_bounds_the_length_of_the_window(tmp_path, monkeypatch):
    contents = small(3)[2]
    monkeypatch.setattr(checker, "MAX_WINDOW", 8)
    checker.check(write(tmp_path, contents))
    monkeypatch.setattr(checker, "MAX_WINDOW", 7)
    with pytest.raises(checker.Rejected, match="out of range"):
        checker.check(tmp_path)


def test_signature_needs_the_key(tmp_path):
    loop = skill(0)
    contents = files(loop, certify(loop), KEY)
    checker.check(write(tmp_path, contents))
    checker.check(tmp_path, KEY)
    with pytest.raises(checker.Rejected, match="not of this key"):
        checker.check(tmp_path, KEY[::-1])
    with pytest.raises(checker.Rejected, match="16 bytes"):
        checker.check(tmp_path, KEY[:15])
    # Anyone can change the claims, compute their digest and keep the old signature.
    claims = json.loads(contents[CERTIFICATE])
    claims["about"] = {"task": "easier"}
    forged = json.loads(seal(claims))
    for signature in ({}, {"signature": claims["signature"]}, {"signature": 3}):
        (tmp_path / CERTIFICATE).write_text(checker.canonical(forged | signature))
        checker.check(tmp_path)
        with pytest.raises(checker.Rejected, match="signature is missing"):
            checker.check(tmp_path, KEY)


def test_certificate_states_a_period_unlike_the_clock(tmp_path):
    loop = replace(skill(4, 0.25), period=1.5 * PERIOD)
    contents = files(loop, certify(loop))
    assert OTHER_CLOCK in json.loads(contents[CERTIFICATE])["assumes"]
    checker.check(write(tmp_path, contents))
    with pytest.raises(checker.Rejected, match="does not state"):
        checker.check(write(tmp_path, faster(contents, 1.0, OTHER_CLOCK)))


def run_checker(folder, capsys, monkeypatch):
    """Return the exit code and the output of the checker as a program."""
    monkeypatch.setattr(sys, "argv", ["checker.py", str(folder)])
    try:
        runpy.run_path(checker.__file__, run_name="__main__")
    except SystemExit as ended:
        return ended.code, capsys.readouterr().out
    return 0, capsys.readouterr().out


@pytest.mark.parametrize("arguments", [[], ["folder", "key", "more"]])
def test_checker_prints_its_usage_for_a_wrong_number_of_arguments(arguments, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["checker.py", *arguments])
    with pytest.raises(SystemExit, match="2"):
        runpy.run_path(checker.__file__, run_name="__main__")
    assert capsys.readouterr().out == "usage: python checker.py FOLDER [KEY_FILE]\n"


NONE = {
    "half of it": lambda c: {**c, CERTIFICATE: c[CERTIFICATE][:100]},
    "no text": lambda c: {**c, CERTIFICATE: bytes(range(256))},
    "no arrays": lambda c: signed({**c, "witness.npz": b"none"}),
    "half of an archive": lambda c: signed({**c, "witness.npz": c["witness.npz"][:-50]}),
    "nothing": lambda c: {},
}


MALFORMED = {
    "a list": lambda c: {**c, CERTIFICATE: b"[]"},
    "a number": lambda c: {**c, CERTIFICATE: b"3"},
    "digests as a list": lambda c: {**c, CERTIFICATE: seal(json.loads(c[CERTIFICATE]) | {"digests": []})},
    "a word for a number": lambda c: signed(altered(c, "primitive.npz", horizon=lambda _: "long")),
}


@pytest.mark.parametrize("what", MALFORMED)
def test_checker_rejects_invalid_content(honest, what, tmp_path, capsys, monkeypatch):
    code, out = run_checker(write(tmp_path, MALFORMED[what](honest)), capsys, monkeypatch)
    assert code == 1
    assert out.startswith("no: ")
    assert out.count("\n") == 1


@pytest.mark.parametrize("what", NONE)
def test_checker_reports_unreadable_files_with_exit_code_2(honest, what, tmp_path, capsys, monkeypatch):
    code, out = run_checker(write(tmp_path, NONE[what](honest)), capsys, monkeypatch)
    assert code == 2
    assert out.startswith("no: the files make no sense")
    assert out.count("\n") == 1


def test_checker_exits_with_0_or_1(honest, tmp_path, capsys, monkeypatch):
    assert run_checker(write(tmp_path, honest), capsys, monkeypatch) == (0, "yes\n")
    code, out = run_checker(write(tmp_path, TAMPERED["a speed"](honest)), capsys, monkeypatch)
    assert code == 1
    assert out.startswith("no: step 20: always speed of output 0 is ")


def test_checker_is_short_and_imports_numpy_only():
    source = Path(checker.__file__).read_text()
    assert len(source.splitlines()) <= 450
    imported = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported.add(str(node.module))
    assert {name for name in imported if name.split(".")[0] not in sys.stdlib_module_names} == {"numpy"}


@cache
def small(history, lower=(-0.21, -np.inf), upper=(0.21, np.inf)):
    """Return a short constrained loop, its bounds and its certificate."""
    phase = np.linspace(0.0, 1.0, 14)
    means = np.column_stack([0.2 * np.sin(np.pi * phase), phase])
    covariances = np.tile(np.array([[0.01, 0.002], [0.002, 0.01]]), (14, 1, 1))
    constraints = LinearConstraints.box(lower, upper)
    reference = ReferenceTrajectory(PERIOD * np.arange(14), means, covariances)
    primitive = LcNsKmp(reference, horizon=4, history=history, constraints=constraints)
    gains = authority_gains(primitive, outputs=np.array([0]))
    loop = CertifiedLoop(primitive, gains, PERIOD, means[0], np.array([0.01, 0.0]))
    result = certify(loop, Budget(np.array([[0.2], [0.5]]), np.array([[0.0, 0.01], [0.0, 0.05]])))
    assert result.can_be_active.any()
    return loop, result, files(loop, result)


def leaves(value, path=()):
    """Yield the paths of a JSON value: every field, and of a list the first, a middle and the last element."""
    if path:
        yield path
    if isinstance(value, dict):
        for key in value:
            yield from leaves(value[key], (*path, key))
    elif isinstance(value, list) and value:
        for i in sorted({0, len(value) // 2, len(value) - 1}):
            yield from leaves(value[i], (*path, i))


RETYPED = {float: str, str: lambda text: [text], list: lambda rows: dict(enumerate(map(str, rows))), dict: list}


def altered_claims(contents):
    """Yield names and certificates with one field of the claims dropped, scaled, retyped or duplicated."""
    claims = json.loads(contents[CERTIFICATE])
    for path in leaves(claims):
        if path[0] in ("digest", "digests"):
            continue
        for kind in ("dropped", "scaled up", "scaled down", "retyped", "duplicated"):
            changed = json.loads(contents[CERTIFICATE])
            *parents, last = path
            inner = changed
            for parent in parents:
                inner = inner[parent]
            value = inner[last]
            if kind == "dropped":
                del inner[last]
            elif kind.startswith("scaled"):
                factor = 1.5 if kind == "scaled up" else 1.0 - 0.9e-4
                if type(value) is not float or value == 0.0:
                    continue
                inner[last] = factor * value
            elif kind == "retyped":
                inner[last] = RETYPED.get(type(value), str)(value)
            elif isinstance(last, int):
                inner.insert(last, value)
            else:
                text = json.dumps(changed, sort_keys=True)
                field = f"{json.dumps(last)}: {json.dumps(value, sort_keys=True)}"
                yield f"{path} {kind}", {**contents, CERTIFICATE: text.replace(field, f"{field}, {field}", 1).encode()}
                continue
            yield f"{path} {kind}", {**contents, CERTIFICATE: seal(changed)}


def altered_arrays(contents):
    """Yield names and certificates with one array dropped, scaled, retyped or duplicated, and new digests."""
    for name in checker.ARRAYS:
        with np.load(io.BytesIO(contents[name])) as arrays:
            values = {key: arrays[key] for key in arrays.files}
        for key, value in values.items():
            changes = {
                "dropped": None,
                "scaled up": 1.5 * value
                if value.dtype.kind == "f"
                else value + 1
                if value.dtype.kind == "i"
                else ~value,
                "scaled down": (1.0 - 0.9e-4) * value if value.dtype.kind == "f" else 0 * value,
                "retyped": value.astype(str),
                "in another precision": value.astype(np.float32 if value.dtype.kind == "f" else np.int16),
                "duplicated": np.concatenate([np.atleast_1d(value)] * 2),
                "of another dimension": value[None],
            }
            for kind, other in changes.items():
                if other is not None and other.dtype == value.dtype and np.array_equal(other, value):
                    continue
                kept = {k: v for k, v in ({**values, key: other}).items() if v is not None}
                written = io.BytesIO()
                np.savez(written, **kept)
                yield f"{name} {key} {kind}", signed({**contents, name: written.getvalue()})
            written = io.BytesIO(contents[name])
            with zipfile.ZipFile(written, "a") as archive, warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                archive.writestr(f"{key}.npy", archive.read(f"{key}.npy"))
            yield f"{name} {key} twice", signed({**contents, name: written.getvalue()})


def holds(found, contents, other):
    """Return True if an altered certificate claims no more than what was certified."""
    claims, before = (json.loads(each[CERTIFICATE]) for each in (other, contents))
    regimes = {"free": found.free, "always": found.always}
    if found.budgeted is not None:
        regimes["budgeted"] = found.budgeted.bounds
        for name in ("excess", "residue"):
            if not (np.array(claims["budgeted"][name]) <= np.array(before["budgeted"][name])).all():
                return False
    for (regime, bounds), name in itertools.product(regimes.items(), checker.QUANTITIES):
        claimed, own = np.array(claims[regime][name], dtype=float), getattr(bounds, name)
        bounded = ~np.isnan(claimed)
        if not ((claimed - own)[bounded] * (-1.0 if name == "lower" else 1.0) >= 0.0).all():
            return False
    return all(claims[k] == before[k] for k in ("about", "assumes", "kernel", "period", "impedance"))


@pytest.mark.parametrize("history", [0, 3])
def test_no_alteration_of_a_field_is_accepted_unless_its_claims_hold(history, tmp_path):
    loop, result, contents = small(history)
    checker.check(write(tmp_path, contents))
    assert compare_subject(contents, loop, *IMPEDANCE, ABOUT) is None
    tried = accepted = 0
    for name, other in itertools.islice((*altered_claims(contents), *altered_arrays(contents)), 0, None, 5):
        tried += 1
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                checker.check(write(tmp_path, other))
        except (checker.Rejected, ValueError):  # a refusal, or one of NumPy's reader
            continue
        if compare_subject(other, loop, *IMPEDANCE, ABOUT) is not None:
            continue
        accepted += 1
        assert holds(result, contents, other), name
    assert tried >= 100
    assert accepted <= 0.1 * tried
