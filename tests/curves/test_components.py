"""The feature set `curve` against numpy's singular value decomposition of naive rows."""

import functools
import math

import numpy as np
import pytest
import torch
import trips_reference
from vehicles import AM96

from suspnet.curves.components import FLOOR, CurveFeatures, noise_components
from suspnet.ground.storage import dump_arrays, read_arrays, write_atomically
from suspnet.vehicle import QuarterCar

FREQUENCIES = torch.arange(12, 180, 2, dtype=torch.float64) / 20
N_CURVES = 300


def curves(n, seed):
    ratios = torch.as_tensor(np.random.default_rng(seed).uniform(0.6, 1.6, (n, 5)))
    return torch.stack(QuarterCar(AM96).responses(ratios, FREQUENCIES), dim=1)


def with_noise(clean, seed, size=0.02):
    """Return curves whose log-magnitude and phase each have white noise, more at high bins."""
    rng = np.random.default_rng(seed)
    spread = size * np.linspace(0.5, 2.0, clean.shape[-1])
    draws = rng.standard_normal((*clean.shape, 2)) @ [1, 1j]
    return clean * torch.as_tensor(np.exp(spread * draws))


CLEAN = curves(N_CURVES, seed=0)
NOISY = with_noise(CLEAN, seed=1)
HEALTHY = torch.stack(QuarterCar(AM96).responses(torch.ones(1, 5), FREQUENCIES), dim=1)[0]


MAGNITUDES = CLEAN.abs()
SPREAD = torch.tensor([[0.04], [0.02]], dtype=torch.float64)


def with_white_noise(magnitudes, seed):
    draws = np.random.default_rng(seed).standard_normal(magnitudes.shape)
    return magnitudes + SPREAD * torch.as_tensor(draws)


NOISY_MAGNITUDES = with_white_noise(MAGNITUDES, seed=1)


@functools.cache
def fitted(**changes):
    return CurveFeatures(**changes).fitted(CLEAN, NOISY, HEALTHY, FREQUENCIES)


@functools.cache
def fitted_to_magnitudes(**changes):
    return CurveFeatures(**changes).fitted(MAGNITUDES, NOISY_MAGNITUDES, HEALTHY.abs(), FREQUENCIES)


def soft_logarithms(magnitudes):
    """Return asinh(m / 2a) relative to healthy by numpy, both responses side by side."""
    noise = (NOISY_MAGNITUDES - MAGNITUDES).numpy()
    floor = FLOOR * np.sqrt(np.mean(noise**2, axis=(0, 2)))
    rows = [
        np.arcsinh(magnitudes[:, k].numpy() / (2 * floor[k]))
        - np.arcsinh(HEALTHY[k].abs().numpy() / (2 * floor[k]))
        for k in (0, 1)
    ]
    return np.hstack(rows), floor


@functools.cache
def decomposition():
    """Return mean, noise, singular values and directions by numpy, row after row."""
    clean, noisy = (
        trips_reference.relative_rows(responses.numpy(), HEALTHY.numpy())
        for responses in (CLEAN, NOISY)
    )
    noise = np.sqrt(np.mean((noisy - clean) ** 2, axis=0))
    mean = clean.mean(axis=0)
    _, singular, directions = np.linalg.svd((clean - mean) / noise, full_matrices=False)
    return mean, noise, singular, directions


# reference


def test_features_are_projections_on_numpys_directions():
    features = fitted(n_components=7)
    mean, noise, singular, directions = decomposition()
    np.testing.assert_allclose(features.basis.mean, mean, rtol=0, atol=1e-12)
    np.testing.assert_allclose(features.basis.noise, noise, rtol=1e-9)
    np.testing.assert_allclose(
        features.basis.explained, singular[:7] ** 2 / np.sum(singular**2), rtol=1e-9
    )
    new = with_noise(curves(30, seed=5), seed=6)
    table = features.extract(new, FREQUENCIES)
    rows = trips_reference.relative_rows(new.numpy(), HEALTHY.numpy())
    expected = ((rows - mean) / noise) @ directions[:7].T
    # a direction is known up to its sign
    signs = np.sign(np.sum(expected * table.values.numpy(), axis=0))
    assert np.abs(expected).max() > 10
    np.testing.assert_allclose(table.values, expected * signs, rtol=0, atol=1e-7)
    assert not table.reasons.any()
    assert table.reasons.shape == (30, 1)
    assert table.reasons.dtype == torch.int64


@pytest.mark.parametrize("explained", [0.5, 0.9, 0.99, 0.9999])
def test_as_many_components_as_explain_the_share(explained):
    features = fitted(explained=explained)
    _, _, singular, _ = decomposition()
    share = np.cumsum(singular**2) / np.sum(singular**2)
    count = len(features.names)
    assert share[count - 1] >= explained
    assert count == 1 or share[count - 2] < explained
    assert features.names == tuple(f"component_{i + 1}" for i in range(count))


def test_features_of_magnitudes_are_projections_on_numpys_directions():
    features = fitted_to_magnitudes(n_components=5)
    (clean, floor), (noisy, _) = soft_logarithms(MAGNITUDES), soft_logarithms(NOISY_MAGNITUDES)
    mean, noise = clean.mean(axis=0), np.sqrt(np.mean((noisy - clean) ** 2, axis=0))
    _, singular, directions = np.linalg.svd((clean - mean) / noise, full_matrices=False)
    np.testing.assert_allclose(features.basis.floor, floor, rtol=1e-12)
    np.testing.assert_allclose(features.basis.floor, FLOOR * SPREAD[:, 0], rtol=0.02)
    np.testing.assert_allclose(
        features.basis.explained, singular[:5] ** 2 / np.sum(singular**2), rtol=1e-9
    )
    new = with_white_noise(curves(30, seed=5).abs(), seed=6)
    table = features.extract(new, FREQUENCIES)
    expected = ((soft_logarithms(new)[0] - mean) / noise) @ directions[:5].T
    signs = np.sign(np.sum(expected * table.values.numpy(), axis=0))
    assert np.abs(expected).max() > 10
    np.testing.assert_allclose(table.values, expected * signs, rtol=0, atol=1e-7)
    assert not table.reasons.any()


@pytest.mark.parametrize("n_rows", [60, 6])  # more rows than columns, and fewer
def test_components_are_those_of_singular_vectors(n_rows):
    rng = np.random.default_rng(1)
    clean = rng.standard_normal((n_rows, 8)) * np.arange(1, 9)
    noisy = clean + rng.standard_normal((n_rows, 8)) * np.linspace(0.1, 2, 8)
    mean, noise, directions, explained = noise_components(
        torch.as_tensor(clean), torch.as_tensor(noisy), 3
    )
    expected_noise = np.sqrt(np.mean((noisy - clean) ** 2, axis=0))
    rows = (clean - clean.mean(axis=0)) / expected_noise
    _, sizes, right = np.linalg.svd(rows, full_matrices=False)
    np.testing.assert_allclose(mean, clean.mean(axis=0), atol=1e-12)
    np.testing.assert_allclose(noise, expected_noise, rtol=1e-12)
    np.testing.assert_allclose(directions.abs(), np.abs(right[:3]), rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(explained, (sizes**2 / np.sum(sizes**2))[:3])


# limit


def test_magnitudes_far_above_their_noise_are_taken_as_logarithms():
    tiny = MAGNITUDES + 1e-9 * (NOISY_MAGNITUDES - MAGNITUDES)
    features = CurveFeatures(n_components=4).fitted(MAGNITUDES, tiny, HEALTHY.abs(), FREQUENCIES)
    logarithms = (MAGNITUDES / HEALTHY.abs()).log().flatten(1)
    torch.testing.assert_close(features.basis.mean, logarithms.mean(dim=0), rtol=0, atol=1e-12)
    assert features.basis.floor.max() < 1e-6


def test_what_noise_buries_is_finite_and_does_not_count():
    buried = MAGNITUDES.clone()
    buried[..., 60:] *= 1e-6
    noisy = with_white_noise(buried, seed=1)
    assert (noisy[..., 60:] < 0).double().mean() > 0.4
    features = CurveFeatures(n_components=4).fitted(buried, noisy, buried[0], FREQUENCIES)
    # there the slope of asinh(m / 2a) is 1 / 2a: the noise of a bin is 1 / (2 FLOOR)
    below = features.basis.noise.reshape(2, -1)[:, 60:]
    np.testing.assert_allclose(below, 1 / (2 * FLOOR), rtol=0.2)
    assert (features.basis.directions.reshape(4, 2, -1)[..., 60:].abs() < 1e-3).all()
    table = features.extract(noisy, FREQUENCIES)
    assert table.values.isfinite().all()
    assert features.extract(-noisy, FREQUENCIES).values.isfinite().all()
    assert not features.extract(torch.zeros(1, 2, 84).double(), FREQUENCIES).reasons.any()


def test_phase_is_followed_beyond_pi():
    turn = torch.linspace(0, 7.0, len(FREQUENCIES), dtype=torch.float64)
    late = HEALTHY * torch.exp(-1j * turn)
    learn = torch.cat([CLEAN, late[None]])
    noisy = with_noise(learn, seed=2)
    features = CurveFeatures(n_components=3).fitted(learn, noisy, HEALTHY, FREQUENCIES)
    n = len(FREQUENCIES)
    rows = trips_reference.relative_rows(learn.numpy(), HEALTHY.numpy())
    assert rows[-1, 2 * n - 1] == pytest.approx(-7.0)
    np.testing.assert_allclose(features.basis.mean, rows.mean(axis=0), atol=1e-12)
    # a small further turn moves the features a little: nothing wraps
    before, after = (
        features.extract(HEALTHY[None] * torch.exp(-1j * angle * turn), FREQUENCIES).values
        for angle in (1.0, 1.0001)
    )
    assert (after - before).abs().max() < 0.01 * before.abs().max()
    assert (after - before).abs().max() > 0


# property


def test_band_leaves_out_what_lies_beside_it():
    features = fitted(n_components=3, low_hz=1.0, high_hz=6.0)
    bins = features.basis.frequencies_hz
    assert (float(bins[0]), float(bins[-1])) == (1.0, 6.0)
    new = with_noise(curves(4, seed=3), seed=4)
    beside = (FREQUENCIES < 1.0 - 1e-6) | (FREQUENCIES > 6.0 + 1e-6)
    before = features.extract(new, FREQUENCIES).values
    spoilt = torch.where(beside, torch.nan, new)
    torch.testing.assert_close(features.extract(spoilt, FREQUENCIES).values, before)
    # a wider or a narrower grid that holds the bins will do
    inner = ~beside
    torch.testing.assert_close(features.extract(new[..., inner], FREQUENCIES[inner]).values, before)


def test_curve_with_a_hole_gives_nan_and_a_reason():
    features = fitted(n_components=3)
    new = curves(4, seed=3)
    new[1, 0, 7] = math.nan
    new[2, 1, 0] = complex(math.inf, 0)
    table = features.extract(new, FREQUENCIES)
    assert table.reasons[:, 0].tolist() == [0, 1, 1, 0]
    words = [CurveFeatures().missing(row.numpy()) for row in table.reasons]
    assert words == ["", "curve (not finite)", "curve (not finite)", ""]
    assert table.values[[1, 2]].isnan().all()
    assert table.values[[0, 3]].isfinite().all()
    assert features.parts == ("curve",)


def test_state_of_magnitudes_is_restored_and_knows_its_kind(tmp_path):
    features = fitted_to_magnitudes(n_components=4, low_hz=1.0)
    path = write_atomically(tmp_path / "basis.safetensors", dump_arrays(features.state()))
    restored = CurveFeatures(n_components=4, low_hz=1.0).restored(read_arrays(path))
    new = with_white_noise(curves(4, seed=3).abs(), seed=4)
    expected = features.extract(new, FREQUENCIES).values
    assert torch.equal(restored.extract(new, FREQUENCIES).values, expected)
    for name, array in features.state().items():
        np.testing.assert_array_equal(restored.state()[name], array)
    assert "floor" not in fitted(n_components=4).state()
    # magnitudes are all it needs of curves with phases
    turned = new * torch.exp(1j * torch.linspace(0, 5, 84, dtype=torch.float64))
    positive = torch.where(new > 0, turned, new)
    assert (new[..., FREQUENCIES >= 1] > 0).all()
    torch.testing.assert_close(restored.extract(positive, FREQUENCIES).values, expected)


# failure


def test_more_components_than_curves_are_rejected():
    with pytest.raises(
        ValueError, match="6 components were asked for, 5 curves of 336 numbers have"
    ):
        CurveFeatures(6).fitted(CLEAN[:5], NOISY[:5], HEALTHY, FREQUENCIES)


def test_features_need_a_basis():
    bare = CurveFeatures(n_components=2)
    assert bare.names == ("component_1", "component_2")
    with pytest.raises(ValueError, match="not fitted to training curves"):
        bare.extract(CLEAN, FREQUENCIES)
    with pytest.raises(ValueError, match="not fitted to training curves"):
        bare.state()
    with pytest.raises(ValueError, match="only known once they are fitted"):
        _ = CurveFeatures().names


def test_curves_on_other_bins_are_rejected():
    features = fitted(n_components=2)
    for bins in (FREQUENCIES + 0.01, FREQUENCIES * 1.001):
        with pytest.raises(ValueError, match=r"other bins than .* instead of 84 bins, 0.6 to 8.9"):
            features.extract(CLEAN, bins)
    with pytest.raises(ValueError, match=r"other bins .* 83 bins"):
        features.extract(CLEAN[..., 1:], FREQUENCIES[1:])
    torch.testing.assert_close(  # a rounding apart is the same bin
        features.extract(CLEAN, FREQUENCIES + 1e-8).values,
        features.extract(CLEAN, FREQUENCIES).values,
    )


def test_band_without_bins_is_rejected():
    with pytest.raises(ValueError, match=r"no bin lies between 20\.0 and inf Hz: 84 bins"):
        fitted(low_hz=20.0)
    with pytest.raises(ValueError, match=r"no bin lies between 0.0 and inf Hz: no bins"):
        fitted(n_components=1).extract(CLEAN[..., :0], FREQUENCIES[:0])


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("healthy", (2, 84)),
        ("mean", (4 * 84 + 1,)),
        ("noise", (84,)),
        ("directions", (3, 84)),
        ("explained", (4,)),
    ],
)
def test_arrays_that_do_not_fit_are_rejected(name, shape):
    arrays = fitted(n_components=3).state() | {name: np.zeros(shape)}
    with pytest.raises(ValueError, match=rf"`{name}` must have shape"):
        CurveFeatures().restored(arrays)


def test_magnitudes_are_no_curves_with_phases():
    with pytest.raises(ValueError, match="learnt with phases, these curves are magnitudes"):
        fitted(n_components=2).extract(MAGNITUDES, FREQUENCIES)
    arrays = fitted_to_magnitudes(n_components=2).state()
    with pytest.raises(ValueError, match="`healthy` must have shape"):
        CurveFeatures().restored({k: v for k, v in arrays.items() if k != "floor"})


def test_missing_and_unknown_arrays_are_rejected():
    arrays = fitted(n_components=3).state()
    with pytest.raises(ValueError, match=r"the basis must hold .*'noise'"):
        CurveFeatures().restored({k: v for k, v in arrays.items() if k != "noise"})
    with pytest.raises(ValueError, match=r"the basis must hold .* got .*'extra'"):
        CurveFeatures().restored(arrays | {"extra": np.zeros(3)})
