"""Fourier modes on a regular grid: the RBF kernel to a given accuracy, for up to three inputs.

The trapezoidal rule turns the spectrum of the kernel into modes with a regular spacing. The
weighted Gram matrix is then Toeplitz: one non-uniform FFT of the weights computes it, its products
are FFTs, and preconditioned conjugate gradients solve the normal equations (Barnett, Greengard and
Rachh, 2023: "Uniform approximation of common Gaussian process kernels using equispaced Fourier
grids"). A fit costs a few non-uniform FFTs over the samples.
"""

import importlib
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.stats import chi
from torch import Tensor

from suspnet.learning.feature_maps import FeatureMap

MAX_INPUTS = 3
MAX_BOX = 800_000
"""Largest number of points of the grid of modes, for which all arrays fit into about 1 GB."""
FFT_ACCURACY = 1e-2  # accuracy of the non-uniform FFTs, relative to the kernel's


@dataclass(frozen=True)
class EquispacedFeatures(FeatureMap):
    """phi(x) = sqrt(2 s_k) (cos(theta_k . z), ..., sin(theta_k . z), ...), z = x - centre.

    theta_k = k spacing for whole numbers k, one of each pair k and -k, the constant first; s_k is
    the kernel's spectral density at theta_k times the cell of the grid, so that
    phi(x) . phi(z) = exp(-|x - z|^2 / sigma^2) to `kernel_tol`, where z lies within the data that
    the map was made for, and x within `reach` of the centre, which is sigma farther. Inputs beyond
    are clipped to that border, as the features are periodic.

    `wave_numbers`: k, whole numbers, the first 0 (n_waves, n_inputs), `strengths`: s_k (n_waves,),
    `spacing`, `centre`, `reach`: (n_inputs,), `kernel_tol`: ().
    """

    wave_numbers: Tensor
    strengths: Tensor
    spacing: Tensor
    centre: Tensor
    reach: Tensor
    kernel_tol: Tensor

    def __post_init__(self) -> None:
        sound = self.wave_numbers.ndim == 2 and len(self.wave_numbers) > 0
        if sound:
            n_waves, n_inputs = self.wave_numbers.shape
            expected = [(n_waves,), (n_inputs,), (n_inputs,), (n_inputs,), ()]
            others = [self.strengths, self.spacing, self.centre, self.reach, self.kernel_tol]
            sound = [tuple(t.shape) for t in others] == expected
            sound &= all(bool(t.isfinite().all()) for t in [self.wave_numbers, *others])
            sound &= all(bool((t > 0).all()) for t in others if t is not self.centre)
        if sound:
            whole = bool((self.wave_numbers == self.wave_numbers.round()).all())
            sound = whole and not bool(self.wave_numbers[0].any())
            sound &= _box(self.wave_numbers) <= MAX_BOX
        if not sound:
            raise ValueError("the arrays are not those of an equispaced feature map")

    @property
    def n_inputs(self) -> int:
        """Number of columns the map takes."""
        return self.wave_numbers.shape[1]

    @property
    def n_features(self) -> int:
        """Number of features."""
        return 2 * len(self.strengths) - 1

    def angles(self, X: Tensor) -> Tensor:
        """Return spacing * (x - centre), inputs out of reach clipped to the border; shape of X."""
        offset = (X.double() - self.centre).clamp(-self.reach, self.reach)
        return offset * self.spacing

    def __call__(self, X: Tensor) -> Tensor:
        """Return features of shape (n_samples, 2 n_waves - 1), cosines first."""
        phase = self.angles(X) @ self.wave_numbers.T
        amplitudes = (2 * self.strengths).sqrt()
        cosines, sines = phase.cos() * amplitudes, phase.sin() * amplitudes
        return torch.cat([cosines[:, :1] / math.sqrt(2), cosines[:, 1:], sines[:, 1:]], dim=1)

    def apply(self, X: Tensor, coef: Tensor) -> Tensor:
        """Return Phi coef, shape (n_samples, n_outputs), by a non-uniform FFT."""
        return EquispacedTransform(self, X).matvec(coef)


def equispaced_fourier(
    X: Tensor, sigma: float, n_components: int, seed: int, kernel_tol: float = 1e-6
) -> EquispacedFeatures:
    """Return the Fourier modes that give the kernel to an error of `kernel_tol` on the data `X`.

    Half of this error is allowed for the weakest modes, which are left out, and half for the images
    of the kernel that the grid repeats every 2 pi / spacing. `X`: (n_samples, n_inputs), n_inputs
    <= 3; `n_components` and `seed` are not used.
    """
    n_inputs = X.shape[1]
    if n_inputs > MAX_INPUTS:
        raise ValueError(
            f"feature_map='equispaced' supports at most {MAX_INPUTS} inputs, got {n_inputs}: the "
            "number of modes grows exponentially with them; use feature_map='rff'"
        )
    if not kernel_tol <= 1:
        raise ValueError(
            f"`kernel_tol` must be <= 1 for feature_map='equispaced', got {kernel_tol:g}"
        )
    X = X.double()
    low, high = X.amin(dim=0), X.amax(dim=0)
    reach = (high - low) / 2 + sigma
    # The kernel's images must be so far away that together they stay below half the tolerance.
    images = math.sqrt(math.log(4 * n_inputs / kernel_tol)) * sigma
    spacing = 2 * math.pi / (high - low + sigma + images)
    # Modes beyond this radius sum to a hundredth of the tolerance, each counted with its cell.
    radius = float(chi.isf(kernel_tol / 200, n_inputs)) * math.sqrt(2) / sigma
    counts = ((radius + spacing.norm()) / spacing).floor()
    if not float((2 * counts + 1).prod()) <= 4 * MAX_BOX:
        raise ValueError(_too_many(sigma, high - low))
    axes = [torch.arange(-count, count + 1, dtype=torch.float64) for count in counts.tolist()]
    k = torch.cartesian_prod(*axes).reshape(-1, n_inputs)
    rank = k @ (2.0 * float(counts.max()) + 1) ** torch.arange(n_inputs, dtype=torch.float64)
    k = k[rank >= 0]  # one of k and -k, its last non-zero part > 0
    # The strength falls with the distance: sort, and drop the modes that sum to half the tolerance.
    distance = (k * spacing).norm(dim=1)
    order = distance.argsort(stable=True)
    k, distance = k[order], distance[order]
    density = (sigma / (2 * math.sqrt(math.pi))) ** n_inputs
    strengths = float(spacing.prod()) * density * torch.exp(-((sigma * distance) ** 2) / 4)
    left_out = 2 * strengths.flip(0).cumsum(0).flip(0)  # from this mode on
    n_kept = max(1, int((left_out > 0.49 * kernel_tol).sum()))
    k, strengths = k[:n_kept], strengths[:n_kept]
    if _box(k) > MAX_BOX:
        raise ValueError(_too_many(sigma, high - low))
    tolerance = torch.tensor(kernel_tol, dtype=torch.float64)
    return EquispacedFeatures(k, strengths, spacing, (low + high) / 2, reach, tolerance)


def _box(wave_numbers: Tensor) -> float:
    """Return the number of points of the grid that holds all wave numbers and their negatives."""
    return float((2 * wave_numbers.abs().amax(dim=0) + 1).prod())


def _too_many(sigma: float, extent: Tensor) -> str:
    return (
        f"feature_map='equispaced' would need a grid of more than {MAX_BOX:,} modes: "
        f"sigma={sigma:g} is small for data of extent {float(extent.max()):.3g}; raise sigma or "
        "kernel_tol, or use feature_map='rff'"
    )


class EquispacedTransform:
    """Products with Phi by non-uniform FFTs of the samples, without Phi in memory.

    `X`: (n_samples, n_inputs). Raises ValueError if finufft is not installed.
    """

    def __init__(self, modes: EquispacedFeatures, X: Tensor) -> None:
        self.modes = modes
        self.n_features, self.n_samples = modes.n_features, len(X)
        self._finufft = _finufft()
        self.waves = modes.wave_numbers.long()
        self.counts = self.waves.abs().amax(dim=0).tolist()
        self._scale = modes.strengths.sqrt()
        self._angles = [np.ascontiguousarray(c) for c in modes.angles(X).numpy().T]
        self._plans: dict[tuple[int, int], Any] = {}
        shape = [2 * count + 1 for count in self.counts]
        self._places = flat_index(self.waves + torch.tensor(self.counts), shape)
        self._size = math.prod(shape)

    def matvec(self, coef: Tensor) -> Tensor:
        """Return Phi coef, shape (n_samples, n_outputs); one transform serves two outputs."""
        spectra = self.spectrum(coef)
        grid = torch.zeros(coef.shape[1], self._size, dtype=torch.complex128)
        grid[:, self._size - 1 - self._places] = spectra.conj()
        grid[:, self._places] = spectra
        values = torch.empty(self.n_samples, coef.shape[1], dtype=torch.float64)
        for j in range(0, coef.shape[1], 2):
            pair = grid[j] if j + 1 == len(grid) else grid[j] + 1j * grid[j + 1]
            transformed = torch.view_as_real(self._transform(2, 1, pair))
            values[:, j : j + 2] = transformed[:, : values.shape[1] - j]
        return values

    def rmatvec(self, columns: Tensor) -> Tensor:
        """Return Phi^T columns, shape (n_features, n_columns)."""
        sums = []
        for pair in columns.double().split(2, dim=1):
            strengths = torch.zeros(self.n_samples, 2, dtype=torch.float64)
            strengths[:, : pair.shape[1]] = pair
            transformed = self._transform(1, 1, torch.view_as_complex(strengths)).flatten()
            direct = transformed[self._places]
            mirrored = transformed[self._size - 1 - self._places].conj()
            sums += [0.5 * (direct + mirrored), -0.5j * (direct - mirrored)][: pair.shape[1]]
        return self.real(torch.stack(sums))

    def toeplitz(self, weights: Tensor) -> Tensor:
        """Return t_k = sum_i w_i exp(-i k . angles_i) for k up to twice the counts, centred."""
        return self._transform(1, 2, weights.to(torch.complex128))

    def spectrum(self, vector: Tensor) -> Tensor:
        """Return sqrt(s_k) f_k of a vector over features, (n_features, n) to (n, n_waves).

        f_0 is the coefficient of the constant, f_k = (that of the cosine - i that of the sine) /
        sqrt(2), and f_-k its conjugate: a unitary change of basis.
        """
        n_waves = len(self.waves)
        sines = torch.cat([torch.zeros_like(vector[:1]), vector[n_waves:]])
        spectra = torch.complex(vector[:n_waves], -sines) / math.sqrt(2)
        spectra[0] *= math.sqrt(2)
        return (spectra * self._scale[:, None]).T

    def real(self, spectra: Tensor) -> Tensor:
        """Return the real coefficients of spectra times sqrt(s_k): the inverse change of basis."""
        coefficients = (spectra * self._scale).T * math.sqrt(2)
        coefficients[0] /= math.sqrt(2)
        return torch.cat([coefficients.real, -coefficients.imag[1:]])

    def _transform(self, kind: int, width: int, values: Tensor) -> Tensor:
        """Return the transform from samples to modes (kind 1) or back (2), for `width` x modes."""
        shape = tuple(2 * width * count + 1 for count in self.counts)
        if (kind, width) not in self._plans:
            accuracy = max(FFT_ACCURACY * float(self.modes.kernel_tol), 1e-14)
            plan = self._finufft.Plan(
                kind, shape, eps=accuracy, isign=2 * kind - 3, nthreads=torch.get_num_threads()
            )
            plan.setpts(*self._angles)
            self._plans[kind, width] = plan
        array = values.numpy() if kind == 1 else values.reshape(shape).numpy()
        return torch.from_numpy(self._plans[kind, width].execute(array))


def flat_index(index: Tensor, shape: list[int] | tuple[int, ...]) -> Tensor:
    """Return the index into the flattened array of each row (n, n_axes) of indices."""
    strides = torch.tensor([math.prod(shape[axis + 1 :]) for axis in range(len(shape))])
    return index @ strides


def _finufft() -> Any:
    try:
        return importlib.import_module("finufft")
    except ImportError as error:
        raise ValueError(
            "feature_map='equispaced' needs finufft: pip install finufft (the extra "
            "`nufft`), or use feature_map='rff'"
        ) from error
