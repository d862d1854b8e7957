"""The feature set `curve`: principal components of log-magnitude and phase of both responses.

With G relative to the healthy vehicle's, v = (log abs, phase) over the bins of a band, mu the mean
of v and s the standard deviation of its noise over training curves, B the leading principal
directions of the noise-free (v - mu) / s::

    features = B ((v - mu) / s)

Every feature then has noise of about unit variance, and the leading features have the highest
signal-to-noise ratio.

Curves may be magnitudes only, with white noise that can make them negative. Then

    v = asinh(m / 2a) - asinh(m_healthy / 2a),   a = FLOOR times the rms of the noise,

which is the logarithm where the magnitude m is well above the floor a and linear below it, so it
does not amplify noise where the magnitude is small.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Self

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from suspnet.curves.extraction import FeatureTable, PeakFeatures
from suspnet.ground.settings import Checked, setting
from suspnet.ground.tensors import as_tensor, curves_as_tensor
from suspnet.ground.types import FloatArray, IntArray

ROUNDING = 1e-12  # noise below this means that all rows are equal in the column: no information
MISSING = 1  # reason code of a curve that is not finite
FLOOR = 10.0
"""Magnitude below which asinh replaces the logarithm, as a multiple of the rms of the noise."""


@dataclass(frozen=True)
class CurveBasis:
    """The basis that `CurveFeatures` learns from training curves.

    `healthy` (2, n_freq): G_p and G_s of the healthy vehicle, real where the curves are magnitudes;
    `mean`, `noise` (4 n_freq,): mu and s, log-magnitude and phase [rad] of G_p, then of G_s;
    `directions` (n_components, 4 n_freq): B, with orthonormal rows; both have 2 n_freq columns for
    magnitudes; `explained` (n_components,): fraction of the noise-free variance along each
    direction; `floor` (2,): a of each response, None where the curves have phases.
    """

    frequencies_hz: Tensor
    healthy: Tensor
    mean: Tensor
    noise: Tensor
    directions: Tensor
    explained: Tensor
    floor: Tensor | None = None


@dataclass(frozen=True)
class CurveFeatures(Checked):
    """Principal components of both responses or magnitudes, relative to the healthy vehicle's.

    `fitted` sets the `basis`.
    """

    n_components: int | None = setting(
        None,
        "Number of principal components of the curves; null is as many as `explained` asks for",
        low=1,
        most=10000,
    )
    explained: float = setting(
        0.9999,
        "Share of the variance of noise-free curves that the components keep, where n_components "
        "is null",
        above=0,
        below=1,
    )
    low_hz: float | None = setting(
        None,
        "Lower end of the band of the curves; null is that of the estimate",
        "Hz",
        above=0,
        most=10000,
    )
    high_hz: float | None = setting(
        None, "Upper end of that band; null is that of the estimate", "Hz", above=0, most=10000
    )
    basis: CurveBasis | None = field(default=None, compare=False)

    kind: ClassVar[str] = "curve"
    positive: ClassVar[bool] = False  # features may have any sign: no logarithm is taken of them
    parts: ClassVar[tuple[str, ...]] = ("curve",)  # names of the columns of the reason codes

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each feature; ValueError if their number is unknown before the fit."""
        count = self.n_components if self.basis is None else len(self.basis.directions)
        if count is None:
            raise ValueError("the number of components is only known once they are fitted")
        return tuple(f"component_{i + 1}" for i in range(count))

    @property
    def is_fitted(self) -> bool:
        """Whether the basis has been learnt."""
        return self.basis is not None

    def blank(self) -> Self:
        """Return the feature set without its basis."""
        return replace(self, basis=None)

    def fitted(self, clean: Tensor, noisy: Tensor, healthy: Tensor, frequencies_hz: Tensor) -> Self:
        """Return the feature set with a basis learnt from training curves.

        `clean`, `noisy` (n_curves, 2, n_freq) are the same curves without and with noise, `healthy`
        (2, n_freq) those of the healthy vehicle: complex, or real magnitudes. ValueError if the
        band has no bin, or there are fewer curves than components.
        """
        inside = self._inside(frequencies_hz)
        frequencies, healthy = frequencies_hz[inside], healthy[:, inside]
        clean, noisy = clean[..., inside], noisy[..., inside]
        floor = None
        if not clean.is_complex():
            floor = FLOOR * (noisy - clean).square().mean(dim=(0, 2)).sqrt()
        rows, noisy_rows = _rows(clean, healthy, floor), _rows(noisy, healthy, floor)
        components = noise_components(rows, noisy_rows, self.n_components, self.explained)
        return replace(self, basis=CurveBasis(frequencies, healthy, *components, floor))

    def extract(self, responses: ArrayLike, frequencies_hz: ArrayLike) -> FeatureTable:
        """Return the features of curves, NaN and reason 1 where a curve is not finite.

        `responses` (n_curves, 2, n_freq) are G_p and G_s, or magnitudes if the basis was learnt
        from these; their bins include those of the basis. ValueError if the basis is not fitted or
        on other bins, or needs phases and the curves have none.
        """
        basis = self._learnt()
        responses, frequencies_hz = curves_as_tensor(responses), as_tensor(frequencies_hz)
        inside = self._inside(frequencies_hz)
        bins = frequencies_hz[inside]
        own = basis.frequencies_hz.to(bins)
        if bins.shape != own.shape or not torch.allclose(bins, own, rtol=0, atol=1e-6):
            raise ValueError(
                "the curves lie on other bins than those the features were learnt on: "
                f"{_span(bins)} instead of {_span(basis.frequencies_hz)}"
            )
        responses = responses[..., inside]
        # a floor means that the basis was learnt from magnitudes
        floor = basis.floor
        if floor is None and not responses.is_complex():
            raise ValueError("the features were learnt with phases, these curves are magnitudes")
        if floor is not None:
            responses = responses.abs() if responses.is_complex() else responses
            floor = floor.to(responses)
        rows = _rows(responses, basis.healthy.to(responses), floor)
        values = ((rows - basis.mean.to(rows)) / basis.noise.to(rows)) @ basis.directions.to(rows).T
        missing = ~torch.isfinite(values).all(dim=1)
        return FeatureTable(
            torch.where(missing[:, None], torch.nan, values), (missing * MISSING)[:, None].long()
        )

    def relative(self, values: FloatArray, healthy: FloatArray) -> FloatArray:
        """Return the difference of features from the healthy vehicle's."""
        return values - healthy

    def missing(self, reasons: IntArray) -> str:
        """Return what is wrong with a curve, from its row of reasons; empty if nothing is."""
        return "curve (not finite)" if reasons.any() else ""

    def state(self) -> dict[str, FloatArray]:
        """Return the basis as real arrays; only a basis of magnitudes has a floor."""
        basis = self._learnt()
        arrays = {f.name: getattr(basis, f.name) for f in fields(basis)}
        if basis.floor is None:
            del arrays["floor"]
            arrays["healthy"] = torch.view_as_real(basis.healthy)
        return {name: array.cpu().contiguous().numpy() for name, array in arrays.items()}

    def restored(self, arrays: Mapping[str, FloatArray]) -> Self:
        """Return the feature set with a stored basis; ValueError if the arrays do not fit."""
        magnitudes = "floor" in arrays
        expected = {f.name for f in fields(CurveBasis)} - (set() if magnitudes else {"floor"})
        if set(arrays) != expected:
            raise ValueError(f"the basis must hold {sorted(expected)}, got {sorted(arrays)}")
        tensors = {name: torch.as_tensor(array) for name, array in arrays.items()}
        n_freq, n = len(tensors["frequencies_hz"]), len(tensors["directions"])
        n_columns = (2 if magnitudes else 4) * n_freq
        shapes: dict[str, tuple[int, ...]] = {
            "healthy": (2, n_freq) if magnitudes else (2, n_freq, 2),
            "mean": (n_columns,),
            "noise": (n_columns,),
            "directions": (n, n_columns),
            "explained": (n,),
        }
        if magnitudes:
            shapes["floor"] = (2,)
        for name, shape in shapes.items():
            if tuple(tensors[name].shape) != shape:
                raise ValueError(f"`{name}` must have shape {shape}, got {arrays[name].shape}")
        if not magnitudes:
            tensors["healthy"] = torch.view_as_complex(tensors["healthy"])
        return replace(self, basis=CurveBasis(**tensors))

    def _learnt(self) -> CurveBasis:
        if self.basis is None:
            raise ValueError("the feature set `curve` is not fitted to training curves yet")
        return self.basis

    def _inside(self, frequencies_hz: Tensor) -> Tensor:
        low = 0.0 if self.low_hz is None else self.low_hz
        high = torch.inf if self.high_hz is None else self.high_hz
        inside = (frequencies_hz >= low - 1e-9) & (frequencies_hz <= high + 1e-9)
        if not bool(inside.any()):
            raise ValueError(f"no bin lies between {low} and {high} Hz: {_span(frequencies_hz)}")
        return inside


def noise_components(
    clean: Tensor, noisy: Tensor, count: int | None, explained: float = 1.0
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return mu, s, B and `explained` of `CurveBasis` for rows (n_rows, n_columns) of curves.

    `count` None: as many components as keep the fraction `explained` of the noise-free variance.
    ValueError if there are fewer rows or columns than components.
    """
    noise = (noisy - clean).square().mean(dim=0).sqrt()
    noise = noise.where(noise > ROUNDING, 1.0)  # avoids division by 0: no information there
    mean = clean.mean(dim=0)
    power, directions = _principal((clean - mean) / noise)
    n_possible = min(len(clean) - 1, clean.shape[1])
    directions = directions[:n_possible]
    share = power[:n_possible].clamp(min=0.0) / power.sum()
    if count is None:
        count = int((share.cumsum(dim=0) < explained).sum()) + 1
    if count > len(directions):
        raise ValueError(
            f"{count} components were asked for, {len(clean)} curves of {clean.shape[1]} numbers "
            f"have {len(directions)}"
        )
    # memory layout as restored: equal bit for bit
    return mean, noise, directions[:count].contiguous(), share[:count]


def _principal(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Return the variances along principal axes, largest first, and these as rows.

    The eigenvectors of the smaller Gram matrix, that of columns or that of rows, are several times
    quicker than singular vectors.
    """
    n_rows, n_columns = rows.shape
    if n_rows >= n_columns:
        power, vectors = torch.linalg.eigh(torch.cov(rows.T))
        return power.flip(0), vectors.T.flip(0)
    power, vectors = torch.linalg.eigh(rows @ rows.T / (n_rows - 1))
    # weak axes still hold some of the strong ones, by rounding: the QR factors remove that
    axes, _ = torch.linalg.qr(rows.T @ vectors.flip(1))
    return power.flip(0), axes.T


def _rows(responses: Tensor, healthy: Tensor, floor: Tensor | None) -> Tensor:
    """Return v of each curve: of magnitudes if there is a floor, else with phases."""
    if floor is None:
        return _relative_rows(responses, healthy)
    scale = 2 * floor[:, None]
    return (torch.asinh(responses / scale) - torch.asinh(healthy / scale)).flatten(1)


def _relative_rows(responses: Tensor, healthy: Tensor) -> Tensor:
    """Return log-magnitude and phase relative to `healthy`, shape (n_curves, 4 n_freq).

    The relative phase is near 0 at low frequency and is unwrapped from there upwards.
    """
    ratio = responses / healthy
    phase = ratio.angle()
    steps = torch.diff(phase, dim=-1)
    turns = -torch.round(steps / (2 * torch.pi)).cumsum(dim=-1) * 2 * torch.pi
    phase = phase + torch.nn.functional.pad(turns, (1, 0))
    return torch.stack([ratio.abs().log(), phase], dim=2).flatten(1)


def _span(frequencies_hz: Tensor) -> str:
    if not len(frequencies_hz):
        return "no bins"
    low, high = float(frequencies_hz[0]), float(frequencies_hz[-1])
    return f"{len(frequencies_hz)} bins, {low:g} to {high:g} Hz"


FEATURE_SETS: dict[str, Any] = {kind.kind: kind for kind in (PeakFeatures, CurveFeatures)}
"""Every feature set by its name in protocols and model files."""
