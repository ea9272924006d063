"""Problem 4.5 the textbook way, in extended precision, sharing nothing with the implementation.

Every matrix is formed as the equations print it (errata of equations 4.7 and 4.17 mended), and factored by a plain
Cholesky in `longdouble`: slow, and good to about 1e-19 times the condition number.
"""

from functools import cached_property

import numpy as np

Extended = np.longdouble


def cholesky(A):
    """The lower factor of symmetric positive definite A, in its precision."""
    n = len(A)
    L = np.zeros_like(A)
    for j in range(n):
        L[j:, j] = A[j:, j] - L[j:, :j] @ L[j, :j]
        L[j:, j] /= np.sqrt(L[j, j])
    return L


def solve(L, B):
    """A⁻¹ B for A = L Lᵀ."""
    n = len(L)
    X = np.array(B, dtype=L.dtype)
    for j in range(n):
        X[j] = (X[j] - L[j, :j] @ X[:j]) / L[j, j]
    for j in range(n - 1, -1, -1):
        X[j] = (X[j] - L[j + 1 :, j] @ X[j + 1 :]) / L[j, j]
    return X


def block_diagonal(blocks):
    n, o = blocks.shape[:2]
    D = np.zeros((n * o, n * o), dtype=blocks.dtype)
    for i in range(n):
        D[i * o : (i + 1) * o, i * o : (i + 1) * o] = blocks[i]
    return D


def cholesky_solve(A, B):
    """A⁻¹ B for symmetric positive definite A, in A's precision."""
    return solve(cholesky(A), B)


class DenseWindow:
    """One window of one problem.

    Attributes:
        y: (N·O,), equation 4.18's free window (history first); S: K A Σ, formed where a constraint pushes.
        first: where the executed point starts.
    """

    def __init__(
        self,
        kernel,
        length_scale,
        inputs,
        means,
        covariances,
        executed,
        lambda_,
        beta,
        action,
        precision=Extended,
        at=None,
    ):
        """`at`: where the actions are, (J,) indices of the inputs; at the executed point alone unless given."""
        t = np.asarray(inputs, dtype=precision)
        mu = np.asarray(means, dtype=precision)
        o = mu.shape[1]
        k = kernel(length_scale, t)
        K = np.kron(k, np.eye(o, dtype=precision))
        self._K, self._blocks = K, np.asarray(covariances, dtype=precision)
        sigma = block_diagonal(self._blocks)
        hbar = precision(lambda_ + beta)
        e = slice(executed * o, (executed + 1) * o)
        self._L = cholesky(K + hbar * sigma)
        xi = np.asarray(action, dtype=precision)
        if at is not None:
            # K̲⁻¹ ξ̂ of all actions together, put where they are: the columns of K̂ follow.
            among = np.kron(k[np.ix_(at, at)], np.eye(o, dtype=precision))
            e = np.concatenate([np.arange(i * o, (i + 1) * o) for i in at]).astype(int)
            xi = cholesky_solve(among, xi.reshape(-1, 1))[:, 0]
        # (β/ħ)(K̂ − K A K̂) ξ̂: the printed form, not the cancellation-free one.
        A_mu_K = solve(self._L, np.column_stack([mu.ravel(), K[:, e]]))
        self.y = K @ A_mu_K[:, 0] + precision(beta) * (sigma @ (A_mu_K[:, 1:] @ xi))
        self.first, self.outputs = executed, o

    @cached_property
    def S(self):
        A_K, o = solve(self._L, self._K), self.outputs
        # Block by block: what Σ is zero at is nothing to add up.
        S = np.hstack([A_K[i * o : (i + 1) * o].T @ block for i, block in enumerate(self._blocks)])
        return (S + S.T) / 2

    def corrected(self, G, alpha):
        """y + S Ḡ α, for constraints on the points from the executed one on, (H+1, O)."""
        o, start = self.outputs, self.first * self.outputs
        push = np.einsum("nfo,nf->no", np.asarray(G, Extended), np.asarray(alpha, Extended)).ravel()
        full = np.zeros(len(self.y), dtype=self.y.dtype)
        full[start:] = push
        pushed = self.y + self.S @ full if full.any() else self.y
        return pushed[start:].reshape(-1, o)


def squared_exponential(length_scale, t):
    return np.exp(-t.dtype.type(0.5 / length_scale**2) * (t[:, None] - t[None, :]) ** 2)
