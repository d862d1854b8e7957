"""Module 3 of the paper: regression. Knows nothing of trains."""

from suspnet.learning.baselines import SVR, LinearRegression
from suspnet.learning.least_squares import CurveFit, levenberg_marquardt
from suspnet.learning.msvr import MSVR
from suspnet.learning.mvgpr import MVGPR
from suspnet.learning.scaling import Scaling

__all__ = [
    "MSVR",
    "MVGPR",
    "SVR",
    "CurveFit",
    "LinearRegression",
    "Scaling",
    "levenberg_marquardt",
]
