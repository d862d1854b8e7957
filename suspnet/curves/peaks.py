"""Position, height and width of a resonance peak, for a batch of magnitude curves at once.

As in O'Haver's findpeaks (reference 41 of the paper): smooth the curve, find its maximum, then fit
the raw points around it by least squares.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.signal import peak_widths
from torch import Tensor
from torch.nn.functional import avg_pool1d

from suspnet.ground.settings import check_choice, check_number
from suspnet.ground.tensors import as_tensor

PeakShape = Literal["lorentzian", "gaussian", "half_prominence"]

CLIP_FRACTION = 0.3
"""Raw points below this fraction of the smoothed curve are noise and are raised to it."""

FLOOR_FRACTION = 1e-3
"""The smoothed curve, which noise can make negative, is raised to this fraction of its maximum."""

LOWEST, REACH = 0.5, 1.5
"""A fit is rejected if its position lies below LOWEST times the frequency of the maximum (a tilt
moves the maximum up), or more than REACH half widths of the window above it."""
EDGE = 3.5
"""Distance in half widths at which a window ends; its weight is exp(-EDGE^4 / 2) = 3e-33 there."""


class PeakReason(IntEnum):
    """Reason code of a curve without a peak; 0 if it has one."""

    FOUND = 0
    NOT_FINITE = 1
    NO_MAXIMUM = 2
    WRONG_CURVATURE = 3
    OUTSIDE_WINDOW = 4
    PLACE_UNKNOWN = 5

    @property
    def words(self) -> str:
        """The reason as text."""
        return self.name.lower().replace("_", " ")


@dataclass(frozen=True)
class PeakFit:
    """How a peak is smoothed, found and fitted.

    `shape` "lorentzian" is a parabola through 1/abs(G)^2, exact for one lightly damped mode,
    "gaussian" one through log abs(G). "half_prominence" fits nothing, but takes bin and value of
    the smoothed curve's maximum and the width at half its prominence, as MATLAB's findpeaks.

    A moving average of `smoothing_hz` locates the maximum and gives the weights of the points. The
    first fit's window exp(-(log(f/centre) / half width)^4 / 2), with the half widths `window_below`
    and `window_above` in log-frequency, is soft, so features are continuous. Each of `n_fits` after
    the first is centred on the previous position, in a window of `top` times the fitted width and
    at most that of the first, and discarded if it fails: a smaller window is closer to the top and
    noisier.

    The maximum searched is that of abs(G) f^tilt: a positive `tilt` finds a peak that damping
    flattens. The fit is always to abs(G) itself.
    """

    shape: PeakShape = "lorentzian"
    smoothing_hz: float = 0.2
    window_below: float = 0.4
    window_above: float = 0.4
    tilt: float = 0.0
    n_fits: int = 3
    top: float = 0.7

    def __post_init__(self) -> None:
        check_choice("shape", self.shape, get_args(PeakShape))
        for name in ("smoothing_hz", "window_below", "window_above", "top"):
            check_number(name, getattr(self, name), above=0)
        check_number("n_fits", self.n_fits, low=1, whole=True)


@dataclass(frozen=True)
class Peaks:
    """One peak for each curve; NaN and a ``PeakReason`` where there is none, each (n_curves,).

    The width is the full width at half power, 2 zeta f_0 for one lightly damped mode; with
    shape="half_prominence" that at half the prominence.
    """

    position_hz: Tensor
    height: Tensor
    width_hz: Tensor
    reason: Tensor

    @property
    def valid(self) -> Tensor:
        """True where a peak was found, shape (n_curves,)."""
        return self.reason == PeakReason.FOUND

    def blanked(self) -> Peaks:
        """Return the peaks with NaN wherever no peak was found."""
        position, height, width = (
            torch.where(self.valid, measure, math.nan)
            for measure in (self.position_hz, self.height, self.width_hz)
        )
        return Peaks(position, height, width, self.reason)


def findpeaks(
    magnitude: ArrayLike,
    frequencies_hz: ArrayLike,
    *,
    low_hz: ArrayLike = 0.0,
    high_hz: ArrayLike = math.inf,
    fit: PeakFit | None = None,
) -> Peaks:
    """Return the largest peak of each curve within its band.

    `magnitude` (n_curves, n_freq) are magnitudes of frequency responses, noise included, on evenly
    spaced positive `frequencies_hz` (n_freq,). `low_hz` and `high_hz`, numbers or (n_curves,), are
    the band in which the maximum of each is searched. ValueError if shapes disagree or the
    frequencies are not positive and evenly spaced.

    Examples
    --------
    >>> f = torch.arange(1, 1001, dtype=torch.float64) * 0.01
    >>> curve = 1 / torch.sqrt((1 - (f / 4) ** 2) ** 2 + (0.04 * f / 4) ** 2)
    >>> peak = findpeaks(curve[None], f, fit=PeakFit(smoothing_hz=0.05))
    >>> round(peak.position_hz.item(), 2), round(peak.width_hz.item() / 4 / 2, 3)
    (4.0, 0.02)
    """
    fit = PeakFit() if fit is None else fit
    curves, bins = as_tensor(magnitude), as_tensor(frequencies_hz)
    check_grid(curves, bins)
    return SmoothedCurves.of(curves, bins, fit).peaks(fit, low_hz, high_hz)


def check_grid(magnitude: Tensor, frequencies_hz: Tensor) -> None:
    """Raise ValueError unless shapes agree and frequencies are positive and evenly spaced."""
    n_freq = frequencies_hz.shape[0]
    if magnitude.ndim != 2 or magnitude.shape[1] != n_freq:
        shape = tuple(magnitude.shape)
        raise ValueError(f"`magnitude` must have shape (n_curves, {n_freq}), got {shape}")
    if n_freq < 3:
        raise ValueError(f"`frequencies_hz` must hold at least 3 values, got {n_freq}")
    steps = frequencies_hz.diff()
    even = bool(torch.allclose(steps, steps.mean(), rtol=1e-6, atol=0))
    if not even or float(frequencies_hz[0]) <= 0 or float(steps[0]) <= 0:
        raise ValueError("`frequencies_hz` must be positive, ascending and evenly spaced")


def smooth(magnitude: Tensor, frequencies_hz: Tensor, length_hz: float) -> Tensor:
    """Return the centred moving average over `length_hz`, shorter at the ends; same shape."""
    step = float(frequencies_hz[1] - frequencies_hz[0])
    half = min(round(length_hz / step) // 2, (magnitude.shape[1] - 1) // 2)
    averaged = avg_pool1d(magnitude[:, None], 2 * half + 1, 1, half, count_include_pad=False)
    return averaged[:, 0]


@dataclass(frozen=True)
class SmoothedCurves:
    """Curves preprocessed for several peak searches with one shape and smoothing.

    The noise of a transformed point is that of abs(G) times 2 abs(G)^-3 (Lorentzian) or abs(G)^-1
    (Gaussian). Least squares weights it by the inverse square, with the smoothed curve for abs(G).
    `finite` (n_curves,): others are replaced by ones; `smoothed`, `target`, `weight` (n_curves,
    n_freq): moving average, transformed curve to which a parabola is fitted, its weights.
    """

    frequencies_hz: Tensor
    finite: Tensor
    smoothed: Tensor
    target: Tensor
    weight: Tensor

    @classmethod
    def of(cls, magnitude: Tensor, frequencies_hz: Tensor, fit: PeakFit) -> SmoothedCurves:
        """Return curves (n_curves, n_freq), smoothed and transformed as `fit` requires."""
        finite = torch.isfinite(magnitude.amax(dim=1)) & torch.isfinite(magnitude.amin(dim=1))
        if not bool(finite.all()):
            magnitude = torch.where(finite[:, None], magnitude, torch.ones_like(magnitude))
        smoothed = smooth(magnitude, frequencies_hz, fit.smoothing_hz)
        floored = torch.maximum(smoothed, FLOOR_FRACTION * smoothed.amax(dim=1, keepdim=True))
        raised = torch.maximum(magnitude, CLIP_FRACTION * floored)
        weight = floored.square_()
        if fit.shape == "lorentzian":
            target, weight = raised.square_().reciprocal_(), weight.pow_(3)
        else:
            target = raised.log_()
        return cls(frequencies_hz, finite, smoothed, target, weight)

    def peaks(self, fit: PeakFit, low_hz: ArrayLike = 0.0, high_hz: ArrayLike = math.inf) -> Peaks:
        """Return the largest peak of each curve within its band; see ``findpeaks``."""
        centre, interior = _largest(self.smoothed, self.frequencies_hz, low_hz, high_hz, fit.tilt)
        if fit.shape == "half_prominence":
            top, near = _half_prominence(self, centre), torch.ones_like(interior)
        else:
            top, near = _fit_top(self, centre, fit)
        reason = torch.full_like(centre, PeakReason.FOUND, dtype=torch.int64)
        reason[~near] = PeakReason.OUTSIDE_WINDOW
        reason[~top.has_maximum] = PeakReason.WRONG_CURVATURE
        reason[~interior] = PeakReason.NO_MAXIMUM
        reason[~self.finite] = PeakReason.NOT_FINITE
        return Peaks(top.position, top.height, top.width, reason).blanked()


def _largest(
    smoothed: Tensor, frequencies_hz: Tensor, low_hz: ArrayLike, high_hz: ArrayLike, tilt: float
) -> tuple[Tensor, Tensor]:
    """Return where the tilted curve is largest in its band, and whether that is a maximum."""
    low, high = (as_tensor(v).to(smoothed).reshape(-1, 1) for v in (low_hz, high_hz))
    inside = ((frequencies_hz >= low) & (frequencies_hz <= high)).expand_as(smoothed)
    tilted = smoothed * frequencies_hz**tilt if tilt else smoothed
    index = torch.where(inside, tilted, -math.inf).argmax(dim=1, keepdim=True)
    last = frequencies_hz.shape[0] - 1
    at_index = inside.gather(1, index)
    before = inside.gather(1, (index - 1).clamp(min=0)) & (index > 0)
    after = inside.gather(1, (index + 1).clamp(max=last)) & (index < last)
    return frequencies_hz[index[:, 0]], (at_index & before & after)[:, 0]


def _fit_top(curves: SmoothedCurves, centre: Tensor, fit: PeakFit) -> tuple[_Top, Tensor]:
    """Return the last fit that is a maximum, and whether it lies near the place of the search."""
    below = torch.full_like(centre, fit.window_below)
    above = torch.full_like(centre, fit.window_above)
    low = centre * LOWEST
    high = centre * math.exp(REACH * fit.window_above)
    best = None
    for _ in range(fit.n_fits):
        parabola = windowed_parabola(
            curves.frequencies_hz, curves.target, curves.weight, centre, below, above
        )
        top = _top(*parabola, centre, fit.shape)
        best = top if best is None else top.where_maximum_else(best)
        centre = torch.where(best.has_maximum, best.position.clamp(low, high), centre)
        reach = torch.where(best.has_maximum, fit.top * best.width / centre, math.inf)
        below, above = reach.clamp(max=fit.window_below), reach.clamp(max=fit.window_above)
    assert best is not None
    return best, (best.position > low) & (best.position < high)


def _half_prominence(curves: SmoothedCurves, centre: Tensor) -> _Top:
    """Return bin, value and width at half prominence of the smoothed curves' maxima."""
    bins, values = curves.frequencies_hz, curves.smoothed
    peak = torch.searchsorted(bins, centre)[:, None]
    # one long curve for SciPy: infinite points between them end the bases as the ends do
    rows = np.pad(values.cpu().numpy(), ((0, 0), (0, 1)), constant_values=math.inf)
    places = np.arange(len(rows)) * rows.shape[1] + peak[:, 0].cpu().numpy()
    with warnings.catch_warnings():
        # a maximum at an end has no prominence, and is left out later
        warnings.simplefilter("ignore", RuntimeWarning)
        n_steps = peak_widths(rows.ravel(), places, rel_height=0.5)[0]
    width = torch.as_tensor(n_steps).to(values) * (bins[1] - bins[0])
    has_maximum = torch.ones_like(width, dtype=torch.bool)
    return _Top(bins[peak[:, 0]], values.gather(1, peak)[:, 0], width, has_maximum)


@dataclass(frozen=True)
class _Top:
    """Fitted maximum of each curve; `has_maximum` is False where the parabola has no maximum."""

    position: Tensor
    height: Tensor
    width: Tensor
    has_maximum: Tensor

    def where_maximum_else(self, earlier: _Top) -> _Top:
        """Return this fit, or the earlier one where only that found a maximum."""
        take = self.has_maximum | ~earlier.has_maximum
        pairs = zip(vars(self).values(), vars(earlier).values(), strict=True)
        return _Top(*(torch.where(take, new, old) for new, old in pairs))


def _top(constant: Tensor, vertex: Tensor, curvature: Tensor, centre: Tensor, shape: str) -> _Top:
    """Return the top whose transform is constant + curvature (f / centre - 1 - vertex)^2."""
    if shape == "lorentzian":
        has_maximum = (curvature > 0) & (constant > 0)
        height, half_width = constant.abs() ** -0.5, (constant / curvature).abs().sqrt()
    else:
        has_maximum = curvature < 0
        height, half_width = constant.exp(), (0.5 * math.log(2) / curvature.abs()).sqrt()
    return _Top(centre * (1 + vertex), height, 2 * centre * half_width, has_maximum)


def windowed_parabola(
    frequencies_hz: Tensor,
    target: Tensor,
    weight: Tensor,
    centre: Tensor,
    below: Tensor,
    above: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Fit target = constant + curvature (u - vertex)^2, u = f / centre - 1, curve by curve.

    The weight of a bin is `weight` (n_curves, n_freq) times the window
    exp(-(log(f / centre) / half width)^4 / 2) with the half widths `below` and `above` in
    log-frequency. Constant, vertex and curvature are NaN where the bins do not determine them.
    """
    bins = _bins_within(frequencies_hz, centre, below, above)
    near = frequencies_hz[bins]
    windowed = _window(near, centre, below, above) * weight[:, bins]
    u = (near - centre[:, None]).mul_(1 / centre[:, None])
    right = _moments(windowed * target[:, bins], u, 3)
    normal = _moments(windowed, u, 5).unfold(1, 3, 1)  # (n_curves, 3, 3): row i, column j is i + j
    solution, info = torch.linalg.solve_ex(normal, right[:, :, None])
    c0, c1, c2 = solution[:, :, 0].unbind(1)
    c2 = torch.where(info == 0, c2, math.nan)
    vertex = -c1 / (2 * c2)
    return c0 - c1 * c1 / (4 * c2), vertex, c2


def _moments(weight: Tensor, u: Tensor, n_moments: int) -> Tensor:
    """Return sum over bins of weight u^k for k < n_moments; overwrites `weight`."""
    sums = [weight.sum(dim=1)] + [weight.mul_(u).sum(dim=1) for _ in range(n_moments - 1)]
    return torch.stack(sums, dim=1)


def _bins_within(frequencies_hz: Tensor, centre: Tensor, below: Tensor, above: Tensor) -> slice:
    """Return the range of bins that covers the windows of all curves."""
    if len(centre) == 0:
        return slice(0)
    lowest, highest = centre * (-EDGE * below).exp(), centre * (EDGE * above).exp()
    ends = torch.stack([lowest.amin(), highest.amax()]).to(frequencies_hz)
    return slice(*torch.searchsorted(frequencies_hz, ends).tolist())


def _window(frequencies_hz: Tensor, centre: Tensor, below: Tensor, above: Tensor) -> Tensor:
    """Return exp(-distance^4 / 2), with the distance in half widths clipped to EDGE.

    Without clipping torch's exp would underflow, which is several times slower.
    """
    distance = frequencies_hz.log() - centre.log()[:, None]
    ahead, behind = distance * (1 / above[:, None]), distance.mul_(-1 / below[:, None])
    distance = torch.maximum(ahead, behind, out=ahead).clamp_(max=EDGE)
    return distance.square_().square_().mul_(-0.5).exp_()
