"""Groups of segments of a recording at one speed, their spectra, and the model of each group.

Checking, commissioning, reading and monitoring all use these functions, so that they agree.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch
from scipy.signal import get_window
from scipy.stats import norm
from torch import Tensor

from suspnet.curves.cross_spectra import CrossSpectra
from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.speeds import SpeedRange, Speeds, range_words, reading_range
from suspnet.curves.welch import SegmentSpectra, Welch
from suspnet.estimation.bogie_model import BogieModel
from suspnet.estimation.estimate import Estimate, Flags
from suspnet.estimation.fitted import FittedMethod, Model
from suspnet.estimation.from_spectra import trip_settings
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.findings import Finding, of, together
from suspnet.ground.parameters import Direction
from suspnet.ground.types import FloatArray
from suspnet.trains.spectra.segments import in_band, without_incoherent, without_loud
from suspnet.trains.spectra.wheel_lines import WheelLine, line_bins


def same_speed(speeds: Tensor, within: Tensor, tolerance: float) -> list[Tensor]:
    """Return groups of segments of similar speed, the largest first, each bool (n_segments,).

    A group's mean speeds lie within 1 +- tolerance of its middle. Groups are formed greedily: the
    range that contains most of the segments `within`, then again for the remaining ones. `speeds`
    has the shape (n_segments, n_samples), [m/s].
    """
    means, remaining, groups = speeds.mean(dim=1), within.clone(), []
    widest = (1 + tolerance) / (1 - tolerance)
    while bool(remaining.any()):  # each round takes at least one segment
        lowest = means[remaining][:, None]
        inside = (means >= lowest) & (means <= lowest * widest * (1 + 1e-9)) & remaining
        group = inside[int(inside.sum(dim=1).argmax())]
        groups.append(group)
        remaining = remaining & ~group
    return groups


def groups_to_read(
    speeds: Tensor, tolerance: float, least_m_per_s: float, *, at_any_speed: bool = False
) -> list[Tensor]:
    """Return the groups of segments that are averaged, the largest first, each (n_segments,).

    Speeds (n_segments, n_samples), [m/s], within a segment and the mean speeds of a group stay
    within 1 +- tolerance; slower groups than `least_m_per_s` are excluded. With `at_any_speed` the
    responses do not depend on speed, and all fast enough segments are one group.
    """
    if at_any_speed:
        group = (speeds >= least_m_per_s).all(dim=1)
        return [group] if bool(group.any()) else []
    is_steady = (speeds / speeds.mean(dim=1, keepdim=True) - 1).abs().amax(dim=1) <= tolerance
    groups = same_speed(speeds, is_steady, tolerance)
    return [group for group in groups if group_speed(speeds, group) >= least_m_per_s]


def group_speed(speeds: Tensor, group: Tensor) -> float:
    """Return the mean speed of a group of segments, which decides what model reads it, [m/s]."""
    return float(speeds[group].mean())


def reads_at_any_speed(method: FittedMethod) -> bool:
    """Return whether a method's responses do not depend on the speed."""
    return method.generator.speed_m_per_s is None


def speed_range(model: Model) -> SpeedRange | None:
    """Return the range of speeds that a model reads; None means any speed."""
    speed = model.generator.speed_m_per_s
    if speed is None or isinstance(model, BogieModel):
        return None
    half_width = trip_settings(model).speed_half_width
    assert half_width is not None  # as the settings are bound
    return SpeedRange.around(speed, half_width)


def groups_of(
    method: FittedMethod, models: Sequence[FittedMethod], speeds: Tensor, groups: Sequence[Tensor]
) -> list[Tensor]:
    """Return those groups of segments that a method reads, given all `models` of the recording.

    A group is read as a whole by the model whose range contains its mean speed, by the nearest of
    several, or by none. `speeds`: (n_segments, n_samples), [m/s]; `groups` from `groups_to_read`.
    """
    own_range = speed_range(method)
    if own_range is None:
        return list(groups)
    ranges = [model_range for model_range in map(speed_range, models) if model_range is not None]
    return [
        group for group in groups if reading_range(group_speed(speeds, group), ranges) == own_range
    ]


def readable_words(models: Sequence[Model]) -> str:
    """Return the speeds that some models read, as text: "the models read 61.0 to 78.0 m/s"."""
    ranges = [model_range for model_range in map(speed_range, models) if model_range is not None]
    kind = "model-reads" if len(models) == 1 else "models-read"
    return Finding(kind, words=range_words(ranges) if ranges else "any speed")


def no_group_words(
    speeds: Tensor,
    groups: Sequence[Tensor],
    models: Sequence[FittedMethod],
    tolerance: float,
    least_m_per_s: float,
) -> str:
    """Return why no group of segments is readable: none is steady, or none at a model's speed."""
    n_segments, half = len(speeds), float(speeds.mean(dim=1).median())
    if not groups:
        rule = Finding("steady-within", tolerance=100 * tolerance)
        if any(map(reads_at_any_speed, models)):
            rule = Finding("at-any-speed-throughout", least_m_per_s=least_m_per_s)
        segments = Finding("segments", n=n_segments)
        return Finding("none-steady", segments=segments, rule=rule, half=half)
    each = (Finding("speed", m_per_s=group_speed(speeds, group)) for group in groups[:3])
    largest = dict.fromkeys(each)
    return Finding(
        "no-model-at-speed",
        largest=together(largest, " and "),
        readable_words=readable_words(models),
    )


def minutes_words(welch: Welch, n_segments: int, least_averages: float, n_bins: int = 1) -> str:
    """Return how long segments are together, and how much longer they must be: in minutes.

    `n_bins` bins are averaged. Averages of segments of different lengths cannot be compared.
    """
    lengths = welch.minutes(n_segments), welch.minutes(welch.n_segments(least_averages, n_bins))
    # rounded first, so that `more` is the difference of the numbers shown
    available, needed = (round(minutes, 1) for minutes in lengths)
    return Finding("minutes", n_there=available, needed=needed, more=needed - available)


def speed_of(speeds: Tensor, segments: SegmentSpectra) -> tuple[float, float]:
    """Return mean and standard deviation of the speeds in segments, with the window's weights."""
    weights = torch.as_tensor(get_window(segments.welch.window, speeds.shape[1])) ** 2
    weights = weights / (weights.sum() * len(speeds))
    mean = float((speeds * weights).sum())
    return mean, math.sqrt(max(0.0, float(((speeds - mean) ** 2 * weights).sum())))


@dataclass(frozen=True)
class Steady:
    """Segments of a recording at one speed, and whether they are enough for an estimate.

    `band` holds all segments on the bins of an estimate; of those of the `group` (n_segments,),
    `candidates` have no far too large power and `chosen` no low coherence. `n_averages` counts
    independent averages of the chosen ones, and `spectra` is their average. `coherences` of G_p and
    G_s are means over the bins in use; `deviation` is the standard deviation of the log-magnitudes,
    [-]: median over the bins, of the less certain response. `speed` is mean and deviation, [m/s].
    `left_out` (n_freq,) are bins with lines of wheels. `has_enough`: there are enough averages;
    `is_certain`: the responses are certain enough.
    """

    band: SegmentSpectra
    group: Tensor
    candidates: Tensor
    chosen: Tensor
    n_incoherent: int
    n_averages: float = 0.0
    spectra: CrossSpectra | None = None
    coherences: Sequence[float] = (math.nan, math.nan)
    deviation: float = math.nan
    speed: tuple[float, float] = (math.nan, math.nan)
    left_out: Tensor | None = None
    has_enough: bool = False
    is_certain: bool = False


def steady(
    segments: SegmentSpectra,
    speeds: Tensor,
    groups: Sequence[Tensor],
    estimate: EstimateSettings,
    settings: TripSettings,
    lines: Sequence[WheelLine] = (),
) -> list[Steady]:
    """Return each group of segments with its usable spectra.

    `speeds`: (n_segments, n_samples), [m/s]; `groups` from `groups_to_read`; `estimate` bound to a
    vehicle; `lines` are those of wheels. Raises NoEstimateError if the recording does not reach the
    bins of `estimate`.
    """
    parts: list[Steady] = []
    if not groups:
        return parts
    band = in_band(segments, estimate.frequencies_hz())
    beyond = estimate.beyond(band.frequencies_hz)
    for group in groups:
        candidates = without_loud(band, group)
        chosen, n_incoherent = without_incoherent(band, candidates, settings.min_coherence)
        part = Steady(band, group, candidates, chosen, n_incoherent)
        if bool(chosen.any()):
            n_averages, spectra = band.welch.n_averages(int(chosen.sum())), band.average(chosen)
            coherences = spectra.coherences().masked_fill(beyond, math.nan).nanmean(dim=1)
            deviations = spectra.deviations(estimate.method).masked_fill(beyond, math.nan)
            deviation = float(deviations.nanmedian(dim=1).values.amax())
            part = replace(
                part,
                n_averages=n_averages,
                spectra=spectra,
                coherences=coherences.tolist(),
                deviation=deviation,
                speed=speed_of(speeds[chosen], band),
                left_out=line_bins(
                    lines, speeds[chosen], band.frequencies_hz, band.welch.segment_s
                ),
                has_enough=n_averages >= settings.min_averages,
                is_certain=deviation <= settings.max_deviation,
            )
        parts.append(part)
    return parts


@dataclass(frozen=True)
class SeenBin:
    """A group of segments at one speed with its spectra, as one model sees it.

    `spectra` (3, n_freq) on the model's bins and `speed_m_per_s` are means over the `chosen`
    segments (n_segments,). `speeds` are those of the segments. `doubts` are doubts and impossible
    checks of the channels; empty if there are none. `left_out` (n_freq,) are bins with lines of
    wheels. `direction` is that of the vehicle that it is compared with, None if it has none.
    """

    settings: EstimateSettings
    direction: Direction | None
    spectra: CrossSpectra
    segments: SegmentSpectra
    chosen: Tensor
    speed_m_per_s: float
    speeds: Speeds
    doubts: str
    left_out: Tensor | None


Bin = TypeVar("Bin", bound=SeenBin)


@dataclass(frozen=True)
class SpeedBin(SeenBin):
    """One method's estimate from a group of segments.

    `estimate` has one row; `noise_share` (n_outputs,) is the fraction of its squared half widths
    that is due to the noise of the segments.
    """

    method: FittedMethod
    estimate: Estimate
    noise_share: FloatArray


def largest(bins: Sequence[Bin]) -> Bin:
    """Return the bin with the most averages."""
    return max(bins, key=lambda b: b.spectra.n_averages)


def combined(bins: Sequence[SpeedBin]) -> Estimate:
    """Return one estimate from several speed bins: weighted means of the logarithms.

    Weights are the inverse squares of the half widths, or the averages where there are none. The
    noise of bins is independent, as they share no segment; the other errors are assumed to be fully
    correlated, as models may have the same errors. Bins that differ by more than their noise show
    how large these errors are, so that slow and fast parts of a trip check each other: the error
    that is not noise is then at least this scatter.
    """
    if len(bins) == 1:
        return bins[0].estimate
    half = np.concatenate([b.estimate.half_widths for b in bins])  # (n_bins, n_outputs)
    weights = np.ones_like(half) * np.array([[b.spectra.n_averages] for b in bins])
    if (np.isfinite(half) & (half > 0)).all():
        weights = 1 / half**2
    weights = weights / weights.sum(axis=0)
    share = np.stack([b.noise_share for b in bins])
    noise = np.sum(weights**2 * share * half**2, axis=0)
    lasting = np.sum(weights * np.sqrt(1 - share) * half, axis=0) ** 2
    logs = np.log([b.estimate.values[0] for b in bins])
    mean = np.sum(weights * logs, axis=0)
    values = np.exp(mean)
    # scatter beyond noise, as the square of a half width
    freedom = np.maximum(1 - np.sum(weights**2, axis=0), np.finfo(float).eps)
    spread = np.sum(weights * (logs - mean) ** 2, axis=0) / freedom
    widths = norm.ppf((1 + bins[0].estimate.level) / 2) ** 2 * spread
    lasting = np.maximum(lasting, widths - np.mean(share * half**2, axis=0))
    ends = [values * np.exp(sign * np.sqrt(noise + lasting)) for sign in (-1, 1)]
    first = bins[0].estimate
    rows = values[None], ends[0][None], ends[1][None]
    misfit = largest(bins).estimate.misfit
    return Estimate(first.names, *rows, first.level, _flags(bins), first.healthy, misfit=misfit)


def _flags(bins: Sequence[SpeedBin]) -> Flags:
    """Return the flags of a trip's estimate: with several bins, those of the largest flagged bin.

    The reasons of bins differ only in their numbers.
    """
    flagged = [b for b in bins if b.estimate.flags.flagged.any()]
    if not flagged:
        return Flags.none(1)
    worst = largest(flagged)
    at = Finding(
        "in-speed-bins", n_found=len(flagged), n_bins=len(bins), speed_m_per_s=worst.speed_m_per_s
    )
    (kind, words), *others = worst.estimate.flags.given[0]
    return Flags((((kind, of(at, words)), *others),))
