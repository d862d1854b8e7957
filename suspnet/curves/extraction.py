"""Feature sets: which peaks of which response are used, and where they are searched.

"The largest peak" of abs(G_p) jumps from the first to the second resonance as k_p grows. The two
primary peaks are therefore defined by their position, below and above the peak of abs(G_s): that is
at the car body's frequency, near which abs(G_p) has a minimum.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol, Self

import torch
from numpy.typing import ArrayLike
from scipy.signal import find_peaks
from torch import Tensor

from suspnet.curves.peaks import (
    PeakFit,
    PeakReason,
    Peaks,
    PeakShape,
    SmoothedCurves,
    check_grid,
    findpeaks,
)
from suspnet.ground.findings import Finding, together
from suspnet.ground.settings import check_settings, setting
from suspnet.ground.tensors import as_tensor, curves_as_tensor
from suspnet.ground.types import FloatArray, IntArray

PEAK_NAMES = ("secondary", "primary_lower", "primary_upper", "primary_largest")
MEASURES = ("position", "height", "width")
LOWER_PEAK_ENDS = 1.2
"""The lower primary peak lies below this multiple of the position of the secondary peak."""
UPPER_PEAK_BEGINS = 1.6
"""The upper primary peak lies above this multiple of the position of the secondary peak."""
UPPER_PEAK_TILT = 1.5
"""`tilt` of the upper primary peak; it finds the peak even if heavy damping flattens it."""
_WINDOWS = {
    "secondary": (0.4, 0.4),
    "primary_lower": (0.4, 0.25),
    "primary_upper": (0.25, 1.0),
    "primary_largest": (0.3, 0.3),
}
"""Half widths below and above a peak, in log-frequency, of the first fit's window."""
GAUSSIAN_WINDOW = 0.25
"""Largest half width, in log-frequency, of the first fit's window of a Gaussian."""


@dataclass(frozen=True)
class FeatureTable:
    """Features (n_curves, n_features), NaN where missing, and reasons (n_curves, n_parts).

    For peaks these are position [Hz], height [-] and width [Hz] of each; a reason is 0 if none is
    missing.
    """

    values: Tensor
    reasons: Tensor


class FeatureSet(Protocol):
    """Turns curves into the inputs of a regression; the defaults suit a set that learns nothing.

    `kind` is its name in protocols and model files; `positive` states that features are positive,
    so that their logarithms may be taken.
    """

    kind: ClassVar[str]
    positive: ClassVar[bool]

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the columns of the reason codes."""
        ...

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each feature."""
        ...

    @property
    def is_fitted(self) -> bool:
        """Whether the feature set needs no (further) training curves."""
        return True

    def fitted(self, clean: Tensor, noisy: Tensor, healthy: Tensor, frequencies_hz: Tensor) -> Self:
        """Return the feature set, fitted to training curves.

        `clean`, `noisy`: the same curves (n_curves, 2, n_freq) without and with noise; `healthy`:
        (2, n_freq).
        """
        return self

    def blank(self) -> Self:
        """Return the feature set without its learnt arrays."""
        return self

    def extract(self, curves: Tensor, frequencies_hz: Tensor) -> FeatureTable:
        """Return the features of curves (n_curves, 2, n_freq)."""
        ...

    def relative(self, values: FloatArray, healthy: FloatArray) -> FloatArray:
        """Return features relative to the healthy vehicle's."""
        ...

    def missing(self, reasons: IntArray) -> str:
        """Return what is missing of one curve and why, from its row of reasons."""
        ...

    def state(self) -> dict[str, FloatArray]:
        """Return the learnt arrays, for storage."""
        return {}

    def restored(self, arrays: Mapping[str, FloatArray]) -> Self:
        """Return the feature set with its stored arrays."""
        return self


@dataclass(frozen=True)
class PeakFeatures(FeatureSet):
    """Position, height and width of chosen peaks of both responses.

    `peaks` are from ``PEAK_NAMES``: `secondary` is the peak of abs(G_s), `primary_lower` and
    `primary_upper` those of abs(G_p) below and above it, `primary_largest` the paper's.
    """

    peaks: Sequence[str] = ("secondary", "primary_lower", "primary_upper")
    shape: PeakShape = setting(
        "lorentzian",
        "Shape fitted to the top of each peak, of feature_set=peaks; half_prominence takes the "
        "highest bin and the width at half prominence instead",
    )
    smoothing_hz: float = setting(
        0.2,
        "Length of the moving average that finds the maximum of a peak",
        "Hz",
        above=0,
        most=10000,
    )
    low_hz: float = setting(
        0.2,
        "Lower end of the band in which peaks are searched; below high_hz",
        "Hz",
        above=0,
        most=10000,
    )
    high_hz: float = setting(15.0, "Upper end of that band", "Hz", above=0, most=10000)
    window: float = setting(
        1.0,
        "Factor on the windows of the fits; a smaller one is closer to the top and noisier",
        above=0,
        most=100,
    )

    def __post_init__(self) -> None:
        unknown = [name for name in self.peaks if name not in PEAK_NAMES]
        if unknown or not self.peaks:
            raise ValueError(f"`peaks` must be chosen from {PEAK_NAMES}, got {list(self.peaks)}")
        check_settings(self)
        if not self.low_hz < self.high_hz:
            raise ValueError(f"need low_hz < high_hz, got {self.low_hz} and {self.high_hz}")

    kind: ClassVar[str] = "peaks"
    positive: ClassVar[bool] = True  # features are positive, so their logarithms may be taken

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the columns of the reason codes."""
        return tuple(self.peaks)

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each feature, in the order of the columns of `extract`."""
        return tuple(f"{peak}_{measure}" for peak in self.peaks for measure in MEASURES)

    def relative(self, values: FloatArray, healthy: FloatArray) -> FloatArray:
        """Return the ratio of features to the healthy vehicle's."""
        return values / healthy

    def missing(self, reasons: IntArray) -> str:
        """Return which peaks are missing and why, from one row of the reasons."""
        findings = (
            Finding("peak-missing", peak=peak, reason=PeakReason(int(reason)).words)
            for peak, reason in zip(self.peaks, reasons, strict=True)
            if reason
        )
        return together(findings, ", ")

    def where_searched(self, curves: Tensor, frequencies_hz: Tensor) -> str:
        """Return where noise-free curves (2, n_freq) have maxima, and where peaks are searched."""
        maxima = [
            ", ".join(f"{float(frequencies_hz[i]):.3g}" for i in find_peaks(curve)[0]) or "no"
            for curve in curves.abs().cpu().numpy()
        ]
        return (
            f"maxima lie at {maxima[1]} Hz (G_s) and {maxima[0]} Hz (G_p), peaks are searched from "
            f"protocol.features.low_hz={self.low_hz:g} to protocol.features.high_hz="
            f"{self.high_hz:g} Hz, primary_upper above UPPER_PEAK_BEGINS={UPPER_PEAK_BEGINS:g} "
            "times that of G_s"
        )

    def extract(self, curves: ArrayLike, frequencies_hz: ArrayLike) -> FeatureTable:
        """Return the features of curves (n_curves, 2, n_freq), G_p and G_s or their magnitudes.

        ValueError if shapes disagree or the frequencies are not ascending and evenly spaced.
        """
        curves, frequencies_hz = curves_as_tensor(curves), as_tensor(frequencies_hz)
        if curves.ndim != 3 or curves.shape[1:] != (2, len(frequencies_hz)):
            expected = f"(n_curves, 2, {len(frequencies_hz)})"
            raise ValueError(f"`curves` must have shape {expected}, got {tuple(curves.shape)}")
        ends = (frequencies_hz < self.low_hz).sum(), (frequencies_hz <= self.high_hz).sum()
        band = slice(*map(int, ends))
        frequencies, curves = frequencies_hz[band], curves[:, :, band]
        primary, secondary = (curves.abs() if curves.is_complex() else curves).unbind(1)
        check_grid(primary, frequencies)
        # the secondary peak first, as it defines where the primary peaks are searched
        peaks: dict[str, Peaks] = {}
        if set(self.peaks) - {"primary_largest"}:
            peaks["secondary"] = findpeaks(secondary, frequencies, fit=self._fit("secondary"))
        if set(self.peaks) - {"secondary"}:
            smoothed = SmoothedCurves.of(primary, frequencies, self._fit("primary_largest"))
            for name in self.peaks:
                if name not in peaks:
                    peaks[name] = self._primary_peak(name, smoothed, peaks.get("secondary"))
        chosen = [peaks[name] for name in self.peaks]
        columns = [c for p in chosen for c in (p.position_hz, p.height, p.width_hz)]
        reasons = torch.stack([p.reason for p in chosen], dim=1)
        return FeatureTable(torch.stack(columns, dim=1), reasons)

    def _primary_peak(self, name: str, primary: SmoothedCurves, secondary: Peaks | None) -> Peaks:
        """Return one peak of abs(G_p), searched on its side of the secondary peak."""
        fit = self._fit(name)
        if name == "primary_largest" or secondary is None:
            return primary.peaks(fit)
        body = torch.nan_to_num(secondary.position_hz, nan=1.0)
        if name == "primary_lower":
            band = {"high_hz": LOWER_PEAK_ENDS * body}
        else:
            band = {"low_hz": UPPER_PEAK_BEGINS * body}
        peak = primary.peaks(fit, **band)
        unplaced = torch.full_like(peak.reason, PeakReason.PLACE_UNKNOWN)
        reason = torch.where(secondary.valid, peak.reason, unplaced)
        return replace(peak, reason=reason).blanked()

    def _fit(self, name: str) -> PeakFit:
        below, above = _WINDOWS[name]
        if self.shape == "gaussian":
            below, above = min(below, GAUSSIAN_WINDOW), min(above, GAUSSIAN_WINDOW)
        tilt = UPPER_PEAK_TILT if name == "primary_upper" else 0.0
        window = self.window * below, self.window * above
        return PeakFit(self.shape, self.smoothing_hz, *window, tilt, top=self.window * PeakFit.top)
