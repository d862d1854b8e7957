"""What the estimators of several outputs share: flags, shapes of outputs, stored arrays."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from suspnet.ground.settings import check_settings
from suspnet.ground.types import FloatArray


class MethodFlags:
    """What programs must know of a method, see `METHODS`; the defaults suit most methods."""

    works_on_curves: ClassVar[bool] = False


class Regressor(MethodFlags, MultiOutputMixin, RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """Base of estimators that take outputs (n_samples,) or (n_samples, n_outputs)."""

    _single_output: bool

    def _training_data(self, X: ArrayLike, y: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return checked samples and outputs (n_samples, n_outputs), after checking settings."""
        check_settings(self)
        X, y = validate_data(self, X, y, multi_output=True, y_numeric=True, dtype=np.float64)
        targets = np.asarray(y, dtype=np.float64)
        self._single_output = targets.ndim == 1
        return np.asarray(X), targets.reshape(len(targets), -1)

    def _inputs(self, X: ArrayLike) -> FloatArray:
        check_is_fitted(self)
        return np.asarray(validate_data(self, X, reset=False, dtype=np.float64))

    def _as_trained(self, values: FloatArray) -> FloatArray:
        """Return values (n_samples, n_outputs) with as many dimensions as `y` had in `fit`."""
        return values[:, 0] if self._single_output else values

    def _stored(self, name: str) -> FloatArray:
        """Return an offset (n_outputs,) for storage, of shape () if `y` had one dimension."""
        check_is_fitted(self)
        offset: FloatArray = getattr(self, name)
        return offset.reshape(() if self._single_output else -1)

    def _restored(self, offset: FloatArray) -> FloatArray:
        """Return a stored offset as (n_outputs,); it tells how many dimensions `y` had."""
        self._single_output = offset.ndim == 0
        return np.atleast_1d(offset)


@contextmanager
def arrays_of(kind: str) -> Iterator[None]:
    """Raise ValueError if arrays of a stored model are missing, or are those of another kind."""
    try:
        yield
    except (KeyError, TypeError) as error:
        raise ValueError(f"the arrays are not those of {kind} model ({error})") from error
