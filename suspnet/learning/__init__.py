"""Module 3 of the paper: regression, independent of trains."""

from typing import Any

from suspnet.learning.baselines import SVR, CurveFit, KernelRidge, LinearRegression
from suspnet.learning.msvr import MSVR
from suspnet.learning.mvgpr import MVGPR
from suspnet.learning.scaling import Scaling

METHODS: dict[str, Any] = {
    "msvr": MSVR,
    "svr": SVR,
    "mvgpr": MVGPR,
    "ridge": KernelRidge,
    "linear": LinearRegression,
    "curve_fit": CurveFit,
}
"""Every method by the name of its file in configs/model/.

In addition to scikit-learn's interface each has `state`, `restore` and the flag `works_on_curves`
(it fits curves, not features).
"""

__all__ = [
    "METHODS",
    "MSVR",
    "MVGPR",
    "SVR",
    "CurveFit",
    "KernelRidge",
    "LinearRegression",
    "Scaling",
]
