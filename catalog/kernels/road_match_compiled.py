"""Loops of `road_match`, compiled by numba: import this only when a section is compared."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.kernels.jit import compiled as _compile

Floats = NDArray[np.float64]

_BLOCK = 512
"""Points done at a time: what they need stays in the first cache."""
_NEGLIGIBLE = 45.0
"""Likelihoods less than exp(-45) of the greatest do not count: all of 1e7 add up to 1e-12."""


@_compile
def measured(
    field: Floats,
    weight: Floats,
    log_variance: Floats,
    section: Floats,
    start: int,
    constant: float,
    out: Floats,
) -> None:
    """Fill `out` with log-likelihoods of `section` (3, K) from point `start` of the map on."""
    axes, length = section.shape
    for low in range(0, out.size, _BLOCK):
        high = min(low + _BLOCK, out.size)
        for s in range(low, high):
            out[s] = constant + log_variance[start + s + length] - log_variance[start + s]
        for a in range(axes):
            for i in range(length):
                z = section[a, i]
                at = start + i
                for s in range(low, high):
                    d = z - field[a, at + s]
                    out[s] += d * d * weight[a, at + s]
        for s in range(low, high):
            out[s] *= -0.5


@_compile
def demeaned(
    field: Floats,
    weight: Floats,
    log_variance: Floats,
    section: Floats,
    start: int,
    constant: float,
    out: Floats,
) -> None:
    """As `measured`, with an unknown bias on each axis integrated over."""
    axes, length = section.shape
    ones, firsts, squares = np.empty(_BLOCK), np.empty(_BLOCK), np.empty(_BLOCK)
    for low in range(0, out.size, _BLOCK):
        count = min(_BLOCK, out.size - low)
        at = start + low
        for s in range(count):
            out[low + s] = constant + log_variance[at + s + length] - log_variance[at + s]
        for a in range(axes):
            ones[:] = 0.0
            firsts[:] = 0.0
            squares[:] = 0.0
            for i in range(length):
                z = section[a, i]
                for s in range(count):
                    w = weight[a, at + i + s]
                    d = z - field[a, at + i + s]
                    ones[s] += w
                    firsts[s] += w * d
                    squares[s] += w * d * d
            for s in range(count):
                out[low + s] += squares[s] - firsts[s] * firsts[s] / ones[s] + math.log(ones[s])
        for s in range(low, low + count):
            out[s] *= -0.5


@_compile
def choose(
    log_likelihood: Floats,
    position: Floats,
    run: NDArray[np.int64],
    least_squared: float,
    bin_points: int,
) -> tuple[int, float, int, float]:
    """Best point, highest log-likelihood far from it, centre of the best bin, sum over the best.

    The sum of likelihoods is in units of the best one's.
    """
    n = log_likelihood.size
    best = 0
    for s in range(n):
        if log_likelihood[s] > log_likelihood[best]:
            best = s
    top, north, east = log_likelihood[best], position[best, 0], position[best, 1]
    second, total = -math.inf, 0.0
    share = np.zeros(n)
    for s in range(n):
        value = log_likelihood[s]
        if value > top - _NEGLIGIBLE:
            share[s] = math.exp(value - top)
            total += share[s]
        if value > second:
            y, x = position[s, 0] - north, position[s, 1] - east
            if y * y + x * x >= least_squared:
                second = value
    return best, second, _best_bin(share, run, bin_points), total


@_compile
def _best_bin(share: Floats, run: NDArray[np.int64], bin_points: int) -> int:
    """The likelihood's centre in the bin of most likelihood, rounded to a point."""
    most, last, held, begin = -1.0, 0, 0.0, 0
    for s in range(share.size):
        if run[s] != run[begin]:
            held, begin = 0.0, s
        held += share[s]
        if s - begin == bin_points:
            held -= share[begin]
            begin += 1
        if held > most:
            most, last = held, s
    first = last
    weight, moment = 0.0, 0.0
    while first > last - bin_points and first >= 0 and run[first] == run[last]:
        weight += share[first]
        moment += share[first] * (last - first)
        first -= 1
    return last - round(moment / weight)


@_compile
def share_within(log_likelihood: Floats, position: Floats, place: int, squared: float) -> float:
    """Share of all likelihood that points within a distance of the point `place` have."""
    top, within, total = -math.inf, 0.0, 0.0
    for s in range(log_likelihood.size):
        top = max(top, log_likelihood[s])
    for s in range(log_likelihood.size):
        if log_likelihood[s] > top - _NEGLIGIBLE:
            likely = math.exp(log_likelihood[s] - top)
            y, x = position[s, 0] - position[place, 0], position[s, 1] - position[place, 1]
            total += likely
            if y * y + x * x <= squared:
                within += likely
    return within / total
