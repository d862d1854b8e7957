"""Arrays give what tensors give; a device that is not there is one clear error."""

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_info
from vehicles import AM96

from suspnet.bounds.information import fisher_information
from suspnet.curves.components import CurveFeatures
from suspnet.curves.curves import CurveSettings
from suspnet.curves.extraction import PeakFeatures
from suspnet.curves.peaks import findpeaks
from suspnet.curves.welch import tfestimate
from suspnet.ground.tensors import complex_log, squared_size, threads
from suspnet.learning import MSVR, MVGPR
from suspnet.vehicle import QuarterCar, VerticalVehicle

RATIOS = np.random.default_rng(0).uniform(0.5, 2.0, (3, 5))
BINS_HZ = np.arange(1, 200) * 0.1


def layouts(values):
    """Return the same values as people have them: lists, views, read-only, foreign byte order."""
    fixed = values.copy()
    fixed.flags.writeable = False
    foreign = values.astype(values.dtype.newbyteorder())
    return values.tolist(), values[::-1].copy()[::-1], fixed, foreign


@pytest.mark.parametrize("generator", [QuarterCar(AM96), VerticalVehicle(AM96)])
def test_generators_take_arrays(generator):
    tensors = torch.tensor(RATIOS), torch.tensor(BINS_HZ)
    expected = generator.responses(*tensors)
    magnitudes = generator.magnitudes(*tensors)
    for ratios, bins in zip(layouts(RATIOS), layouts(BINS_HZ), strict=True):
        for found, response in zip(generator.responses(ratios, bins), expected, strict=True):
            assert isinstance(found, torch.Tensor)
            assert torch.equal(found, response)
        assert torch.equal(generator.magnitudes(ratios, bins), magnitudes)
    system, same = (generator.motion_system(row) for row in (RATIOS[0], tensors[0][0]))
    np.testing.assert_array_equal(system.stiffness, same.stiffness)


def test_vertical_vehicle_samples_from_arrays():
    vehicle = VerticalVehicle(AM96, distribution={"speed": 0.1})
    sampled = vehicle.sample_unmeasured(RATIOS, 1)
    assert torch.equal(sampled, vehicle.sample_unmeasured(torch.tensor(RATIOS), 1))


def test_findpeaks_takes_arrays():
    curves = QuarterCar(AM96).magnitudes(RATIOS, BINS_HZ)[:, 1]
    expected = findpeaks(curves, torch.tensor(BINS_HZ), low_hz=torch.full((3,), 0.3))
    found = findpeaks(curves.numpy(), BINS_HZ, low_hz=np.full(3, 0.3, np.float32))
    torch.testing.assert_close(found.position_hz, expected.position_hz, rtol=0, atol=0)


def test_features_and_information_take_arrays_of_any_layout():
    responses = torch.stack(QuarterCar(AM96).responses(RATIOS, BINS_HZ), dim=1).numpy()
    tensors = torch.tensor(responses), torch.tensor(BINS_HZ)
    curve = CurveFeatures(n_components=2).fitted(
        tensors[0], tensors[0] * (1 + 1e-3j), tensors[0][0], tensors[1]
    )
    observer = CurveSettings().observer(QuarterCar(AM96))
    information = fisher_information(observer, RATIOS)
    for ratios in layouts(RATIOS):
        np.testing.assert_array_equal(fisher_information(observer, ratios), information)
    for features in (curve, PeakFeatures(peaks=("secondary",))):
        expected = features.extract(*tensors).values
        for curves, bins in zip(layouts(responses), layouts(BINS_HZ), strict=True):
            found = features.extract(curves, bins).values
            torch.testing.assert_close(found, expected, rtol=0, atol=0, equal_nan=True)


def test_tfestimate_takes_lists_and_tensors():
    x, y = np.random.default_rng(1).normal(size=(2, 4000))
    expected = tfestimate(x, y, 100.0).response
    for kind in (np.ndarray.tolist, torch.tensor):
        np.testing.assert_array_equal(tfestimate(kind(x), kind(y), 100.0).response, expected)


@pytest.mark.parametrize("estimator", [MSVR(device="cuda:99"), MVGPR(device="cuda:99")])
def test_device_that_is_not_there_is_named_at_fit(estimator):
    with pytest.raises(ValueError, match=r"`device`='cuda:99' cannot be used here"):
        estimator.fit(np.zeros((4, 2)), np.zeros((4, 2)))


def test_complex_log_and_squared_size_are_those_of_numpy():
    rng = np.random.default_rng(1)
    sizes = 10.0 ** rng.uniform(-12, 12, 2000)
    values = sizes * np.exp(1j * rng.uniform(-np.pi, np.pi, 2000))
    values[:4] = 1.0, -1.0, 1j, -1j
    found = complex_log(torch.tensor(values)).numpy()
    np.testing.assert_allclose(found.real, np.log(np.abs(values)), rtol=1e-14, atol=1e-15)
    np.testing.assert_allclose(found.imag, np.angle(values), rtol=1e-14, atol=1e-15)
    squares = squared_size(torch.tensor(values)).numpy()
    np.testing.assert_allclose(squares, np.abs(values) ** 2, rtol=1e-14)


@pytest.mark.parametrize("number", [1, 2])
def test_threads_limit_torch_and_blas_within_the_block(number):
    def now():
        of_blas = [one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"]
        return torch.get_num_threads(), *of_blas

    before = now()
    with threads(number):
        assert set(now()) == {number}
    assert now() == before
