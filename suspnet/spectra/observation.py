"""Interfaces of an observation of curves: settings, observer and misfit, and common checks.

An observation is a pair of classes: settings, which hold the numbers of a YAML file, and the
observer that they make of a generator. `curves` is the paper's (magnitudes with white noise),
`estimates` that of trips (transfer functions estimated from recordings).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Protocol, Self

from torch import Tensor

from suspnet.dynamics import ResponseGenerator, Vehicle
from suspnet.ground.checks import check_number
from suspnet.spectra.directions import Directions

LEAST_CALIBRATION = 100
"""Least number of calibration curves; the coverage of a 90 % interval then scatters by 3 %."""

MOST_CURVES = 100_000_000
"""Largest number of curves; their parameters alone then fill 4 GB."""


class Misfit(Protocol):
    """Residuals of observed curves in units of their noise.

    Their sum of squares is -2 log likelihood; with J the derivative, J^T J is the Fisher
    information.

    Attributes
    ----------
    observed : tensor of shape (n_rows, 2, n_freq), [-]
    expected : float
        Mean square of a residual if the model is true.
    """

    @property
    def observed(self) -> Tensor: ...  # noqa: D102

    @property
    def expected(self) -> float: ...  # noqa: D102

    def __call__(self, ratios: Tensor, rows: Tensor) -> Tensor:
        """Return residuals (n, n_points) of the vehicles `ratios` (n, 5) to the curves `rows`."""
        ...


class Observer(Protocol):
    """Makes curves of vehicles as they would be observed.

    Attributes
    ----------
    settings : Observation
    generator : ResponseGenerator
    frequencies_hz : tensor of shape (n_freq,), [Hz]
    directions : Directions
        Of the generator's uncertain numbers, which its curves show.
    """

    @property
    def settings(self) -> Any: ...  # noqa: D102

    @property
    def generator(self) -> ResponseGenerator: ...  # noqa: D102

    @property
    def frequencies_hz(self) -> Tensor: ...  # noqa: D102

    @property
    def directions(self) -> Directions: ...  # noqa: D102

    def noise_free(self, ratios: Tensor) -> Tensor:
        """Return curves without noise, shape (n_vehicles, 2, n_freq)."""
        ...

    def observe(self, ratios: Tensor, seed: int) -> Tensor:
        """Return noisy curves; the generator's uncertain quantities are drawn too."""
        ...

    def for_features(self, curves: Tensor) -> Tensor:
        """Return curves (n_curves, 2, n_freq) as the feature set is to see them."""
        ...

    def misfit(self, curves: Tensor, near: Tensor, used: Sequence[int] = (0, 1)) -> Misfit:
        """Return the misfit of observed curves.

        Parameters
        ----------
        curves : tensor of shape (n_curves, 2, n_freq), [-]
        near : tensor of shape (n_curves, 5), [-]
            Ratios of vehicles whose noise is like that of the curves.
        used : sequence of int
            Which of G_p (0) and G_s (1) are used.
        """
        ...


class Observation(Protocol):
    """Settings of an observation, as in a file of configs/data.

    Attributes
    ----------
    kind : str
        Names the observation in model files.
    n_train, n_test : int or "all"
        Curves for training and testing; "all" is the whole grid of the protocol.
    n_calibrate : int or None
        Fresh curves from which intervals and thresholds are learnt; None gives the model neither.
    snr_db : float, [dB]
    low_hz, high_hz : float or None, [Hz]
        Band.
    cache_dir : str or None
        Where feature tables are kept between runs; None keeps none.
    """

    __dataclass_fields__: ClassVar[dict[str, Any]]
    kind: ClassVar[str]

    @property
    def n_train(self) -> int | str: ...  # noqa: D102

    @property
    def n_test(self) -> int | str: ...  # noqa: D102

    @property
    def n_calibrate(self) -> int | None: ...  # noqa: D102

    @property
    def snr_db(self) -> float: ...  # noqa: D102

    @property
    def low_hz(self) -> float | None: ...  # noqa: D102

    @property
    def high_hz(self) -> float | None: ...  # noqa: D102

    @property
    def cache_dir(self) -> str | None: ...  # noqa: D102

    def bound(self, vehicle: Vehicle) -> Self:
        """Return the settings for a vehicle, with the values that follow from it filled in."""
        ...

    def frequencies_hz(self) -> Tensor:
        """Return the frequency bins, shape (n_freq,), [Hz]."""
        ...

    def observer(self, generator: ResponseGenerator) -> Observer:
        """Return the observer of a generator's vehicles."""
        ...

    def words(self) -> str:
        """Return in words what is observed, with which noise."""
        ...


def check_counts(settings: Observation) -> None:
    """Raise TypeError or ValueError unless every number of curves is one."""
    for name in ("n_train", "n_test"):
        value = getattr(settings, name)
        if value != "all":
            check_number(f"data.{name}", value, low=1, most=MOST_CURVES, whole=True)
    check_number(
        "data.n_calibrate",
        settings.n_calibrate,
        low=LEAST_CALIBRATION,
        most=MOST_CURVES,
        whole=True,
        optional=True,
    )
