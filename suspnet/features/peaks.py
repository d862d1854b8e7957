"""Position, height and width of a resonance peak, for a batch of magnitude curves at once.

As in O'Haver's findpeaks (reference 41 of the paper): smooth the curve, find its maximum, then fit
the raw points around it by least squares.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

import torch
from torch import Tensor

CLIP_FRACTION = 0.3
"""Raw points below this fraction of the smoothed curve are noise; they are raised to it."""

VERTEX_RANGE = (0.5, 2.0)
"""A fitted position must lie between these multiples of the window's centre."""


class PeakReason(IntEnum):
    """Why a curve has no peak; 0 where it has one."""

    FOUND = 0
    NOT_FINITE = 1
    NO_MAXIMUM = 2
    WRONG_CURVATURE = 3
    OUTSIDE_WINDOW = 4
    PLACE_UNKNOWN = 5


@dataclass(frozen=True)
class PeakFit:
    """How a peak is smoothed, found and fitted.

    Parameters
    ----------
    shape : {"lorentzian", "gaussian"}
        Lorentzian: a parabola through 1/abs(G)^2, exact for one lightly damped mode.
        Gaussian: a parabola through log abs(G).
    smoothing_hz : float, [Hz]
        Length of the moving average that finds the maximum and weighs the points.
    window_below, window_above : float
        Half widths of the fit window on either side of its centre, in log-frequency; the window
        exp(-(log(f/centre) / half width)^4 / 2) is soft, so features stay continuous.
    tilt : float
        The maximum is searched on abs(G) f^tilt; a positive tilt keeps a flattening peak in sight.
        The fit is always to abs(G) itself.
    n_fits : int
        Least-squares fits; each after the first is centred on the position found before.

    Raises
    ------
    ValueError
        If a setting is out of range.
    """

    shape: Literal["lorentzian", "gaussian"] = "lorentzian"
    smoothing_hz: float = 0.3
    window_below: float = 0.4
    window_above: float = 0.4
    tilt: float = 0.0
    n_fits: int = 2

    def __post_init__(self) -> None:
        if self.shape not in ("lorentzian", "gaussian"):
            raise ValueError(f"`shape` must be 'lorentzian' or 'gaussian', got {self.shape!r}")
        for name in ("smoothing_hz", "window_below", "window_above"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"`{name}` must be > 0, got {value}")
        if self.n_fits < 1:
            raise ValueError(f"`n_fits` must be >= 1, got {self.n_fits}")


@dataclass(frozen=True)
class Peaks:
    """One peak for each curve; NaN and a reason where there is none.

    Attributes
    ----------
    position_hz, height, width_hz : tensors of shape (n_curves,)
        Place [Hz] and value [-] of the fitted maximum, and full width at half power [Hz]
        (2 zeta f_0 for one lightly damped mode).
    reason : int64 tensor of shape (n_curves,)
        A ``PeakReason``.
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
        """Return the same with NaN for whatever is not valid."""
        position, height, width = (
            torch.where(self.valid, measure, math.nan)
            for measure in (self.position_hz, self.height, self.width_hz)
        )
        return Peaks(position, height, width, self.reason)


def findpeaks(
    magnitude: Tensor,
    frequencies_hz: Tensor,
    *,
    low_hz: Tensor | float = 0.0,
    high_hz: Tensor | float = math.inf,
    fit: PeakFit | None = None,
) -> Peaks:
    """Return the largest peak of each curve within its band.

    Parameters
    ----------
    magnitude : tensor of shape (n_curves, n_freq), [-]
        Magnitudes of frequency responses, noise included.
    frequencies_hz : tensor of shape (n_freq,), [Hz]
        Evenly spaced and positive.
    low_hz, high_hz : float or tensor of shape (n_curves,), [Hz]
        The band of each curve in which the maximum is searched.
    fit : PeakFit, optional
        Smoothing, window and shape.

    Returns
    -------
    Peaks

    Raises
    ------
    ValueError
        If shapes disagree or the frequencies are not positive and evenly spaced.

    Examples
    --------
    >>> f = torch.arange(1, 1001, dtype=torch.float64) * 0.01
    >>> curve = 1 / torch.sqrt((1 - (f / 4) ** 2) ** 2 + (0.04 * f / 4) ** 2)
    >>> peak = findpeaks(curve[None], f, fit=PeakFit(smoothing_hz=0.05))
    >>> round(peak.position_hz.item(), 2), round(peak.width_hz.item() / 4 / 2, 3)
    (4.0, 0.02)
    """
    fit = PeakFit() if fit is None else fit
    _check_grid(magnitude, frequencies_hz)
    finite = torch.isfinite(magnitude).all(dim=1)
    magnitude = torch.where(finite[:, None], magnitude, torch.ones_like(magnitude))
    smoothed = smooth(magnitude, frequencies_hz, fit.smoothing_hz)
    centre, interior = _largest(smoothed, frequencies_hz, low_hz, high_hz, fit.tilt)
    position, height, width, found, near = _fit_top(
        magnitude, smoothed, frequencies_hz, centre, fit
    )
    reason = torch.full_like(centre, PeakReason.FOUND, dtype=torch.int64)
    reason[~near] = PeakReason.OUTSIDE_WINDOW
    reason[~found] = PeakReason.WRONG_CURVATURE
    reason[~interior] = PeakReason.NO_MAXIMUM
    reason[~finite] = PeakReason.NOT_FINITE
    return Peaks(position, height, width, reason).blanked()


def smooth(magnitude: Tensor, frequencies_hz: Tensor, length_hz: float) -> Tensor:
    """Return the centred moving average over `length_hz`, shorter at the ends; same shape."""
    step = float(frequencies_hz[1] - frequencies_hz[0])
    half = min(round(length_hz / step) // 2, (magnitude.shape[1] - 1) // 2)
    averaged: Tensor = torch.nn.functional.avg_pool1d(
        magnitude[:, None], 2 * half + 1, stride=1, padding=half, count_include_pad=False
    )
    return averaged[:, 0]


def _check_grid(magnitude: Tensor, frequencies_hz: Tensor) -> None:
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


def _largest(
    smoothed: Tensor,
    frequencies_hz: Tensor,
    low_hz: Tensor | float,
    high_hz: Tensor | float,
    tilt: float,
) -> tuple[Tensor, Tensor]:
    """Return where the tilted curve is largest in its band, and whether that is a maximum."""
    low, high = (torch.as_tensor(v).to(smoothed).reshape(-1, 1) for v in (low_hz, high_hz))
    inside = ((frequencies_hz >= low) & (frequencies_hz <= high)).expand_as(smoothed)
    tilted = smoothed * frequencies_hz**tilt if tilt else smoothed
    index = torch.where(inside, tilted, -math.inf).argmax(dim=1, keepdim=True)
    last = frequencies_hz.shape[0] - 1
    here = inside.gather(1, index)
    before = inside.gather(1, (index - 1).clamp(min=0)) & (index > 0)
    after = inside.gather(1, (index + 1).clamp(max=last)) & (index < last)
    return frequencies_hz[index[:, 0]], (here & before & after)[:, 0]


def _fit_top(
    magnitude: Tensor, smoothed: Tensor, frequencies_hz: Tensor, centre: Tensor, fit: PeakFit
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return position, height, width, and whether the fit is a peak near its window's centre.

    The transformed noise of a point is that of abs(G) times 2 abs(G)^-3 (Lorentzian) or abs(G)^-1
    (Gaussian); least squares weighs by the inverse square, the smoothed curve standing for abs(G).
    """
    raised = torch.maximum(magnitude, CLIP_FRACTION * smoothed)
    if fit.shape == "lorentzian":
        target, signal = raised**-2, smoothed.square() ** 3
    else:
        target, signal = raised.log(), smoothed.square()
    log_frequency = frequencies_hz.log()
    low, high = VERTEX_RANGE
    for _ in range(fit.n_fits):
        window = _window(log_frequency, centre, fit)
        u = frequencies_hz / centre[:, None] - 1
        constant, vertex, curvature = _parabola(u, target, window * signal)
        if fit.shape == "lorentzian":
            found = (curvature > 0) & (constant > 0)
            height, half_width = constant.abs() ** -0.5, (constant / curvature).abs().sqrt()
        else:
            found = curvature < 0
            height, half_width = constant.exp(), (0.5 * math.log(2) / curvature.abs()).sqrt()
        position, width = centre * (1 + vertex), 2 * centre * half_width
        near = (1 + vertex > low) & (1 + vertex < high)
        centre = torch.where(found & near, position, centre)
    return position, height, width, found, near


def _window(log_frequency: Tensor, centre: Tensor, fit: PeakFit) -> Tensor:
    distance = log_frequency - centre.log()[:, None]
    below, above = (-0.5 / half_width**4 for half_width in (fit.window_below, fit.window_above))
    scale = torch.where(distance < 0, below, above)
    return distance.square_().square_().mul_(scale).exp_()


def _parabola(u: Tensor, target: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Fit target = constant + curvature (u - vertex)^2 by weighted least squares, row by row."""
    columns = torch.stack([torch.ones_like(u), u, u * u, target], dim=1)
    normal = (columns[:, :3] * weight[:, None]) @ columns.transpose(1, 2)  # (n_curves, 3, 4)
    solution, info = torch.linalg.solve_ex(normal[:, :, :3], normal[:, :, 3:])
    c0, c1, c2 = solution[:, :, 0].unbind(1)
    c2 = torch.where(info == 0, c2, math.nan)
    vertex = -c1 / (2 * c2)
    return c0 - c1 * c1 / (4 * c2), vertex, c2
