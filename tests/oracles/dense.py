"""Problem 4.5 the textbook way, in extended precision, sharing nothing with the implementation.

Every matrix is formed as the equations print it (errata of equations 4.7 and 4.17 mended), and factored by a plain
Cholesky in `longdouble`: slow, and good to about 1e-19 times the condition number.
"""

import numpy as np

Extended = np.longdouble


def cholesky_solve(A, B):
    """A⁻¹ B for symmetric positive definite A, in A's precision."""
    n = len(A)
    L = np.zeros_like(A)
    for j in range(n):
        L[j:, j] = A[j:, j] - L[j:, :j] @ L[j, :j]
        L[j:, j] /= np.sqrt(L[j, j])
    X = np.array(B, dtype=A.dtype)
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


class DenseWindow:
    """One window of one problem.

    Attributes:
        y: (N·O,), equation 4.18's free window (history first); S: K A Σ.
        first: where the executed point starts.
    """

    def __init__(
        self,
        kernel,
        inverse_length,
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
        k = kernel(inverse_length, t)
        K = np.kron(k, np.eye(o, dtype=precision))
        sigma = block_diagonal(np.asarray(covariances, dtype=precision))
        hbar = precision(lambda_ + beta)
        e = slice(executed * o, (executed + 1) * o)
        A_mu_K = cholesky_solve(K + hbar * sigma, np.column_stack([mu.ravel(), K]))
        A_mu, A_K = A_mu_K[:, 0], A_mu_K[:, 1:]
        xi = np.asarray(action, dtype=precision)
        if at is not None:
            # K̲⁻¹ ξ̂ of all actions together, put where they are: the columns of K̂ follow.
            among = np.kron(k[np.ix_(at, at)], np.eye(o, dtype=precision))
            e = np.concatenate([np.arange(i * o, (i + 1) * o) for i in at]).astype(int)
            xi = cholesky_solve(among, xi.reshape(-1, 1))[:, 0]
        # (β/ħ)(K̂ − K A K̂) ξ̂: the printed form, not the cancellation-free one.
        self.y = K @ A_mu + precision(beta) * (sigma @ (A_K[:, e] @ xi))
        S = A_K.T @ sigma
        self.S = (S + S.T) / 2
        self.first, self.outputs = executed, o

    def corrected(self, G, alpha):
        """y + S Ḡ α, for constraints on the points from the executed one on, (H+1, O)."""
        o, start = self.outputs, self.first * self.outputs
        push = np.einsum("nfo,nf->no", np.asarray(G, Extended), np.asarray(alpha, Extended)).ravel()
        full = np.zeros(len(self.y), dtype=self.y.dtype)
        full[start:] = push
        return (self.y + self.S @ full)[start:].reshape(-1, o)


def squared_exponential(inverse_length, t):
    return np.exp(-t.dtype.type(inverse_length) * (t[:, None] - t[None, :]) ** 2)
