"""Fisher information of curves, and Cramer-Rao bounds.

The covariance of an unbiased estimator is at least I^-1, with the Fisher information I = J^T J and
J the derivative of the curves in units of their noise (`suspnet.curves.expected_spectra`). A
Gaussian error has MAPE = sqrt(2 / pi) times its relative standard deviation.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from suspnet.curves.curves import Directions
from suspnet.curves.estimates import Misfit, Observer
from suspnet.curves.protocols import RESPONSES, Task, columns_of
from suspnet.ground.tensors import as_tensor, threads
from suspnet.ground.types import FloatArray
from suspnet.learning.least_squares import ONE_SIDED_DIFFERENCE
from suspnet.vehicle import PARAMETERS

ROWS = 256  # number of vehicles at once


@threads(1)  # spectra are computed in blocks as large as the cache of one core
def fisher_information(
    observer: Observer,
    ratios: FloatArray,
    parameters: Sequence[str] = PARAMETERS,
    responses: Sequence[str] = RESPONSES,
) -> FloatArray:
    """Return the information of noisy curves on some parameters, the others being known.

    I = J^T J, J the derivative of the observer's misfit by automatic differentiation. For
    magnitudes with white noise, I is the sum over curves of J^T J / rms^2, J the derivative of the
    curves. For transfer functions estimated from a trip, with J the derivative of (log G_p, log
    G_s), Sigma the covariance of their estimate and r = ``Welch.correlated_bins``::

        I = 2 / r sum over bins of Re(J^H Sigma^-1 J)

    Weak bins do not count. A generator's uncertain numbers are unknown too, at the median of their
    distribution: see `without_uncertain`.

    `ratios`: (n_vehicles, 5), [-]; `parameters` and `responses` are from ``PARAMETERS`` and
    ``RESPONSES``; estimates from trips always use both responses. The result (n_vehicles,
    n_parameters, n_parameters) is with respect to ratios to healthy.
    """
    used = [RESPONSES.index(name) for name in responses]
    blocks = []
    for rows in as_tensor(ratios).split(ROWS):
        misfit = observer.misfit(observer.noise_free(rows), rows, used)
        jacobian = _joint_derivative(misfit, rows, parameters, observer.directions)
        blocks.append((jacobian @ jacobian.mT).cpu().numpy())
    return without_uncertain(np.concatenate(blocks), len(parameters))


def without_uncertain(information: FloatArray, n_parameters: int) -> FloatArray:
    """Return the information on parameters with uncertain numbers unknown except for a prior.

    With z their standard normal coordinates, the uncertainty of z reduces the information (van
    Trees, Detection, estimation and modulation theory, 1968)::

        I = I_tt - I_tz (I_zz + 1)^-1 I_zt

    `information` has the shape (..., n_parameters + n_z, n_parameters + n_z).
    """
    n = n_parameters
    i_tt = information[..., :n, :n]
    if information.shape[-1] == n:
        return i_tt
    i_tz = information[..., :n, n:]
    prior = np.eye(information.shape[-1] - n)
    solved = np.linalg.solve(information[..., n:, n:] + prior, np.swapaxes(i_tz, -1, -2))
    return np.asarray(i_tt - i_tz @ solved)


def _joint_derivative(
    misfit: Misfit, ratios: Tensor, parameters: Sequence[str], directions: Directions
) -> Tensor:
    """Return the derivative of a misfit to parameters and uncertain numbers, (n, n, n_points)."""
    every = torch.arange(len(ratios))
    columns = columns_of(parameters)
    jacobian = derivative_of_rows(lambda point: misfit(point, every), ratios, columns)
    if not directions.n:
        return jacobian
    return torch.cat([jacobian, _nuisance(directions, misfit, ratios.to(jacobian))], dim=1)


def derivative_of_rows(
    function: Callable[[Tensor], Tensor], rows: Tensor, columns: Sequence[int]
) -> Tensor:
    """Return the derivative of real values of each row to some of its columns, (n, n_columns, ...).

    `function` gives values of the shape (n, ...), each from its own row of `rows` alone.

    J^T v by reverse differentiation is linear in v: its derivative with respect to v is J. One
    evaluation serves all columns, while torch.func.jvp needs one for each and, once, two seconds to
    import the compiler of torch.
    """
    with torch.enable_grad():
        point = rows.detach().clone().requires_grad_()
        values = function(point)
        v = torch.zeros_like(values, requires_grad=True)
        (product,) = torch.autograd.grad((values * v).sum(), point, create_graph=True)
        derivatives = [
            torch.autograd.grad(product[:, column].sum(), v, retain_graph=True)[0]
            for column in columns
        ]
    return torch.stack(derivatives, dim=1)


def _nuisance(directions: Directions, misfit: Misfit, ratios: Tensor) -> Tensor:
    """Return the derivative of a misfit, 0 at `ratios`, with respect to z, (n, n_z, n_points)."""
    every = torch.arange(len(ratios))
    steps = torch.eye(directions.n).to(ratios) * ONE_SIDED_DIFFERENCE
    moved = [
        misfit(directions.vehicles(ratios, step.expand(len(ratios), -1)), every) for step in steps
    ]
    return torch.stack(moved, dim=1) / ONE_SIDED_DIFFERENCE


def cramer_rao(information: FloatArray) -> FloatArray:
    """Return the smallest standard deviations, shape (n, n_parameters); inf where unidentifiable.

    A parameter without information has the bound inf. If a matrix is not finite, or its scaled form
    has a condition number above 1e12, all of its bounds are inf.
    """
    finite = np.asarray(np.isfinite(information).all(axis=(1, 2)))
    information = np.where(finite[:, None, None], information, 0.0)
    diagonal = np.einsum("nii->ni", information)
    unseen = ~(diagonal > 0)
    scale = np.sqrt(np.where(unseen, 1.0, diagonal))
    scaled = information / (scale[:, :, None] * scale[:, None, :])
    scaled += unseen[:, :, None] * np.eye(information.shape[1])
    bounds = np.full(scale.shape, np.inf)
    usable = np.linalg.cond(scaled) < 1e12
    inverse = np.linalg.inv(scaled[usable])
    bounds[usable] = np.sqrt(np.einsum("nii->ni", inverse)) / scale[usable]
    bounds[unseen] = np.inf
    return bounds


def output_bounds(task: Task, observer: Observer, ratios: FloatArray) -> FloatArray:
    """Return the Cramer-Rao bounds of a task's outputs, shape (n_vehicles, n_outputs), [-].

    All parameters that vary together and are not measured are estimated jointly; of several sets
    that of the vehicle is taken as known, so an output that stays healthy in it has the bound 0.
    `ratios`: (n_vehicles, 5).
    """
    bounds = np.zeros((len(ratios), len(task.outputs)))
    for names, rows in task.rows_of_sets(ratios):
        information = fisher_information(observer, ratios[rows], names, task.responses)
        joint_bounds = cramer_rao(information)
        for j, output in enumerate(task.outputs):
            if output in names:
                bounds[rows, j] = joint_bounds[:, names.index(output)]
    return bounds


def best_possible(
    task: Task, bounds: FloatArray, ratios: FloatArray
) -> dict[str, dict[str, float]]:
    """Return {output: {"mape_percent": ..., "rmse": ...}}: the smallest errors of a task.

    From Cramer-Rao `bounds` (n_vehicles, n_outputs) of `ratios` (n_vehicles, 5); inf where an
    output is not identifiable.
    """
    mape = math.sqrt(2 / math.pi) * relative_percent(task, bounds, ratios)
    rmse = np.sqrt(np.mean(bounds**2, axis=0))
    return {
        name: {"mape_percent": float(mape[j]), "rmse": float(rmse[j])}
        for j, name in enumerate(task.outputs)
    }


def relative_percent(task: Task, bounds: FloatArray, ratios: FloatArray) -> FloatArray:
    """Return the mean bound of each output relative to its value, shape (n_outputs,), [%]."""
    return np.asarray(100 * (bounds / ratios[:, task.output_indices]).mean(axis=0))


def over_bound(errors: FloatArray, bounds: FloatArray) -> FloatArray:
    """Return errors over their bounds; NaN where a bound is infinite, not a quotient of 0."""
    quotients = np.full(bounds.shape, np.nan)
    np.divide(errors, bounds, out=quotients, where=np.isfinite(bounds))
    return quotients
