"""Slow, naive oracles for suspnet.learning: loops, dense matrices and other people's optimisers."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import optimize, stats

from suspnet.learning.feature_maps import FeatureMap


@dataclass(frozen=True)
class Mapped(FeatureMap):
    """The features that a function returns."""

    function: Callable

    def __call__(self, X):
        return self.function(X)


def naive_loss(u, epsilon):
    """Eq. (8) for one number."""
    return 0.0 if u < epsilon else (u - epsilon) ** 2


def naive_msvr_objective(Phi, Y, W, b, C, epsilon):
    """Eq. (7), sample by sample."""
    total = 0.5 * sum(w * w for w in np.ravel(W))
    for phi, y in zip(Phi, Y, strict=True):
        residual = [y[j] - sum(phi * W[:, j]) - b[j] for j in range(len(y))]
        total += C * naive_loss(math.sqrt(sum(r * r for r in residual)), epsilon)
    return total


def naive_msvr_weights(Phi, Y, W, b, C, epsilon):
    """Eq. (10), sample by sample: a_i = C L'(u_i) / u_i."""
    norms = [math.sqrt(sum(r * r for r in y - phi @ W - b)) for phi, y in zip(Phi, Y, strict=True)]
    limit = 2 * C if epsilon == 0 else 0.0
    return np.array([C * 2 * (u - epsilon) / u if u > epsilon else limit for u in norms])


def naive_lower_bound(Phi, Y, W, b, dW, db, C, epsilon, fit_intercept):
    """F + q(d) - |r|^2 / 2, b eliminated, from dense matrices; what irwls proves F to exceed."""
    a = naive_msvr_weights(Phi, Y, W, b, C, epsilon)
    residual = Y - Phi @ W - b
    if fit_intercept and a.sum() > 0:
        # The best db for this dW: the weighted mean of what is left vanishes.
        db = a @ (residual - Phi @ dW) / a.sum()
    left = residual - Phi @ dW - db
    # L(u) >= L(u_0) + L'(u_0) (u^2 - u_0^2) / (2 u_0), which is C times it for every sample.
    norms = np.linalg.norm(residual, axis=1)
    touching = C * np.maximum(norms - epsilon, 0) ** 2 - 0.5 * a * norms**2
    value = 0.5 * ((W + dW) ** 2).sum() + (touching + 0.5 * a * (left**2).sum(axis=1)).sum()
    remaining = W + dW - Phi.T @ (a[:, None] * left)
    return value - 0.5 * (remaining**2).sum()


def naive_rbf(X, Z, sigma):
    """exp(-|x - z|^2 / sigma^2), pair by pair, from the differences."""
    return np.array([[math.exp(-sum((x - z) ** 2) / sigma**2) for z in Z] for x in X])


def lbfgs_msvr(Phi, Y, C, epsilon, fit_intercept=False):
    """Minimise Eq. (7) by scipy's L-BFGS-B; (W, b, minimum)."""
    n_features, n_outputs = Phi.shape[1], Y.shape[1]
    # Only a change of variables (W = T V): it makes the quadratic part round, so that a general
    # optimiser gets to the optimum.
    values, vectors = np.linalg.eigh(np.eye(n_features) + 2 * C * Phi.T @ Phi)
    T = vectors / np.sqrt(values)
    offset_scale = 1 / math.sqrt(2 * C * len(Phi))

    def objective(theta):
        V = theta[: n_features * n_outputs].reshape(n_features, n_outputs)
        W = T @ V
        b = theta[n_features * n_outputs :] * offset_scale if fit_intercept else 0.0
        R = Y - Phi @ W - b
        u = np.sqrt((R**2).sum(axis=1))
        over = np.maximum(u - epsilon, 0)
        slope = -2 * C * (over / np.where(u > 0, u, 1))[:, None] * R  # dF / d(fitted values)
        gradient = [(T.T @ (W + Phi.T @ slope)).ravel()]
        if fit_intercept:
            gradient.append(slope.sum(axis=0) * offset_scale)
        return 0.5 * (W**2).sum() + C * (over**2).sum(), np.concatenate(gradient)

    start = np.zeros(n_features * n_outputs + (n_outputs if fit_intercept else 0))
    found = optimize.minimize(
        objective,
        start,
        jac=True,
        method="L-BFGS-B",
        options={"maxiter": 20000, "maxfun": 50000, "ftol": 1e-15, "gtol": 1e-10, "maxcor": 30},
    )
    W = T @ found.x[: n_features * n_outputs].reshape(n_features, n_outputs)
    b = found.x[n_features * n_outputs :] * offset_scale if fit_intercept else np.zeros(n_outputs)
    return W, b, float(found.fun)


def matrix_normal_logpdf(Y, K, Omega):
    """Log density of vec(Y) ~ N(0, Omega x K), columns stacked."""
    covariance = np.kron(Omega, K)
    return stats.multivariate_normal(np.zeros(Y.size), covariance).logpdf(Y.T.ravel())


def draw_matrix_normal(rng, K, Omega):
    """One Y with vec(Y) ~ N(0, Omega x K)."""
    normal = rng.standard_normal((len(K), len(Omega)))
    return np.linalg.cholesky(K) @ normal @ np.linalg.cholesky(Omega).T


def smooth_data(seed, n_samples=150, n_inputs=2, noise=0.05):
    """Two smooth noisy outputs of scattered inputs, of order 1 and not centred."""
    rng = np.random.default_rng(seed)
    X = rng.uniform(-2, 2, (n_samples, n_inputs))
    clean = np.column_stack(
        [np.sin(2 * X[:, 0]) + 0.5 * X[:, -1], 0.7 * np.cos(X.sum(axis=1)) + 0.3]
    )
    return X, clean + noise * rng.standard_normal(clean.shape)
