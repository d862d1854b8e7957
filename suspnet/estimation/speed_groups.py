"""Which segments of a recording are read together, and by which of some models.

Checking, commissioning, reading and monitoring ask here, so that they agree.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from suspnet.estimation.fitted import FittedMethod
from suspnet.estimation.from_spectra import trip_settings
from suspnet.spectra.speeds import SpeedRange, range_words, reading_range


def steady_segments(speeds: Tensor, tolerance: float) -> Tensor:
    """Return which segments keep their speed (n_segments, n_samples) within 1 +- tolerance."""
    return (speeds / speeds.mean(dim=1, keepdim=True) - 1).abs().amax(dim=1) <= tolerance


def same_speed(speeds: Tensor, within: Tensor, tolerance: float) -> list[Tensor]:
    """Return groups of segments of like speed, the largest first, each bool (n_segments,).

    A group's mean speeds lie within 1 +- tolerance of its middle. The most segments that one such
    range holds are a group; then the most of the others, until none is left.

    Parameters
    ----------
    speeds : tensor of shape (n_segments, n_samples), [m/s]
    within : bool tensor of shape (n_segments,)
        Segments that are grouped.
    tolerance : float, [-]
    """
    means, left, groups = speeds.mean(dim=1), within.clone(), []
    widest = (1 + tolerance) / (1 - tolerance)
    while bool(left.any()):  # each round takes at least one segment
        lowest = means[left][:, None]
        inside = (means >= lowest) & (means <= lowest * widest * (1 + 1e-9)) & left
        group = inside[int(inside.sum(dim=1).argmax())]
        groups.append(group)
        left = left & ~group
    return groups


def groups_to_read(
    speeds: Tensor, tolerance: float, least_m_per_s: float, *, at_any_speed: bool = False
) -> list[Tensor]:
    """Return the groups of segments that are averaged, the largest first, each (n_segments,).

    Parameters
    ----------
    speeds : tensor of shape (n_segments, n_samples), [m/s]
    tolerance : float, [-]
        The speed of a segment, and the mean speeds of a group, stay within 1 +- this.
    least_m_per_s : float, [m/s]
        Slower segments are left out.
    at_any_speed : bool
        The vehicle's responses do not depend on the speed: all segments are one group.
    """
    if at_any_speed:
        group = (speeds >= least_m_per_s).all(dim=1)
        return [group] if bool(group.any()) else []
    groups = same_speed(speeds, steady_segments(speeds, tolerance), tolerance)
    return [group for group in groups if group_speed(speeds, group) >= least_m_per_s]


def group_speed(speeds: Tensor, group: Tensor) -> float:
    """Return the mean speed of a group of segments, by which a model reads all of it, [m/s]."""
    return float(speeds[group].mean())


def reads_at_any_speed(method: FittedMethod) -> bool:
    """Return whether a method's responses do not depend on the speed."""
    return method.generator.speed_m_per_s is None


def speed_range(method: FittedMethod) -> SpeedRange | None:
    """Return the speeds that a method reads; None is any."""
    speed = method.generator.speed_m_per_s
    if speed is None:
        return None
    return SpeedRange.around(speed, trip_settings(method).speed_half_width)


def groups_of(
    method: FittedMethod, models: Sequence[FittedMethod], speeds: Tensor, groups: Sequence[Tensor]
) -> list[Tensor]:
    """Return the groups of segments that a method reads, where some models read the recording.

    A group is read as a whole, by the model whose range holds its mean speed; by the nearest of
    several. A group that no model reads is in none of the lists.

    Parameters
    ----------
    method : FittedMethod
    models : sequence of FittedMethod
        All that read the recording, with the method itself.
    speeds : tensor of shape (n_segments, n_samples), [m/s]
    groups : sequence of bool tensors of shape (n_segments,)
        From `groups_to_read`.
    """
    own = speed_range(method)
    if own is None:
        return list(groups)
    ranges = [one for one in map(speed_range, models) if one is not None]
    return [group for group in groups if reading_range(group_speed(speeds, group), ranges) == own]


def readable_words(models: Sequence[FittedMethod]) -> str:
    """Return which speeds some models read: "the models read 61.0 to 78.0 m/s"."""
    ranges = [one for one in map(speed_range, models) if one is not None]
    subject = "the model reads" if len(models) == 1 else "the models read"
    return f"{subject} {range_words(ranges) if ranges else 'any speed'}"


def _speeds_of(speeds: Tensor, groups: Sequence[Tensor], most: int = 3) -> str:
    """Return the speeds of the largest groups: "69.1 and 50.0 m/s"."""
    each = dict.fromkeys(f"{group_speed(speeds, group):.1f}" for group in groups[:most])
    return f"{' and '.join(each)} m/s"


def no_group_words(
    speeds: Tensor,
    groups: Sequence[Tensor],
    models: Sequence[FittedMethod],
    tolerance: float,
    least_m_per_s: float,
) -> str:
    """Return why no group of segments can be read: none is steady, or none at a model's speed."""
    n_segments, half = len(speeds), float(speeds.mean(dim=1).median())
    if not groups:
        rule = f"steady within {100 * tolerance:g} %"
        if any(map(reads_at_any_speed, models)):
            rule = f"at {least_m_per_s:g} m/s or faster throughout"
        return (
            f"0 of {n_segments} segments without faults are {rule} (half of the trip is run at "
            f"{half:.1f} m/s or less)"
        )
    return (
        f"the trip is run at {_speeds_of(speeds, groups)}, {readable_words(models)}: is the speed "
        "in m/s? If so, train a model for it, speed_m_per_s=..."
    )
