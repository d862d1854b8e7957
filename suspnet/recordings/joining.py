"""Two recordings that follow each other, as one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from suspnet.recordings.recording import Recording


def followed(one: Recording, other: Recording, offset_s: float) -> Recording:
    """Return a recording that goes on with another one of the same sensors.

    Between the last instant of the first and the first of the second nothing is usable: a moment at
    least, as filters need samples on both sides.

    Parameters
    ----------
    one, other : Recording
    offset_s : float, [s]
        Zero of the second one's clock on that of the first.
    """
    end = round(one.start_s * one.rate_hz) + len(one.usable)
    n_gap = round((other.start_s + offset_s) * one.rate_hz) - end
    n_skip = max(-n_gap, 0)  # a rate that is no whole number may let them overlap by an instant
    n_gap = max(n_gap, 0)
    usable = [one.usable, np.zeros(n_gap, dtype=np.bool_), other.usable[n_skip:]]
    speeds = [one.speed_m_per_s, np.full(n_gap, np.nan), other.speed_m_per_s[n_skip:]]
    signals = [one.signals, np.zeros((len(one.signals), n_gap)), other.signals[:, n_skip:]]
    pairs = [
        one.differences,
        np.zeros((len(one.differences), n_gap)),
        other.differences[:, n_skip:],
    ]
    later = (replace(fault, first_s=fault.first_s + offset_s) for fault in other.faults)
    words = dict.fromkeys(filter(None, (one.words, other.words)))
    return replace(
        one,
        signals=np.concatenate(signals, axis=1),
        usable=np.concatenate(usable),
        speed_m_per_s=np.concatenate(speeds),
        faults=(*one.faults, *later),
        duration_s=sum(map(len, usable)) / one.rate_hz,
        differences=np.concatenate(pairs, axis=1),
        words="; ".join(words),
    )
