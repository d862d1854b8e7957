"""Data sets: a file gives the arrays back, and scores are those of a run."""

from dataclasses import fields, replace

import numpy as np
import pytest

from suspnet import LinearRegression, Problem, make_dataset, read_dataset, train, write_dataset
from suspnet.curves.curves import CurveSettings
from suspnet.curves.problem import TEST, TRAIN


@pytest.fixture(scope="module")
def problem(quarter_car, task):
    settings = CurveSettings(150, 20, 100)
    return Problem(quarter_car, task(), settings, seed=3)


@pytest.fixture(scope="module")
def data(problem):
    return make_dataset(problem)


def test_rows_are_those_of_the_problem(problem, data):
    for name, stream in (("train", TRAIN), ("test", TEST)):
        made = problem.features(stream)
        here = data.split == name
        assert np.array_equal(data.X[here], made.inputs, equal_nan=True)
        assert np.array_equal(data.Y[here], made.outputs)
        assert np.array_equal(data.rows(name)[here], made.valid)
    assert np.array_equal(
        data.curves[data.split == "train"][128:],
        problem.curves(problem.ratios(TRAIN), TRAIN, 1).numpy(),
    )
    assert len(data.Y) == 150 + 20 + 100


def test_noise_is_what_the_noise_free_curves_lack(problem, data):
    clean = problem.noise_free(data.ratios).numpy()
    assert np.allclose(data.curves - data.noise, clean, rtol=1e-12)
    ratio = np.sqrt((data.noise**2).mean(axis=2) / (clean**2).mean(axis=2))
    expected = 10 ** (-problem.settings.snr_db / 20)
    assert np.median(ratio) == pytest.approx(expected, rel=0.1)


@pytest.fixture(scope="module")
def few(data):
    """The first curves of the data set, which take little time to write."""
    rows = {one.name: getattr(data, one.name)[:9] for one in fields(data)[:7]}
    return replace(data, **rows)


@pytest.mark.parametrize("is_complex", [False, True])
def test_a_file_gives_the_arrays_back(few, is_complex, tmp_path):
    data = few
    if is_complex:
        data = replace(data, curves=data.curves * (1 + 2j), noise=data.noise * 1j)
    path = write_dataset(data, tmp_path / "set.npz")
    with np.load(path, allow_pickle=False) as file:
        assert np.array_equal(file["Y"], data.Y)  # without suspnet
    found = read_dataset(path)
    for one in fields(data)[:-1]:
        written, read = getattr(data, one.name), getattr(found, one.name)
        assert np.array_equal(written, read, equal_nan=read.dtype.kind != "U"), one.name
        assert read.dtype.kind == written.dtype.kind
    assert found.about == data.about


def test_score_is_that_of_a_run(problem, data):
    metrics = train(problem, LinearRegression())
    known, asked = data.rows("train"), data.rows("test")
    X, Y = np.log(data.X), np.log(data.Y)
    A = np.column_stack([X[known], np.ones(known.sum())])
    W = np.linalg.lstsq(A, Y[known], rcond=None)[0]
    predicted = np.exp(np.column_stack([X[asked], np.ones(asked.sum())]) @ W)
    found = data.score(predicted)
    for name in data.about["outputs"]:
        assert found[name]["ratio"] == pytest.approx(metrics["rms_ratio"][name], rel=1e-6)
        assert found[name]["rms_percent"] == pytest.approx(metrics["rms_percent"][name], rel=1e-6)
    assert np.isnan(data.bound[known]).all()


@pytest.mark.parametrize("wrong", ["shape", "nan"])
def test_estimates_that_do_not_fit_are_refused(data, wrong):
    predicted = data.Y[data.rows("test")].copy()
    if wrong == "shape":
        predicted = predicted[1:]
    else:
        predicted[0, 0] = np.nan
    with pytest.raises(ValueError, match=r"finite estimates of Y\[rows"):
        data.score(predicted)


def test_no_file_is_replaced_and_other_suffixes_are_refused(few, tmp_path):
    (tmp_path / "set.npz").write_text("mine")
    with pytest.raises(FileExistsError, match=r"set\.npz exists"):
        write_dataset(few, tmp_path / "set.npz")
    assert (tmp_path / "set.npz").read_text() == "mine"
    with pytest.raises(ValueError, match=r"\.npz"):
        write_dataset(few, tmp_path / "set.csv")


def test_file_that_is_no_data_set_is_refused(tmp_path):
    path = tmp_path / "other.npz"
    path.write_bytes(b"not one" * 10)
    with pytest.raises(ValueError, match="is no data set of suspnet"):
        read_dataset(path)


def test_pickle_in_a_file_is_not_read(tmp_path):
    np.savez(tmp_path / "evil.npz", X=np.array([{"a": 1}], dtype=object))
    with pytest.raises(ValueError, match="is no data set of suspnet"):
        read_dataset(tmp_path / "evil.npz")


@pytest.mark.parametrize("how", ["packed.npz", "header.npz"])
def test_a_small_file_that_unpacks_to_a_large_one_is_refused(how, tmp_path):
    path, zeros = tmp_path / how, np.zeros((1000, 1000))
    if how == "packed.npz":
        np.savez_compressed(path, X=zeros)
    else:
        np.savez(path, X=zeros)
        path.write_bytes(path.read_bytes().replace(b"(1000, 1000)", b"(99999,99999)"))
    with pytest.raises(ValueError, match="is no data set of suspnet"):
        read_dataset(path)
