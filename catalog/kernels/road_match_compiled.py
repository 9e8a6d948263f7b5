"""Loops of `road_match`, compiled by numba: import this only when a section is compared."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.kernels.jit import compiled as _compile
from magtiles.catalog.kernels.road_match import CHOICE_BLOCK

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
    # A loop that counts from 0 over slices, and no other index, becomes vector instructions.
    axes, length = section.shape
    for low in range(0, out.size, _BLOCK):
        part = out[low : low + _BLOCK]
        at, count = start + low, part.size
        first, last = log_variance[at : at + count], log_variance[at + length :]
        for s in range(count):
            part[s] = constant + last[s] - first[s]
        for a in range(axes):
            for i in range(length):
                z = section[a, i]
                f = field[a, at + i : at + i + count]
                w = weight[a, at + i : at + i + count]
                for s in range(count):
                    d = z - f[s]
                    part[s] += d * d * w[s]
        for s in range(count):
            part[s] *= -0.5


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
        part = out[low : low + _BLOCK]
        at, count = start + low, part.size
        first, last = log_variance[at : at + count], log_variance[at + length :]
        for s in range(count):
            part[s] = constant + last[s] - first[s]
        for a in range(axes):
            ones[:] = 0.0
            firsts[:] = 0.0
            squares[:] = 0.0
            for i in range(length):
                z = section[a, i]
                f = field[a, at + i : at + i + count]
                w = weight[a, at + i : at + i + count]
                for s in range(count):
                    d = z - f[s]
                    ones[s] += w[s]
                    firsts[s] += w[s] * d
                    squares[s] += w[s] * d * d
            for s in range(count):
                part[s] += squares[s] - firsts[s] * firsts[s] / ones[s] + math.log(ones[s])
        for s in range(count):
            part[s] *= -0.5


@_compile
def choose(
    log_likelihood: Floats,
    greatest: Floats,
    best: int,
    position: Floats,
    run: NDArray[np.int64],
    least_squared: float,
    bin_points: int,
) -> tuple[float, int, float]:
    """Highest log-likelihood far from the best, centre of the best bin, sum over the best.

    `greatest` holds the maximum of each `CHOICE_BLOCK` points: most need no look. The sum of
    likelihoods is in units of the best one's.
    """
    n = log_likelihood.size
    top, north, east = log_likelihood[best], position[best, 0], position[best, 1]
    second, total, count = -math.inf, 0.0, 0
    place, share = np.empty(n, np.int64), np.empty(n)
    for b in range(greatest.size):
        if greatest[b] <= min(second, top - _NEGLIGIBLE):
            continue
        for s in range(b * CHOICE_BLOCK, min((b + 1) * CHOICE_BLOCK, n)):
            value = log_likelihood[s]
            if value > top - _NEGLIGIBLE:
                place[count], share[count] = s, math.exp(value - top)
                total += share[count]
                count += 1
            if value > second:
                y, x = position[s, 0] - north, position[s, 1] - east
                if y * y + x * x >= least_squared:
                    second = value
    return second, _best_bin(place[:count], share[:count], run, bin_points), total


@_compile
def _best_bin(
    place: NDArray[np.int64], share: Floats, run: NDArray[np.int64], bin_points: int
) -> int:
    """The likelihood's centre, rounded to a point, in the bin of most likelihood.

    `place` are the points that have any, ascending, and `share` how much.
    """
    most, held, begin, first, last = -1.0, 0.0, 0, 0, 0
    for k in range(place.size):
        held += share[k]
        while run[place[begin]] != run[place[k]] or place[k] - place[begin] >= bin_points:
            held -= share[begin]
            begin += 1
        if held > most:
            most, first, last = held, begin, k
    weight, moment = 0.0, 0.0
    for k in range(first, last + 1):
        weight += share[k]
        moment += share[k] * (place[k] - place[first])
    return int(place[first] + round(moment / weight))


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
