"""Check a certificate with NumPy alone: `python checker.py FOLDER`; exit code 0: yes, 1: no, 2: no such files.

It bounds all sequences of actions, W h being what the history h implies of the window and C the kernel given h:
    y = W h + S Σ⁻¹ (μ − W h) + β S[:, first] a + S Gᵀ α,   S = (Σ⁻¹ + (λ + β) C⁻¹)⁻¹,   multipliers α ≥ 0
"""

import hashlib
import itertools
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

Arrays = dict[str, np.ndarray]
KERNELS: dict[str, Any] = {"squared_exponential": lambda d, length: np.exp(-np.longdouble(0.5 / length**2) * d**2)}
QUANTITIES = ("lower", "upper", "speed", "acceleration")
AGREEMENT = 1e-4  # largest difference from a claim, relative to the largest value of the quantity
TOLERANCE = 1e-7  # largest violation by a correction, relative to the size of the constraint
ROUNDING = 1e-6  # smallest squared radius, relative to the squared correction
# First half of the SHA-256 of the assumptions: six sentences always, one for a budget, one for another period
ASSUMED = ["e5158d7dbfb9eb94f8416c6dc4d2ff18", "a655ad2b35cbf716049b5b81125193c9", "a36592ef1fbc0ffbb0d3964081e759de"]


class Rejected(Exception):
    """Reason why a certificate is rejected."""


def require(condition: Any, words: str) -> None:
    """Reject the certificate unless a condition holds."""
    if not condition:
        raise Rejected(words)


def read(folder: Path) -> tuple[Arrays, Arrays, dict[str, Any]]:
    """Return primitive and constraints, witness and claims; reject a file that differs from its digest."""
    claims = json.loads((folder / "certificate.json").read_text())
    text = json.dumps({key: value for key, value in claims.items() if key != "digest"}, sort_keys=True)
    require(hashlib.sha256(text.encode()).hexdigest() == claims.get("digest"), "certificate.json was changed")
    files: dict[str, Arrays] = {}
    for name in ("primitive.npz", "constraints.npz", "witness.npz"):
        content = (folder / name).read_bytes()
        require(hashlib.sha256(content).hexdigest() == claims["digests"].get(name), f"{name} was changed")
        with np.load(folder / name, allow_pickle=False) as arrays:
            files[name] = {key: arrays[key] for key in arrays.files}
        require(all(np.isfinite(each).all() for each in files[name].values()), f"{name} has values that are not finite")
    return {**files["primitive.npz"], **files["constraints.npz"]}, files["witness.npz"], claims


def solve(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Compute A⁻¹ B of a positive definite A in extended precision."""
    n, M = len(A), np.hstack([A, B])
    for j, rest in enumerate(~np.eye(n, dtype=bool)):
        M[j] /= M[j, j]
        M[rest] -= np.outer(M[rest, j], M[j])
    return M[:, n:]


class Primitive:
    """Problem 4.5 at every step."""

    def __init__(self, p: Arrays, kernel: str):
        self.means, self.covariances = p["means"], p["covariances"]
        self.steps, self.outputs = self.means.shape
        self.past, self.horizon = int(p["history"]), int(p["horizon"])
        self.beta, self.hbar = float(p["beta"]), float(p["lambda"]) + float(p["beta"])
        self.noise, self.length_scale = self.hbar * float(p["history_variance"]), float(p["length_scale"])
        self.kernel, self.inputs = KERNELS[kernel], p["inputs"].astype(np.longdouble)
        clock, times = np.diff(self.inputs.astype(float)), self.past + self.steps + self.horizon
        require(len(clock) == times - 1 and np.allclose(clock, clock[0]), "the clock is not even, or not the steps'")
        self.G, self.c = (np.broadcast_to(p[k], (self.steps, *p[k].shape[-n:])) for k, n in (("G", 2), ("c", 1)))
        self.known: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

    def features(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Compute W (H+1, P), and features F (H+1, r) of the kernel given the history, F Fᵀ = C."""
        P, t = self.past, self.inputs[n : n + self.past + self.horizon + 1]
        key = np.round((t - t[0]).astype(float), 12).tobytes()
        if key not in self.known:
            k = self.kernel(t[:, None] - t[None, :], self.length_scale)
            W = solve(k[:P, :P] + self.noise * np.eye(P, dtype=k.dtype), k[:P, P:]).T
            values, vectors = np.linalg.eigh((k[P:, P:] - W @ k[:P, P:]).astype(float))
            kept = values > 1e-15 * values[-1]
            self.known[key] = W.astype(float), vectors[:, kept] * np.sqrt(values[kept])
        return self.known[key]

    def window(self, n: int) -> tuple[np.ndarray, ...]:
        """Compute the window's maps of history and action, offset, L with S = L Lᵀ, constraint rows and bounds."""
        W, F = self.features(n)
        outs, at = self.outputs, np.minimum(np.arange(n, n + self.horizon + 1), self.steps - 1)
        precision, F_bar = np.linalg.inv(self.covariances[at]), np.kron(F, np.eye(outs))
        M = np.einsum("ja,jb,jop->aobp", F, F, precision).reshape(F.shape[1] * outs, -1)
        L = np.linalg.solve(np.linalg.cholesky((M + M.T) / 2 + self.hbar * np.eye(len(M))), F_bar.T).T
        weigh = np.einsum("joa,jop->jpa", L.reshape(len(at), outs, -1), precision).reshape(F_bar.shape[0], -1)
        history = (W_bar := np.kron(W, np.eye(outs))) - L @ (weigh.T @ W_bar)
        rows = np.einsum("jfo,jk->jfko", self.G[at], np.eye(len(at))).reshape(-1, F_bar.shape[0])
        return history, self.beta * L @ L[:outs].T, L @ (weigh.T @ self.means[at].ravel()), L, rows, self.c[at].ravel()

    def caps(self) -> tuple[np.ndarray, np.ndarray]:
        """Return lower and upper bounds (N, outs) by the constraints that involve a single output."""
        alone = ((self.G != 0).sum(axis=2) == 1)[..., None]
        cap = self.c[..., None] / np.where(self.G == 0, 1, self.G)
        least = np.where(alone & (self.G > 0), cap, -np.inf).max(axis=1, initial=-np.inf)
        return least, np.where(alone & (self.G < 0), cap, np.inf).min(axis=1, initial=np.inf)

    def reach(self, p: Arrays, witness: Arrays) -> tuple[np.ndarray, ...]:
        """Compute free motion, generators, bounds of corrected commands (2, N, outs) or NaN, and maps of histories."""
        P, N, outs = self.past, self.steps, self.outputs
        moved, claimed = np.flatnonzero(p["gains"]), witness["active"].astype(bool)
        require(claimed.shape == (N,) and (p["start_within"] >= 0).all(), "missing steps, or a negative start_within")
        middle, spread = np.zeros((P + N, outs)), np.zeros((P + N, outs, N * (A := len(moved)) + outs))
        middle[:P], spread[:P, :, N * A :] = p["start"], np.diag(p["start_within"])
        corrected, maps = np.full((2, N, outs), np.nan), np.zeros((N, outs, P * outs))
        for n in range(N):
            history, action, offset, L, rows, c = self.window(n)
            maps[n], y = history[:outs], history @ middle[n : P + n].ravel() + offset
            g = history @ spread[n : P + n].reshape(P * outs, N * A + outs)
            g[:, n * A : (n + 1) * A] += (by := action[:, moved] * p["gains"][moved])
            middle[P + n], spread[P + n] = y[:outs], g[:outs]
            touches = not (rows @ y - np.abs(rows @ g).sum(axis=1) >= c - TOLERANCE).all()
            require(claimed[n] or not touches, f"step {n}: a constraint can be active there")
            if claimed[n] and P == 0:
                alphas = witness["multipliers"][claimed[:n].sum()]
                corrected[:, n] = cells(n, y, by, L[:outs], (rows @ L, rows, c), alphas)
        if P:
            tied, reached = (p["covariances"] != 0).any(axis=0), (p["G"].reshape(-1, outs) != 0).any(axis=0)
            reached = np.linalg.matrix_power(tied + np.eye(outs), outs) @ reached > 0
            unknown = np.logical_or.accumulate(claimed)[:, None] & reached
            corrected[0, unknown], corrected[1, unknown] = -np.inf, np.inf
        return middle, spread, corrected, maps

    def bounds(self, p: Arrays, found: tuple[np.ndarray, ...], period: float) -> dict[str, Arrays]:
        """Compute the quantities (N, outs) of the first two regimes."""
        (middle, spread, corrected, _), P, N, outs = found, self.past, self.steps, self.outputs
        size, off, (least, greatest) = np.abs(spread).sum(axis=2), ~np.isnan(corrected[0]), self.caps()
        free = {"lower": (middle - size)[P:], "upper": (middle + size)[P:]}
        for order, name in ((1, "speed"), (2, "acceleration")):
            change = np.abs(np.diff(middle, order, axis=0)) + np.abs(np.diff(spread, order, axis=0)).sum(axis=2)
            free[name] = np.concatenate([np.zeros((order, outs)), change])[-N:] / period**order
        low = np.where(off, np.maximum(corrected[0], least), free["lower"])
        high = np.where(off, np.minimum(corrected[1], greatest), free["upper"])
        always = {"lower": low, "upper": high}
        low, high = (np.vstack([p["start"] + side * p["start_within"]] * 2 + [y]) for side, y in ((-1, low), (1, high)))
        off = np.vstack([np.zeros((2, outs), bool), off])
        near = [off[1:-1] | off[2:], off[:-2] | off[1:-1] | off[2:]]
        steps = np.maximum(high[2:] - low[1:-1], high[1:-1] - low[2:])
        bends = np.maximum(high[2:] - 2 * low[1:-1] + high[:-2], 2 * high[1:-1] - low[2:] - low[:-2])
        for order, (name, new) in enumerate((("speed", steps), ("acceleration", bends))):
            moves = near[order] & (np.arange(N)[:, None] > (order if P == 0 else -1))
            always[name] = np.where(moves, new / period ** (order + 1), free[name])
        return {"free": free, "always": always}

    def budgeted(self, p: Arrays, w: Arrays, claims: Any, reached: tuple[np.ndarray, ...]) -> Arrays:
        """Compute the quantities of the third regime; any multipliers of constraints at other steps prove bounds."""
        (middle, spread, _, maps), P, N, outs = reached, self.past, self.steps, self.outputs
        first, U = int(np.argmax(w["active"])), np.flatnonzero(p["gains"] == 0)
        A, late, more = outs - len(U), N - first, np.zeros((P + N, outs, (N - first) * len(U)))
        budgets = [np.array(claims["budgeted"]["excess"]), np.array(claims["budgeted"]["residue"])[:, U]]
        (at, of, alphas), (low, high) = (w[f"lagrange_{k}"] for k in ("steps", "outputs", "multipliers")), self.caps()
        valid = [np.isfinite(alphas), at >= 0, of >= 0, budgets[0] >= 0, budgets[1] >= 0, P > 0 and w["active"].any()]
        require(all(np.all(each) for each in valid), "invalid budgets or multipliers")
        for n in range(first, N):
            more[P + n] = maps[n] @ more[n : P + n].reshape(P * outs, more.shape[2])
            more[P + n, U, (n - first) * len(U) + np.arange(len(U))] = 1
        spread, most = np.concatenate([spread, more], axis=2), np.zeros((3, 2, N, outs))
        for order, side, n in itertools.product(range(3), range(2), range(first, N)):
            k, o, alpha = at[order, side, n], of[order, side, n], alphas[order, side, n]
            sign, row = 1 - 2 * side, slice(P + n - order, P + n + 1)
            g = sign * np.diff(spread[row], order, axis=0)[0] - np.einsum("or,orc->oc", alpha, spread[P + k, o])
            margin = np.where(alpha > 0, high[k, o], low[k, o]) - middle[P + k, o]
            value = sign * np.diff(middle[row], order, axis=0)[0] + np.abs(g[:, : N * A + outs]).sum(axis=1)
            value += (alpha * np.where(alpha == 0, 0, margin)).sum(axis=1)
            for part, budget in zip((g[:, first * A : N * A], g[:, N * A + outs :]), budgets, strict=True):
                spent = np.clip(budget[1] - np.arange(late)[:, None] * budget[0], 0, budget[0])
                value += (np.sort(np.abs(part).reshape(outs, late, -1), axis=1)[:, ::-1] * spent).sum(axis=(1, 2))
            most[order, side, n] = value
        moves = [most[order].max(axis=0) / claims["period"] ** order for order in (1, 2)]
        return dict(zip(QUANTITIES, (np.maximum(-most[0, 1], low), np.minimum(most[0, 0], high), *moves), strict=True))


def cells(n: int, y: np.ndarray, by: np.ndarray, L: np.ndarray, kept: Any, alphas: np.ndarray) -> tuple[Any, Any]:
    """Bound the commands of step n by cells; v is within ‖v̄‖² − ‖v‖² of the mean v̄ of the corners' corrections."""
    (rows_L, rows, c), outs, A, alphas = kept, len(L), by.shape[1], alphas.reshape(len(alphas), -1)
    along = round(len(alphas) ** (1 / A)) - 1
    fine = along >= 1 and (along + 1) ** A == len(alphas) and (alphas >= 0).all() and alphas.shape[1] == len(c)
    require(fine, f"step {n}: these are not the multipliers of every corner of the actions")
    places = np.array(list(itertools.product(range(along + 1), repeat=A)))
    free = y + (2.0 * places / along - 1.0) @ by.T
    v, short = alphas @ rows_L, c - free @ rows.T
    slack = v @ rows_L.T - short + TOLERANCE * (1 + np.abs(c))
    require((slack >= 0).all(), f"step {n}: the correction violates a constraint")
    least, commands, norms = alphas @ short.T, free[:, :outs] + v @ L.T, np.linalg.norm(L, axis=1)
    weights = (along + 1) ** np.arange(A)[::-1]
    near = np.array(list(itertools.product((0, 1), repeat=A))) @ weights
    i = (places[(places < along).all(axis=1)] @ weights)[:, None] + near  # corners of every cell
    squared, apart = (v[i] ** 2).sum(axis=2), ((v[i][:, :, None] - v[i][:, None]) ** 2).sum(axis=3)
    dual = least[i[:, :, None], i[:, None]]
    d = dual * (dual >= 0).all(axis=2, keepdims=True) / np.maximum(np.sqrt(squared), 1e-300)[..., None]
    between = ((d[..., None] - d[..., None, :]) ** 2 - apart[:, None]).max(axis=(2, 3))
    radii = (squared[:, None] - d**2).max(axis=2) + np.maximum(between, 0) / 2
    radius = np.sqrt(np.maximum(radii.min(axis=1), ROUNDING * squared.max(axis=1)))[:, None] * norms
    return (commands[i].min(axis=1) - radius).min(axis=0), (commands[i].max(axis=1) + radius).max(axis=0)


def compare(claims: dict[str, Any], found: dict[str, Arrays]) -> None:
    """Reject a claim that differs from the computed quantities, and name the worst step."""
    for regime, name in itertools.product(found, QUANTITIES):
        claimed = np.array(claims[regime][name], dtype=float)  # null is NaN: unbounded
        own = np.where(np.isinf(found[regime][name]), np.nan, found[regime][name])
        fits = claimed.shape == own.shape and (np.isnan(claimed) == np.isnan(own)).all()
        require(fits, f"{regime} {name} has other shapes or unbounded entries")
        scale = np.maximum(np.nan_to_num(np.abs(own)).max(axis=0), 1e-9)
        wrong = np.nan_to_num(np.abs(claimed - own), posinf=np.inf) / scale
        n, o = np.unravel_index(int(wrong.argmax()), wrong.shape)
        require(wrong[n, o] <= AGREEMENT, f"step {n}: {regime} {name} of output {o} is {own[n, o]:.6g}, not as claimed")


def check(folder: Path) -> None:
    """Raise `Rejected` unless the certificate in a folder holds."""
    p, witness, claims = read(folder)
    require(claims["format"] == "guiderail certificate 3" and 0 < claims["period"] < np.inf, "wrong format or period")
    require(claims["kernel"] in KERNELS, f"the kernel is {claims['kernel']!r}, not one of {list(KERNELS)}")
    primitive, period = Primitive(p, claims["kernel"]), float(claims["period"])
    given = True, "budgeted" in claims, abs(period / np.diff(p["inputs"]).mean() - 1) > 1e-6
    texts = ["\n".join(claims["assumes"][:6]), *claims["assumes"][6:]]
    digests = [hashlib.sha256(text.encode()).hexdigest()[:32] for text in texts]
    require(digests == list(itertools.compress(ASSUMED, given)), "it does not state the required assumptions")
    found = primitive.bounds(p, reached := primitive.reach(p, witness), period)
    if "budgeted" in claims:
        third, before = primitive.budgeted(p, witness, claims, reached), np.cumsum(witness["active"])[:, None] == 0
        found["budgeted"] = {name: np.where(before, found["free"][name], third[name]) for name in QUANTITIES}
    compare(claims, found)
    if "limits" in claims:
        stiffness, limits = np.array(claims["stiffness"]), np.array(claims["limits"])
        forces = [("force", np.linalg.norm(limits[:3]), claims["force"])]
        for regime in set(found) - {"free"}:
            ranges = found[regime]["upper"].max(axis=0) - found[regime]["lower"].min(axis=0)
            rest = np.linalg.norm(np.minimum(limits, stiffness * ranges)[:3])
            forces.append((f"{regime} rest_force", rest, claims[regime]["rest_force"]))
        for name, own, claimed in forces:
            require(abs(claimed - own) <= AGREEMENT * own, f"{name} is {own:.6g} N, not {claimed:.6g} N")


if __name__ == "__main__":
    try:
        check(Path(sys.argv[1]))
        print("yes")
    except Exception as reason:  # files may hold anything
        print("no:", reason if isinstance(reason, Rejected) else f"the files make no sense, {reason!r}")
        sys.exit(1 if isinstance(reason, Rejected) else 2)
