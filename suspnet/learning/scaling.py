"""Scaling of the columns of inputs and outputs."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from suspnet.ground.types import FloatArray


@dataclass(frozen=True)
class Scaling:
    """Scaling of each column, z = (log v - mean) / scale, or without the logarithm.

    `mean`, `scale`: (n_columns,). With `log`, values must be positive.
    """

    mean: FloatArray
    scale: FloatArray
    log: bool = True

    @classmethod
    def of(cls, values: FloatArray, log: bool = True) -> Self:
        """Return the scaling that gives `values` (n_rows, n_columns) mean 0 and deviation 1.

        ValueError if a value is not finite, or not positive and `log` is True, or if a column is
        constant.
        """
        if not np.isfinite(values).all():
            raise ValueError("values must be finite to be scaled")
        if log and not (values > 0).all():
            raise ValueError("values must be positive for a logarithmic scaling")
        moved = np.log(values) if log else values
        mean, scale = moved.mean(axis=0), moved.std(axis=0)
        constant = np.flatnonzero(scale <= np.finfo(float).eps * np.abs(mean))
        if constant.size:
            raise ValueError(f"columns {constant.tolist()} are constant; nothing can be learnt")
        return cls(mean, scale, log)

    @classmethod
    def relative_changes(cls, n_columns: int, log: bool = False) -> Self:
        """Return the scaling of ratios to healthy v to v - 1, or to log v."""
        return cls(np.zeros(n_columns) if log else np.ones(n_columns), np.ones(n_columns), log)

    def apply(self, values: FloatArray) -> FloatArray:
        """Return scaled values, same shape."""
        moved = np.log(values) if self.log else values
        return np.asarray((moved - self.mean) / self.scale)

    def undo(self, scaled: FloatArray) -> FloatArray:
        """Return values from scaled ones, same shape."""
        moved = scaled * self.scale + self.mean
        return np.exp(moved) if self.log else np.asarray(moved)
