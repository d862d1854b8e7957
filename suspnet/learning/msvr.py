"""MSVR: multi-output support vector regression as a scikit-learn estimator on torch."""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np
import torch
from numpy.typing import ArrayLike
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils import check_random_state
from torch import Tensor

from suspnet.ground.settings import check_number, check_settings, setting
from suspnet.ground.tensors import as_tensor, check_device
from suspnet.ground.types import FloatArray
from suspnet.learning import feature_maps
from suspnet.learning.design import DenseDesign, Design
from suspnet.learning.equispaced import EquispacedFeatures, equispaced_fourier
from suspnet.learning.irwls import IRWLS, Iteration, Status
from suspnet.learning.kernel_design import KernelDesign
from suspnet.learning.regressor import Regressor, arrays_of
from suspnet.learning.toeplitz import EquispacedDesign

PREDICT_ROWS = 8192  # rows predicted at once, so that their features fit into memory
MOST_EXACT = 5000
"""Number of samples above which `exact` warns: its kernel takes 0.2 GB, a factor of it as much."""


@dataclass(frozen=True)
class MapKind:
    """A kind of feature map: its constructor, its class and its design matrix.

    ``make(X, sigma, n_components, seed, kernel_tol)`` returns the map for samples X, `holds` is the
    class that `restore` rebuilds from its tensors. `on_gpu`: it runs on other devices than
    the CPU.
    """

    make: Callable[[Tensor, float, int, int, float], feature_maps.FeatureMap]
    holds: Callable[..., feature_maps.FeatureMap]
    design: Callable[[Any, Tensor], Design] = DenseDesign
    on_gpu: bool = True


MAPS = {
    "rff": MapKind(feature_maps.random_fourier, feature_maps.FourierFeatures),
    "orf": MapKind(feature_maps.orthogonal_fourier, feature_maps.FourierFeatures),
    "nystroem": MapKind(feature_maps.nystroem, feature_maps.LandmarkFeatures),
    "equispaced": MapKind(equispaced_fourier, EquispacedFeatures, EquispacedDesign, on_gpu=False),
    "exact": MapKind(feature_maps.exact, feature_maps.KernelColumns, KernelDesign),
}
"""Every feature map by name; a new one is added here."""


@dataclass(repr=False, eq=False)
class MSVR(Regressor):
    """Multi-output support vector regression with a hyperspherical epsilon-insensitive loss.

    Minimises, over W and b (Eq. 7 of the paper; a sum over samples, not a mean)::

        1/2 |W|^2 + C sum_i L(|y_i - W^T phi(x_i) - b|),   L(u) = max(0, u - epsilon)^2

    by IRWLS in the primal, or for the exact kernel in dual coefficients. phi approximates the RBF
    kernel ``exp(-|x - z|^2 / sigma^2)``, i.e. scikit-learn's gamma = 1 / sigma^2. Scale inputs and
    outputs first, e.g. with `suspnet.learning.Scaling`.

    In scikit-learn's words, sigma is a width in units of the inputs, "scale" as its
    ``gamma="scale"``: sqrt(n) for n standardised inputs. At epsilon = 0 and without intercept C is
    ``alpha = 1 / (2 C)`` of ``KernelRidge``; ``SVR`` has an absolute loss. A tube (epsilon, in
    units of the outputs) that contains many samples needs tens to hundreds of iterations, a narrow
    one a few.

    The time of an iteration grows with the cube of the number of features; the memory of `exact`
    with the square of the number of samples.

    The fit stops when the objective is proven to lie within the fraction `tol` of its minimum.
    `callback` gets an ``Iteration`` after each iteration.

    A fit sets `coef_`, W (n_features, n_outputs), for the exact kernel the dual coefficients
    (n_samples, n_outputs), `intercept_`, b (n_outputs,), `n_iter_`, `converged_`, `objective_` and
    `grad_norm_` at the solution, `gap_`, the proven bound on the relative distance of the objective
    from its minimum, `objectives_` before the first and after each iteration, and
    `support_fraction_`, that of the samples outside the tube. It warns with ConvergenceWarning if
    `tol` was not reached.

    Examples
    --------
    >>> import numpy as np
    >>> X = np.linspace(-2, 2, 200)[:, None]
    >>> Y = np.column_stack([np.sin(X[:, 0]), np.cos(X[:, 0])])
    >>> model = MSVR(sigma=1.0).fit(X, Y)
    >>> model.converged_, bool(np.abs(model.predict(X) - Y).mean() < 0.01)
    (True, True)
    """

    C: float = setting(
        100.0, "Penalty of residuals outside the tube, as tuned for the group", above=0
    )
    sigma: float | Literal["scale"] = setting(
        3.0, "Width of the kernel exp(-|x - z|²/sigma²)", rule="scaled inputs; above 0; or scale"
    )
    epsilon: float = setting(
        1e-3, "Radius of the tube within which residuals cost nothing", "scaled outputs", low=0
    )
    feature_map: Literal["rff", "orf", "nystroem", "equispaced", "exact"] = setting(
        "rff",
        "Approximation of the kernel: random Fourier features, orthogonal ones, Nystroem "
        "landmarks, modes on a grid (three inputs at most), or the kernel itself (memory as "
        "data.n_train squared)",
    )
    n_components: int = setting(
        1024,
        "Number of features of rff and orf (rounded up to an even number), and largest number "
        "of nystroem",
        low=1,
    )
    kernel_tol: float = setting(
        1e-6,
        "Error of the kernel that equispaced may make, and at which nystroem stops adding "
        "landmarks",
        above=0,
    )
    fit_intercept: bool = setting(True, "Whether to fit an intercept, which is not penalised")
    max_iter: int = setting(
        1000, "Number of iterations after which the solver warns that it has not converged", low=1
    )
    tol: float = setting(
        1e-8,
        "Relative distance of the objective from its minimum, proven, at which the solver stops",
        low=0,
    )
    random_state: Any = setting(
        0, "Seed of the random features or landmarks", rule="whole number; 0 to 4294967295"
    )
    solver: Literal["newton", "irwls"] = setting(
        "newton", "Algorithm: that of the paper as printed, or a faster one with the same minimum"
    )
    device: str = setting(
        "cpu", "Device of the fit; equispaced runs on the CPU only", rule="cpu or cuda"
    )
    callback: Callable[[Iteration], None] | None = setting(
        None, "Function called after each iteration, which train.py sets itself", rule="null"
    )

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Fit to samples (n_samples, n_inputs) and outputs (n_samples,) or (.., n_outputs)."""
        self.check_parameters()
        check_device(self.device)
        inputs, outputs = self._training_data(X, y)
        samples, targets = (as_tensor(part).to(self.device) for part in (inputs, outputs))
        if self.feature_map == "exact" and len(samples) > MOST_EXACT:
            warnings.warn(
                f"feature_map='exact' takes {2 * 8e-9 * len(samples) ** 2:.1f} GB and more for "
                f"{len(samples)} samples; 'rff' or 'nystroem' needs far less",
                UserWarning,
                stacklevel=2,
            )
        kind, seed = MAPS[self.feature_map], check_random_state(self.random_state)
        make = samples, self._width(samples), self.n_components, int(seed.randint(2**31 - 1))
        self._map = kind.make(*make, self.kernel_tol)
        # constant outputs are the intercept, without the rounding that a fit would leave
        constant = torch.zeros_like(targets[:1])
        if self.fit_intercept and bool((targets == targets[:1]).all()):
            constant = targets[:1]
        design, targets = kind.design(self._map, samples), targets - constant
        parts = self.C, self.epsilon, self.fit_intercept, self.max_iter, self.tol
        solver, start = IRWLS(*parts, solver=self.solver), None
        if isinstance(design, KernelDesign):
            start = design.start(solver, targets)
        solution = solver.minimise(design, targets, self.callback, start)
        self.coef_ = np.ascontiguousarray(solution.coef.cpu().numpy())
        self.intercept_ = (solution.intercept + constant.sum(dim=0)).cpu().numpy()
        self.n_iter_ = solution.n_iter
        self.converged_ = solution.status == Status.CONVERGED
        self.objective_, self.objectives_ = solution.objective, solution.objectives
        self.grad_norm_, self.gap_ = solution.grad_norm, solution.gap
        self.support_fraction_ = solution.support_fraction
        if not self.converged_:
            warnings.warn(
                f"MSVR stopped after {self.n_iter_} iterations ({solution.status}): relative gap "
                f"{self.gap_:.1e} > tol={self.tol:g}; raise max_iter or tol, or lower C or epsilon",
                ConvergenceWarning,
                stacklevel=2,
            )
        return self

    def predict(self, X: ArrayLike) -> FloatArray:
        """Return predictions, shape (n_samples,) or (n_samples, n_outputs) as `y` was."""
        samples = as_tensor(self._inputs(X)).to(self.device)
        coef = torch.tensor(self.coef_, device=self.device)
        blocks = [self._map.apply(rows, coef).double() for rows in samples.split(PREDICT_ROWS)]
        return self._as_trained(torch.cat(blocks).cpu().numpy() + self.intercept_)

    def state(self) -> dict[str, FloatArray]:
        """Return the arrays that define the fitted model together with the parameters."""
        intercept = self._stored("intercept_")
        arrays = {f"map.{k}": v.cpu().numpy() for k, v in self._map.tensors().items()}
        return {"coef": self.coef_, "intercept": intercept, **arrays}

    def restore(self, state: Mapping[str, FloatArray]) -> Self:
        """Load the arrays of `state`; ValueError if they are missing or inconsistent."""
        self.check_parameters()
        names = [name.removeprefix("map.") for name in state if name.startswith("map.")]
        map_type = MAPS[self.feature_map].holds
        tensors = {name: torch.tensor(state[f"map.{name}"], device=self.device) for name in names}
        with arrays_of("an MSVR"):
            self.coef_, self.intercept_ = state["coef"], self._restored(state["intercept"])
            self._map = map_type(**tensors)
        self.n_features_in_ = self._map.n_inputs
        none = torch.zeros(1, self.n_features_in_, dtype=torch.float64, device=self.device)
        n_features = self._map(none).shape[1]
        if self.coef_.shape != (n_features, len(self.intercept_)):
            raise ValueError(f"coef has shape {self.coef_.shape}, the map {n_features} features")
        return self

    def _width(self, samples: Tensor) -> float:
        if self.sigma != "scale":
            return float(self.sigma)
        variance = float(samples.var(correction=0))
        return float(np.sqrt(samples.shape[1] * variance)) or 1.0  # as scikit-learn's

    def check_parameters(self) -> None:
        """Raise TypeError or ValueError unless every parameter is valid and they fit together."""
        check_settings(self)
        if not (isinstance(self.sigma, str) and self.sigma == "scale"):
            check_number("sigma", self.sigma, above=0)
        if not isinstance(self.fit_intercept, bool | np.bool_):
            raise TypeError(f"`fit_intercept` must be True or False, got {self.fit_intercept!r}")
        if not MAPS[self.feature_map].on_gpu and torch.device(self.device).type != "cpu":
            raise ValueError(
                f"feature_map={self.feature_map!r} runs on the CPU: set device='cpu', or use "
                "feature_map='rff'"
            )
