"""Multivariate Gaussian process regression (Chen, Wang and Gorban, 2020), the paper's MV-GPR."""

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.optimize import minimize
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils import check_random_state
from torch import Tensor

from suspnet.ground.settings import setting
from suspnet.ground.tensors import as_tensor, check_device
from suspnet.ground.types import FloatArray
from suspnet.learning.design import cholesky
from suspnet.learning.feature_maps import rbf_kernel, squared_distances
from suspnet.learning.regressor import Regressor, arrays_of

START_RANGES = {"length_scale": (1e-2, 10.0), "noise_to_signal": (1e-6, 1e-1)}
"""Ranges of Table V, from which the random starts are drawn."""
BOUNDS = {"length_scale": (1e-3, 1e3), "noise_to_signal": (1e-8, 1e2)}  # bounds of the optimiser
PREDICT_ROWS = 1024  # rows predicted at once, so that their kernel fits into memory


def log_marginal_likelihood(Y: Tensor, factor: Tensor) -> tuple[Tensor, Tensor]:
    """Return the log density of Y ~ MN(0, K', Omega) at the most likely Omega, and that Omega.

    log p = -n Q/2 log(2 pi) - Q/2 log|K'| - n/2 log|Omega| - tr(Omega^-1 Y^T K'^-1 Y) / 2,
    greatest for Omega = Y^T K'^-1 Y / n, where the last term is -n Q / 2. `Y`: (n, Q), `factor`:
    lower Cholesky factor of K' = K + sigma_n^2 I, (n, n).
    """
    n, Q = Y.shape
    whitened = torch.linalg.solve_triangular(factor, Y, upper=False)
    omega = whitened.T @ whitened / n
    log_det = 2 * factor.diagonal().log().sum()
    constant = n * Q * (math.log(2 * math.pi) + 1)
    return -0.5 * (constant + Q * log_det + n * torch.logdet(omega)), omega


@dataclass(frozen=True)
class LikelihoodEvaluation:
    """Argument of the callback after each evaluation of the likelihood."""

    n_evaluations: int
    log_likelihood: float
    length_scale: float
    noise_to_signal: float


@dataclass(repr=False, eq=False)
class MVGPR(Regressor):
    """Gaussian process with the covariance Omega x (sigma_f^2 exp(-d^2/(2 l^2)) + sigma_n^2 I).

    Omega (outputs) is profiled out of the marginal likelihood. Scaling sigma_f^2 and sigma_n^2 by
    the same factor and dividing Omega by it changes nothing, so optimised values are reported with
    the mean of Omega's diagonal equal to 1. The mean of the outputs is subtracted.

    Without an `optimizer` the three values are used as they are; linearly dependent outputs are
    also fitted without it, as their likelihood is unbounded. Further starts are drawn log-uniformly
    from Table V's ranges. `callback` gets a ``LikelihoodEvaluation`` after each evaluation.

    A fit sets `length_scale_`, `signal_variance_`, `noise_variance_`, `omega_` (n_outputs,
    n_outputs), which is the covariance of the outputs up to the kernel's factor,
    `log_marginal_likelihood_` of all training samples, and `n_iter_` and `converged_` of the
    optimiser's best start, 1 and True without an optimiser. It warns with ConvergenceWarning if
    that start did not converge.
    """

    length_scale: float = setting(
        3.0,
        "Length scale l of the kernel, or the optimiser's first start",
        "scaled inputs",
        above=0,
    )
    signal_variance: float = setting(
        1.0,
        "Variance of the signal, sigma_f², or the optimiser's first start",
        "scaled outputs²",
        above=0,
    )
    noise_variance: float = setting(
        1e-3,
        "Variance of the noise, sigma_n², or the optimiser's first start",
        "scaled outputs²",
        above=0,
    )
    optimizer: Literal["marginal_likelihood"] | None = setting(
        "marginal_likelihood",
        "Whether to maximise the marginal likelihood over the three values above; null takes "
        "them as they are",
    )
    n_restarts: int = setting(2, "Number of further random starts of the optimiser", low=0)
    n_optimize: int = setting(
        1000,
        "Number of training curves on which the likelihood is maximised; the fit uses all",
        low=2,
    )
    max_iter: int = setting(100, "Largest number of L-BFGS iterations of each start", low=1)
    random_state: Any = setting(
        0,
        "Seed of the starts and of the curves of the optimisation",
        rule="whole number; 0 to 4294967295",
    )
    device: str = setting("cpu", "Device of the fit", rule="cpu or cuda")
    callback: Callable[[LikelihoodEvaluation], None] | None = setting(
        None, "Function called after each evaluation, which train.py sets itself", rule="null"
    )

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Fit to samples (n_samples, n_inputs) and outputs (n_samples,) or (.., n_outputs)."""
        inputs, targets = self._training_data(X, y)
        check_device(self.device)
        self.mean_ = targets.mean(axis=0)
        samples = as_tensor(inputs).to(self.device)
        centred = as_tensor(targets - self.mean_).to(self.device)
        self.length_scale_ = float(self.length_scale)
        self.signal_variance_ = float(self.signal_variance)
        self.noise_variance_ = float(self.noise_variance)
        self.converged_, self.n_iter_ = True, 1
        are_independent = bool(torch.linalg.matrix_rank(centred) == centred.shape[1])
        if self.optimizer is not None and are_independent:
            self._optimize(samples, centred)
        self._condition(samples, centred)
        if not self.converged_:
            warnings.warn(
                f"MVGPR's likelihood did not converge in {self.max_iter} iterations; raise "
                "max_iter or give a better start",
                ConvergenceWarning,
                stacklevel=2,
            )
        return self

    def predict(
        self, X: ArrayLike, return_std: bool = False
    ) -> FloatArray | tuple[FloatArray, FloatArray]:
        """Return the predictive mean and, with `return_std`, the deviation of a new noisy output.

        Both have the shape (n_samples,) or (n_samples, n_outputs).
        """
        samples = as_tensor(self._inputs(X)).to(self.device)
        weights = torch.tensor(self.weights_, device=self.device)
        means, variances = [], []
        for rows in samples.split(PREDICT_ROWS):
            cross = self._kernel(rows, self._samples)
            means.append((cross @ weights).cpu().numpy())
            if return_std:
                half = torch.linalg.solve_triangular(self._factor(), cross.T, upper=False)
                explained = half.square().sum(dim=0).cpu().numpy()
                variances.append(self.signal_variance_ + self.noise_variance_ - explained)
        mean: FloatArray = np.concatenate(means) + self.mean_
        mean = self._as_trained(mean)
        if not return_std:
            return mean
        variance = np.maximum(np.concatenate(variances), 0.0)
        std = np.sqrt(variance[:, None] * self.omega_.diagonal())
        return mean, self._as_trained(std)

    def state(self) -> dict[str, FloatArray]:
        """Return the arrays that define the fitted model together with the parameters."""
        mean = self._stored("mean_")
        kernel = [self.length_scale_, self.signal_variance_, self.noise_variance_]
        return {
            "samples": self._samples.cpu().numpy(),
            "weights": self.weights_,
            "mean": mean,
            "omega": self.omega_,
            "kernel": np.array(kernel),
        }

    def restore(self, state: Mapping[str, FloatArray]) -> Self:
        """Load the arrays of `state`; ValueError if they are missing or inconsistent."""
        with arrays_of("an MVGPR"):
            self._samples = torch.tensor(state["samples"], device=self.device)
            self.weights_, self.mean_ = state["weights"], self._restored(state["mean"])
            self.omega_, kernel = state["omega"], state["kernel"]
        n_outputs = len(self.mean_)
        if self.weights_.shape != (len(self._samples), n_outputs) or kernel.shape != (3,):
            raise ValueError(f"weights have shape {self.weights_.shape}, mean {self.mean_.shape}")
        self.length_scale_, self.signal_variance_, self.noise_variance_ = map(float, kernel)
        self.n_features_in_ = self._samples.shape[1]
        self._kept_factor: Tensor | None = None
        return self

    def _kernel(self, X: Tensor, Z: Tensor) -> Tensor:
        return self.signal_variance_ * rbf_kernel(X, Z, math.sqrt(2) * self.length_scale_)

    def _factor(self) -> Tensor:
        """Return the Cholesky factor of K', recomputed on first use after loading."""
        if self._kept_factor is not None:
            return self._kept_factor
        kernel = self._kernel(self._samples, self._samples)
        kernel.diagonal().add_(self.noise_variance_)
        self._kept_factor = factor = _factored(kernel)
        return factor

    def _condition(self, samples: Tensor, centred: Tensor) -> None:
        """Compute Omega, the likelihood and the weights K'^-1 Y of all samples."""
        self._samples = samples
        self._kept_factor = None
        factor = self._factor()
        value, omega = log_marginal_likelihood(centred, factor)
        self.log_marginal_likelihood_ = float(value)
        self.omega_ = omega.cpu().numpy()
        self.weights_ = np.ascontiguousarray(torch.cholesky_solve(centred, factor).cpu().numpy())

    def _optimize(self, samples: Tensor, centred: Tensor) -> None:
        """Set the three hyperparameters to the best of several maximisations of the likelihood."""
        random = check_random_state(self.random_state)
        # An evaluation costs the cube of the number of samples: a random subset is enough.
        chosen = random.permutation(len(samples))[: self.n_optimize]
        samples, centred = samples[chosen], centred[chosen]
        squared = squared_distances(samples, samples)
        evaluations = 0

        def negative(theta: FloatArray) -> tuple[float, FloatArray]:
            nonlocal evaluations
            logs = torch.tensor(theta, requires_grad=True, device=samples.device)
            kernel = torch.exp(-0.5 * squared * torch.exp(-2 * logs[0]))
            kernel = kernel + torch.exp(logs[1]) * torch.eye(len(samples)).to(samples)
            value, _ = log_marginal_likelihood(centred, _factored(kernel))
            value.backward()
            evaluations += 1
            if self.callback is not None:
                length, noise = np.exp(theta).tolist()
                likelihood = float(value.detach())
                self.callback(LikelihoodEvaluation(evaluations, likelihood, length, noise))
            gradient = logs.grad if logs.grad is not None else torch.zeros_like(logs)
            return -float(value.detach()), -gradient.cpu().numpy()

        # The likelihood has several maxima: one search from the given values, others at random.
        starts = [np.log([self.length_scale, self.noise_variance / self.signal_variance])]
        lows, highs = np.log(list(START_RANGES.values())).T
        starts += [random.uniform(lows, highs) for _ in range(self.n_restarts)]
        bounds = np.log(list(BOUNDS.values()))
        how: dict[str, Any] = {"jac": True, "method": "L-BFGS-B", "bounds": bounds}
        how["options"] = {"maxiter": self.max_iter}
        runs = [minimize(negative, np.clip(start, *bounds.T), **how) for start in starts]
        best = min(runs, key=lambda run: run.fun)
        self.converged_, self.n_iter_ = bool(best.success), max(1, int(best.nit))
        self.length_scale_, noise = map(float, np.exp(best.x))
        # Only the ratio of noise to signal was searched: the mean variance of the outputs at the
        # optimum sets the scale of both.
        kernel = torch.exp(-0.5 * squared / self.length_scale_**2)
        kernel.diagonal().add_(noise)
        _, omega = log_marginal_likelihood(centred, _factored(kernel))
        self.signal_variance_ = float(omega.diagonal().mean())
        self.noise_variance_ = noise * self.signal_variance_


def _factored(kernel: Tensor) -> Tensor:
    return cholesky(kernel, "kernel matrix", "raise noise_variance or lower length_scale")
