"""How much later one sensor's stamps are than another's, from what both saw of the same turns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

Real = NDArray[np.float64]

_GRID = 81
_POINTS = 20_000
_COARSE = 4
"""The grid is searched with every fourth point."""
_LEAST_POINTS = 100
_LEAST_SHARE = 0.5
"""Of the variance, the other sensor must explain half, or it saw something else."""
_MOST_SIGMA_S = 0.05
_WINDOW_S = 0.5
_GOLDEN = 0.6180339887498949


@dataclass(frozen=True)
class Samples:
    """What a sensor saw: seconds (n,), ascending, and values (n, m); rows of NaN are gaps."""

    seconds: Real
    values: Real
    max_gap_s: float

    @property
    def step(self) -> float:
        """The usual time between samples, s."""
        return float(np.median(np.diff(self.seconds)))

    def known(self) -> Samples:
        """Without the rows of NaN."""
        good = np.isfinite(self.values).all(axis=1)
        return Samples(self.seconds[good], self.values[good], self.max_gap_s)


class Means:
    """Running means of samples over a window of time, centred; NaN outside and over gaps."""

    def __init__(self, samples: Samples, window_s: float) -> None:
        self._seconds, self._half = samples.seconds, 0.5 * window_s
        steps = np.diff(samples.seconds)
        areas = 0.5 * (samples.values[1:] + samples.values[:-1]) * steps[:, None]
        self._integral = np.concatenate([np.zeros((1, areas.shape[1])), np.cumsum(areas, axis=0)])
        self._gaps = np.concatenate([[0], np.cumsum(steps > samples.max_gap_s)])

    def __call__(self, seconds: Real) -> Real:
        """Means (k, m) about each of `seconds` (k,)."""
        first, begin, out_before = self._read(seconds - self._half)
        last, end, out_after = self._read(seconds + self._half)
        lost = out_before | out_after | (self._gaps[last + 1] != self._gaps[first])
        means = (end - begin) / (2.0 * self._half)
        return np.where(lost[:, None], np.nan, means)

    def _read(self, seconds: Real) -> tuple[NDArray[np.intp], Real, NDArray[np.bool_]]:
        """Interval, integral there, and whether it is outside."""
        row = np.clip(np.searchsorted(self._seconds, seconds) - 1, 0, self._seconds.size - 2)
        share = (seconds - self._seconds[row]) / (self._seconds[row + 1] - self._seconds[row])
        before, after = self._integral[row], self._integral[row + 1]
        return row, before + share[:, None] * (after - before), (share < 0.0) | (share > 1.0)


@dataclass(frozen=True)
class Lag:
    """A lag in seconds, its 1 sigma, and the share of variance explained at it."""

    seconds: float
    sigma: float
    explained: float


def estimate_lag(response: Samples, cause: Samples, *, max_lag_s: float) -> Lag | None:
    """How much later `cause` is stamped than `response`, which it explains linearly.

    Least squares at each lag, so no calibration of the response need be known: any matrix and
    bias is part of the fit. A grid of lags, then a bounded search about its best. Both are taken
    as running means over the same half second (or two steps of the slower): else the noise of
    the cause, which differs from one lag to the next, would hide what the turns say, and draw
    the lag half-way between samples. The 1 sigma is of the curvature of the sum of squares, with
    residuals thinned by their autocorrelation.

    None where nothing can be said: fewer than 100 points, less than half of the variance
    explained, the best lag at the limit, or a sigma above 0.05 s.
    """
    response, cause = response.known(), cause.known()
    if min(response.seconds.size, cause.seconds.size) < _LEAST_POINTS // 2:
        return None
    window = max(_WINDOW_S, 2.0 * response.step, 2.0 * cause.step)
    seen, turns = Means(response, window), Means(cause, window)
    at = _points(response, seen, turns, max_lag_s)
    if at.size < _LEAST_POINTS:
        return None
    fit, coarse = _Fit(seen, turns, at), _Fit(seen, turns, at[::_COARSE])
    grid = np.linspace(-max_lag_s, max_lag_s, _GRID)
    squares = np.array([coarse.left(lag) for lag in grid])
    best = int(np.argmin(squares))
    if best in (0, _GRID - 1) or squares[best] > (1.0 - _LEAST_SHARE) * coarse.scale:
        return None
    found = minimize_scalar(
        fit.left, bounds=(grid[best - 1], grid[best + 1]), method="bounded", options={"xatol": 1e-6}
    )
    sigma = fit.sigma(float(found.x), 0.1 * float(grid[1] - grid[0]))
    if not sigma < _MOST_SIGMA_S:
        return None
    return Lag(float(found.x), sigma, 1.0 - float(found.fun) / fit.scale)


def _points(response: Samples, seen: Means, turns: Means, max_lag_s: float) -> Real:
    """Times (k,) within both at every lag, that stand in no ratio to the samples'."""
    steps = np.arange(response.seconds.size - 1)
    steps = steps[:: max(1, -(-steps.size // _POINTS))]
    share = np.modf(np.arange(steps.size) * _GOLDEN)[0]
    at = response.seconds[steps] + share * np.diff(response.seconds)[steps]
    good = np.isfinite(seen(at)).all(axis=1)
    for limit in (-max_lag_s, max_lag_s):
        good &= np.isfinite(turns(at + limit)).all(axis=1)
    return np.asarray(at[good])


class _Fit:
    """Least squares of what is left of the response at a lag."""

    def __init__(self, seen: Means, turns: Means, at: Real) -> None:
        self._at, self._turns = at, turns
        values = seen(at)
        self._about = values - values.mean(axis=0)
        self.scale = float(np.sum(self._about**2))

    def residual(self, lag: float) -> Real:
        """What is left (k, m) at a lag."""
        columns = self._turns(self._at + lag)
        # The mean is part of every fit, so both sides are taken about theirs.
        centred = np.nan_to_num(columns - np.nanmean(columns, axis=0))
        solution = np.linalg.lstsq(centred, self._about, rcond=1e-10)[0]
        return np.asarray(self._about - centred @ solution)

    def left(self, lag: float) -> float:
        """Sum of squares that is left."""
        return float(np.sum(self.residual(lag) ** 2))

    def sigma(self, lag: float, span: float) -> float:
        """Gauss-Newton: variance of the residual over the squared change of the fit."""
        rest = self.residual(lag)
        change = (self.residual(lag + span) - self.residual(lag - span)) / (2.0 * span)
        slope, power = float(np.sum(change**2)), float(np.sum(rest**2))
        if slope == 0.0:
            return np.inf
        variance = power / rest.size * _correlated(rest)
        return float(np.sqrt(variance / slope))


def _correlated(rest: Real) -> float:
    """How many of the points (k, m) say the same: the autocorrelation, summed to its first zero."""
    size = 2 * rest.shape[0]
    spectrum = np.fft.rfft(rest - rest.mean(axis=0), size, axis=0)
    products = np.fft.irfft(np.abs(spectrum) ** 2, size, axis=0)[: rest.shape[0]].sum(axis=1)
    if products[0] <= 0.0:
        return 1.0
    shares = products[1:] / products[0]
    zero = int(np.argmax(shares < 0.0)) if (shares < 0.0).any() else shares.size
    return float(1.0 + 2.0 * shares[:zero].sum())
