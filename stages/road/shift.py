"""How far a pass lies along the road from a map, by the shape of the field."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

Real = NDArray[np.float64]

_WINDOW_M = 80.0
_STEP_M = 40.0
_CANDIDATE_M = 0.25
_REACH = 3.0
"""Standard deviations of position within which the shift is sought."""
_DRIFT_M = 0.5
"""Standard deviation of the shift's change from one window to the next."""
_CORRELATED_M = 5.0
"""Length over which differences of two passes are one piece of information."""
_FLOOR_NT = 100.0
"""By which passes differ in any case, in lane and sensor: closer agreement says no more."""


def shifts(
    distance: Real, field: Real, pass_distance: Real, pass_field: Real, *, sigma_m: float
) -> Real:
    """Shift (m,) such that pass(distance + shift) is the field at `distance`, metres.

    In each window the likelihood of a shift is that of the difference of the two fields less
    its mean (calibrations differ by a constant), its variance unknown:
    L = (sum of squares)^(-n/2). Shifts of neighbouring windows differ little, and all have the
    standard deviation `sigma_m`; their posterior mean is found by the forward-backward
    algorithm over a ladder of shifts.

    Parameters
    ----------
    distance, field : (m,) ascending, (m, 3), of the map.
    pass_distance, pass_field : (n,) strictly ascending, (n, 3), of the pass.
    """
    reach = _REACH * sigma_m
    count = 2 * int(np.ceil(reach / _CANDIDATE_M)) + 1
    ladder: Real = _CANDIDATE_M * (np.arange(count, dtype=np.float64) - count // 2)
    centres = np.arange(distance[0], distance[-1] + _STEP_M, _STEP_M)
    spline = CubicSpline(pass_distance, pass_field)
    ends = pass_distance[0], pass_distance[-1]
    found = [_misfit(distance, field, spline, ends, shift, centres) for shift in ladder]
    variance, number = (np.stack(part, axis=1) for part in zip(*found, strict=True))
    # Of the overlap that every shift has, so that none gains by having less to explain.
    pieces = number.min(axis=1, keepdims=True) * float(np.median(np.diff(distance))) / _CORRELATED_M
    log_likelihood = -0.5 * pieces * np.log(variance).sum(axis=2)
    log_likelihood -= 0.5 * (ladder / sigma_m) ** 2
    return np.interp(distance, centres, _posterior_mean(np.asarray(log_likelihood), ladder))


def _misfit(
    distance: Real, field: Real, spline: CubicSpline, ends: tuple[float, float], shift: float,
    centres: Real,
) -> tuple[Real, Real]:  # fmt: skip
    """Variance of the difference (window, 3) at one shift, and its points (window,)."""
    at = distance + shift
    inside = (at >= ends[0]) & (at <= ends[1])
    difference = np.where(inside[:, None], spline(np.clip(at, *ends)) - field, 0.0)
    low = np.searchsorted(distance, centres - _WINDOW_M / 2)
    high = np.searchsorted(distance, centres + _WINDOW_M / 2)
    number = _sums(inside.astype(np.float64), low, high)
    safe = np.maximum(number, 1.0)[:, None]
    mean = _sums(difference, low, high) / safe
    variance = np.maximum(_sums(difference**2, low, high) / safe - mean**2, 0.0)
    return variance + _FLOOR_NT**2, number


def _sums(values: Real, low: NDArray[np.intp], high: NDArray[np.intp]) -> Real:
    running = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
    return np.asarray(running[high] - running[low])


def _posterior_mean(log_likelihood: Real, ladder: Real) -> Real:
    """Mean shift of each window, given all."""
    move = np.exp(-0.5 * ((ladder[:, None] - ladder) / _DRIFT_M) ** 2)
    move /= move.sum(axis=1, keepdims=True)
    own = np.exp(log_likelihood - log_likelihood.max(axis=1, keepdims=True))
    forward, backward = own.copy(), np.ones_like(own)
    for k in range(1, len(own)):
        forward[k] *= forward[k - 1] @ move
        forward[k] /= forward[k].sum()
    for k in range(len(own) - 2, -1, -1):
        backward[k] = move @ (own[k + 1] * backward[k + 1])
        backward[k] /= backward[k].sum()
    both = forward * backward
    return np.asarray(both @ ladder / both.sum(axis=1))
