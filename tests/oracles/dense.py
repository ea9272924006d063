"""Dense reference solution of problem 4.5 in extended precision, independent of the implementation.

Every matrix is formed as in the equations (with the errata of equations 4.7 and 4.17), and factored by a Cholesky
decomposition in `longdouble`: slow, and accurate to about 1e-19 times the condition number.
"""

from functools import cached_property

import numpy as np

Extended = np.longdouble


def cholesky(A):
    """Compute the lower factor of a symmetric positive definite A in its precision."""
    n = len(A)
    L = np.zeros_like(A)
    for j in range(n):
        L[j:, j] = A[j:, j] - L[j:, :j] @ L[j, :j]
        L[j:, j] /= np.sqrt(L[j, j])
    return L


def solve(L, B):
    """Compute A⁻¹ B for A = L Lᵀ."""
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
    """Compute A⁻¹ B for a symmetric positive definite A in its precision."""
    return solve(cholesky(A), B)


class DenseWindow:
    """Dense solution of one window of one problem.

    Attributes:
        y: Window of equation 4.18 without constraints (N·O,), history first.
        S: K A Σ, computed if a constraint is active.
        first: Index of the executed point's first output.
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
        """Solve the window; `at` are the indices (J,) of the inputs with actions, the executed point by default."""
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
        """Compute y + S Ḡ α (H+1, O), for constraints on the executed point and those after it."""
        o, start = self.outputs, self.first * self.outputs
        push = np.einsum("nfo,nf->no", np.asarray(G, Extended), np.asarray(alpha, Extended)).ravel()
        full = np.zeros(len(self.y), dtype=self.y.dtype)
        full[start:] = push
        pushed = self.y + self.S @ full if full.any() else self.y
        return pushed[start:].reshape(-1, o)


def squared_exponential(length_scale, t):
    return np.exp(-t.dtype.type(0.5 / length_scale**2) * (t[:, None] - t[None, :]) ** 2)
