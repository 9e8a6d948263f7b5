"""Gauss coefficients of a crust from the total-field anomaly around the globe.

The anomaly T = A x + e is linear in the coefficients x of the crust's potential
(`sphere_operator`), but says little of some fields: of those across the ambient field near
the dip equator (Backus 1970), and of degrees that the nodes hardly resolve. So x is given what is
likely beforehand, independent coefficients of variance C_n at degree n, and what the data then make
most likely is

    x = argmin (T - A x)' W (T - A x) + sum x_nm^2 / C_n

W holds 1 / (u^2 + t^2) times the cosine of latitude, so that equal areas weigh alike: u the
survey's own sigma, t what its nodes hold of still shorter waves. C_n and t are those under which
the data are most likely (MacKay 1992, Neural Computation 4:415-447): in turn with x,

    C_n = sum x_nm^2 / gamma_n        u^2 + t^2 = (T - A x)' W (T - A x) / (data - sum gamma_n)

with gamma_n the number of coefficients of degree n that the data determine. From degree 16 up the
log of a degree's power, C_n (n + 1) (2n + 1), is a straight line: degree by degree, a survey that
undersamples the crust could not tell it from noise.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, cg

from magtiles.schemas.errors import CoverageError
from magtiles.stages.field.sphere_operator import AnomalyOperator

Real = NDArray[np.float64]

_log = logging.getLogger(__name__)

DRAWS = 16
"""Random crusts, and as many of noise, that measure the error."""

_DRAWS_OF_PRIOR = 4
_SETS_AT_ONCE = 8
_SEED = 19700514
_ROUNDS = 30
_SETTLED = 0.01
_LOWEST_CRUST = 16
"""Core fields are removed up to degree 13 to 15: below, the power follows no line."""

_WIDTH = 0.05
"""Below it the power of a degree is a mean over so much of the degrees around it, at least one."""

_LEAST_POWER = 1e-6, 1e-9
"""Of the power of a degree: as a part of the highest, and nT^2."""
_TOLERANCES = 1e-3, 1e-6
"""Relative residuals of random sets, and of the data's own."""


@dataclass(frozen=True)
class GlobeData:
    """The anomaly on the nodes of a grid (rows, columns).

    `values` nT, 0 where there are none; `area`, the cosine of latitude, 0 where there are none;
    `variance` of the survey's own error, nT^2.
    """

    values: Real
    area: Real
    variance: Real

    @property
    def count(self) -> int:
        """Number of data."""
        return int(np.count_nonzero(self.area))

    def mean(self, values: Real) -> float:
        """Mean over the area that has data."""
        return float(np.sum(self.area * values) / np.sum(self.area))


@dataclass(frozen=True)
class SphereFit:
    """Coefficients of a crust, and how far off they may be.

    Attributes
    ----------
    coefficients : (k,) nT, of degrees 1 and up.
    power : (degree,) likely mean square of the field of each degree at the reference radius, nT^2.
    excess : t^2, nT^2.
    residual : mean square of one datum about the true sum of the degrees, nT^2, u^2 included.
    determined : how many coefficients the data determine.
    signal_errors, noise_errors : (draws, k) errors of random crusts, and what random noise makes.
    """

    data: GlobeData
    degree: int
    coefficients: Real
    power: Real
    excess: float
    residual: float
    determined: float
    signal_errors: Real
    noise_errors: Real


def fit(operator: AnomalyOperator, data: GlobeData) -> SphereFit:
    """The most likely crust of the data, with `DRAWS` random errors of each kind.

    Raises CoverageError where the equations do not settle.
    """
    prior, start, determined = _learn(operator, data)
    normal = _Normal(operator, data, prior)
    own = normal.solve(data.values[None], start[:1], _TOLERANCES[1])
    misfit = data.mean((data.values - normal.anomaly(own)[0]) ** 2)
    random = np.random.default_rng(_SEED + 1)
    crusts = random.standard_normal((DRAWS, operator.size))
    noise = random.standard_normal((DRAWS, *operator.shape))
    found = normal.solve_all(normal.anomaly, crusts), normal.solve_all(normal.noise, noise)
    return SphereFit(
        data=data,
        degree=operator.degree,
        coefficients=normal.amplitude * own[0],
        power=prior.power,
        excess=prior.excess,
        residual=misfit / (1.0 - _leverage(data, determined)),
        determined=determined,
        signal_errors=normal.amplitude * (found[0] - crusts),
        noise_errors=normal.amplitude * found[1],
    )


def _leverage(data: GlobeData, determined: float) -> float:
    """How much of a datum's own error, mean over the area, the coefficients follow.

    Of each in proportion to its area: beside the poles many nodes share what few need.
    """
    return determined * float(np.sum(data.area**2) / np.sum(data.area) ** 2)


@dataclass(frozen=True)
class _Prior:
    """What is likely before the data: power of each degree, and t^2."""

    power: Real
    excess: float

    @property
    def deviation(self) -> Real:
        """sqrt(C_n) of each coefficient (k,)."""
        n = np.arange(1, self.power.size + 1)
        each = np.sqrt(self.power / ((n + 1) * (2 * n + 1)))
        return np.repeat(each, 2 * n + 1)


class _Normal:
    """The normal equations for coefficients in units of their deviation, z = x / sqrt(C)."""

    def __init__(self, operator: AnomalyOperator, data: GlobeData, prior: _Prior) -> None:
        self._operator, self.amplitude = operator, prior.deviation
        variance = data.variance + prior.excess
        self._weight = data.area / variance
        self._noise = np.sqrt(
            np.divide(variance, data.area, where=data.area > 0.0, out=np.zeros(data.area.shape))
        )
        n = np.repeat(np.arange(1, operator.degree + 1), 2 * np.arange(1, operator.degree + 1) + 1)
        # The mean square over the sphere of a coefficient's anomaly, were the field vertical.
        alone = self._weight.sum() * (n + 1.0) ** 2 / (2 * n + 1)
        self._scale = 1.0 / (1.0 + 0.5 * self.amplitude**2 * alone)

    def anomaly(self, z: Real) -> Real:
        """(sets, rows, columns) nT of coefficients (sets, k) in units of their deviation."""
        return self._operator.forward(self.amplitude * z)

    def noise(self, unit: Real) -> Real:
        """Noise like that of the data, of random numbers of unit variance."""
        return np.asarray(self._noise * unit)

    def solve(self, values: Real, start: Real, tolerance: float) -> Real:
        """Coefficients z (sets, k) of data (sets, rows, columns), by conjugate gradients."""
        shape = start.shape
        right = self.amplitude * self._operator.adjoint(self._weight * values)

        def apply(flat: Real) -> Real:
            z = flat.reshape(shape)
            back = self._operator.adjoint(self._weight * self.anomaly(z))
            return (z + self.amplitude * back).ravel()

        def precondition(flat: Real) -> Real:
            return np.asarray((self._scale * flat.reshape(shape)).ravel())

        size = (start.size, start.size)
        found, failed = cg(
            LinearOperator(size, apply, dtype=np.float64),
            right.ravel(),
            start.ravel(),
            rtol=tolerance,
            M=LinearOperator(size, precondition, dtype=np.float64),
            maxiter=2000,
        )
        if failed:
            raise CoverageError(
                f"the coefficients do not settle within {failed} steps",
                expected="a survey whose values and sigma are of like size",
                remedy="check no_data and uncertainty_nt in the source's TOML",
            )
        return np.asarray(found.reshape(shape))

    def solve_all(self, make: Callable[[Real], Real], drawn: Real) -> Real:
        """Coefficients z of the data that `make` makes of each draw, some at once."""
        parts = (drawn[i : i + _SETS_AT_ONCE] for i in range(0, len(drawn), _SETS_AT_ONCE))
        return np.concatenate(
            [
                self.solve(make(part), np.zeros((len(part), self.amplitude.size)), _TOLERANCES[0])
                for part in parts
            ]
        )


def _learn(operator: AnomalyOperator, data: GlobeData) -> tuple[_Prior, Real, float]:
    """The prior under which the data are most likely, z found on the way, and sum gamma_n.

    gamma_n, a trace, is measured by random crusts and noise put through the same equations.
    """
    random = np.random.default_rng(_SEED)
    crusts = random.standard_normal((_DRAWS_OF_PRIOR, operator.size))
    noise = random.standard_normal((_DRAWS_OF_PRIOR, *operator.shape))
    signal = data.mean(data.values**2)
    own = data.mean(data.variance)
    prior = _Prior(np.full(operator.degree, max(signal, own) / operator.degree), 0.1 * signal)
    z = np.zeros((1 + _DRAWS_OF_PRIOR, operator.size))
    for done in range(1, _ROUNDS + 1):
        normal = _Normal(operator, data, prior)
        values = np.concatenate([data.values[None], normal.anomaly(crusts) + normal.noise(noise)])
        z = normal.solve(values, z, _TOLERANCES[0])
        gamma = _by_degree(1.0 - np.mean((z[1:] - crusts) ** 2, axis=0))
        misfit = np.sum(data.area * (data.values - normal.anomaly(z[:1])[0]) ** 2
                        / (data.variance + prior.excess))  # fmt: skip
        total = (own + prior.excess) * misfit / max(data.count - gamma.sum(), 1.0)
        power = _likely_power(_by_degree(z[0] ** 2) * prior.power, gamma)
        last, prior = prior, _Prior(power, max(total - own, 0.0))
        z *= last.deviation / prior.deviation
        _log.info("globe: round %d, sigma %.3g nT, %.0f of %d coefficients determined",
                  done, np.sqrt(own + prior.excess), gamma.sum(), operator.size)  # fmt: skip
        if _change(last, prior, own) < _SETTLED:
            break
    return prior, z, float(gamma.sum())


def _change(last: _Prior, prior: _Prior, own: float) -> float:
    """By how much a prior differs from the last: in logarithms of power (mean), or of sigma^2."""
    coefficients = 2.0 * np.arange(1, prior.power.size + 1) + 1.0
    power = np.average(np.abs(np.log(prior.power / last.power)), weights=coefficients)
    return max(float(power), float(abs(np.log((own + prior.excess) / (own + last.excess)))))


def _by_degree(values: Real) -> Real:
    """Sums over the orders of each degree (degree,) of values (k,)."""
    n = np.arange(1, int(np.sqrt(values.size + 1)))
    return np.asarray(np.add.reduceat(values, n * n - 1))


def _likely_power(found: Real, gamma: Real) -> Real:
    """Power of each degree from sum z_nm^2 times the power that it is in units of, and gamma_n."""
    n = np.arange(1, found.size + 1)
    half = np.maximum(1, (_WIDTH * n).astype(int))
    first, last = np.maximum(n - 1 - half, 0), np.minimum(n + half, found.size)

    def around(values: Real) -> Real:
        sums = np.concatenate([[0.0], np.cumsum(values)])
        return np.asarray(sums[last] - sums[first])

    power = around(found) / np.maximum(around(gamma), 0.02 * around(np.asarray(2.0 * n + 1.0)))
    power = np.maximum(power, _LEAST_POWER[0] * power.max() + _LEAST_POWER[1])
    crust = n >= _LOWEST_CRUST
    if np.count_nonzero(crust) > 2:
        weight = np.sqrt(np.maximum(gamma, 1e-3 * (2 * n + 1))[crust])
        line = np.polynomial.Polynomial.fit(n[crust], np.log(power[crust]), 1, w=weight)
        power[crust] = np.exp(line(n[crust].astype(float)))
    return np.asarray(power)
