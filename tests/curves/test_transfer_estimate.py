"""Estimates of transfer functions against scipy's and against the scatter of simulated records."""

import math

import numpy as np
import pytest
import torch
import trips_reference
from built_once import built_once
from scipy import signal

from suspnet.curves.cross_spectra import METHODS, PAIRS, CrossSpectra
from suspnet.curves.welch import Welch, segment_spectra, tfestimate

SEGMENT = 64  # samples, at 1 Hz
WELCH = Welch(segment_s=float(SEGMENT))
N_RECORDS, N_SEGMENTS = 1500, 60
INNER = slice(4, SEGMENT // 2 - 4)
FILTERS = (([1.0, 0.4], [1.0]), ([0.5, -0.3], [1.0]))
"""Axle box to bogie, bogie to body: short against a segment."""
NOISE = (0.3, 0.2, 0.1)
KINDS = ["H1", "H2", "Hv", "IV"]


def three_channels(rng, shape, noise=NOISE):
    """Return records of a chain of two filters, (*shape[:-1], 3, n), with noise on each sensor."""
    source = rng.standard_normal((*shape[:-1], shape[-1] + 8))
    chain = [source]
    for b, a in FILTERS:
        chain.append(signal.lfilter(b, a, chain[-1]))
    records = np.stack(chain, axis=-2)[..., 8:]
    return records + np.array(noise)[:, None] * rng.standard_normal(records.shape)


def true_spectra(frequencies, n_averages=1.0, noise=NOISE):
    """Return the spectra of `three_channels` as naive products of filter gains, one-sided."""
    gains = [np.ones(len(frequencies), dtype=complex)]
    for b, a in FILTERS:
        gains.append(gains[-1] * signal.freqz(b, a, frequencies, fs=1.0)[1])
    auto = [2 * (abs(g) ** 2 + s**2) for g, s in zip(gains, noise, strict=True)]
    cross = [2 * gains[x].conj() * gains[y] for x, y in PAIRS]
    return CrossSpectra(
        torch.as_tensor(np.array(auto)), torch.as_tensor(np.array(cross)), n_averages
    )


def averaged(records, welch=WELCH):
    """Return the spectra of many records, (n_records, 3, n_freq)."""
    n_records, n_channels, n = records.shape
    segments = segment_spectra(torch.as_tensor(records.reshape(-1, n)), 1.0, welch)
    values = segments.values.reshape(len(segments.values), n_records, n_channels, -1)
    auto = values.abs().square().mean(dim=0)
    cross = torch.stack(
        [(values[:, :, x].conj() * values[:, :, y]).mean(dim=0) for x, y in PAIRS], dim=1
    )
    n_averages = welch.n_averages(len(values))
    return segments.frequencies_hz, CrossSpectra(auto, cross, n_averages)


@pytest.fixture(scope="module")
def many():
    """Spectra of many independent records of `three_channels`."""

    def build(folder):
        n_samples = SEGMENT + (N_SEGMENTS - 1) * SEGMENT // 2
        records = three_channels(np.random.default_rng(3), (N_RECORDS, n_samples))
        frequencies, found = averaged(records)
        folder.mkdir()
        np.savez(folder / "many.npz", f=frequencies, auto=found.auto, cross=found.cross)
        (folder / "n").write_text(repr(found.n_averages))

    folder = built_once("three_channels", build)
    known, n = np.load(folder / "many.npz"), float((folder / "n").read_text())
    auto, cross = (torch.as_tensor(known[name]) for name in ("auto", "cross"))
    return known["f"], CrossSpectra(auto, cross, n)


@pytest.fixture(scope="module")
def expected(many):
    """What the spectra of `many` tend to, on the same bins."""
    frequencies, spectra = many
    taps = WELCH.smear().numpy()
    margin = np.arange(1, len(taps) // 2 + 1) / SEGMENT
    wide = np.concatenate([frequencies[0] - margin[::-1], frequencies, frequencies[-1] + margin])
    exact = true_spectra(wide)
    auto, cross = (
        torch.as_tensor(np.array([trips_reference.smeared(row, taps) for row in rows.numpy()]))
        for rows in (exact.auto, exact.cross)
    )
    return CrossSpectra(auto, cross, spectra.n_averages)


def relative_spread(estimates, expected):
    """Return the rms over records, divided by what is expected, averaged over inner bins."""
    return (estimates.std(dim=0) / expected)[..., INNER].mean(dim=-1)


# reference


@pytest.mark.parametrize(
    ("window", "overlap", "length"),
    [("hann", 0.5, 250), ("hamming", 0.73, 251), ("boxcar", 0.0, 250)],
)
def test_estimates_equal_scipys(window, overlap, length):
    rate_hz = 100.0
    x, y, z = three_channels(np.random.default_rng(0), (2000,)) + 3.0
    welch = Welch(segment_s=length / rate_hz, overlap=overlap, window=window)
    options = {
        "fs": rate_hz,
        "window": window,
        "nperseg": length,
        "noverlap": round(overlap * length),
        "detrend": "constant",
    }
    frequencies, s_xx = signal.welch(x, **options)
    _, s_yy = signal.welch(y, **options)
    s_xy, s_zx, s_zy = (signal.csd(a, b, **options)[1] for a, b in ((x, y), (z, x), (z, y)))
    by_scipy = {
        "H1": s_xy / s_xx,
        "H2": s_yy / s_xy.conj(),
        "Hv": np.sqrt(s_yy / s_xx) * s_xy / abs(s_xy),
        "IV": s_zy / s_zx,
    }
    assert set(by_scipy) == set(METHODS)
    inside = slice(1, None)  # the mean is removed: nothing but rounding is left in bin 0 of boxcar
    for method, response in by_scipy.items():
        found = tfestimate(x, y, rate_hz, welch, method, instrument=z)
        np.testing.assert_allclose(found.frequencies_hz, frequencies, rtol=1e-12)
        np.testing.assert_allclose(found.response[inside], response[inside], rtol=1e-10)
        coherence = signal.coherence(x, y, **options)[1]
        assert coherence.max() > 0.9
        np.testing.assert_allclose(found.coherence[inside], coherence[inside], rtol=1e-10)


@pytest.mark.parametrize("length", [50, 51])
def test_power_densities_equal_scipys_at_every_bin(length):
    records = three_channels(np.random.default_rng(1), (500,))
    segments = segment_spectra(torch.as_tensor(records), 20.0, Welch(length / 20.0))
    spectra = segments.average(torch.ones(len(segments.values), dtype=torch.bool))
    options = {"fs": 20.0, "nperseg": length, "noverlap": round(0.5 * length)}
    _, power = signal.welch(records, detrend="constant", **options)
    np.testing.assert_allclose(spectra.auto, power, rtol=1e-10)
    for row, (x, y) in zip(spectra.cross, PAIRS, strict=True):
        _, cross = signal.csd(records[x], records[y], detrend="constant", **options)
        # at the ends a cross spectrum may nearly vanish
        np.testing.assert_allclose(row, cross, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("window", ["hann", "hamming", "boxcar"])
@pytest.mark.parametrize(("overlap", "n"), [(0.0, 9), (0.5, 2), (0.5, 9), (0.75, 9)])
@pytest.mark.parametrize("n_bins", [1, 5])
def test_number_of_averages_is_welchs_sum(window, overlap, n, n_bins):
    welch = Welch(segment_s=20.0, overlap=overlap, window=window)
    step = round(256 * (1 - overlap))
    expected = trips_reference.n_averages(signal.get_window(window, 256), step, n, n_bins)
    assert welch.n_averages(n, n_bins) == pytest.approx(expected, rel=1e-10)
    assert welch.n_averages(n) <= n
    assert (welch.n_averages(n) == n) == (overlap == 0)


@pytest.mark.parametrize("n_averages", [1, 3.2, 10, math.nextafter(7, 8), 1e6])
@pytest.mark.parametrize("overlap", [0.0, 0.5, 0.75])
@pytest.mark.parametrize("n_bins", [1, 5])
def test_least_number_of_segments_holds_the_averages(overlap, n_averages, n_bins):
    welch = Welch(segment_s=20.0, overlap=overlap)
    n = welch.n_segments(n_averages, n_bins)
    assert welch.n_averages(n, n_bins) >= n_averages
    assert n == 1 or welch.n_averages(n - 1, n_bins) < n_averages


@pytest.mark.parametrize(
    ("window", "overlap"), [("hann", 0.5), ("hamming", 0.75), ("blackman", 0.0)]
)
def test_averages_of_white_noise_scatter_as_their_number_says(window, overlap):
    welch = Welch(segment_s=32.0, overlap=overlap, window=window)
    length, step = welch.sizes(1.0)
    n = 8
    records = np.random.default_rng(5).standard_normal((4000, length + (n - 1) * step))
    segments = segment_spectra(torch.as_tensor(records), 1.0, welch)
    assert len(segments.values) == n
    power = segments.values.abs().square().mean(dim=0)[:, 4:-4]
    assert float(power.mean()) == pytest.approx(2.0, rel=0.01)  # one-sided, at 1 Hz
    relative = power.var(dim=0) / power.mean(dim=0).square()
    # nine bins of 4000 records; correlated, they fix the variance to about 2 %
    assert 1 / float(relative.mean()) == pytest.approx(welch.n_averages(n), rel=0.1)
    bands = power.unfold(1, 5, 1).mean(dim=2)
    relative = bands.var(dim=0) / bands.mean(dim=0).square()
    assert 1 / float(relative.mean()) == pytest.approx(welch.n_averages(n, 5), rel=0.1)


def test_smear_of_bands_is_the_mean_of_that_of_their_bins():
    one, band = WELCH.smear().tolist(), WELCH.smear(3).tolist()
    shifted = [[0.0] * i + one + [0.0] * (2 - i) for i in range(3)]
    assert band == pytest.approx([sum(taps) / 3 for taps in zip(*shifted, strict=True)])
    assert sum(band) == pytest.approx(1.0)


@pytest.mark.parametrize(("window", "overlap"), [("hann", 0.5), ("blackman", 0.0)])
def test_neighbouring_bins_correlate_as_stated(window, overlap):
    welch = Welch(segment_s=32.0, overlap=overlap, window=window)
    length, step = welch.sizes(1.0)
    records = np.random.default_rng(6).standard_normal((6000, length + 7 * step))
    power = segment_spectra(torch.as_tensor(records), 1.0, welch).values.abs().square().mean(dim=0)
    found = np.corrcoef(power.numpy().T)
    rho = welch.correlation().numpy()
    assert rho[0] == pytest.approx(1.0)
    for lag in range(1, 5):
        stated = rho[lag] if lag < len(rho) else 0.0
        measured = np.diagonal(found[4:-4, 4:-4], lag).mean()
        # a correlation from 6000 records is known to 0.013; overlap adds up to 0.02
        assert measured == pytest.approx(stated, abs=0.035)


@pytest.mark.parametrize("window", ["hann", "hamming", "blackman", "boxcar"])
def test_smear_and_correlation_are_transforms_of_the_window(window):
    welch = Welch(window=window)
    w = signal.get_window(window, 256)
    t = np.arange(256)
    taps, rho = welch.smear().numpy(), welch.correlation().numpy()
    half = len(taps) // 2
    power = [
        abs(np.sum(w * np.exp(-2j * math.pi * k * t / 256))) ** 2 for k in range(-half, half + 1)
    ]
    np.testing.assert_allclose(taps, np.array(power) / np.sum(power), rtol=1e-9)
    squares = [
        abs(np.sum(w**2 * np.exp(-2j * math.pi * k * t / 256)) / np.sum(w**2)) ** 2
        for k in range(len(rho))
    ]
    np.testing.assert_allclose(rho, squares, rtol=1e-9)


@pytest.mark.parametrize("window", ["hann", "hamming", "blackman"])
def test_smear_is_the_leakage_of_a_resonance(window):
    length, n = 256, 4000
    pole = np.exp(-0.02 + 2j * math.pi * 40 / length)  # half-power width of 1.6 bins
    a = np.poly([pole, pole.conj()]).real
    record = signal.lfilter([1.0], a, np.random.default_rng(8).standard_normal(n * length + 2000))
    welch = Welch(segment_s=float(length), overlap=0.0, window=window)
    segments = segment_spectra(torch.as_tensor(record[None, 2000:]), 1.0, welch)
    power = segments.values[:, 0].abs().square().mean(dim=0).numpy()
    taps = welch.smear().numpy()
    half = len(taps) // 2
    bins = np.arange(30, 51)
    wide = np.arange(30 - half, 51 + half)
    exact = 2 * abs(signal.freqz([1.0], a, wide / length, fs=1.0)[1]) ** 2
    leaked = trips_reference.smeared(exact, taps)
    sharp = exact[half:-half]
    # 4000 averages are good for 1.6 %; five of those
    np.testing.assert_allclose(power[bins], leaked, rtol=0.08)
    assert np.abs(power[bins] / sharp - 1).max() > 0.2
    # what the sampled window leaves is at most a quarter of the leakage, in the mean
    mean_error = np.abs(power[bins] / leaked - 1).mean()
    assert mean_error < 0.25 * np.abs(power[bins] / sharp - 1).mean()


@pytest.mark.parametrize("method", KINDS)
def test_scatter_of_log_magnitudes_is_the_stated_deviation(many, expected, method):
    _, spectra = many
    scatter = spectra.responses(method).abs().log()
    stated = expected.deviations(method)
    assert stated[..., INNER].min() > 1e-3
    ratio = relative_spread(scatter, stated)
    assert ratio.shape == (2,)
    np.testing.assert_allclose(ratio, 1.0, atol=0.08)  # 15 % at the very most, below per bin
    per_bin = (scatter.std(dim=0) / stated)[..., INNER]
    np.testing.assert_allclose(per_bin, 1.0, atol=0.15)


@pytest.mark.parametrize("method", ["H1", "H2"])
def test_deviation_of_h1_and_h2_is_bendat_and_piersols(many, method):
    _, spectra = many
    coherence = spectra.coherences()
    n = spectra.n_averages
    closed = torch.sqrt((1 - coherence) / (2 * n * coherence))
    np.testing.assert_allclose(spectra.deviations(method), closed, rtol=1e-6)
    closed = torch.sqrt((1 - coherence) / (2 * n))
    np.testing.assert_allclose(spectra.deviations("Hv"), closed, rtol=1e-9)


@pytest.mark.parametrize("method", ["H1", "H2", "IV"])
def test_covariance_is_that_of_the_complex_logarithms(many, expected, method):
    _, spectra = many
    stated = expected.covariance(method)
    assert stated.shape == (2, 2, SEGMENT // 2 + 1)
    mean = spectra.responses(method).mean(dim=0)
    errors = (spectra.responses(method) / mean).log()
    errors = errors - errors.mean(dim=0)
    found = (errors[:, :, None] * errors[:, None].conj()).mean(dim=0)
    deviation = torch.stack([stated[0, 0].real, stated[1, 1].real]).sqrt()
    size = deviation[:, None] * deviation
    difference = ((found - stated) / size)[..., INNER]
    # correlation from 1500 records: 0.026 each, some bias of order 1 / n; five of those at most
    assert difference.abs().max() < 0.16
    assert difference.abs().mean() < 0.05
    # the two share the noise of the bogie: they are correlated
    assert (stated[0, 1] / size[0, 1])[..., INNER].abs().mean() > 0.1


# limit


def test_signal_that_comes_later_has_a_falling_phase():
    source = np.random.default_rng(4).standard_normal(4002)
    found = tfestimate(source[2:], source[:-2], 50.0, Welch(4.0))
    late = np.exp(-2j * math.pi * found.frequencies_hz.numpy() * 2 / 50.0)
    # two samples of 200 are not shared by a segment of both
    assert np.abs(found.response.numpy() - late)[1:].max() < 0.05


# property


def test_instrument_is_unbiased_where_noise_biases_the_others():
    noise = (0.6, 0.4, 0.3)
    n_samples = SEGMENT + 199 * SEGMENT // 2
    records = three_channels(np.random.default_rng(11), (200, n_samples), noise)
    frequencies, spectra = averaged(records)
    bins = frequencies.numpy()
    chain = [torch.as_tensor(signal.freqz(b, a, bins, fs=1.0)[1]) for b, a in FILTERS]
    truth = torch.stack(chain)
    relative = {
        method: (spectra.responses(method) / truth).log().mean(dim=0)[..., INNER]
        for method in METHODS
    }
    # about 190 averages of 200 records, relative noise of at most 1.5 for one average
    assert relative["IV"].abs().mean() < 0.01
    assert relative["IV"].abs().max() < 0.05
    # 0.36 of noise on an input of 1
    assert relative["H1"][0].real.mean() == pytest.approx(-math.log(1.36), abs=0.03)
    assert (relative["H1"].real < -0.03).all()
    assert (relative["H2"].real > 0.03).all()
    between = relative["Hv"].real
    assert (between > relative["H1"].real).all()
    assert (between < relative["H2"].real).all()


def test_segments_with_an_unusable_sample_are_left_out():
    records = torch.as_tensor(three_channels(np.random.default_rng(12), (1000,)))
    welch = Welch(segment_s=100.0, overlap=0.5)
    usable = torch.ones(1000, dtype=torch.bool)
    usable[[149, 430]] = False
    spoilt = torch.where(usable, records, torch.nan)
    whole = segment_spectra(records, 1.0, welch)
    found = segment_spectra(spoilt, 1.0, welch, usable=usable)
    # 50 to 149 and 100 to 199 hold sample 149; 350 to 449 and 400 to 499 hold sample 430
    kept = [first for first in range(0, 901, 50) if first not in (50, 100, 350, 400)]
    assert found.first.tolist() == kept
    assert torch.isfinite(torch.view_as_real(found.values)).all()
    torch.testing.assert_close(found.values, whole.values[[first // 50 for first in kept]])
    none = segment_spectra(spoilt, 1.0, welch, usable=torch.zeros(1000, dtype=torch.bool))
    assert none.values.shape == (0, 3, 51)
    assert none.first.shape == (0,)


def test_average_is_over_the_chosen_segments():
    records = torch.as_tensor(three_channels(np.random.default_rng(13), (1000,)))
    segments = segment_spectra(records, 1.0, Welch(100.0))
    chosen = torch.zeros(len(segments.values), dtype=torch.bool)
    chosen[[2, 7, 8]] = True
    spectra = segments.average(chosen)
    values = segments.values[[2, 7, 8]].numpy()
    np.testing.assert_allclose(spectra.auto, (abs(values) ** 2).mean(axis=0), rtol=1e-12)
    for row, (x, y) in zip(spectra.cross.numpy(), PAIRS, strict=True):
        np.testing.assert_allclose(row, (values[:, x].conj() * values[:, y]).mean(0), rtol=1e-12)
    assert spectra.n_averages == segments.welch.n_averages(3)


# failure


def test_signals_that_hold_nothing_to_estimate_are_rejected():
    good = np.random.default_rng(0).standard_normal(1000)
    bad = good.copy()
    bad[[3, 5]] = math.nan, math.inf
    welch = Welch(1.0)
    with pytest.raises(ValueError, match="`y` holds 2 NaN or inf"):
        tfestimate(good, bad, 100.0, welch)
    with pytest.raises(ValueError, match="`x` holds 2 NaN or inf"):
        tfestimate(bad, good, 100.0, welch)
    with pytest.raises(ValueError, match="`instrument` holds 2 NaN or inf"):
        tfestimate(good, good, 100.0, welch, "IV", instrument=bad)
    with pytest.raises(ValueError, match="`x` is constant"):
        tfestimate(np.ones(1000), good, 100.0, welch)
    with pytest.raises(ValueError, match=r"`y` must have shape \(1000,\), got \(999,\)"):
        tfestimate(good, good[1:], 100.0, welch)
    with pytest.raises(ValueError, match=r"`x` must have shape \(2, 500\)"):
        tfestimate(good.reshape(2, 500), good.reshape(2, 500), 100.0, welch)
    with pytest.raises(ValueError, match=r"10\.0 s of recording are shorter than one segment of 2"):
        tfestimate(good, good, 100.0)


def test_unknown_methods_and_missing_instruments_are_rejected():
    good = np.random.default_rng(0).standard_normal(1000)
    with pytest.raises(ValueError, match=r"`method` must be one of .*'H3'"):
        tfestimate(good, good, 100.0, Welch(1.0), method="H3")
    with pytest.raises(ValueError, match="'IV' needs a third channel"):
        tfestimate(good, good, 100.0, Welch(1.0), method="IV")


def test_average_of_nothing_is_rejected():
    segments = segment_spectra(torch.randn(3, 500, generator=torch.manual_seed(0)), 1.0, WELCH)
    with pytest.raises(ValueError, match="no segment is chosen"):
        segments.average(torch.zeros(len(segments.values), dtype=torch.bool))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"segment_s": 0.0}, "`segment_s` must be a finite number > 0, got 0.0"),
        ({"segment_s": math.inf}, "`segment_s` must be a finite number > 0, got inf"),
        ({"segment_s": math.nan}, "`segment_s` must be a finite number > 0, got nan"),
        ({"overlap": 1.0}, "`overlap` must be a finite number >= 0 and < 1, got 1.0"),
        ({"overlap": -0.1}, "`overlap` must be a finite number >= 0 and < 1"),
        ({"window": "hanning_typo"}, "[Ww]indow"),
    ],
)
def test_settings_out_of_range_are_rejected(changes, message):
    with pytest.raises(ValueError, match=message):
        Welch(**changes)
