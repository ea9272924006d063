"""Checks a certificate: `python checker.py FOLDER`. It needs NumPy alone, and nothing of what made the certificate.

It reads what the primitive is, forms problem 4.5 at every step anew from the kernel and the demonstrations, and adds up
what all sequences of actions can come to. It says yes, or no and where. Exit code 0 or 1; 2 if a file can't be read.

    y = W h + S Σ⁻¹ (μ − W h) + β S[:, first] a,   S = (Σ⁻¹ + (λ + β) C⁻¹)⁻¹
W maps the history h on the window and C is the kernel given the history. A correction for constraints G y ≥ c with
multipliers α ≥ 0 moves the window by S Gᵀ α; its squared size is αᵀ G S Gᵀ α.
"""

import hashlib
import itertools
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

Arrays = dict[str, np.ndarray]
Regimes = dict[str, Arrays]
QUANTITIES = ("lower", "upper", "speed", "acceleration")
AGREES = 1e-4  # of a quantity's largest value: how well two ways of calculating it agree
KEEPS = 1e-7  # of a constraint's size: how well a correction that is shown must keep it
ROUNDING = 1e-6  # of a squared correction: a radius below its root is none


class Rejected(Exception):
    """Why a certificate is not accepted."""


def require(condition: Any, words: str) -> None:
    """Rejects the certificate unless a condition holds."""
    if not condition:
        raise Rejected(words)


def read(folder: Path) -> tuple[Arrays, Arrays, dict[str, Any]]:
    """The primitive with its constraints, the witness and the claims; every file must be the one that was signed."""
    claims = json.loads((folder / "certificate.json").read_text())
    told = json.dumps({key: value for key, value in claims.items() if key != "digest"}, sort_keys=True)
    require(hashlib.sha256(told.encode()).hexdigest() == claims.get("digest"), "certificate.json was changed")
    files: dict[str, Arrays] = {}
    for name in ("primitive.npz", "constraints.npz", "witness.npz"):
        content = (folder / name).read_bytes()
        require(hashlib.sha256(content).hexdigest() == claims["digests"].get(name), f"{name} was changed")
        with np.load(folder / name, allow_pickle=False) as arrays:
            files[name] = {key: arrays[key] for key in arrays.files}
    return {**files["primitive.npz"], **files["constraints.npz"]}, files["witness.npz"], claims


def solve(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """A⁻¹ B of a positive definite A, in extended precision."""
    n, L, X = len(A), np.zeros_like(A), B.copy()
    for j in range(n):
        L[j:, j] = A[j:, j] - L[j:, :j] @ L[j, :j]
        L[j:, j] /= np.sqrt(L[j, j])
    for j in range(n):
        X[j] = (X[j] - L[j, :j] @ X[:j]) / L[j, j]
    for j in reversed(range(n)):
        X[j] = (X[j] - L[j + 1 :, j] @ X[j + 1 :]) / L[j, j]
    return X


class Primitive:
    """Problem 4.5 at every step."""

    def __init__(self, p: Arrays):
        self.means, self.covariances = p["means"], p["covariances"]
        self.steps, self.outputs = self.means.shape
        self.past, self.horizon = int(p["history"]), int(p["horizon"])
        self.beta, self.hbar = float(p["beta"]), float(p["lambda"]) + float(p["beta"])
        self.noise, self.inverse_length = self.hbar * float(p["history_variance"]), float(p["inverse_length"])
        self.inputs = p["inputs"].astype(np.longdouble)
        require(len(self.inputs) == self.past + self.steps + self.horizon, "the clock has not one time for each step")
        self.G, self.c = p["G"], p["c"]
        self.known: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

    def kernel(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """W (H+1, P), and features F of the kernel given the history, F Fᵀ = C."""
        P, t = self.past, self.inputs[n : n + self.past + self.horizon + 1]
        key = np.round((t - t[0]).astype(float), 12).tobytes()
        if key not in self.known:
            k = np.exp(-np.longdouble(self.inverse_length) * (t[:, None] - t[None, :]) ** 2)
            W = solve(k[:P, :P] + self.noise * np.eye(P, dtype=k.dtype), k[:P, P:]).T
            values, vectors = np.linalg.eigh((k[P:, P:] - W @ k[:P, P:]).astype(float))
            kept = values > 1e-15 * values[-1]
            self.known[key] = W.astype(float), vectors[:, kept] * np.sqrt(values[kept])
        return self.known[key]

    def window(self, n: int) -> tuple[np.ndarray, ...]:
        """The window's maps from history and action, its offset, L with S = L Lᵀ, and constraints on it, as rows."""
        W, F = self.kernel(n)
        outs, at = self.outputs, np.minimum(np.arange(n, n + self.horizon + 1), self.steps - 1)
        precision = np.linalg.inv(self.covariances[at])
        M = np.einsum("ja,jb,jop->aobp", F, F, precision).reshape(F.shape[1] * outs, -1)
        F_bar = np.kron(F, np.eye(outs))
        L = np.linalg.solve(np.linalg.cholesky((M + M.T) / 2 + self.hbar * np.eye(len(M))), F_bar.T).T
        weigh = np.einsum("joa,jop->jpa", L.reshape(len(at), outs, -1), precision).reshape(F_bar.shape[0], -1)
        W_bar = np.kron(W, np.eye(outs))
        history = W_bar - L @ (weigh.T @ W_bar)
        G = np.broadcast_to(self.G, (self.steps, *self.G.shape[-2:]))[at]
        c = np.broadcast_to(self.c, (self.steps, self.c.shape[-1]))[at]
        rows = np.zeros((G.shape[0] * G.shape[1], F_bar.shape[0]))
        for j, f in itertools.product(range(G.shape[0]), range(G.shape[1])):
            rows[j * G.shape[1] + f, j * outs : (j + 1) * outs] = G[j, f]
        return history, self.beta * L @ L[:outs].T, L @ (weigh.T @ self.means[at].ravel()), L, rows, c.ravel()


def reach(primitive: Primitive, p: Arrays, witness: Arrays) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Free motion, generators, and what corrected commands reach (2, N, outputs): NaN where none is corrected."""
    P, N, outs = primitive.past, primitive.steps, primitive.outputs
    moved, claimed = np.flatnonzero(p["gains"]), witness["touched"].astype(bool)
    require(claimed.shape == (N,), "the witness has not one entry for each step")
    middle, spread = np.zeros((P + N, outs)), np.zeros((P + N, outs, N * (A := len(moved)) + outs))
    middle[:P], spread[:P, :, N * A :] = p["start"], np.diag(p["start_within"])
    corrected = np.full((2, N, outs), np.nan)
    for n in range(N):
        history, action, offset, L, rows, c = primitive.window(n)
        y = history @ middle[n : P + n].ravel() + offset
        g = history @ spread[n : P + n].reshape(P * outs, -1) if P else np.zeros((len(y), N * A + outs))
        by = action[:, moved] * p["gains"][moved]
        g[:, n * A : (n + 1) * A] += by
        middle[P + n], spread[P + n] = y[:outs], g[:outs]
        touches = len(c) > 0 and (rows @ y - np.abs(rows @ g).sum(axis=1) < c - KEEPS).any()
        require(claimed[n] or not touches, f"step {n}: a constraint can be active there")
        if claimed[n] and P == 0:
            corrected[:, n] = cells(y, by, L, rows, c, witness["multipliers"][claimed[:n].sum()], n, outs)
    if P:
        tied, reached = (p["covariances"] != 0).any(axis=0), (p["G"].reshape(-1, outs) != 0).any(axis=0)
        for _ in range(outs):
            reached = reached | (tied & reached).any(axis=1)
        unknown = np.logical_or.accumulate(claimed)[:, None] & reached
        corrected[0, unknown], corrected[1, unknown] = -np.inf, np.inf
    return middle, spread, corrected


def cells(
    y: np.ndarray, by: np.ndarray, L: np.ndarray, rows: np.ndarray, c: np.ndarray, alphas: np.ndarray, n: int, outs: int
) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest corrected command of step n, by cells of the actions whose corners' multipliers are shown.

    Between corners the mean of their corrections is feasible, and the least one v is within ‖v̄‖² − ‖v‖² of it.
    """
    A, alphas = by.shape[1], alphas.reshape(len(alphas), -1)
    along = round(len(alphas) ** (1 / A)) - 1
    require(along >= 1 and (along + 1) ** A == len(alphas), f"step {n}: not every corner of the actions is shown")
    require((alphas >= 0).all() and alphas.shape[1] == len(c), f"step {n}: these are no multipliers")
    places = np.array(list(itertools.product(range(along + 1), repeat=A)))
    free = y + (2.0 * places / along - 1.0) @ by.T
    v = alphas @ rows @ L
    short = c - free @ rows.T
    kept = ((free + v @ L.T) @ rows.T - c >= -KEEPS * (1 + np.abs(c))).all()
    require(kept, f"step {n}: the correction that is shown breaks a constraint")
    least, commands = alphas @ short.T, (free + v @ L.T)[:, :outs]
    found = []
    for first in itertools.product(range(along), repeat=A):
        i = np.flatnonzero(((places >= first) & (places <= np.add(first, 1))).all(axis=1))
        squared, apart = (v[i] ** 2).sum(axis=1), ((v[i][:, None] - v[i]) ** 2).sum(axis=2)
        radii = []
        for k in i:
            d, size = least[k, i], np.linalg.norm(v[k])
            d = d / size if size > 0 and (d >= 0).all() else 0 * d
            radii.append((squared - d**2).max() + max(((d[:, None] - d) ** 2 - apart).max(), 0) / 2)
        radius = np.linalg.norm(L[:outs], axis=1) * np.sqrt(max(min(radii), ROUNDING * squared.max()))
        found.append((commands[i].min(axis=0) - radius, commands[i].max(axis=0) + radius))
    return np.min(found, axis=0)[0], np.max(found, axis=0)[1]


def bounds(
    primitive: Primitive, p: Arrays, middle: np.ndarray, spread: np.ndarray, corrected: np.ndarray, period: float
) -> Regimes:
    """Both regimes' quantities, each (N, outs)."""
    P, N, outs = primitive.past, primitive.steps, primitive.outputs
    size = np.abs(spread).sum(axis=2)
    free = {"lower": (middle - size)[P:], "upper": (middle + size)[P:]}
    for order, name in ((1, "speed"), (2, "acceleration")):
        change = np.abs(np.diff(middle, order, axis=0)) + np.abs(np.diff(spread, order, axis=0)).sum(axis=2)
        free[name] = np.concatenate([np.zeros((order, outs)), change])[-N:] / period**order
    least, greatest = np.full((N, outs), -np.inf), np.full((N, outs), np.inf)
    G, c = np.broadcast_to(p["G"], (N, *p["G"].shape[-2:])), np.broadcast_to(p["c"], (N, p["c"].shape[-1]))
    for n, f in itertools.product(range(N), range(G.shape[1])):
        (alone,) = np.nonzero(G[n, f])
        if len(alone) == 1:
            cap, o = c[n, f] / G[n, f, alone[0]], (n, alone[0])
            if G[n, f, o[1]] > 0:
                least[o] = max(least[o], cap)
            else:
                greatest[o] = min(greatest[o], cap)
    off = ~np.isnan(corrected[0])
    low = np.where(off, np.maximum(corrected[0], least), free["lower"])
    high = np.where(off, np.minimum(corrected[1], greatest), free["upper"])
    always = {"lower": low, "upper": high, "speed": free["speed"].copy(), "acceleration": free["acceleration"].copy()}
    before = [np.tile(p["start"] + side * p["start_within"], (2, 1)) for side in (-1, 1)]
    low, high = np.vstack([before[0], low]), np.vstack([before[1], high])
    off = np.vstack([np.zeros((2, outs), bool), off])
    for n in range(2, N + 2):
        if n > 2 or P:
            new = np.maximum(high[n] - low[n - 1], high[n - 1] - low[n]) / period
            always["speed"][n - 2] = np.where(off[n - 1 : n + 1].any(axis=0), new, always["speed"][n - 2])
        if n > 3 or P:
            up = high[n] - 2 * low[n - 1] + high[n - 2]
            new = np.maximum(up, 2 * high[n - 1] - low[n] - low[n - 2]) / period**2
            always["acceleration"][n - 2] = np.where(off[n - 2 : n + 1].any(axis=0), new, always["acceleration"][n - 2])
    return {"free": free, "always": always}


def compare(claims: dict[str, Any], found: Regimes) -> None:
    """Rejects a claim that is not what was found; the worst step is named."""
    for regime, name in itertools.product(found, QUANTITIES):
        claimed = np.array(claims[regime][name], dtype=float)  # null is NaN: nothing is known
        unknown = np.inf if name != "lower" else -np.inf
        claimed, mine = np.where(np.isnan(claimed), unknown, claimed), found[regime][name]
        require(claimed.shape == mine.shape, f"{regime} {name} has not a bound for each step and output")
        known = np.isfinite(mine)
        require((np.isfinite(claimed) == known).all(), f"{regime} {name} is known where it is not, or unknown")
        scale = np.maximum(np.abs(np.where(known, mine, 0.0)).max(axis=0), 1e-9)
        wrong = np.abs(np.where(known, claimed, 0.0) - np.where(known, mine, 0.0)) / scale
        n, o = np.unravel_index(int(wrong.argmax()), wrong.shape)
        require(wrong[n, o] <= AGREES, f"step {n}: {regime} {name} of output {o} is {mine[n, o]:.6g}, not as claimed")


def check(folder: Path) -> None:
    """Raises `Rejected` unless the certificate in a folder holds."""
    p, witness, claims = read(folder)
    period = float(claims["period"])
    require(period > 0 and claims["format"] == "guiderail certificate 1", "the format or the period is none")
    primitive = Primitive(p)
    clock = np.diff(primitive.inputs[primitive.past : primitive.past + primitive.steps]).astype(float)
    require(np.allclose(clock, clock[0]), "the clock is not even, and speeds would have no one period")
    found = bounds(primitive, p, *reach(primitive, p, witness), period)
    compare(claims, found)
    if "limits" in claims:
        stiffness, limits = np.array(claims["stiffness"]), np.array(claims["limits"])
        ranges = found["always"]["upper"].max(axis=0) - found["always"]["lower"].min(axis=0)
        rest = np.linalg.norm(np.minimum(limits, stiffness * ranges)[:3])
        for name, mine in (("force", np.linalg.norm(limits[:3])), ("rest_force", rest)):
            require(abs(claims[name] - mine) <= AGREES * mine, f"{name} is {mine:.6g} N, not {claims[name]:.6g} N")


if __name__ == "__main__":
    try:
        check(Path(sys.argv[1]))
    except Rejected as why:
        print(f"no: {why}")
        sys.exit(1)
    except (OSError, KeyError, ValueError, TypeError, IndexError, np.linalg.LinAlgError) as error:
        print(f"no: the files are not readable ({type(error).__name__}: {error})")
        sys.exit(2)
    print("yes")
