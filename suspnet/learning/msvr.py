"""MSVR: multi-output support vector regression as a scikit-learn estimator on torch."""

from __future__ import annotations

import functools
import operator
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Literal, Self

import numpy as np
import torch
from numpy.typing import ArrayLike
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils import check_random_state
from sklearn.utils.validation import _check_sample_weight, validate_data
from torch import Tensor

from suspnet.ground.settings import Setting, check_number, check_settings
from suspnet.ground.tensors import as_tensor, check_device
from suspnet.ground.types import FloatArray, IntArray
from suspnet.learning import ranks
from suspnet.learning.design import CACHE_BYTES, Coefficients, DenseDesign, Design
from suspnet.learning.equispaced import EquispacedFeatures
from suspnet.learning.feature_maps import FeatureMap
from suspnet.learning.irwls import IRWLS, Iteration, Solution, Status
from suspnet.learning.kernel_design import NARROW, KernelDesign
from suspnet.learning.map_kinds import MAPS, MOST_EXACT, automatic, name_of
from suspnet.learning.regressor import Regressor, arrays_of

PREDICT_ROWS = 8192
"""Rows predicted at once, so that their features fit into memory."""
SAME_GRAM_PARAMETERS = ("C", "epsilon")
"""Hyperparameters that the Gram matrix does not depend on."""


class MSVR(Regressor):
    """Multi-output support vector regression with a hyperspherical epsilon-insensitive loss.

    Minimises, over W and b (Eq. 7 of the paper; a sum over samples, not a mean)::

        1/2 |W|^2 + C sum_i L(|y_i - W^T phi(x_i) - b|),   L(u) = max(0, u - epsilon)^2

    by IRWLS in the primal, or for the exact kernel in dual coefficients. phi approximates the RBF
    kernel ``exp(-|x - z|^2 / sigma^2)``, i.e. scikit-learn's gamma = 1 / sigma^2. Scale inputs and
    outputs first, e.g. with `suspnet.learning.Scaling`.

    `settings` has the meaning of each argument. In scikit-learn's words, sigma is a width in units
    of the inputs, "scale" as its ``gamma="scale"``: sqrt(n) for n standardised inputs. At epsilon =
    0 and without intercept C is ``alpha = 1 / (2 C)`` of ``KernelRidge``; ``SVR`` has an absolute
    loss. A tube (epsilon, in units of the outputs) that contains many samples needs tens to
    hundreds of iterations, a narrow one a few.

    feature_map "auto" takes `exact` up to twice `n_components` samples, 5,000 in a wide tube, else
    `equispaced` where it pays and finufft is installed, else `rff`. The time of an iteration grows
    with the cube of the number of features; the memory of `exact` with the square of the number of
    samples. dtype "float32" is that of the features of `rff` and `orf` and of products with them;
    sums over blocks and solves are float64, but `gap_` does not include the rounding of products:
    at C = 1e4 the objective may lie 1e-5 above its minimum.

    The fit stops when the objective is proven to lie within the fraction `tol` of its minimum.
    With `distributed`, the samples given to `fit` are this rank's shard of those of all ranks of
    ``torch.distributed``, which may be empty; every rank gets the same model. `callback` gets an
    ``Iteration`` after each iteration.

    Attributes
    ----------
    feature_map_ : str
        The feature map in use, never "auto".
    coef_ : array of shape (n_features, n_outputs)
        W; for the exact kernel the dual coefficients, (n_samples, n_outputs).
    intercept_ : array of shape (n_outputs,)
        b.
    n_iter_ : int
    converged_ : bool
    objective_, grad_norm_ : float
        At the solution.
    gap_ : float
        Proven bound on the relative distance of the objective from its minimum.
    objectives_ : list of float
        Before the first and after each iteration.
    support_fraction_ : float
        Fraction of the samples outside the tube.

    Warns
    -----
    ConvergenceWarning
        If `tol` was not reached.

    Examples
    --------
    >>> import numpy as np
    >>> X = np.linspace(-2, 2, 200)[:, None]
    >>> Y = np.column_stack([np.sin(X[:, 0]), np.cos(X[:, 0])])
    >>> model = MSVR(sigma=1.0).fit(X, Y)
    >>> model.converged_, bool(np.abs(model.predict(X) - Y).mean() < 0.01)
    (True, True)
    """

    settings: ClassVar[Mapping[str, Setting]] = {
        "C": Setting("Penalty of residuals outside the tube, as tuned for the group", above=0),
        "sigma": Setting(
            "Width of the kernel exp(-|x - z|²/sigma²)", rule="scaled inputs; above 0; or scale"
        ),
        "epsilon": Setting(
            "Radius of the tube within which residuals cost nothing", "scaled outputs", low=0
        ),
        "feature_map": Setting(
            "Approximation of the kernel: random Fourier features, orthogonal ones, Nystroem "
            "landmarks, modes on a grid (three inputs at most), the kernel itself (memory as "
            "data.n_train squared), or the quickest for the data"
        ),
        "n_components": Setting(
            "Number of features of rff and orf (rounded up to an even number), and largest number "
            "of nystroem",
            low=1,
        ),
        "kernel_tol": Setting(
            "Error of the kernel that equispaced may make, and at which nystroem stops adding "
            "landmarks",
            above=0,
        ),
        "fit_intercept": Setting("Whether to fit an intercept, which is not penalised"),
        "max_iter": Setting(
            "Number of iterations after which the solver warns that it has not converged", low=1
        ),
        "tol": Setting(
            "Relative distance of the objective from its minimum, proven, at which the solver "
            "stops",
            low=0,
        ),
        "random_state": Setting(
            "Seed of the random features or landmarks", rule="whole number; 0 to 4294967295"
        ),
        "dtype": Setting("Precision of the features of rff and orf; the other maps need float64"),
        "solver": Setting(
            "Algorithm: that of the paper as printed, or a faster one with the same minimum"
        ),
        "device": Setting("Device of the fit; equispaced runs on the CPU only", rule="cpu or cuda"),
        "distributed": Setting(
            "Whether processes of torchrun share one fit, which train.py sets itself"
        ),
        "callback": Setting(
            "Function called after each iteration, which train.py sets itself", rule="null"
        ),
    }
    """What each argument means and which values it takes."""

    distributable: ClassVar[bool] = True

    feature_map_: str

    def __init__(
        self,
        C: float = 100.0,
        sigma: float | Literal["scale"] = 3.0,
        epsilon: float = 1e-3,
        feature_map: Literal["rff", "orf", "nystroem", "equispaced", "exact", "auto"] = "rff",
        n_components: int = 1024,
        kernel_tol: float = 1e-6,
        fit_intercept: bool = True,
        max_iter: int = 1000,
        tol: float = 1e-8,
        random_state: Any = 0,
        dtype: Literal["float64", "float32"] = "float64",
        solver: Literal["newton", "irwls"] = "newton",
        device: str = "cpu",
        distributed: bool = False,
        callback: Callable[[Iteration], None] | None = None,
    ) -> None:
        self.C = C
        self.sigma = sigma
        self.epsilon = epsilon
        self.feature_map = feature_map
        self.n_components = n_components
        self.kernel_tol = kernel_tol
        self.fit_intercept = fit_intercept
        self.max_iter = max_iter
        self.tol = tol
        self.random_state = random_state
        self.dtype = dtype
        self.solver = solver
        self.device = device
        self.distributed = distributed
        self.callback = callback

    def fit(self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None = None) -> Self:
        """Fit to samples (n_samples, n_inputs) and outputs (n_samples,) or (.., n_outputs).

        `sample_weight` (n_samples,), at least 0, multiplies C for each sample: a weight of 2 is a
        sample given twice. None is 1.
        """
        self.check_parameters()
        check_device(self.device)
        samples, targets = self._validated(X, y)
        self._map = self._chosen_map(samples, targets)
        self._warn_of_cost(len(samples), targets.shape[1])
        # constant outputs are the intercept, without the rounding that a fit would leave
        constant = torch.zeros_like(targets[:1])
        if self.fit_intercept and not self.distributed and bool((targets == targets[:1]).all()):
            constant = targets[:1]
        all_reduce = ranks.all_reduce if self.distributed else ranks.identity
        design = MAPS[self.feature_map_].design(self._map, samples, all_reduce)
        weights = self._sample_weight(sample_weight, samples)
        solution = self._solve(design, targets - constant, weights)
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

    def cross_predictor(
        self, X: ArrayLike, y: ArrayLike, folds: Sequence[IntArray]
    ) -> Callable[[Mapping[str, float]], list[FloatArray]]:
        """Return a function that predicts each fold by a model fitted to all other folds.

        It takes a mapping with values of C and epsilon that replace the model's own, and returns a
        list of predictions (n_fold, n_outputs). The models are those of `fit`, but all values of C
        and epsilon share one Gram matrix, from which a fold's own is subtracted. It requires a map
        that does not depend on the samples (``shares_gram``). `folds` are row indices; each row is
        in one fold.
        """
        self.check_parameters()
        samples, targets = self._validated(X, y)
        self.feature_map_ = self.feature_map
        feature_map = self._make_map(samples)
        designs = [
            DenseDesign(feature_map, samples[fold], cache_bytes=CACHE_BYTES // len(folds))
            for fold in folds
        ]
        whole = functools.reduce(operator.add, (design.gram() for design in designs))
        # the design and the targets of all folds but one, for each fold
        others = [
            (
                DenseDesign.joined(designs[:j] + designs[j + 1 :], whole - designs[j].gram()),
                torch.cat([targets[fold] for k, fold in enumerate(folds) if k != j]),
            )
            for j in range(len(folds))
        ]

        def predict(setting: Mapping[str, float]) -> list[FloatArray]:
            model = clone(self).set_params(**setting)
            model.check_parameters()
            solutions = (model._solve(design, rows) for design, rows in others)
            return [
                design.predict(Coefficients(solution.coef, solution.intercept)).cpu().numpy()
                for design, solution in zip(designs, solutions, strict=True)
            ]

        return predict

    @property
    def shares_gram(self) -> bool:
        """Whether `cross_predictor` supports this feature map."""
        return self.feature_map in MAPS and not MAPS[self.feature_map].of_data

    def predict(self, X: ArrayLike) -> FloatArray:
        """Return predictions, shape (n_samples,) or (n_samples, n_outputs) as `y` was."""
        samples = as_tensor(self._inputs(X)).to(self.device, self._torch_dtype)
        coef = torch.tensor(self.coef_, dtype=self._torch_dtype, device=self.device)
        predicted = np.empty((len(samples), coef.shape[1]))
        for start in range(0, len(samples), PREDICT_ROWS):
            rows = slice(start, start + PREDICT_ROWS)
            predicted[rows] = self._map.apply(samples[rows], coef).double().cpu().numpy()
        return self._as_trained(predicted + self.intercept_)

    def state(self) -> dict[str, FloatArray]:
        """Return the arrays that define the fitted model together with the parameters."""
        intercept = self._stored("intercept_")
        arrays = {f"map.{k}": v.cpu().numpy() for k, v in self._map.tensors().items()}
        return {"coef": self.coef_, "intercept": intercept, **arrays}

    def restore(self, state: Mapping[str, FloatArray]) -> Self:
        """Load the arrays of `state`; ValueError if they are missing or inconsistent."""
        self.check_parameters()
        names = [name.removeprefix("map.") for name in state if name.startswith("map.")]
        self.feature_map_ = name_of(names) if self.feature_map == "auto" else self.feature_map
        map_type = MAPS[self.feature_map_].holds
        tensors = {
            name: torch.tensor(state[f"map.{name}"], dtype=self._torch_dtype, device=self.device)
            for name in names
        }
        with arrays_of("an MSVR"):
            self.coef_, self.intercept_ = state["coef"], self._restored(state["intercept"])
            if self.feature_map == "exact" and "whitening" in tensors:
                # models saved before dual coefficients: Phi = K V
                self.coef_ = tensors.pop("whitening").double().numpy() @ self.coef_
            self._map = map_type(**tensors)
        self.n_features_in_ = self._map.n_inputs
        none = torch.zeros(1, self.n_features_in_, dtype=self._torch_dtype, device=self.device)
        n_features = self._map(none).shape[1]
        if self.coef_.shape != (n_features, len(self.intercept_)):
            raise ValueError(f"coef has shape {self.coef_.shape}, the map {n_features} features")
        return self

    @property
    def _torch_dtype(self) -> torch.dtype:
        return torch.float32 if self.dtype == "float32" else torch.float64

    def _validated(self, X: ArrayLike, y: ArrayLike) -> tuple[Tensor, Tensor]:
        """Return samples and targets (n_samples, n_outputs); a rank may have none."""
        if self.distributed and ranks.is_distributed() and len(np.asarray(X)) == 0:
            X = validate_data(self, X, dtype=np.float64, ensure_min_samples=0)
        else:
            X, y = validate_data(self, X, y, multi_output=True, y_numeric=True, dtype=np.float64)
        samples = as_tensor(X).to(self.device, self._torch_dtype)
        targets = as_tensor(y).to(self.device)
        self._single_output = targets.ndim == 1
        return samples, targets[:, None] if targets.ndim == 1 else targets

    def _chosen_map(self, samples: Tensor, targets: Tensor) -> FeatureMap:
        """Set ``feature_map_`` and return the map for these samples."""
        is_shared = self.distributed and ranks.is_distributed()
        self.feature_map_ = self.feature_map
        if self.feature_map == "exact" and is_shared:
            raise ValueError(
                "feature_map='exact' needs all samples in one process: use 'nystroem' or 'rff'"
            )
        if self.feature_map == "auto":
            is_plain = samples.device.type == "cpu" and self.dtype == "float64" and not is_shared
            spread = float(targets.std(dim=0, correction=0).max()) if len(targets) else 0.0
            self.feature_map_, feature_map = automatic(
                samples,
                self._width(samples),
                self.n_components,
                self.kernel_tol,
                is_plain=is_plain,
                is_narrow=self.epsilon <= NARROW * spread,
            )
            if feature_map is not None:
                return feature_map
        everywhere = self.distributed and MAPS[self.feature_map_].of_data
        return self._make_map(ranks.all_gather(samples) if everywhere else samples)

    def _warn_of_cost(self, n_samples: int, n_outputs: int) -> None:
        """Warn of a fit that takes much memory or time."""
        message = None
        if self.feature_map == "exact" and n_samples > MOST_EXACT:
            message = (
                f"feature_map='exact' takes {2 * 8e-9 * n_samples**2:.1f} GB and more for "
                f"{n_samples} samples; 'rff' or 'nystroem' needs far less"
            )
        if isinstance(self._map, EquispacedFeatures):
            message = self._map.cost(n_samples, n_outputs)
        if message is not None:
            warnings.warn(message, UserWarning, stacklevel=3)

    def _make_map(self, samples: Tensor) -> FeatureMap:
        seed = int(check_random_state(self.random_state).randint(2**31 - 1))
        make = MAPS[self.feature_map_].make
        return make(samples, self._width(samples), self.n_components, seed, self.kernel_tol)

    def _width(self, samples: Tensor) -> float:
        """Return sigma as a number."""
        if self.sigma != "scale":
            return float(self.sigma)
        if self.distributed and ranks.is_distributed():
            raise ValueError("sigma='scale' needs all samples in one process: give a number")
        variance = float(samples.var(correction=0))
        return float(np.sqrt(samples.shape[1] * variance)) or 1.0  # as scikit-learn's

    def _sample_weight(self, sample_weight: ArrayLike | None, samples: Tensor) -> Tensor | None:
        if sample_weight is None:
            return None
        weights = _check_sample_weight(
            sample_weight, samples.cpu().numpy(), dtype=np.float64, ensure_non_negative=True
        )
        return torch.tensor(weights, dtype=torch.float64, device=self.device)

    def _solve(
        self, design: Design, targets: Tensor, sample_weight: Tensor | None = None
    ) -> Solution:
        solver = IRWLS(
            self.C,
            self.epsilon,
            self.fit_intercept,
            self.max_iter,
            self.tol,
            solver=self.solver,
        )
        start = None
        if isinstance(design, KernelDesign):
            start = design.start(solver, targets, sample_weight)
        return solver.minimise(design, targets, self.callback, sample_weight, start)

    def check_parameters(self) -> None:
        """Raise TypeError or ValueError unless every parameter is valid and they fit together."""
        check_settings(self)
        if not (isinstance(self.sigma, str) and self.sigma == "scale"):
            check_number("sigma", self.sigma, above=0)
        if not isinstance(self.fit_intercept, bool | np.bool_):
            raise TypeError(f"`fit_intercept` must be True or False, got {self.fit_intercept!r}")
        if self.feature_map == "auto":  # takes one that suits the precision and the device
            return
        kind = MAPS[self.feature_map]
        if self.dtype == "float32" and not kind.float32:
            raise ValueError(
                f"feature_map={self.feature_map!r} needs dtype='float64': its Gram matrix is too "
                "ill conditioned for single precision"
            )
        if not kind.on_gpu and torch.device(self.device).type != "cpu":
            raise ValueError(
                f"feature_map={self.feature_map!r} runs on the CPU: set device='cpu', or use "
                "feature_map='rff'"
            )
