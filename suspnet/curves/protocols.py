"""Protocols: the parameters that vary, the measured curves and the outputs (Table IV)."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Annotated, Any, Literal

import numpy as np
from scipy.stats import qmc

from suspnet.curves.components import FEATURE_SETS, CurveFeatures
from suspnet.curves.extraction import FeatureSet, PeakFeatures
from suspnet.ground.parameters import BODY_MASS, PARAMETERS
from suspnet.ground.settings import (
    Setting,
    check_choice,
    check_flag,
    check_number,
    check_settings,
    setting,
)
from suspnet.ground.types import BoolArray, FloatArray

RESPONSES = ("G_p", "G_s")
BODY_MASS_COLUMN = PARAMETERS.index(BODY_MASS)
"""Column of the car-body mass in arrays ordered as ``PARAMETERS``."""
REACH = 2.0
"""Factor beyond the training range up to which the estimate of a regression means anything: of
noisy features, the exponential of its output can be any number."""
SHARED = (
    "sampling test_sampling lower upper step mass_step mass_known log_ratios standardised".split()
)
"""Settings of a protocol that its tasks share."""
TEST_STREAM = 1  # number of the stream of test curves


def columns_of(parameters: Sequence[str]) -> list[int]:
    """Return the columns of some parameters in arrays ordered as ``PARAMETERS``."""
    return [PARAMETERS.index(name) for name in parameters]


@dataclass(frozen=True)
class Task:
    """One group of one protocol: everything that defines a learning problem.

    `varied_sets` are sets of parameters that vary together while the others stay healthy, such as
    the groups of Table IV; curves are drawn from each of them. `outputs` are estimated, `responses`
    from ``RESPONSES`` may be used; the others are as in `Protocol`, ranges relative to healthy.
    TypeError or ValueError if a name is unknown or a number is out of range.
    """

    protocol: str
    group: str
    varied_sets: tuple[tuple[str, ...], ...]
    outputs: tuple[str, ...]
    responses: tuple[str, ...]
    extractor: FeatureSet
    sampling: Literal["grid", "sobol"]
    test_sampling: Literal["grid", "sobol"]
    lower: float
    upper: float
    mass_lower: float
    mass_upper: float
    step: float
    mass_step: float
    mass_known: bool
    log_ratios: bool
    standardised: bool

    def __post_init__(self) -> None:
        for names in self.varied_sets:
            _known(names, PARAMETERS, "varied")
        _known(self.outputs, self.varied, "outputs")
        _known(self.responses, RESPONSES, "responses")
        for name in ("sampling", "test_sampling"):
            check_choice(name, getattr(self, name), ("grid", "sobol"))
        for low, high in (("lower", "upper"), ("mass_lower", "mass_upper")):
            check_number(low, getattr(self, low), above=0, most=100)
            check_number(high, getattr(self, high), above=getattr(self, low), most=100)
        for name in ("step", "mass_step"):
            check_number(name, getattr(self, name), above=0, most=100)
        for name in ("mass_known", "log_ratios", "standardised"):
            check_flag(name, getattr(self, name))
        if not self.standardised and not self.extractor.positive:
            raise ValueError(
                f"the feature set {self.extractor.kind!r} has no relative changes, which "
                "`standardised=false` asks for; take feature_set=peaks"
            )

    @property
    def inputs(self) -> tuple[str, ...]:
        """Name of each input of the model."""
        return self.extractor.names + ((BODY_MASS,) if self.mass_known else ())

    @property
    def varied(self) -> tuple[str, ...]:
        """Parameters that vary in any of the sets, in the order of ``PARAMETERS``."""
        return tuple(name for name in PARAMETERS if any(name in s for s in self.varied_sets))

    @property
    def output_indices(self) -> list[int]:
        """Columns of the outputs in arrays ordered as ``PARAMETERS``."""
        return columns_of(self.outputs)

    @property
    def unknown(self) -> tuple[str, ...]:
        """Varied parameters that are not measured and have to be estimated."""
        measured = (BODY_MASS,) if self.mass_known else ()
        return tuple(name for name in self.varied if name not in measured)

    @property
    def unknown_sets(self) -> list[tuple[str, ...]]:
        """Unknown parameters of each of the sets that vary together."""
        return [tuple(n for n in names if n in self.unknown) for names in self.varied_sets]

    def rows_of_sets(self, ratios: FloatArray) -> list[tuple[tuple[str, ...], BoolArray]]:
        """Return the unknown parameters of each set and the vehicles (n_vehicles, 5) it is of.

        A vehicle is of the first set outside of which it is healthy, else of none: then all
        parameters are unknown. Sets without a vehicle are left out.
        """
        unassigned, sets = np.ones(len(ratios), dtype=bool), []
        for names, unknown in zip(self.varied_sets, self.unknown_sets, strict=True):
            others = [j for j, name in enumerate(PARAMETERS) if name not in names]
            rows = unassigned & (ratios[:, others] == 1).all(axis=1)
            sets.append((unknown, rows))
            unassigned = unassigned & ~rows
        sets.append((self.unknown, unassigned))
        return [(unknown, rows) for unknown, rows in sets if rows.any()]

    @property
    def used_responses(self) -> list[int]:
        """Indices in ``RESPONSES`` of the curves that may be used."""
        return [RESPONSES.index(name) for name in self.responses]

    def describe(self) -> dict[str, Any]:
        """Return the task as JSON-able values, its feature set without the learnt arrays."""
        extractor = self.extractor.blank()
        plain: dict[str, Any] = json.loads(json.dumps(asdict(replace(self, extractor=extractor))))
        plain["extractor"]["kind"] = extractor.kind
        return plain

    def levels(self, name: str) -> FloatArray:
        """Return the grid values of a parameter's ratio, e.g. 0.50, 0.51 ... 2.00."""
        step = self.mass_step if name == BODY_MASS else self.step
        lower, upper = self.range(name)
        n_steps = math.floor((upper - lower) / step + 1e-9)
        return np.asarray(np.round(lower + step * np.arange(n_steps + 1), 10))

    def range(self, name: str) -> tuple[float, float]:
        """Return the range of a parameter's ratio, [-]."""
        return (self.mass_lower, self.mass_upper) if name == BODY_MASS else (self.lower, self.upper)

    def bounded(self, ratios: FloatArray, reach: float = REACH) -> FloatArray:
        """Return ratios of the outputs (n, n_outputs), none outside ``reach`` times their range.

        From the lower end of the training range over `reach` to its upper end times `reach`; NaN
        stays NaN.
        """
        ranges = np.array([self.range(name) for name in self.outputs])
        return np.clip(ratios, ranges[:, 0] / reach, ranges[:, 1] * reach)

    @property
    def grid_sizes(self) -> list[int]:
        """Number of curves of the full grid of each set."""
        return [math.prod(len(self.levels(name)) for name in s) for s in self.varied_sets]

    def sample(self, n_curves: int | None, seed: int, stream: int) -> FloatArray:
        """Return ratios (n_curves, 5) of training (stream 0), test (1) or calibration (2) curves.

        A grid is shuffled by the seed. Training curves come from its start, test curves from its
        end and calibration curves from its middle, so they share no vehicle unless the grid is too
        small; None curves are the full grid, in its natural order. Sobol points are scrambled with
        a separate seed for each stream. ValueError if the grid has fewer curves, or if None is
        given for a Sobol sequence.
        """
        sampling = self.test_sampling if stream == TEST_STREAM else self.sampling
        draw = self._sobol if sampling == "sobol" else self._grid
        return draw(n_curves, seed, stream)

    def _grid(self, n_curves: int | None, seed: int, stream: int) -> FloatArray:
        """Return the ratios of a stream's points of the grids, shape (n_curves, 5)."""
        total = sum(self.grid_sizes)
        if n_curves is None:
            chosen = np.arange(total)
        elif n_curves > total:
            raise ValueError(
                f"the grid of group {self.group!r} holds {total} curves, {n_curves} were asked for"
            )
        else:
            shuffled = np.random.default_rng(seed).permutation(total)
            ordered = (shuffled, shuffled[::-1], np.roll(shuffled, -(total // 2)))[stream]
            chosen = ordered[:n_curves]
        ratios = np.ones((len(chosen), len(PARAMETERS)))
        start = 0
        for names, size in zip(self.varied_sets, self.grid_sizes, strict=True):
            rows = np.flatnonzero((chosen >= start) & (chosen < start + size))
            levels = [self.levels(name) for name in names]
            index = np.unravel_index(chosen[rows] - start, [len(level) for level in levels])
            for name, level, places in zip(names, levels, index, strict=True):
                ratios[rows, PARAMETERS.index(name)] = level[places]
            start += size
        return ratios

    def _sobol(self, n_curves: int | None, seed: int, stream: int) -> FloatArray:
        """Return scrambled Sobol points of each set in turn, shape (n_curves, 5)."""
        if n_curves is None:
            raise ValueError(f"protocol {self.protocol!r} has no finite grid; give a number")
        ratios = np.ones((n_curves, len(PARAMETERS)))
        for k, names in enumerate(self.varied_sets):
            rows = np.arange(k, n_curves, len(self.varied_sets))
            rng = np.random.default_rng([seed, stream, k] if k else [seed, stream])
            sampler = qmc.Sobol(len(names), rng=rng)
            n_points = max(1, math.ceil(math.log2(max(1, len(rows)))))
            points = sampler.random_base2(n_points)[: len(rows)]
            ranges = np.array([self.range(name) for name in names])
            scaled = ranges[:, 0] + (ranges[:, 1] - ranges[:, 0]) * points
            ratios[rows[:, None], columns_of(names)] = scaled
        return ratios


@dataclass(frozen=True)
class Protocol:
    """A formulation of the problem; `task` gives the learning problem of one of its groups.

    `features` are further arguments of ``PeakFeatures``. ValueError if a name is unknown or a
    setting is out of range.
    """

    name: Annotated[str, Setting("Name of the protocol in tables and model files", rule="text")]
    groups: Annotated[
        Mapping[str, Mapping[str, Sequence[str]]],
        Setting(
            "For each group the parameters that vary and are estimated (outputs: k_p, c_p, k_s, "
            "c_s), the curves that may be used (responses: G_p, G_s), and their peaks (secondary, "
            "primary_lower, primary_upper, primary_largest)",
            rule="mapping",
        ),
    ]
    sampling: Literal["grid", "sobol"] = setting(
        "grid",
        "How vehicles are drawn: from the grid of Table IV, or as Sobol points over the whole "
        "range",
    )
    test_sampling: Literal["grid", "sobol"] | None = setting(
        None, "How test vehicles are drawn; null is as `sampling` says"
    )
    varied: Annotated[
        Sequence[Sequence[str]] | None,
        Setting(
            "Sets of parameters that vary together while all others stay healthy, of all groups; "
            "curves are drawn from each set. null is the outputs of each group and the mass",
            rule="lists of k_p, c_p, k_s, c_s, M_s",
        ),
    ] = None
    lower: float = setting(
        0.5, "Lower end of the range of stiffness and damping relative to healthy", above=0, below=1
    )
    upper: float = setting(2.0, "Upper end of that range", low=1, most=100)
    step: float = setting(
        0.01, "Step of the grid in stiffness and damping relative to healthy", above=0, most=100
    )
    mass_step: float = setting(
        0.1, "Step of the grid in the car body's mass relative to the vehicle's", above=0, most=100
    )
    mass_lower: float | None = setting(
        None,
        "Lower end of the range of the car body's mass relative to the vehicle's; null is `lower`",
        above=0,
        below=1,
    )
    mass_upper: float | None = setting(
        None, "Upper end of that range; null is `upper`", above=1, most=100
    )
    mass_known: bool = setting(
        False,
        "Whether the measured mass of the car body is one more input; such a model cannot read "
        "trips",
    )
    estimate_mass: bool = setting(
        False, "Whether the mass of the car body is one more output; not together with mass_known"
    )
    log_ratios: bool = setting(
        True,
        "Whether inputs and outputs are logarithms of the ratios to healthy, or the ratios "
        "themselves",
    )
    standardised: bool = setting(
        True,
        "Whether inputs and outputs are scaled to mean 0 and deviation 1, or are relative changes "
        "as they are",
    )
    feature_set: str = setting(
        "peaks",
        "Inputs of the model: position, height and width of peaks, or principal components of "
        "the whole curves",
        rule="peaks or curve, or the kind of a registered feature set",
    )
    features: Mapping[str, Any] = field(default_factory=dict)
    curve: Annotated[
        Mapping[str, Any],
        Setting(
            "Settings of feature_set=curve: n_components, explained, low_hz, high_hz, as "
            "protocol=trips lists them",
            rule="mapping",
        ),
    ] = field(default_factory=dict)
    feature_settings: Annotated[
        Mapping[str, Any] | None, Setting("Settings of a registered feature set", rule="mapping")
    ] = None

    def __post_init__(self) -> None:
        check_settings(self)
        check_choice("feature_set", self.feature_set, tuple(FEATURE_SETS))
        check_number("mass_upper", self._mass_range()[1], above=1, most=100)
        if self.mass_known and self.estimate_mass:
            raise ValueError("the car-body mass is either known or estimated, not both")
        for group in self.groups:
            self.task(group)  # checks everything else

    def task(self, group: str) -> Task:
        """Return the learning problem of a group; ValueError if the protocol has no such group."""
        if group not in self.groups:
            raise ValueError(
                f"protocol {self.name!r} has no group {group!r}; choose from {sorted(self.groups)}"
            )
        entry = self.groups[group]
        peaks_needed = {"peaks"} if self.feature_set == "peaks" else set()
        missing = {"outputs", "responses", *peaks_needed} - set(entry)
        if missing:
            raise ValueError(f"group {group!r} of protocol {self.name!r} lacks {sorted(missing)}")
        outputs = tuple(_known(entry["outputs"], PARAMETERS[:4], "outputs"))
        varied = [(*outputs, BODY_MASS)] if self.varied is None else self.varied
        return Task(
            protocol=self.name,
            group=group,
            varied_sets=tuple(map(tuple, varied)),
            outputs=(*outputs, BODY_MASS) if self.estimate_mass else outputs,
            responses=tuple(entry["responses"]),
            extractor=self._extractor(entry),
            mass_lower=self._mass_range()[0],
            mass_upper=self._mass_range()[1],
            **{name: getattr(self, name) for name in SHARED}
            | {"test_sampling": self.test_sampling or self.sampling},
        )

    def _extractor(self, entry: Mapping[str, Sequence[str]]) -> FeatureSet:
        if self.feature_set == "curve":
            if set(entry["responses"]) != set(RESPONSES):
                raise ValueError(
                    f"the feature set `curve` uses both responses, protocol {self.name!r} only "
                    f"{list(entry['responses'])}: take feature_set=peaks or another protocol"
                )
            return CurveFeatures(**self.curve)
        if self.feature_set == "peaks":
            return PeakFeatures(peaks=tuple(entry["peaks"]), **self.features)
        registered = FEATURE_SETS[self.feature_set]
        settings = self.feature_settings or {}
        names = [declared.name for declared in fields(registered)]
        unknown = sorted(set(settings) - set(names))
        if unknown:
            raise ValueError(
                f"`feature_settings.{unknown[0]}` is no setting of {registered.kind}, only "
                f"{', '.join(names)}"
            )
        feature_set: FeatureSet = registered(**settings)
        return feature_set

    def _mass_range(self) -> tuple[float, float]:
        low = self.lower if self.mass_lower is None else self.mass_lower
        return low, self.upper if self.mass_upper is None else self.mass_upper


def _known(names: Sequence[str], allowed: Sequence[str], key: str) -> Sequence[str]:
    if not names or any(name not in allowed for name in names) or len(set(names)) < len(names):
        raise ValueError(
            f"`{key}` must be chosen from {tuple(allowed)}, each once, got {list(names)}"
        )
    return names
