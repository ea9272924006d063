"""Certified bounds contain all commands of random and adversarial actions; the checker rejects changed files."""

import ast
import hashlib
import io
import itertools
import json
import os
import runpy
import sys
import warnings
import zipfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import certificate_extremes
import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.control.wrench import impact_ratio
from guiderail.models.primitives import LcNsKmp, LinearConstraints, Matern52, ReferenceTrajectory
from guiderail.models.primitives.gains import authority_gains
from guiderail_studies.certificate import checker
from guiderail_studies.certificate.adversary import Adversary
from guiderail_studies.certificate.bounds import certify
from guiderail_studies.certificate.files import (
    BUDGET,
    CERTIFICATE,
    OTHER_CLOCK,
    STIFFNESS_RATIOS,
    certificate_files,
    compare_subject,
    seal,
)
from guiderail_studies.certificate.lagrange_bounds import Budget, MultiplierSearch, residue_generators
from guiderail_studies.certificate.loop import CertifiedLoop, reach

PERIOD, STEPS = 0.02, 60
PHASE = np.linspace(0.0, 1.0, STEPS)


def make_loop(history, bound=None, correlation=0.0):
    """Return a loop of two outputs: actions move the first, which is constrained to ±bound if a bound is given."""
    means = np.column_stack([0.2 * np.sin(np.pi * PHASE), PHASE])
    width = 0.05 + 0.1 * np.sin(np.pi * PHASE)
    covariances = np.zeros((STEPS, 2, 2))
    covariances[:, 0, 0], covariances[:, 1, 1] = width**2, 0.04**2
    covariances[:, 0, 1] = covariances[:, 1, 0] = correlation * 0.04 * width
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


@cache
def certify_case(name):
    """Return a loop of `CASES` and its bounds; the budgets are 1.5 times the excess and residue of an attack."""
    loop = make_loop(*CASES[name], correlation=0.5)
    attack = Adversary(loop, np.ones(STEPS, bool)).attack(30 * STEPS)
    return loop, certify(loop, Budget(1.5 * attack.excess + 0.01, 1.5 * attack.residue))


@pytest.fixture(scope="module", params=CASES)
def case(request):
    return certify_case(request.param)


def execute(loop, actions, start):
    """Return the commands (N, O) for actions (N,) of the first output."""
    history = np.tile(start, (loop.primitive.history, 1))
    commands = []
    for n, action in enumerate(actions):
        past = history if loop.primitive.history else None
        commands.append(loop.primitive.predict(n, action * loop.gains, past).output)
        if loop.primitive.history:
            history = np.vstack([history[1:], commands[-1]])
    return np.array(commands)


def action_sequences(rng, number):
    """Yield sequences of ±1 whose sign never changes, changes with probability 0.05 or 0.3, or at every step."""
    for i in range(number):
        turns = np.cumsum(rng.uniform(size=STEPS) < (0.0, 0.05, 0.3, 1.0)[i % 4]) % 2
        yield (2.0 * turns - 1.0) * rng.choice([-1.0, 1.0])


def test_bounds_contain_commands_of_random_actions_tightly(case):
    loop, result = case
    rng, always = np.random.default_rng(0), result.always
    reached = {"position": 0.0, "speed": 0.0}  # largest value, relative to its bound
    without_actions = execute(loop, np.zeros(STEPS), loop.start)[:, 0]
    for actions in action_sequences(rng, 40):
        y = execute(loop, actions, loop.start + rng.uniform(-1.0, 1.0, 2) * loop.start_within)
        speed, acceleration = (np.abs(np.diff(y, order, axis=0)) / PERIOD**order for order in (1, 2))
        assert (y >= always.lower - 1e-7).all()
        assert (y <= always.upper + 1e-7).all()
        assert (speed <= always.speed[1:] + 1e-6).all()
        assert (acceleration <= always.acceleration[2:] + 1e-4).all()
        distance = y[:, 0] - without_actions
        room = np.where(distance > 0.0, always.upper[:, 0] - without_actions, without_actions - always.lower[:, 0])
        reached["position"] = max(reached["position"], np.max(np.abs(distance) / room))
        reached["speed"] = max(reached["speed"], speed[:, 0].max() / always.speed[:, 0].max())
    assert reached["position"] > 0.9
    if not result.can_be_active.any():
        assert reached["speed"] > 0.6


def test_free_bound_is_reached_by_impulse_response_signs():
    """The signs of the impulse responses are the actions that reach the support of the zonotope."""
    loop = make_loop(4)
    result = certify(loop)
    n = STEPS - 1
    highest, lowest = loop.start + loop.start_within, loop.start - loop.start_within
    without_actions = execute(loop, np.zeros(STEPS), highest)[n, 0]
    impulses = [execute(loop, np.eye(STEPS)[m], highest)[n, 0] for m in range(STEPS)]
    actions = np.sign(np.array(impulses) - without_actions)
    assert max(execute(loop, actions, start)[n, 0] for start in (highest, lowest)) == pytest.approx(
        result.free.upper[n, 0], rel=1e-6
    )


def test_output_coupled_through_a_history_has_no_bound():
    coupled, uncoupled = (certify(make_loop(4, 0.25, correlation)).always for correlation in (0.5, 0.0))
    assert np.isinf(coupled.upper[-1, 1])
    assert np.isfinite(uncoupled.upper).all()
    assert coupled.upper[:, 0].max() < 0.3


def test_budgeted_bounds_contain_an_attack_tightly():
    """With a history and constraints, all bounds exist and are at most twice the values that an adversary reaches."""
    loop, result = certify_case("sKGRL, constrained")
    budget, bounds = result.budgeted.budget, result.budgeted.bounds
    attack = Adversary(loop, np.ones(STEPS, bool), seed=1).attack(80 * STEPS)
    assert attack.corrected > 100
    assert (attack.excess <= budget.excess).all()
    assert (attack.residue <= budget.residue).all()
    assert (attack.lower >= bounds.lower - 1e-9).all()
    assert (attack.upper <= bounds.upper + 1e-9).all()
    for quantity, bound in (("speed", bounds.speed), ("acceleration", bounds.acceleration)):
        assert (attack.largest[quantity] <= bound * (1.0 + 1e-6)).all()
        assert (bound.max(axis=0) <= 2.0 * attack.largest[quantity].max(axis=0)).all()
    assert np.isinf(result.always.upper[:, 1]).any()


def test_attack_uses_no_budget_without_constraints():
    attack = Adversary(make_loop(4, None, correlation=0.5), np.ones(STEPS, bool)).attack(10 * STEPS)
    assert attack.corrected == 0
    assert not attack.excess.any()
    assert not attack.residue.any()


def test_attack_samples_starts_at_corners_and_inside():
    loop = make_loop(4)
    adversary = Adversary(loop, np.zeros(STEPS, bool))
    starts = np.array([adversary._sample_start() for _ in range(200)])
    offsets = (starts - loop.start)[:, 0] / loop.start_within[0]
    assert np.abs(offsets).max() == pytest.approx(1.0)
    assert {-1.0, 1.0} <= set(np.round(offsets, 9))
    assert 50 < (np.abs(offsets) < 0.999).sum() < 150


def test_attack_exceeds_bounds_when_a_start_is_uncertified():
    loop = make_loop(4)
    bounds = certify(replace(loop, start_within=np.zeros(2))).free
    attack = Adversary(loop, np.zeros(STEPS, bool)).attack(20 * STEPS)
    assert (attack.upper[:2, 0] > bounds.upper[:2, 0] + 1e-3).all()
    assert (attack.upper <= certify(loop).free.upper + 1e-9).all()


def test_any_multipliers_prove_a_bound():
    """Multipliers that are not optimal only make a bound wider."""
    loop, result = certify_case("sKGRL, constrained")
    budgeted = result.budgeted
    middle, generators = reach(loop)
    first = int(np.argmax(result.can_be_active))
    attack = Adversary(loop, np.ones(STEPS, bool), seed=2).attack(40 * STEPS)
    generators = np.concatenate([generators, residue_generators(loop, first)], axis=2)
    search = MultiplierSearch(loop, middle, generators, first, budgeted.budget)
    for change in (0.0, 0.3, -2.0):
        changed = budgeted.multipliers + change * (budgeted.multipliers != 0.0)
        for n in range(first, STEPS):
            steps, outputs, multipliers = (a[0, 0, n] for a in (budgeted.steps, budgeted.outputs, changed))
            highest = middle[4 + n] + search.bound(generators[4 + n], steps, outputs, multipliers)
            assert (attack.upper[n] <= highest + 1e-9).all(), change


IMPEDANCE = np.array([1500.0, 1500.0]), np.array([40.0, 40.0]), 2.5e4
ABOUT = {"task": "none", "environment": {"guidance": "kgrl"}}
KEY = bytes(range(32))


def make_files(loop, result, key=None):
    return certificate_files(loop, result, *IMPEDANCE, ABOUT, key)


def write(folder, contents):
    """Write the files of a certificate to a folder; return the folder."""
    for name, content in contents.items():
        (folder / name).write_bytes(content)
    return folder


def test_checker_accepts_computed_certificates(case, tmp_path):
    checker.check(write(tmp_path, make_files(*case)))


def change_claims(contents, **changed):
    """Return a certificate with changed claims and matching digests.

    Args:
        contents: Content of each file by its name.
        changed: Function of the old value of a claim by the claim's path, with __ between the keys of the path. A claim
            is removed if its function returns `DROPPED`.
    """
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


def change_arrays(contents, name, **changed):
    """Return a certificate with changed arrays in the file `name`, and unchanged digests.

    Args:
        contents: Content of each file by its name.
        name: Name of the changed file.
        changed: Function of the old array by the array's name.
    """
    with np.load(io.BytesIO(contents[name])) as arrays:
        values = {key: arrays[key].copy() for key in arrays.files}
    for key, change in changed.items():
        values[key] = change(values.get(key))
    return {**contents, name: npz(values)}


def change_data(contents, name, **changed):
    """Return a certificate as from `change_arrays`, with matching digests."""
    return change_claims(change_arrays(contents, name, **changed))


def npz(arrays):
    """Return the content of a file of arrays."""
    content = io.BytesIO()
    np.savez(content, **arrays)
    return content.getvalue()


def change_entry(index, factor=1.0, plus=0.0):
    """Return a function that multiplies an entry of an array by `factor` and adds `plus`."""

    def change(value):
        array = np.array(value, dtype=float)
        array[index] = factor * array[index] + plus
        return array if isinstance(value, np.ndarray) else array.tolist()

    return change


def scale_period(contents, factor, *left_out):
    """Return a consistent certificate with the period scaled by `factor`, without the assumptions `left_out`."""
    claims = json.loads(contents[CERTIFICATE])
    claims["period"] *= factor
    for regime in ("free", "always"):
        for order, name in ((1, "speed"), (2, "acceleration")):
            rows = claims[regime][name]
            claims[regime][name] = [[None if x is None else x / factor**order for x in row] for row in rows]
    claims["assumes"] = [sentence for sentence in claims["assumes"] if sentence not in left_out]
    return {**contents, CERTIFICATE: seal(claims)}


def make_constraint_nan(contents):
    """Return a certificate with a NaN constraint and the claims of an unconstrained loop."""
    changed = change_arrays(contents, "constraints.npz", c=lambda c: np.nan * c)
    changed = change_arrays(changed, "witness.npz", active=np.zeros_like, multipliers=lambda alphas: alphas[:0])
    return change_claims(changed, always=lambda _: json.loads(contents[CERTIFICATE])["free"])


def tighten(contents, share):
    """Return a certificate with all bounds tightened by a share of the largest value of their quantity."""
    claims = json.loads(contents[CERTIFICATE])
    for regime in ("free", "always", "budgeted"):
        for name in checker.QUANTITIES if claims[regime] else ():
            values = np.array(claims[regime][name], dtype=float)
            change = share * np.nan_to_num(np.abs(values)).max(axis=0) * (1 if name == "lower" else -1)
            rows = (values + change).tolist()
            claims[regime][name] = [[None if x != x else x for x in row] for row in rows]
    return {**contents, CERTIFICATE: seal(claims)}


def change_text(contents, before, after):
    """Return a certificate with text of its claims replaced once, and unchanged digests."""
    return {**contents, CERTIFICATE: contents[CERTIFICATE].replace(before, after, 1)}


def test_impacts_are_those_of_the_law():
    """`impact_ratio` is compared with an integration in tests/models/control/test_wrench.py."""
    assert pytest.approx(IMPACTS, rel=1e-12) == checker.PEAKS


def make_every_step_active(contents):
    """Return a certificate that calls every step active, with multipliers of zero at the added steps."""
    with np.load(io.BytesIO(contents["witness.npz"])) as witness:
        active, multipliers = witness["active"], witness["multipliers"]
    padded = np.zeros((STEPS, *multipliers.shape[1:]))
    padded[active] = multipliers
    return change_data(contents, "witness.npz", active=np.ones_like, multipliers=lambda _: padded)


def limit_forces_to_1_n(impedance):
    impacts = [2**0.5 * (1 + 1e-5) * peak for peak in IMPACTS]
    changed = {"limits": [1.0, 1.0], "force": 2**0.5, "rest_force": {"always": 2**0.5}, "impacts": impacts}
    return {**impedance, **changed}


def without_impacts(impedance):
    return {**impedance, "contact_stiffness": 0.0, "impacts": []}


IMPACTS = [impact_ratio(ratio) for ratio in STIFFNESS_RATIOS]
ALTERATIONS = {
    "an impact": lambda c: change_claims(c, impedance__impacts=lambda impacts: [*impacts[:3], 0.99 * impacts[3]]),
    "a missing impact": lambda c: change_claims(c, impedance__impacts=lambda impacts: impacts[:3]),
    "impacts without a stiffness": lambda c: change_claims(c, impedance__contact_stiffness=lambda _: 0.0),
    "a negative stiffness of a contact": lambda c: change_claims(c, impedance__contact_stiffness=lambda _: -1.0),
    "an upper bound": lambda c: change_claims(c, always__upper=change_entry((30, 0), plus=-0.01)),
    "a lower bound": lambda c: change_claims(c, always__lower=change_entry((30, 0), plus=0.01)),
    "a bound that is too wide": lambda c: change_claims(c, always__upper=change_entry((10, 1), plus=0.1)),
    "a free bound": lambda c: change_claims(c, free__upper=change_entry((40, 0), plus=-0.01)),
    "a speed": lambda c: change_claims(c, always__speed=change_entry((20, 0), factor=0.9)),
    "an acceleration": lambda c: change_claims(c, free__acceleration=change_entry((20, 0), factor=0.9)),
    "the period": lambda c: change_claims(c, period=lambda period: 2.0 * period),
    "a missing step of a bound": lambda c: change_claims(c, always__upper=lambda rows: rows[:-1]),
    "the limits of force": lambda c: change_claims(c, impedance__limits=lambda limits: [0.5 * x for x in limits]),
    "missing limits": lambda c: change_claims(c, impedance__limits=lambda limits: DROPPED),
    "limits of null": lambda c: change_claims(c, impedance__limits=lambda limits: None),
    "negative limits": lambda c: change_claims(c, impedance__limits=lambda limits: [-40.0, -40.0]),
    "the force": lambda c: change_claims(c, impedance__force=lambda force: 0.9 * force),
    "the force, by 3e-5 of its value": lambda c: change_claims(c, impedance__force=lambda force: (1 - 3e-5) * force),
    "the stiffness": lambda c: change_claims(c, impedance__stiffness=lambda stiffness: [0.01 * x for x in stiffness]),
    "the force at rest": lambda c: change_claims(c, impedance__rest_force__always=lambda force: 0.99 * force),
    "a force at rest of the free regime": lambda c: change_claims(c, impedance__rest_force__free=lambda _: 1.0),
    "a force at rest among the bounds": lambda c: change_claims(c, free__rest_force=lambda _: 1.0),
    "an unknown claim": lambda c: change_claims(c, peak_force=lambda _: 1.0),
    "an unknown claim of a regime": lambda c: change_claims(c, always__jerk=lambda _: [[0.0, 0.0]] * STEPS),
    "a missing regime": lambda c: change_claims(c, free=lambda _: DROPPED),
    "a budget without bounds": lambda c: change_claims(c, budgeted=lambda _: {"excess": [[0.0], [0.0]]}),
    "a number as text": lambda c: change_claims(c, period=str),
    "numbers as text": lambda c: change_claims(c, always__upper=lambda rows: [[str(x) for x in row] for row in rows]),
    "a number as a bool": lambda c: change_claims(c, always__upper=lambda rows: [[True, *rows[0][1:]], *rows[1:]]),
    "a whole number": lambda c: change_claims(c, always__upper=lambda rows: [[1, *rows[0][1:]], *rows[1:]]),
    "a bound replaced by null": lambda c: change_claims(
        c, always__upper=lambda rows: [[None, *rows[0][1:]], *rows[1:]]
    ),
    "a duplicate key": lambda c: change_text(c, b'"about": ', b'"about": {"task": "easy"}, "about": '),
    "a duplicate regime": lambda c: change_text(c, b'"always": ', b'"always": {}, "always": '),
    "indentation": lambda c: {**c, CERTIFICATE: json.dumps(json.loads(c[CERTIFICATE]), indent=1).encode()},
    "a period of NaN": lambda c: change_text(c, b'"period": 0.02', b'"period": NaN'),
    "all bounds, by 0.9e-4 of the largest": lambda c: tighten(c, 0.9e-4),
    "all bounds, by 2e-5 of the largest": lambda c: tighten(c, 2e-5),
    "every step active": make_every_step_active,
    "active steps in reverse order": lambda c: change_data(c, "witness.npz", active=lambda t: t[::-1].copy()),
    "a tiny row of constraints": lambda c: change_data(
        c, "constraints.npz", G=lambda G: 1e-9 * G, c=lambda c: 1e-9 * c
    ),
    "a tiny row of constraints with a large bound": lambda c: change_data(
        c, "constraints.npz", G=lambda G: 1e-9 * G, c=lambda c: 1e-9 * (c + 0.22)
    ),
    "a large row of constraints": lambda c: change_data(c, "constraints.npz", G=lambda G: 1e9 * G, c=lambda c: 1e9 * c),
    "a row of constraints of zeros": lambda c: change_data(c, "constraints.npz", G=np.zeros_like),
    "the clock": lambda c: change_data(c, "primitive.npz", clock=lambda clock: 1e-14 * clock),
    "an uneven clock": lambda c: change_data(c, "primitive.npz", clock=lambda clock: clock * np.arange(STEPS)),
    "a clock without progress": lambda c: change_data(c, "primitive.npz", clock=np.zeros_like),
    "an unknown array": lambda c: change_data(c, "primitive.npz", inputs=lambda _: np.arange(STEPS + 10.0)),
    "a history that is no integer": lambda c: change_data(c, "primitive.npz", history=lambda h: h + 0.5),
    "an asymmetric covariance": lambda c: change_data(
        c, "primitive.npz", covariances=change_entry((30, 0, 1), plus=1e-6)
    ),
    "means in single precision": lambda c: change_data(c, "primitive.npz", means=lambda m: m.astype(np.float32)),
    "multipliers of other corners": lambda c: change_data(c, "witness.npz", multipliers=lambda a: a[:, ::-1].copy()),
    "negative multipliers": lambda c: change_data(c, "witness.npz", multipliers=lambda a: -a),
    "the format": lambda c: change_claims(c, format=lambda _: "guiderail certificate 3"),
    "a missing task": lambda c: change_claims(c, about=lambda about: {"run": "?"}),
    "assumptions as text": lambda c: change_claims(c, assumes=lambda sentences: "\n".join(sentences)),
    "a mean": lambda c: change_data(c, "primitive.npz", means=change_entry((30, 0), plus=0.02)),
    "a covariance": lambda c: change_data(c, "primitive.npz", covariances=change_entry((30, 0, 0), factor=3.0)),
    "the gains": lambda c: change_data(c, "primitive.npz", gains=lambda gains: 1.1 * gains),
    "beta": lambda c: change_data(c, "primitive.npz", beta=lambda beta: 1.2 * beta),
    "the length scale": lambda c: change_data(c, "primitive.npz", length_scale=lambda length: 0.8 * length),
    "the kernel": lambda c: change_claims(c, kernel=lambda _: "matern52"),
    "the constraint's bound": lambda c: change_data(c, "constraints.npz", c=lambda c: 1.2 * c),
    "the constraint's matrix": lambda c: change_data(c, "constraints.npz", G=lambda G: G[:, ::-1].copy()),
    "no active step": lambda c: change_data(c, "witness.npz", active=np.zeros_like),
    "a multiplier": lambda c: change_data(c, "witness.npz", multipliers=lambda a: 0.5 * a),
    "a digest": lambda c: change_text(c, b'"digest": "', b'"digest": "0'),
    "a constraint of NaN": make_constraint_nan,
    "a mean of NaN": lambda c: change_data(c, "primitive.npz", means=change_entry((30, 0), factor=np.nan)),
    "a negative range of starts": lambda c: change_data(c, "primitive.npz", start_within=lambda within: -within),
    "the period and the speeds": lambda c: scale_period(c, 2.0),
    "an infinite period": lambda c: scale_period(c, np.inf),
    "an empty list of assumptions": lambda c: change_claims(c, assumes=lambda sentences: []),
    "a missing assumption": lambda c: change_claims(c, assumes=lambda sentences: sentences[:-1]),
    "the words of an assumption": lambda c: change_claims(
        c, assumes=lambda sentences: [sentences[0].replace("-1", "-2"), *sentences[1:]]
    ),
    "an added assumption": lambda c: change_claims(c, assumes=lambda sentences: [*sentences, OTHER_CLOCK]),
    "a file without its digest": lambda c: change_arrays(c, "primitive.npz", gains=lambda gains: 1.0 * gains + 1e-9),
}


def test_certificate_refuses_a_kernel_that_the_checker_lacks():
    loop = make_loop(0)
    primitive = LcNsKmp(loop.primitive.reference, kernel=Matern52(0.5), horizon=10)
    loop = replace(loop, primitive=primitive)
    with pytest.raises(InputError, match="squared_exponential"):
        make_files(loop, certify(loop))


@pytest.fixture(scope="module")
def valid_files():
    loop = make_loop(0, 0.25, correlation=0.5)
    return make_files(loop, certify(loop))


@pytest.fixture(scope="module")
def budgeted_files():
    return make_files(*certify_case("sKGRL, constrained"))


@pytest.mark.parametrize("changed", ALTERATIONS)
def test_checker_rejects_a_changed_certificate(valid_files, tmp_path, changed):
    with pytest.raises((checker.Rejected, ValueError)):
        checker.check(write(tmp_path, ALTERATIONS[changed](valid_files)))


# Alterations that the checker accepts and only a comparison with the skill detects.
SUBJECT_ALTERATIONS = {
    "about": lambda c: change_claims(c, about=lambda _: {"task": "easier", "environment": {"guidance": "kgrl"}}),
    "limits": lambda c: change_claims(c, impedance=limit_forces_to_1_n),
    "stiffness": lambda c: change_claims(c, impedance=lambda _: None),
    "contact_stiffness": lambda c: change_claims(c, impedance=without_impacts),
}


@pytest.mark.parametrize("name", SUBJECT_ALTERATIONS)
def test_compare_subject_names_changed_data_of_the_skill(valid_files, name):
    loop = make_loop(0, 0.25, correlation=0.5)
    assert compare_subject(valid_files, loop, *IMPEDANCE, ABOUT) is None
    assert compare_subject(SUBJECT_ALTERATIONS[name](valid_files), loop, *IMPEDANCE, ABOUT) == name


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"gains": np.array([0.1, 0.0])}, "gains"),
        ({"start_within": np.zeros(2)}, "start_within"),
        ({"period": 0.03}, "period"),
        ({"primitive": make_loop(0, 0.26, correlation=0.5).primitive}, "c"),
        ({"primitive": make_loop(0, 0.25, correlation=0.4).primitive}, "covariances"),
    ],
)
def test_compare_subject_names_a_difference_of_the_loop(valid_files, change, name):
    loop = replace(make_loop(0, 0.25, correlation=0.5), **change)
    assert compare_subject(valid_files, loop, *IMPEDANCE, ABOUT) == name


def scale(factor):
    """Return a function that multiplies each number of nested lists by a factor."""
    return lambda rows: [[factor * x for x in row] for row in rows]


BUDGET_ALTERATIONS = {
    "a bound": lambda c: change_claims(c, budgeted__upper=change_entry((50, 1), plus=-0.05)),
    "a speed": lambda c: change_claims(c, budgeted__speed=change_entry((50, 0), factor=0.9)),
    "the force at rest": lambda c: change_claims(c, impedance__rest_force__budgeted=lambda force: 0.9 * force),
    "the excess": lambda c: change_claims(c, budgeted__excess=scale(0.5)),
    "the residue": lambda c: change_claims(c, budgeted__residue=scale(0.5)),
    "an excess of zero": lambda c: change_claims(c, budgeted__excess=scale(0.0)),
    "a residue of zero": lambda c: change_claims(c, budgeted__residue=scale(0.0)),
    "budgets of zero": lambda c: change_claims(c, budgeted__excess=scale(0.0), budgeted__residue=scale(0.0)),
    "a total excess below that of a step": lambda c: change_claims(
        c, budgeted__excess=lambda rows: [[2.0 * rows[1][0]], rows[1]]
    ),
    "a residue of an output that actions move": lambda c: change_claims(
        c, budgeted__residue=change_entry((1, 0), plus=1.0)
    ),
    "a negative budget": lambda c: change_claims(c, budgeted__residue=scale(-1.0)),
    "a Lagrange multiplier": lambda c: change_data(c, "witness.npz", lagrange_multipliers=lambda p: 1.1 * p),
    "a multiplier's step before the first": lambda c: change_data(c, "witness.npz", lagrange_steps=lambda k: k - STEPS),
    "a multiplier's step after the last": lambda c: change_data(c, "witness.npz", lagrange_steps=lambda k: k + STEPS),
    "a missing assumption": lambda c: change_claims(
        c, assumes=lambda sentences: [text for text in sentences if text != BUDGET]
    ),
    "a missing regime": lambda c: change_claims(c, budgeted=lambda _: None),
    "bounds of the regime always": lambda c: change_claims(
        c, budgeted=lambda claims: json.loads(c[CERTIFICATE])["always"] | {k: claims[k] for k in checker.BUDGETS}
    ),
}


@pytest.mark.parametrize("changed", BUDGET_ALTERATIONS)
def test_checker_rejects_a_changed_budgeted_regime(budgeted_files, tmp_path, changed):
    with pytest.raises((checker.Rejected, ValueError)):
        checker.check(write(tmp_path, BUDGET_ALTERATIONS[changed](budgeted_files)))


@pytest.mark.parametrize("largest", [1.0, 1.7e308])
def test_checker_rejects_a_bound_that_overflows(budgeted_files, tmp_path, largest):
    """A bound of NaN, the sum of 300 large products, is neither tighter nor wider than a claim."""
    with np.load(io.BytesIO(budgeted_files["witness.npz"])) as witness:
        steps, outputs, multipliers = (witness[f"lagrange_{name}"] for name in ("steps", "outputs", "multipliers"))
    pad = [(0, 0)] * 4 + [(0, 300 - multipliers.shape[-1])]
    large, last = np.pad(multipliers, pad), np.pad(steps, pad)
    large[0, 1, -1, 0], last[0, 1, -1, 0] = largest, STEPS - 1
    changed = change_arrays(
        budgeted_files, "witness.npz", lagrange_steps=lambda _: last, lagrange_outputs=lambda _: np.pad(outputs, pad),
        lagrange_multipliers=lambda _: large,
    )  # fmt: skip
    changed = change_claims(changed, budgeted__excess=lambda rows: [rows[0], rows[0]])
    with pytest.raises(checker.Rejected, match="has no value" if largest > 1.0 else "tighter|wider"):
        checker.check(write(tmp_path, changed))


@pytest.mark.parametrize("largest", [1.0, 1.7e308])
def test_checker_rejects_a_correction_that_overflows(tmp_path, largest):
    """A correction of NaN, from large multipliers of one-sided constraints, must not count as no correction."""
    contents = short_certificate(0, lower=(-0.02, -3.0), upper=(np.inf, np.inf))[2]
    checker.check(write(tmp_path, contents))
    with np.load(io.BytesIO(contents["witness.npz"])) as witness:
        multipliers = witness["multipliers"]
    multipliers[0] = np.array([1e-2, 1.0]) * largest
    changed = change_data(contents, "witness.npz", multipliers=lambda _: multipliers)
    with pytest.raises(checker.Rejected, match="too large" if largest > 1.0 else "violates a constraint"):
        checker.check(write(tmp_path, changed))


def test_checker_rejects_a_window_longer_than_the_limit(tmp_path, monkeypatch):
    contents = short_certificate(3)[2]
    monkeypatch.setattr(checker, "MAX_WINDOW", 8)
    checker.check(write(tmp_path, contents))
    monkeypatch.setattr(checker, "MAX_WINDOW", 7)
    with pytest.raises(checker.Rejected, match="out of range"):
        checker.check(tmp_path)


def test_signature_is_checked_when_a_key_is_given(tmp_path):
    loop = make_loop(0)
    contents = make_files(loop, certify(loop), KEY)
    checker.check(write(tmp_path, contents))
    checker.check(tmp_path, KEY)
    with pytest.raises(checker.Rejected, match="not of this key"):
        checker.check(tmp_path, KEY[::-1])
    with pytest.raises(checker.Rejected, match="16 bytes"):
        checker.check(tmp_path, KEY[:15])
    # The digest of changed claims can be computed without the key, but not their signature.
    claims = json.loads(contents[CERTIFICATE])
    claims["about"] = {"task": "easier"}
    forged = json.loads(seal(claims))
    for signature in ({}, {"signature": claims["signature"]}, {"signature": 3}):
        (tmp_path / CERTIFICATE).write_text(checker.canonical(forged | signature))
        checker.check(tmp_path)
        with pytest.raises(checker.Rejected, match="signature is missing"):
            checker.check(tmp_path, KEY)


def test_certificate_states_a_period_other_than_the_clock(tmp_path):
    loop = replace(make_loop(4, 0.25), period=1.5 * PERIOD)
    contents = make_files(loop, certify(loop))
    assert OTHER_CLOCK in json.loads(contents[CERTIFICATE])["assumes"]
    checker.check(write(tmp_path, contents))
    with pytest.raises(checker.Rejected, match="does not state"):
        checker.check(write(tmp_path, scale_period(contents, 1.0, OTHER_CLOCK)))


def run_checker(folder, capsys, monkeypatch):
    """Return the exit code and the output of the checker as a program."""
    monkeypatch.setattr(sys, "argv", ["checker.py", str(folder)])
    try:
        runpy.run_path(checker.__file__, run_name="__main__")
    except SystemExit as error:
        return error.code, capsys.readouterr().out
    return 0, capsys.readouterr().out


@pytest.mark.parametrize("arguments", [[], ["folder", "key", "more"]])
def test_checker_prints_usage_when_arguments_are_wrong(arguments, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["checker.py", *arguments])
    with pytest.raises(SystemExit, match="2"):
        runpy.run_path(checker.__file__, run_name="__main__")
    assert capsys.readouterr().out == "usage: python checker.py FOLDER [KEY_FILE]\n"


MALFORMED = {
    "claims as a list": lambda c: {**c, CERTIFICATE: b"[]"},
    "claims as a number": lambda c: {**c, CERTIFICATE: b"3"},
    "digests as a list": lambda c: {**c, CERTIFICATE: seal(json.loads(c[CERTIFICATE]) | {"digests": []})},
    "a horizon as text": lambda c: change_data(c, "primitive.npz", horizon=lambda _: "long"),
}
UNREADABLE = {
    "100 bytes of the claims": lambda c: {**c, CERTIFICATE: c[CERTIFICATE][:100]},
    "claims that are not UTF-8": lambda c: {**c, CERTIFICATE: bytes(range(256))},
    "a file without arrays": lambda c: change_claims({**c, "witness.npz": b"none"}),
    "a truncated archive": lambda c: change_claims({**c, "witness.npz": c["witness.npz"][:-50]}),
    "no files": lambda c: {},
}


@pytest.mark.parametrize("content", MALFORMED | UNREADABLE)
def test_checker_exits_with_1_or_2_for_invalid_files(valid_files, content, tmp_path, capsys, monkeypatch):
    folder = write(tmp_path, (MALFORMED | UNREADABLE)[content](valid_files))
    code, out = run_checker(folder, capsys, monkeypatch)
    assert code == (1 if content in MALFORMED else 2)
    assert out.startswith("no: " if content in MALFORMED else "no: the files make no sense")
    assert out.count("\n") == 1


@pytest.mark.parametrize("name", [CERTIFICATE, "primitive.npz", "constraints.npz", "witness.npz"])
def test_checker_exits_with_2_when_a_file_is_a_pipe(valid_files, name, tmp_path, capsys, monkeypatch):
    folder = write(tmp_path, valid_files)
    (folder / name).unlink()
    os.mkfifo(folder / name)
    code, out = run_checker(folder, capsys, monkeypatch)
    assert code == 2
    assert "not a regular file" in out


def test_checker_exits_with_2_when_the_key_is_a_pipe(valid_files, tmp_path, capsys, monkeypatch):
    os.mkfifo(tmp_path / "key")
    monkeypatch.setattr(sys, "argv", ["checker.py", str(write(tmp_path, valid_files)), str(tmp_path / "key")])
    with pytest.raises(SystemExit, match="2"):
        runpy.run_path(checker.__file__, run_name="__main__")
    assert "not a regular file" in capsys.readouterr().out


@pytest.mark.parametrize("history", [0, 1, 4])
def test_first_commands_have_the_speed_from_the_start(history, tmp_path):
    """Before the first command the robot rests at the start, without a history too."""
    loop = make_loop(history)
    result = certify(loop)
    checker.check(write(tmp_path, make_files(loop, result)))
    largest = np.zeros((2, STEPS))
    for sides in itertools.product([-1.0, 1.0], repeat=3):
        start = loop.start + sides[0] * loop.start_within
        actions = np.concatenate([sides[1:], np.zeros(STEPS - 2)])
        motion = np.vstack([start, start, execute(loop, actions, start)])[:, 0]
        values = [np.abs(np.diff(motion, order))[-STEPS:] / PERIOD**order for order in (1, 2)]
        largest = np.maximum(largest, values)
    assert largest[0, 0] == pytest.approx(result.free.speed[0, 0], rel=1e-9)
    assert largest[1, :2] == pytest.approx(result.free.acceleration[:2, 0], rel=1e-9)


@pytest.mark.parametrize("parameter", ["speed", "acceleration"])
def test_checker_rejects_a_first_step_without_the_way_from_the_start(valid_files, tmp_path, parameter):
    for regime in ("free", "always"):
        changed = change_claims(valid_files, **{f"{regime}__{parameter}": change_entry((0, 0), factor=0.9)})
        with pytest.raises(checker.Rejected, match=f"step 0: {regime} {parameter}"):
            checker.check(write(tmp_path, changed))


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"lambda": 1e-22, "beta": 0.0}, "λ \\+ β is too small"),
        ({"lambda": 1e-300, "beta": 0.0}, "out of range"),
        ({"length_scale": 1e300}, "out of range"),
        ({"history_variance": 1e-45}, "out of range"),
        ({"history_variance": 1e-38, "history": 3}, "too small for its length"),
        ({"gains": np.array([1e200, 0.0])}, "out of range"),
        ({"means": np.full((STEPS, 2), 1e50)}, "out of range"),
    ],
)
def test_checker_rejects_numbers_that_it_cannot_bound(valid_files, tmp_path, changed, reason):
    """Directions of the kernel below the rounding errors must be small compared with λ + β."""
    changes = {name: lambda old, value=value: np.array(value, dtype=old.dtype) for name, value in changed.items()}
    with pytest.raises(checker.Rejected, match=reason):
        checker.check(write(tmp_path, change_data(valid_files, "primitive.npz", **changes)))


def test_certificates_near_numerical_limits_have_no_false_claims():
    outcomes, wrong = certificate_extremes.run(60)
    assert wrong == []
    assert outcomes["accepted, executed"] > 20


def test_checker_exits_with_1_only_when_a_file_is_changed(valid_files, tmp_path, capsys, monkeypatch):
    assert run_checker(write(tmp_path, valid_files), capsys, monkeypatch) == (0, "yes\n")
    code, out = run_checker(write(tmp_path, ALTERATIONS["a speed"](valid_files)), capsys, monkeypatch)
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
def short_certificate(history, lower=(-0.21, -np.inf), upper=(0.21, np.inf)):
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
    return loop, result, make_files(loop, result)


def field_paths(value, path=()):
    """Yield the paths of all fields of a JSON value, and of the first, middle and last element of each list."""
    if path:
        yield path
    if isinstance(value, dict):
        for key in value:
            yield from field_paths(value[key], (*path, key))
    elif isinstance(value, list) and value:
        for i in sorted({0, len(value) // 2, len(value) - 1}):
            yield from field_paths(value[i], (*path, i))


CONVERSIONS = {float: str, str: lambda text: [text], list: lambda rows: dict(enumerate(map(str, rows))), dict: list}


def alter_claims(contents):
    """Yield names of alterations, and certificates with a claim dropped, scaled, converted or duplicated."""
    claims = json.loads(contents[CERTIFICATE])
    for path in field_paths(claims):
        if path[0] in ("digest", "digests"):
            continue
        for kind in ("dropped", "scaled up", "scaled down", "converted", "duplicated"):
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
            elif kind == "converted":
                inner[last] = CONVERSIONS.get(type(value), str)(value)
            elif isinstance(last, int):
                inner.insert(last, value)
            else:
                text = json.dumps(changed, sort_keys=True)
                field = f"{json.dumps(last)}: {json.dumps(value, sort_keys=True)}"
                yield f"{path} {kind}", {**contents, CERTIFICATE: text.replace(field, f"{field}, {field}", 1).encode()}
                continue
            yield f"{path} {kind}", {**contents, CERTIFICATE: seal(changed)}


def alter_arrays(contents):
    """Yield names of alterations, and certificates with an array changed as in `alter_claims`, and new digests."""
    for name in checker.ARRAYS:
        with np.load(io.BytesIO(contents[name])) as arrays:
            values = {key: arrays[key] for key in arrays.files}
        for key, value in values.items():
            changes = {
                "dropped": None,
                "scaled up": {"f": lambda x: 1.5 * x, "i": lambda x: x + 1, "b": np.invert}[value.dtype.kind](value),
                "scaled down": (1.0 - 0.9e-4) * value if value.dtype.kind == "f" else 0 * value,
                "converted": value.astype(str),
                "in another precision": value.astype(np.float32 if value.dtype.kind == "f" else np.int16),
                "duplicated": np.concatenate([np.atleast_1d(value)] * 2),
                "of another dimension": value[None],
            }
            for kind, changed in changes.items():
                if changed is not None and changed.dtype == value.dtype and np.array_equal(changed, value):
                    continue
                arrays = {k: v for k, v in ({**values, key: changed}).items() if v is not None}
                yield f"{name} {key} {kind}", change_claims({**contents, name: npz(arrays)})
            content = io.BytesIO(contents[name])
            with zipfile.ZipFile(content, "a") as archive, warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                archive.writestr(f"{key}.npy", archive.read(f"{key}.npy"))
            yield f"{name} {key} twice", change_claims({**contents, name: content.getvalue()})


def has_valid_claims(altered, contents, result):
    """Return True if the claims of an altered certificate follow from the bounds of its original `contents`."""
    claims, original = (json.loads(files[CERTIFICATE]) for files in (altered, contents))
    regimes = {"free": result.free, "always": result.always}
    if result.budgeted is not None:
        regimes["budgeted"] = result.budgeted.bounds
        for name in checker.BUDGETS:
            if not (np.array(claims["budgeted"][name]) <= np.array(original["budgeted"][name])).all():
                return False
    for (regime, bounds), name in itertools.product(regimes.items(), checker.QUANTITIES):
        claimed, certified = np.array(claims[regime][name], dtype=float), getattr(bounds, name)
        bounded = ~np.isnan(claimed)
        if not ((claimed - certified)[bounded] * (-1.0 if name == "lower" else 1.0) >= 0.0).all():
            return False
    return all(claims[k] == original[k] for k in ("about", "assumes", "kernel", "period", "impedance"))


@pytest.mark.parametrize("history", [0, 3])
def test_checker_accepts_altered_fields_only_with_valid_claims(history, tmp_path):
    loop, result, contents = short_certificate(history)
    checker.check(write(tmp_path, contents))
    assert compare_subject(contents, loop, *IMPEDANCE, ABOUT) is None
    num_altered = num_accepted = 0
    for name, altered in itertools.islice((*alter_claims(contents), *alter_arrays(contents)), 0, None, 5):
        num_altered += 1
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                checker.check(write(tmp_path, altered))
        except (checker.Rejected, ValueError):  # rejected by the checker or by NumPy's reader
            continue
        if compare_subject(altered, loop, *IMPEDANCE, ABOUT) is not None:
            continue
        num_accepted += 1
        assert has_valid_claims(altered, contents, result), name
    assert num_altered >= 100
    assert num_accepted <= 0.1 * num_altered


def test_tolerances_of_the_checker_have_their_documented_values():
    """A wider tolerance would accept more claims; the other tests show false claims far beyond it only."""
    assert (checker.AGREEMENT, checker.BORDER, checker.COMMAND_TOLERANCE, checker.ROUNDING) == (1e-4, 1e-5, 1e-9, 1e-6)
    assert (checker.getcontext().prec, checker.DECIMAL, checker.EPS) == (60, 1e-59, np.finfo(float).eps)
    assert (checker.SMALLEST, checker.LARGEST, checker.UNDERFLOW) == (1e-40, 1e40, 1e-60)
    assert (checker.MAX_BYTES, checker.MAX_WINDOW) == (2**30, 500)
