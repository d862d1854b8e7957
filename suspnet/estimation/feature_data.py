"""Inputs and outputs of a learning problem, one row a curve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suspnet.ground.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class FeatureData:
    """Inputs and outputs of a learning problem, one row a curve.

    Attributes
    ----------
    inputs : array of shape (n_curves, n_inputs), [-]
        Features relative to the healthy vehicle's (and the mass ratio where it is known); NaN
        where a peak is missing.
    outputs : array of shape (n_curves, n_outputs), [-]
        Parameters relative to healthy.
    ratios : array of shape (n_curves, 5), [-]
        All parameters relative to healthy, in the order of ``PARAMETERS``.
    reasons : array of shape (n_curves, n_peaks)
        A ``PeakReason`` for each peak.
    """

    inputs: FloatArray
    outputs: FloatArray
    ratios: FloatArray
    reasons: IntArray

    @property
    def valid(self) -> BoolArray:
        """True where every feature was found, shape (n_curves,)."""
        return np.asarray(np.isfinite(self.inputs).all(axis=1))

    def complete(self) -> FeatureData:
        """Return the curves on which every feature was found.

        Raises
        ------
        ValueError
            If there is none.
        """
        kept = self.valid
        if not kept.any():
            raise ValueError(f"none of the {len(kept)} curves has all of its peaks")
        return self.subset(kept)

    def first(self, n_curves: int) -> FeatureData:
        """Return the first curves."""
        return self.subset(np.arange(len(self.inputs)) < n_curves)

    def subset(self, rows: BoolArray) -> FeatureData:
        """Return the curves for which `rows` is true, perhaps none."""
        return FeatureData(
            self.inputs[rows], self.outputs[rows], self.ratios[rows], self.reasons[rows]
        )
