"""Dense reference solution of problem 4.5 in extended precision, independent of the implementation.

Matrices are formed as in the equations (with the errata of equations 4.7 and 4.17) and factored by a Cholesky
decomposition in `longdouble`. The solution is slow, with an error of about 1e-19 times the condition number.
"""

from functools import cached_property

import numpy as np

Extended = np.longdouble


def cholesky(A):
    """Compute the lower Cholesky factor of a symmetric positive definite matrix A in the precision of A."""
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
    """Return the matrix (N·O, N·O) with the diagonal blocks (N, O, O)."""
    n, o = blocks.shape[:2]
    D = np.zeros((n * o, n * o), dtype=blocks.dtype)
    for i in range(n):
        D[i * o : (i + 1) * o, i * o : (i + 1) * o] = blocks[i]
    return D


def cholesky_solve(A, B):
    """Compute A⁻¹ B for a symmetric positive definite matrix A in the precision of A."""
    return solve(cholesky(A), B)


class DenseWindow:
    """Dense solution of problem 4.5 in one window.

    Attributes:
        y: Outputs of equation 4.18 without constraints (N·O,), history first.
        S: Matrix K A Σ (N·O, N·O), computed at the first use.
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
        """Solve the window without constraints; `at` (J,) indexes the inputs with actions (default: executed)."""
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
            # K̲⁻¹ ξ̂ with the kernel K̲ between the inputs with actions; K̂ has the columns of K at these inputs.
            K_actions = np.kron(k[np.ix_(at, at)], np.eye(o, dtype=precision))
            e = np.concatenate([np.arange(i * o, (i + 1) * o) for i in at]).astype(int)
            xi = cholesky_solve(K_actions, xi.reshape(-1, 1))[:, 0]
        # The term of the actions is (β/ħ)(K̂ − K A K̂) ξ̂ = β Σ A K̂ ξ̂, which has no cancellation.
        A_mu_K = solve(self._L, np.column_stack([mu.ravel(), K[:, e]]))
        self.y = K @ A_mu_K[:, 0] + precision(beta) * (sigma @ (A_mu_K[:, 1:] @ xi))
        self.executed, self.outputs = executed, o

    @cached_property
    def S(self):
        A_K, o = solve(self._L, self._K), self.outputs
        # Multiply block by block, because Σ is block-diagonal.
        S = np.hstack([A_K[i * o : (i + 1) * o].T @ block for i, block in enumerate(self._blocks)])
        return (S + S.T) / 2

    def corrected(self, G, alpha):
        """Compute y + S Ḡ α (H+1, O) with constraints on the executed point and the points after it."""
        o, start = self.outputs, self.executed * self.outputs
        G_alpha = np.zeros(len(self.y), dtype=self.y.dtype)
        G_alpha[start:] = np.einsum("nfo,nf->no", np.asarray(G, Extended), np.asarray(alpha, Extended)).ravel()
        outputs = self.y + self.S @ G_alpha if G_alpha.any() else self.y
        return outputs[start:].reshape(-1, o)


def squared_exponential(length_scale, t):
    return np.exp(-t.dtype.type(0.5 / length_scale**2) * (t[:, None] - t[None, :]) ** 2)
