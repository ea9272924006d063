"""Check a certificate by NumPy: `python checker.py FOLDER [KEY_FILE]`; exit code 0 valid, 1 rejected, 2 unreadable.

The checker bounds the commands y of a window of steps for all actions a. Given the history h, the prior has the mean
W h and the kernel C. μ, Σ, λ and β are the primitive's means, covariances and parameters, G its rows of constraints:
    y = W h + S Σ⁻¹ (μ − W h) + β S[:, first] a + S Gᵀ α,   S = (Σ⁻¹ + (λ + β) C⁻¹)⁻¹,   multipliers α ≥ 0

Windows are computed in extended precision, and no claim may be tighter than a bound that includes the rounding errors.
`guiderail certify SKILL --verify FOLDER` also compares subject, primitive, impedance and budget with those of the
skill. Only a signature, made with a key, detects deliberate changes.
"""

import hashlib
import hmac
import io
import itertools
import json
import sys
import zipfile
from decimal import Decimal, getcontext
from pathlib import Path
from typing import Any

import numpy as np

Arrays = dict[str, np.ndarray]
Real = np.longdouble
extended = np.vectorize(lambda decimal: Real(str(decimal)), otypes=[Real])
KERNELS: dict[str, Any] = {"squared_exponential": lambda d, length: (-(d * d) / (2 * length * length)).exp()}
QUANTITIES, BUDGETS = ("lower", "upper", "speed", "acceleration"), ("excess", "residue")
AGREEMENT = 1e-4  # largest excess of a claim over the computed value, relative to the largest value of the quantity
BORDER = 1e-5  # largest slack of a constraint that a claim may call active, relative to the constraint's terms
COMMAND_TOLERANCE = 1e-9  # largest violation of constraints, with rows of unit norm, that the primitive accepts
ROUNDING = 1e-6  # smallest squared radius of a cell, relative to the squared correction
getcontext().prec, DECIMAL = 60, 1e-59  # digits of decimal numbers, and their relative rounding error
EPS, EXTENDED = 2.0**-52, float(np.finfo(Real).eps)
PEAKS = 1.5, 1.5, 1.5643944629973865, 1.8731779968143014  # impacts at 1, 2, 4, 8 times the stiffness
SMALLEST, LARGEST, UNDERFLOW = 1e-40, 1e40, 1e-60  # range of a primitive's numbers; bound on errors by underflow
MAX_BYTES, MAX_WINDOW = 2**30, 500  # largest size of a file's arrays; history and horizon together are less [steps]
# First halves of the SHA-256 of assumptions: the seven required ones together, that of a budget, that of another period
ASSUMED = ["1667823335eeaf59deffdc0b3a834045", "24d1c5853812f1558e29694e3071f8b5", "a36592ef1fbc0ffbb0d3964081e759de"]
# Kind and shape of each array: N steps, O outputs, F rows, H steps of a window, T active steps, C corners, R rounds
ARRAYS: dict[str, dict[str, tuple[str, str]]] = {
    "primitive.npz": {
        **{"means": ("f", "NO"), "covariances": ("f", "NOO"), "gains": ("f", "O"), "start": ("f", "O")},
        **{"start_within": ("f", "O"), "clock": ("f", ""), "length_scale": ("f", ""), "lambda": ("f", "")},
        **{"beta": ("f", ""), "history_variance": ("f", ""), "horizon": ("i", ""), "history": ("i", "")},
    },
    "constraints.npz": {"G": ("f", "NFO"), "c": ("f", "NF")},
    "witness.npz": {"active": ("b", "N"), "multipliers": ("f", "TCHF")},
}
LAGRANGE = {f"lagrange_{k}": (kind, "32NOR") for k, kind in (("steps", "i"), ("outputs", "i"), ("multipliers", "f"))}


class Rejected(Exception):
    """Reason why a certificate is rejected."""


def require(condition: Any, reason: str) -> None:
    """Raise `Rejected` with a reason unless a condition holds."""
    if not condition:
        raise Rejected(reason)


def canonical(claims: dict[str, Any], *left_out: str) -> str:
    """Return the canonical text of claims without the fields `left_out`; `read` rejects any other text."""
    return json.dumps({k: v for k, v in claims.items() if k not in left_out}, sort_keys=True, allow_nan=False)


def content(path: Path) -> bytes:
    """Return the content of a file; raise an OSError if the file is not regular or larger than `MAX_BYTES`."""
    if path.exists() and not (path.is_file() and path.stat().st_size <= MAX_BYTES):
        raise OSError(f"{path.name} is not a regular file of at most 1 GiB")
    return path.read_bytes()


def read(folder: Path, key: bytes | None) -> tuple[Arrays, Arrays, dict[str, Any]]:
    """Return the arrays of primitive and constraints, those of the witness, and the claims; reject other formats."""
    claims = json.loads(text := content(folder / "certificate.json").decode())
    require(type(claims) is dict and text == canonical(claims), "certificate.json is not in canonical form")
    has_budget, names = claims.get("budgeted") is not None, ["about", "always", "assumes", "budgeted", "digest"]
    names += ["digests", "format", "free", "impedance", "kernel", "period"] + ["signature"] * ("signature" in claims)
    require(sorted(claims) == sorted(names), f"its fields are not {', '.join(names)}")
    digest = hashlib.sha256(canonical(claims, "digest", "signature").encode()).hexdigest()
    require(claims["digest"] == digest, "certificate.json was changed")
    if key is not None:
        require(len(key) >= 16, "a key has 16 bytes at least")
        signature = hmac.new(key, digest.encode(), hashlib.sha256).hexdigest()
        signed = isinstance(claims.get("signature"), str) and hmac.compare_digest(claims["signature"], signature)
        require(signed, "the signature is missing, or not of this key")
    require(type(claims["digests"]) is dict and sorted(claims["digests"]) == sorted(ARRAYS), "digests of other files")
    files, sizes = {}, {"3": 3, "2": 2}
    for name, expected in ARRAYS.items():
        expected = {**expected, **(LAGRANGE if has_budget and name == "witness.npz" else {})}
        data = content(folder / name)
        require(hashlib.sha256(data).hexdigest() == claims["digests"][name], f"{name} changed")
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            require(sorted(archive.namelist()) == sorted(f"{k}.npy" for k in expected), f"{name} has other arrays")
            require(sum(info.file_size for info in archive.infolist()) <= MAX_BYTES, f"{name} is too large")
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            files[name] = {k: arrays[k] for k in expected}
        for k, (kind, shape) in expected.items():
            array, dtype = files[name][k], {"f": np.dtype("<f8"), "i": np.dtype("<i8"), "b": np.dtype(bool)}[kind]
            require(array.dtype == dtype and array.ndim == len(shape), f"{k} is not of its type and dimension")
            require(np.isfinite(array).all(), f"{k} has values that are not finite")
            fits = all(sizes.setdefault(letter, n) == n for letter, n in zip(shape, array.shape, strict=True))
            require(fits, f"{k} has another shape than the other arrays imply")
    return {**files["primitive.npz"], **files["constraints.npz"]}, files["witness.npz"], claims


def numbers(value: Any, shape: tuple[int, ...], what: str, may_be_null: bool = False) -> np.ndarray:
    """Convert nested lists of floats to an array, null to NaN if `may_be_null`; reject other types, even integers."""
    if shape:
        require(type(value) is list and len(value) == shape[0], f"{what} has another shape")
        return np.array([numbers(one, shape[1:], what, may_be_null) for one in value]).reshape(shape)
    require(type(value) is float or (may_be_null and value is None), f"{what} has something other than numbers")
    return np.array(np.nan if value is None else value)


def fields(value: Any, names: tuple[str, ...], what: str) -> Any:
    """Return a value that is a dictionary with exactly these keys; reject any other value."""
    require(type(value) is dict and sorted(value) == sorted(names), f"the fields of {what} are not {', '.join(names)}")
    return value


def solve(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Compute A⁻¹ B of positive definite or lower triangular matrices A (…, n, n) in their precision."""
    M = np.concatenate([A, B], axis=-1)
    for j, rest in enumerate(~np.eye(A.shape[-1], dtype=bool)):
        M[..., j, :] /= M[..., j, j, None].copy()
        M[..., rest, :] -= M[..., rest, j, None] * M[..., None, j, :]
    return M[..., A.shape[-1] :]


def cholesky(A: np.ndarray) -> np.ndarray:
    """Compute the lower Cholesky factor of a positive definite matrix in its precision."""
    L = np.zeros_like(A)
    for j in range(len(A)):
        L[j:, j] = (A[j:, j] - L[j:, :j] @ L[j, :j]) / np.sqrt(A[j, j] - L[j, :j] @ L[j, :j])
    return L


class Primitive:
    """Optimization problem of a primitive (thesis, 4.5) at every step."""

    def __init__(self, p: Arrays, kernel: str):
        self.means, self.covariances, self.G, self.c = p["means"], p["covariances"], p["G"], p["c"]
        (self.steps, self.outputs), self.past, self.horizon = self.means.shape, int(p["history"]), int(p["horizon"])
        self.gains, self.beta, self.hbar = p["gains"], float(p["beta"]), Real(p["lambda"]) + p["beta"]
        valid = [self.steps >= 2, min(self.past, self.horizon) >= 0, self.past + self.horizon < MAX_WINDOW]
        valid += [self.beta >= 0, p["lambda"] >= 0, *(p["start_within"] >= 0)]
        variances, alone = self.covariances.diagonal(0, 1, 2), [p["clock"], p["length_scale"], p["history_variance"]]
        scales, spans = np.hstack([*alone, self.hbar, variances.ravel()]), np.abs(np.hstack([self.beta, self.gains]))
        sizes = np.abs(np.hstack([scales, spans, *(p[k].ravel() for k in ("means", "c", "start", "start_within"))]))
        valid += [(scales >= SMALLEST).all(), (spans[spans != 0] >= SMALLEST).all(), (sizes <= LARGEST).all()]
        require(all(valid), "a parameter is out of range")
        norms = np.linalg.norm(self.G, axis=2)
        is_row = (np.abs(norms - 1) <= 8 * EPS) | (((self.G == 0).all(axis=2)) & (self.c <= 0))
        require(is_row.all(), "rows of constraints are not of unit norm")
        require((self.covariances == self.covariances.transpose(0, 2, 1)).all(), "covariances are not symmetric")
        np.linalg.cholesky(self.covariances)  # raises an error unless they are positive definite
        self.precisions = solve(self.covariances.astype(Real), np.zeros_like(self.covariances) + np.eye(self.outputs))
        # The kernel, which is the same in every window, is conditioned on the history once, with 60 digits.
        n, P, length = self.past + self.horizon + 1, self.past, Decimal(float(p["length_scale"]))
        along = [KERNELS[kernel](k * Decimal(float(p["clock"])), length) for k in range(n)]
        k = np.array(along, dtype=object)[np.abs(np.arange(n)[:, None] - np.arange(n))]
        noise = sum(Decimal(float(p[name])) for name in ("lambda", "beta")) * Decimal(float(p["history_variance"]))
        rounding = 4 * DECIMAL * P**2 / float(noise)  # error of W and C by the least eigenvalue of K + noise I
        require(rounding <= 1e-30, "the variance of the history is too small for its length")
        V = solve(chol := cholesky(k[:P, :P] + np.diag([noise] * P)), k[:P, P:])
        C, N = k[P:, P:] - V.T @ V, n - P
        F, left = self.factor(C)
        self.W, self.F = extended(solve(chol[::-1, ::-1].T, V[::-1])[::-1].T), extended(F)
        self.dropped, scale = float((left + N * rounding) / self.hbar), 1 / np.sqrt(variances)  # ≥ ‖C − F Fᵀ‖ / ħ
        # The same for the executed primitive, which drops pivots of 10 N ε and rounds F to double precision.
        executed = self.dropped + N * (10 * N * EXTENDED + 4 * EPS * float(max(C.diagonal()))) / self.hbar
        require(executed * np.einsum("noo->n", self.precisions).max() <= 1e-5, "λ + β is too small")
        conditions = np.linalg.cond(self.covariances * scale[:, :, None] * scale[:, None])
        require((conditions <= 1e12).all(), "a covariance is too badly conditioned")
        self.covariance_error = 4 * self.outputs * (3 * self.outputs + 1) * EXTENDED * conditions

    def factor(self, C: np.ndarray) -> tuple[np.ndarray, float]:
        """Compute F with F Fᵀ ≈ C by pivoted elimination, and the trace of C − F Fᵀ."""
        left, columns = C.diagonal().copy(), np.zeros((len(C), 0), dtype=object)
        while left[i := int(np.argmax(left))] > Decimal(EXTENDED) * max(C.diagonal()):
            columns = np.column_stack([columns, (C[i] - columns @ columns[i]) / left[i].sqrt()])
            left = left - columns[:, -1] ** 2
            left[i] = 0
        return columns, float(sum(abs(left)))

    def window(self, n: int) -> tuple[Any, ...]:
        """Compute the window's maps of history and action, offset, L with S ≈ L Lᵀ, E, rows, c, and errors.

        |x (S − L Lᵀ) y| ≤ ‖x E‖ ‖y E‖ for all x and y. Two bounds on errors: a function of the history without actions
        (P outs,) and the history's generators (P outs, K), and the error by all actions.
        """
        outs, at = self.outputs, np.minimum(np.arange(n, n + self.horizon + 1), self.steps - 1)
        eye, precision, r = np.eye(outs, dtype=Real), self.precisions[at], self.F.shape[1] * self.outputs
        M = np.einsum("ja,jb,jop->aobp", self.F, self.F, precision).reshape(r, r) + self.hbar * np.eye(r, dtype=Real)
        L = solve(cholesky(M), np.kron(self.F, eye).T).T
        weigh = np.einsum("joa,jop->jpa", L.reshape(len(at), outs, r), precision).reshape(-1, r)
        W, mean = np.kron(self.W, eye), self.means[at].ravel().astype(Real)
        history, action, offset = W - L @ (weigh.T @ W), self.beta * L @ L[:outs].T, L @ (weigh.T @ mean)
        # Cholesky's error depends on the least eigenvalue λ of M with a unit diagonal: 4 r (r + H) ε ‖L‖ ‖Lᵀb‖ / λ.
        root = np.sqrt(M.diagonal())
        least = float(np.linalg.eigvalsh((M / root / root[:, None]).astype(float))[0])
        require(least > 1e-8, f"step {n}: the problem is too badly conditioned")
        share, inverse = 4 * r * (r + len(at)) * EXTENDED / least, self.covariance_error[at].max()
        sizes, weights = np.linalg.norm(L.astype(float), axis=1), np.abs(weigh.T).astype(float)
        precise, spread_W = np.abs(precision).astype(float), np.abs(W).astype(float)
        spread_W += 1e-10 * spread_W.max(initial=0)  # for `rounding`, which is relative to the largest entry of W
        # S − L Lᵀ = ħ B (C − F Fᵀ) (I + X)⁻ᵀ Bᵀ with ħ B = I − L Lᵀ Σ⁻¹ and ‖X‖ ≤ ‖C − F Fᵀ‖ ‖Σ⁻¹‖ / ħ ≤ 1/2
        E = np.sqrt(2 * self.dropped) * (np.eye(len(L)) - L @ weigh.T).astype(float)
        E_sizes = np.linalg.norm(E, axis=1) + 1e-12 * np.linalg.norm(E) * (1 + sizes * np.linalg.norm(weights))
        known = (precision @ np.column_stack([W, mean]).reshape(len(at), outs, -1)).reshape(len(L), -1).astype(float)
        rest, size = 1e-10 * np.linalg.norm(E) * np.linalg.norm(known) * np.eye(known.shape[1]), np.abs(self.gains)
        unknown = np.vstack([E.T @ known, rest])
        by_actions = self.beta * (share * sizes * (sizes[:outs] @ size) + E_sizes * (E_sizes[:outs] @ size))

        def error(past: np.ndarray, reached: np.ndarray) -> np.ndarray:
            values = np.abs(np.column_stack([mean - W @ past, W.astype(float) @ reached.astype(float)])).astype(float)
            weighed = np.einsum("jop,jpk->jok", precise, values.reshape(len(at), outs, -1)).reshape(values.shape)
            pulled, whitened = np.linalg.norm(weights @ values, axis=0), np.sqrt((values * weighed).sum(axis=0))
            whole = (np.abs(past) + np.abs(reached).sum(axis=1)).astype(float)
            noise = 4 * (r + self.past + 4) * EXTENDED * (spread_W @ whole + np.abs(mean).astype(float))
            noise += EPS * self.past * (spread_W @ np.abs(reached).astype(float)).sum(axis=1) * share  # by `values`
            state = np.vstack([np.column_stack([-past, reached]), np.eye(1, 1 + reached.shape[1])]).astype(float)
            rounded = share * pulled.sum() + inverse * whitened.sum() + np.linalg.norm(weights @ noise)
            return sizes * rounded + noise + E_sizes * np.linalg.norm(unknown @ state, axis=0).sum() + UNDERFLOW

        rows = np.einsum("jfo,jk->jfko", self.G[at], np.eye(len(at))).reshape(-1, len(at) * outs)
        return history, action, offset, L.astype(float), E, rows, self.c[at].ravel(), error, by_actions

    def caps(self) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds (N, outs) by the constraints on a single output, widened by `COMMAND_TOLERANCE`."""
        alone = ((self.G != 0).sum(axis=2) == 1)[..., None]
        cap = self.c[..., None] / np.where(self.G == 0, 1, self.G)
        least = np.where(alone & (self.G > 0), cap, -np.inf).max(axis=1, initial=-np.inf)
        most = np.where(alone & (self.G < 0), cap, np.inf).min(axis=1, initial=np.inf)
        return least - COMMAND_TOLERANCE, most + COMMAND_TOLERANCE

    def reach(self, p: Arrays, witness: Arrays) -> tuple[np.ndarray, ...]:
        """Compute the commands that are reached without active constraints, and bounds where one can be active.

        Returns: centers (2 + N, outs) and generators (2 + N, outs, B) of commands, the first two at rest at the start,
        bounds (2 + N, outs) of their errors, bounds (2, N, outs) of corrected commands or NaN, and maps of histories.
        """
        P, N, outs = self.past, self.steps, self.outputs
        moved, claimed = np.flatnonzero(p["gains"]), witness["active"]
        A, R = len(moved), max(P, 2)  # number of actions, and of commands at rest before the first
        middle, spread = (np.zeros((R + N, outs, *n), dtype=Real) for n in ((), (N * A + outs,)))
        middle[:R], spread[:R, :, N * A :] = p["start"], np.diag(p["start_within"])
        corrected, maps = np.full((2, N, outs), np.nan), np.zeros((N, outs, P * outs), dtype=Real)
        echo = np.zeros((R + N, outs, N * outs))
        errors, added = np.zeros((R + N, outs)), np.zeros(N * outs)  # errors of commands, and errors added at each step
        require(claimed.sum() == len(witness["multipliers"]) or P > 0, "there are not multipliers for each active step")
        for n in range(N):
            history, action, offset, L, E, rows, c, error, by_actions = self.window(n)
            row, before = R + n, slice(R + n - P, R + n)
            past, reached = middle[before].ravel(), spread[before].reshape(P * outs, N * A + outs)
            by, size = (action[:, moved] * p["gains"][moved]).astype(float), np.abs(reached).astype(float).sum(axis=1)
            maps[n], y, first = history[:outs], history @ past + offset, history[:outs] @ reached
            first[:, n * A : (n + 1) * A] += by[:outs]
            H, bound = np.abs(history).astype(float), error(past, reached) + by_actions + EPS * np.abs(by).sum(axis=1)
            # An error at one step propagates to later steps by the impulse responses of the loop.
            earlier = echo[before, :, : n * outs].reshape(P * outs, n * outs)
            echo[row, :, : n * outs] = history[:outs].astype(float) @ earlier
            echo[row, np.arange(outs), np.arange(n * outs, (n + 1) * outs)] = 1
            added[n * outs : (n + 1) * outs] = 2 * bound[:outs]
            middle[row], spread[row], errors[row] = y[:outs], first, np.abs(echo[row]) @ added
            # The rest of the window is computed in double precision.
            history, y = history.astype(float), y.astype(float)
            g = history @ reached.astype(float)
            g[:, n * A : (n + 1) * A] += by
            terms = np.abs(y) + np.abs(g).sum(axis=1)
            bound += H @ errors[before].ravel() + (P * outs + 4) * EPS * (H @ size) + (N * A + outs) * EPS * terms
            center, reach = rows @ y - c, np.abs(rows @ g).sum(axis=1)
            slack, scale = center - reach, np.abs(center) + reach
            room = np.abs(rows) @ bound + 4 * (N * A + outs) * EPS * (np.abs(rows) @ terms + np.abs(c))
            require(claimed[n] or (slack >= room).all(), f"step {n}: a constraint can be active there")
            require(not claimed[n] or (slack <= room + BORDER * scale).any(), f"step {n}: no constraint can be active")
            if claimed[n] and P == 0:
                alphas = witness["multipliers"][claimed[:n].sum()]
                corrected[:, n] = cells(n, y, by, (L[:outs], E[:outs]), (rows @ L, rows @ E, rows, c, room), alphas)
                require(not np.isnan(corrected[:, n]).any(), f"step {n}: the multipliers are too large")
        if P:
            require(witness["multipliers"].size == 0, "multipliers prove nothing with a history")
            tied, reached = (p["covariances"] != 0).any(axis=0), (p["G"] != 0).any(axis=(0, 1))
            reached = np.linalg.matrix_power(tied + np.eye(outs), outs) @ reached > 0
            corrected[:, np.logical_or.accumulate(claimed)[:, None] & reached] = [[-np.inf], [np.inf]]
        return middle[R - 2 :], spread[R - 2 :], errors[R - 2 :], corrected, maps

    def bounds(self, p: Arrays, reached: tuple[np.ndarray, ...], period: Any) -> dict[str, Arrays]:
        """Compute the quantities (N, outs) of the regimes "free" and "always"."""
        (middle, spread, error, corrected, _), N = reached, self.steps
        error = error + 4 * spread.shape[2] * EXTENDED * (np.abs(middle) + np.abs(spread).sum(axis=2))
        size, is_corrected, (least, greatest) = np.abs(spread).sum(axis=2) + error, ~np.isnan(corrected[0]), self.caps()
        free = {"lower": (middle - size)[2:], "upper": (middle + size)[2:]}
        for order, name in ((1, "speed"), (2, "acceleration")):
            change = np.abs(np.diff(middle, order, axis=0)) + np.abs(np.diff(spread, order, axis=0)).sum(axis=2)
            for k, times in enumerate(((1, 1), (1, 2, 1))[order - 1]):
                change += times * error[k : len(error) - order + k]
            free[name] = change[-N:] / period**order * (1 + 8 * EXTENDED)
        low = np.where(is_corrected, np.maximum(corrected[0] - error[2:], least), free["lower"])
        high = np.where(is_corrected, np.minimum(corrected[1] + error[2:], greatest), free["upper"])
        always = {"lower": low, "upper": high}
        low, high = (y + s * 16 * EXTENDED * np.abs(y) for s, y in ((-1, low), (1, high)))
        low, high = np.vstack([(middle - size)[:2], low]), np.vstack([(middle + size)[:2], high])
        is_corrected = np.pad(is_corrected, ((2, 0), (0, 0)))
        near = [is_corrected[1:-1] | is_corrected[2:], is_corrected[:-2] | is_corrected[1:-1] | is_corrected[2:]]
        steps = np.maximum(high[2:] - low[1:-1], high[1:-1] - low[2:])
        bends = np.maximum(high[2:] - 2 * low[1:-1] + high[:-2], 2 * high[1:-1] - low[2:] - low[:-2])
        for order, (name, new) in enumerate((("speed", steps), ("acceleration", bends))):
            always[name] = np.where(near[order], new / period ** (order + 1) * (1 + 8 * EXTENDED), free[name])
        return {"free": free, "always": always}

    def budgeted(self, p: Arrays, w: Arrays, budgets: list[np.ndarray], reached: Any, period: Any) -> Arrays:
        """Compute the quantities (N, outs) of the regime "budgeted"; any multipliers prove valid bounds."""
        (middle, spread, errors, _, maps), P, N, outs = reached, self.past, self.steps, self.outputs
        first, U = int(np.argmax(w["active"])), np.flatnonzero(p["gains"] == 0)
        A, steps_left, residues = outs - len(U), N - first, np.zeros((P + N, outs, (N - first) * len(U)), dtype=Real)
        (at, of, alphas), (low, high) = (w[f"lagrange_{k}"] for k in ("steps", "outputs", "multipliers")), self.caps()
        valid = [at >= 0, at < N, of >= 0, of < outs, P > 0, w["active"].any(), budgets[1][:, p["gains"] != 0] == 0]
        valid += [*(budget[1] >= budget[0] for budget in budgets), budgets[0][0] >= 0.01, budgets[1][0] >= 0]
        require(all(np.all(each) for each in valid), "invalid budgets or multipliers")
        budgets = [budgets[0], budgets[1][:, U]]
        for n in range(first, N):
            residues[P + n] = maps[n] @ residues[n : P + n].reshape(P * outs, residues.shape[2])
            residues[P + n, U, (n - first) * len(U) + np.arange(len(U))] = 1
        residues, most = np.pad(residues[P:], ((2, 0), (0, 0), (0, 0))), np.zeros((3, 2, N, outs))
        changes = [np.diff(np.concatenate([spread, residues], axis=2), k, axis=0).astype(float) for k in range(3)]
        moved, sizes = [np.diff(middle, order, axis=0) for order in range(3)], np.abs(changes[0]).sum(axis=2)
        for order, side, n in itertools.product(range(3), range(2), range(first, N)):
            k, o, alpha = at[order, side, n], of[order, side, n], alphas[order, side, n]
            sign, row = 1 - 2 * side, 2 + n - order
            g = sign * changes[order][row] - np.einsum("or,orc->oc", alpha, changes[0][2 + k, o])
            margin = np.where(alpha > 0, high[k, o], low[k, o]) - middle[2 + k, o]
            value = sign * moved[order][row] + np.abs(g[:, : N * A + outs]).sum(axis=1)
            value += (alpha * np.where(alpha == 0, 0, margin)).sum(axis=1)
            value += errors[row : n + 3].sum(axis=0) * (1, 1, 2)[order] + (np.abs(alpha) * errors[2 + k, o]).sum(axis=1)
            terms = np.abs(changes[order][row]).sum(axis=1) + (np.abs(alpha) * sizes[2 + k, o]).sum(axis=1)
            value += 8 * g.shape[1] * EPS * terms
            for part, budget in zip((g[:, first * A : N * A], g[:, N * A + outs :]), budgets, strict=True):
                spent = np.clip(budget[1] - np.arange(steps_left)[:, None] * budget[0], 0, budget[0])
                value += (np.sort(np.abs(part).reshape(outs, steps_left, -1), axis=1)[:, ::-1] * spent).sum(axis=(1, 2))
            most[order, side, n] = value
        moves = [most[order].max(axis=0) / period**order * (1 + 8 * EPS) for order in (1, 2)]
        return dict(zip(QUANTITIES, (np.maximum(-most[0, 1], low), np.minimum(most[0, 0], high), *moves), strict=True))


def cells(n: int, y: np.ndarray, by: np.ndarray, factors: Any, limits: Any, alphas: np.ndarray) -> tuple[Any, Any]:
    """Bound the commands of step n by ‖v − v̄‖² ≤ ‖v̄‖² − ‖v‖²; v̄ interpolates the corrections v of a cell's corners."""
    L, (rows_L, rows_E, rows, c, room), alphas = factors[0], limits, alphas.reshape(len(alphas), -1)
    outs, A, norms = len(L), by.shape[1], np.hypot(*(np.linalg.norm(factor, axis=1) for factor in factors))
    along = round(len(alphas) ** (1 / max(A, 1))) - 1
    is_complete = along >= 1 and (along + 1) ** A == len(alphas) and (alphas >= 0).all() and alphas.shape[1] == len(c)
    require(is_complete, f"step {n}: these are not the multipliers of every corner of the actions")
    nodes = np.array(list(itertools.product(range(along + 1), repeat=A)))
    free = y + (2.0 * nodes / along - 1.0) @ by.T
    v, short = alphas @ rows_L, c - free @ rows.T
    # If the corrections at corners are feasible in spite of rounding, their interpolation is feasible in the cell.
    margins = room + 8 * len(c) * EPS * (np.abs(alphas) @ (np.abs(rows_L) @ np.abs(rows_L).T))
    require((v @ rows_L.T - short >= margins).all(), f"step {n}: a correction violates a constraint")
    least = alphas @ short.T - alphas @ room[:, None] - 8 * len(c) * EPS * alphas @ np.abs(short).T
    weights = (along + 1) ** np.arange(A)[::-1]
    near = np.array(list(itertools.product((0, 1), repeat=A))) @ weights
    i = (nodes[(nodes < along).all(axis=1)] @ weights)[:, None] + near  # corners of every cell
    squared, apart = (v[i] ** 2).sum(axis=2), ((v[i][:, :, None] - v[i][:, None]) ** 2).sum(axis=3)
    dual = least[i[:, :, None], i[:, None]]
    norm = np.sqrt(squared + ((alphas @ rows_E) ** 2).sum(axis=1)[i])
    d = dual * (dual >= 0).all(axis=2, keepdims=True) / np.maximum(norm, 1e-300)[..., None]
    between = ((d[..., None] - d[..., None, :]) ** 2 - apart[:, None]).max(axis=(2, 3))
    radii = (squared[:, None] - d**2).max(axis=2) + np.maximum(between, 0) / 2
    radius = np.sqrt(np.maximum(radii.min(axis=1), ROUNDING * squared.max(axis=1)))[:, None] * norms
    terms = np.abs(y[:outs]) + np.abs(by[:outs]).sum(axis=1) + np.abs(v) @ np.abs(L).T
    low, high = (free[:, :outs] + v @ L.T + side * 4 * (L.shape[1] + A + 4) * EPS * terms for side in (-1, 1))
    return (low[i].min(axis=1) - radius).min(axis=0), (high[i].max(axis=1) + radius).max(axis=0)


def compare(claims: dict[str, Arrays], computed: dict[str, Arrays]) -> None:
    """Reject a claim that is tighter than the computed quantity or much wider; the reason names the worst step."""
    for regime, name in itertools.product(computed, QUANTITIES):
        own, claimed, sign = computed[regime][name], claims[regime][name], -1.0 if name == "lower" else 1.0
        require(not np.isnan(own).any(), f"{regime} {name} has no value: numbers are too large")
        require((np.isnan(claimed) == np.isinf(own)).all(), f"{regime} {name} has other unbounded entries")
        own = np.where(np.isinf(own), np.nan, own)
        room = AGREEMENT * np.maximum(np.nan_to_num(np.abs(own)).max(axis=0), 1e-9)
        for excess, word in ((sign * (own - claimed), "tighter"), (sign * (claimed - own) - room, "wider")):
            n, o = np.unravel_index(int(np.nan_to_num(excess, nan=-np.inf).argmax()), excess.shape)
            is_valid, values = not excess[n, o] > 0, f"{own[n, o]:.6g}, and claimed {word}: {claimed[n, o]:.6g}"
            require(is_valid, f"step {n}: {regime} {name} of output {o} is {values}")


def check_forces(impedance: Any, computed: dict[str, Arrays], outputs: int) -> None:
    """Reject forces that do not follow from `impedance` and from `computed` bounds."""
    fields(impedance, ("stiffness", "limits", "contact_stiffness", "force", "rest_force", "impacts"), "impedance")
    stiffness, limits = (numbers(impedance[k], (outputs,), k) for k in ("stiffness", "limits"))
    contact = numbers(impedance["contact_stiffness"], (), "contact_stiffness")
    require(all(SMALLEST <= x <= LARGEST for x in (*stiffness, *limits, contact or 1.0)), "impedance is out of range")
    force, impacts = np.linalg.norm(limits[:3]), numbers(impedance["impacts"], (4 if contact else 0,), "impacts")
    claims: dict[str, Any] = {f"impact {n}": (force * PEAKS[n], impact) for n, impact in enumerate(impacts)}
    claims["force"] = force, numbers(impedance["force"], (), "force")
    at_rest = fields(impedance["rest_force"], tuple(regime for regime in computed if regime != "free"), "rest_force")
    for regime, claim in at_rest.items():
        most = stiffness * (computed[regime]["upper"].max(axis=0) - computed[regime]["lower"].min(axis=0))
        claims[f"{regime} rest"] = np.linalg.norm(np.minimum(limits, most)[:3]), numbers(claim, (), "rest_force")
    for name, (own, claim) in claims.items():
        require(own <= claim <= own * (1 + 4 * AGREEMENT), f"{name} is {own:.6g} N, not {claim:.6g} N")


def check(folder: Path, key: bytes | None = None) -> dict[str, Any]:
    """Return the claims of a valid certificate, signed with the key if one is given; otherwise raise `Rejected`."""
    p, witness, claims = read(folder, key)
    require(claims["format"] == "guiderail certificate 7", "wrong format")
    require(type(claims["kernel"]) is str and claims["kernel"] in KERNELS, f"the kernel is none of {list(KERNELS)}")
    require(type(claims["about"]) is dict and "task" in claims["about"], "the certificate does not name its task")
    period = Real(numbers(claims["period"], (), "period"))
    require(SMALLEST <= period <= LARGEST, "the period is out of range")
    is_stated = True, claims["budgeted"] is not None, abs(period - p["clock"]) > 1e-6 * p["clock"]
    sentences = claims["assumes"]
    require(type(sentences) is list and all(type(each) is str for each in sentences), "assumes is not a list of texts")
    digests = [hashlib.sha256(text.encode()).hexdigest()[:32] for text in ("\n".join(sentences[:7]), *sentences[7:])]
    require(digests == list(itertools.compress(ASSUMED, is_stated)), "it does not state the required assumptions")
    (steps, outputs), A = p["means"].shape, int((p["gains"] != 0).sum())
    claimed = {}
    for regime in ("free", "always", *(["budgeted"] if claims["budgeted"] is not None else [])):
        values = fields(claims[regime], QUANTITIES + BUDGETS * (regime == "budgeted"), regime)
        claimed[regime] = {k: numbers(values[k], (steps, outputs), f"{regime} {k}", True) for k in QUANTITIES}
    primitive = Primitive(p, claims["kernel"])
    computed = primitive.bounds(p, reached := primitive.reach(p, witness), period)
    if claims["budgeted"] is not None:
        budgets = [numbers(claims["budgeted"][k], (2, n), k) for k, n in zip(BUDGETS, (A, outputs), strict=True)]
        third = primitive.budgeted(p, witness, budgets, reached, period)
        before = np.cumsum(witness["active"])[:, None] == 0
        computed["budgeted"] = {name: np.where(before, computed["free"][name], third[name]) for name in QUANTITIES}
    compare(claimed, computed)
    if claims["impedance"] is not None:
        check_forces(claims["impedance"], computed, outputs)
    return claims


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        print("usage: python checker.py FOLDER [KEY_FILE]")
        sys.exit(2)
    try:
        check(Path(sys.argv[1]), content(Path(sys.argv[2])) if len(sys.argv) > 2 else None)
        print("yes")
    except Exception as reason:  # files may hold anything
        print("no:", reason if isinstance(reason, Rejected) else f"the files make no sense, {reason!r}")
        sys.exit(1 if isinstance(reason, Rejected) else 2)
