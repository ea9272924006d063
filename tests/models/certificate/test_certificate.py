"""Certified bounds hold against adversaries, and the checker rejects changed files."""

import ast
import hashlib
import io
import json
import runpy
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from guiderail.models.certificate import checker
from guiderail.models.certificate.adversary import Adversary
from guiderail.models.certificate.bounds import certify
from guiderail.models.certificate.files import BUDGET, CERTIFICATE, OTHER_CLOCK, certificate_files, digest
from guiderail.models.certificate.lagrange_bounds import Budget, MultiplierSearch, residue_generators
from guiderail.models.certificate.loop import CertifiedLoop, reach
from guiderail.models.common.errors import InputError
from guiderail.models.primitives import LcNsKmp, LinearConstraints, Matern52, ReferenceTrajectory
from guiderail.models.primitives.gains import authority_gains

PERIOD, STEPS = 0.02, 60
PHASE = np.linspace(0.0, 1.0, STEPS)


def skill(history, bound=None, tied=0.0):
    """Return a loop of two outputs, of which the first is explored and may be constrained to ±bound."""
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
    made = skill(*CASES["sKGRL, constrained"], tied=0.5)
    return made, certified(made)


@pytest.fixture(scope="module", params=CASES)
def case(request):
    if request.param == "sKGRL, constrained":
        return constrained()
    made = skill(*CASES[request.param], tied=0.5)
    return made, certified(made)


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
    """Yield sequences of full deflections that change sign never, sometimes, often or at every step."""
    for i in range(number):
        turns = np.cumsum(rng.uniform(size=STEPS) < (0.0, 0.05, 0.3, 1.0)[i % 4]) % 2
        yield (2.0 * turns - 1.0) * rng.choice([-1.0, 1.0])


def test_random_sequences_stay_in_the_bounds_and_reach_them(case):
    made, found = case
    rng, always = np.random.default_rng(0), found.always
    reached = {"position": 0.0, "speed": 0.0, "acceleration": 0.0}
    middle = executed(made, np.zeros(STEPS), made.start)[:, 0]
    for actions in adversaries(rng, 40):
        y = executed(made, actions, made.start + rng.uniform(-1.0, 1.0, 2) * made.start_within)
        speed, acceleration = (np.abs(np.diff(y, order, axis=0)) / PERIOD**order for order in (1, 2))
        assert (y >= always.lower - 1e-7).all()
        assert (y <= always.upper + 1e-7).all()
        assert (speed <= always.speed[1:] + 1e-6).all()
        assert (acceleration <= always.acceleration[2:] + 1e-4).all()
        room = np.where(y[:, 0] > middle, always.upper[:, 0] - middle, middle - always.lower[:, 0])
        reached["position"] = max(reached["position"], np.max(np.abs(y[:, 0] - middle) / room))
        reached["speed"] = max(reached["speed"], speed[:, 0].max() / always.speed[:, 0].max())
    assert reached["position"] > 0.9
    if not found.can_be_active.any():
        assert reached["speed"] > 0.6


def test_free_bound_is_reached_by_its_worst_actions():
    """The signs of the impulse responses reach the support of the zonotope."""
    made = skill(4)
    found = certify(made)
    n = STEPS - 1
    still = executed(made, np.zeros(STEPS), made.start + made.start_within)
    impulses = [executed(made, np.eye(STEPS)[m], made.start + made.start_within)[n, 0] for m in range(STEPS)]
    worst = executed(made, np.sign(np.array(impulses) - still[n, 0]), made.start + made.start_within)
    below = executed(made, np.sign(np.array(impulses) - still[n, 0]), made.start - made.start_within)
    assert max(worst[n, 0], below[n, 0]) == pytest.approx(found.free.upper[n, 0], rel=1e-6)


def test_output_coupled_through_a_history_has_no_bound():
    tied, alone = certify(skill(4, 0.25, tied=0.5)).always, certify(skill(4, 0.25)).always
    assert np.isinf(tied.upper[-1, 1])
    assert np.isfinite(alone.upper).all()
    assert np.abs(tied.upper[:, 0]).max() <= 0.25 + 1e-9 or tied.upper[:, 0].max() < 0.3


def test_adversary_stays_in_the_bounds_within_the_budget():
    """With a history and constraints, all bounds exist and are at most twice what an adversary reaches."""
    made, found = constrained()
    budget, bounds = found.budgeted.budget, found.budgeted.bounds
    seen = Adversary(made, np.ones(STEPS, bool), seed=1).attack(80 * STEPS)
    assert seen.corrected > 100
    assert (seen.excess <= budget.excess).all()
    assert (seen.residue <= budget.residue).all()
    assert (seen.lower >= bounds.lower - 1e-9).all()
    assert (seen.upper <= bounds.upper + 1e-9).all()
    for quantity, claimed in (("speed", bounds.speed), ("acceleration", bounds.acceleration)):
        assert (seen.largest[quantity] <= claimed * (1.0 + 1e-6)).all()
        assert (claimed.max(axis=0) <= 2.0 * seen.largest[quantity].max(axis=0)).all()
    assert np.isinf(found.always.upper[:, 1]).any()


def test_budget_is_not_used_without_constraints():
    seen = Adversary(skill(4, None, tied=0.5), np.ones(STEPS, bool)).attack(10 * STEPS)
    assert seen.corrected == 0
    assert not seen.excess.any()
    assert not seen.residue.any()


def test_attack_samples_starts_in_corners_and_between():
    made = skill(4)
    adversary = Adversary(made, np.zeros(STEPS, bool))
    places = (np.array([adversary._sample_start() for _ in range(200)]) - made.start)[:, 0] / made.start_within[0]
    assert np.abs(places).max() == pytest.approx(1.0)
    assert {-1.0, 1.0} <= set(np.round(places, 9))
    assert 50 < (np.abs(places) < 0.999).sum() < 150


def test_attack_detects_a_start_that_was_not_certified():
    made = skill(4)
    kept = certify(replace(made, start_within=np.zeros(2))).free
    seen = Adversary(made, np.zeros(STEPS, bool)).attack(20 * STEPS)
    assert (seen.upper[:2, 0] > kept.upper[:2, 0] + 1e-3).all()
    assert (seen.upper <= certify(made).free.upper + 1e-9).all()


@pytest.mark.parametrize("change", [0.0, 0.3, -2.0])
def test_any_multiplier_proves_a_bound(change):
    """Bad multipliers only make a bound wider."""
    made, found = constrained()
    worse = replace(
        found.budgeted, multipliers=found.budgeted.multipliers + change * (found.budgeted.multipliers != 0.0)
    )
    middle, generators = reach(made)
    first = int(np.argmax(found.can_be_active))
    seen = Adversary(made, np.ones(STEPS, bool), seed=2).attack(40 * STEPS)
    generators = np.concatenate([generators, residue_generators(made, first)], axis=2)
    search = MultiplierSearch(made, middle, generators, first, worse.budget)
    for n in range(first, STEPS):
        steps, outputs, multipliers = (a[0, 0, n] for a in (worse.steps, worse.outputs, worse.multipliers))
        highest = middle[4 + n] + search.bound(generators[4 + n], steps, outputs, multipliers)
        assert (seen.upper[n] <= highest + 1e-9).all()


def files(made, found):
    stiffness, limits = np.array([1500.0, 1500.0]), np.array([40.0, 40.0])
    return certificate_files(made, found, stiffness, limits, {"task": "none"})


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
        inner[last] = change(inner[last])
    claims["digest"] = digest(claims)
    return {**contents, CERTIFICATE: json.dumps(claims).encode()}


def altered(contents, name, **changed):
    """Return the files with changed arrays in one of them."""
    with np.load(io.BytesIO(contents[name])) as arrays:
        values = {key: arrays[key].copy() for key in arrays.files}
    for key, change in changed.items():
        values[key] = change(values[key])
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
    claims["digest"] = digest(claims)
    return {**contents, CERTIFICATE: json.dumps(claims).encode()}


def constrained_by_nothing(contents):
    """Return a certificate with a NaN constraint and the claims of an unconstrained loop."""
    none = altered(contents, "constraints.npz", c=lambda c: np.nan * c)
    none = altered(none, "witness.npz", active=np.zeros_like, multipliers=lambda alphas: alphas[:0])
    claims = json.loads(contents[CERTIFICATE])
    free, stiffness, limits = (claims[name] for name in ("free", "stiffness", "limits"))
    ranges = np.max(free["upper"], axis=0) - np.min(free["lower"], axis=0)
    at_rest = float(np.linalg.norm(np.minimum(limits, np.array(stiffness) * ranges)))
    return signed(none, always=lambda _: free | {"rest_force": at_rest})


TAMPERED = {
    "an upper bound": lambda c: signed(c, always__upper=at((30, 0), plus=-0.01)),
    "a lower bound": lambda c: signed(c, always__lower=at((30, 0), plus=0.01)),
    "a bound that is too wide": lambda c: signed(c, always__upper=at((10, 1), plus=0.1)),
    "a free bound": lambda c: signed(c, free__upper=at((40, 0), plus=-0.01)),
    "a speed": lambda c: signed(c, always__speed=at((20, 0), factor=0.9)),
    "an acceleration": lambda c: signed(c, free__acceleration=at((20, 0), factor=0.9)),
    "the period": lambda c: signed(c, period=lambda period: 2.0 * period),
    "a bound that is left out": lambda c: signed(c, always__upper=lambda rows: rows[:-1]),
    "the limits of force": lambda c: signed(c, limits=lambda limits: [0.5 * x for x in limits]),
    "the force": lambda c: signed(c, force=lambda force: 0.9 * force),
    "the stiffness": lambda c: signed(c, stiffness=lambda stiffness: [0.01 * x for x in stiffness]),
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
    "a period without end": lambda c: faster(c, np.inf),
    "that anything is assumed": lambda c: signed(c, assumes=lambda sentences: []),
    "a sentence that is assumed": lambda c: signed(c, assumes=lambda sentences: sentences[:-1]),
    "the words of a sentence": lambda c: signed(c, assumes=lambda them: [them[0].replace("-1", "-2"), *them[1:]]),
    "a sentence too many": lambda c: signed(c, assumes=lambda sentences: [*sentences, OTHER_CLOCK]),
    "a file, unsigned": lambda c: altered(c, "primitive.npz", gains=lambda gains: 1.0 * gains + 1e-9),
}


def test_certificate_refuses_a_kernel_without_a_checker():
    made = skill(0)
    primitive = LcNsKmp(made.primitive.reference, kernel=Matern52(0.5), horizon=10)
    made = replace(made, primitive=primitive)
    with pytest.raises(InputError, match="squared_exponential"):
        files(made, certify(made))


@pytest.fixture(scope="module")
def honest():
    made = skill(0, 0.25, tied=0.5)
    return files(made, certify(made))


@pytest.fixture(scope="module")
def budgeted():
    return files(*constrained())


@pytest.mark.parametrize("what", TAMPERED)
def test_checker_rejects_a_changed_certificate(honest, tmp_path, what):
    with pytest.raises((checker.Rejected, ValueError)):
        checker.check(write(tmp_path, TAMPERED[what](honest)))


BUDGETED = {
    "a bound": lambda c: signed(c, budgeted__upper=at((50, 1), plus=-0.05)),
    "a speed": lambda c: signed(c, budgeted__speed=at((50, 0), factor=0.9)),
    "the force at rest": lambda c: signed(c, budgeted__rest_force=lambda force: 0.9 * force),
    "the excess": lambda c: signed(c, budgeted__excess=lambda rows: [[0.5 * x for x in row] for row in rows]),
    "the residue": lambda c: signed(c, budgeted__residue=lambda rows: [[0.5 * x for x in row] for row in rows]),
    "a budget below zero": lambda c: signed(c, budgeted__residue=lambda rows: [[-x for x in row] for row in rows]),
    "a Lagrange multiplier": lambda c: signed(altered(c, "witness.npz", lagrange_multipliers=lambda p: 1.1 * p)),
    "what it assumes": lambda c: signed(c, assumes=lambda them: [one for one in them if one != BUDGET]),
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


def test_certificate_states_a_period_unlike_the_clock(tmp_path):
    made = replace(skill(4, 0.25), period=1.5 * PERIOD)
    contents = files(made, certify(made))
    assert OTHER_CLOCK in json.loads(contents[CERTIFICATE])["assumes"]
    checker.check(write(tmp_path, contents))
    with pytest.raises(checker.Rejected, match="does not state"):
        checker.check(write(tmp_path, faster(contents, 1.0, OTHER_CLOCK)))


def told(folder, capsys, monkeypatch):
    """Return the exit code and the output of the checker as a program."""
    monkeypatch.setattr(sys, "argv", ["checker.py", str(folder)])
    try:
        runpy.run_path(checker.__file__, run_name="__main__")
    except SystemExit as ended:
        return ended.code, capsys.readouterr().out
    return 0, capsys.readouterr().out


NONE = {
    "a list": lambda c: {**c, CERTIFICATE: b"[]"},
    "a number": lambda c: {**c, CERTIFICATE: b"3"},
    "half of it": lambda c: {**c, CERTIFICATE: c[CERTIFICATE][:100]},
    "no text": lambda c: {**c, CERTIFICATE: bytes(range(256))},
    "digests as a list": lambda c: signed(c, digests=lambda digests: []),
    "no arrays": lambda c: signed({**c, "witness.npz": b"none"}),
    "half of an archive": lambda c: signed({**c, "witness.npz": c["witness.npz"][:-50]}),
    "a word for a number": lambda c: signed(altered(c, "primitive.npz", horizon=lambda _: "long")),
    "nothing": lambda c: {},
}


@pytest.mark.parametrize("what", NONE)
def test_checker_reports_unreadable_files_with_exit_code_2(honest, what, tmp_path, capsys, monkeypatch):
    code, out = told(write(tmp_path, NONE[what](honest)), capsys, monkeypatch)
    assert code == 2
    assert out.startswith("no: the files make no sense")
    assert out.count("\n") == 1


def test_checker_exits_with_0_or_1(honest, tmp_path, capsys, monkeypatch):
    assert told(write(tmp_path, honest), capsys, monkeypatch) == (0, "yes\n")
    code, out = told(write(tmp_path, TAMPERED["a speed"](honest)), capsys, monkeypatch)
    assert code == 1
    assert out.startswith("no: step 20: always speed of output 0 is ")


def test_checker_is_short_and_imports_numpy_only():
    source = Path(checker.__file__).read_text()
    assert len(source.splitlines()) <= 250
    imported = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported.add(str(node.module))
    assert {name for name in imported if name.split(".")[0] not in sys.stdlib_module_names} == {"numpy"}
