"""Which pass of a road met something that the others did not: a truck that went by."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magtiles.stages.road.statistics import Counts, Statistics

Real = NDArray[np.float64]
Mask = NDArray[np.bool_]

_SLOW_M = 80.0
"""Over which a difference of calibrations is constant: longer than a transient."""
_LENGTH_M = 4.0
"""Over which a lorry is felt at the least; steel under the lane, which others missed, is not."""
_SEED = 2.6
"""Standard deviations, all along that length, at which a difference is no scatter, and"""
_EDGE = 1.2
"""those down to which it belongs to the same disturbance."""
_APART_M = 1.0
"""Two passes lie this far apart even when aligned, in lane and place: steep fields differ."""
_NEAR_M = 2.0
_CALIBRATION = 0.2
"""Share of a local feature by which lanes and vehicles may see it differently."""
_FLOOR_NT = 150.0
"""Scatter that passes have in any case."""
_PRIOR = 3.0
"""Degrees of freedom that this expected scatter weighs against that of a point's own passes."""
_CLEARLY = 2.0
"""Times nearer that one of two passes must be for the other to be dropped."""


def drop_transients(
    statistics: Statistics, vehicle: int, field: Real, where: Mask, spacing_m: float,
    already: Mask,
) -> tuple[Mask, Mask]:  # fmt: skip
    """Judge a new pass against those before it, and two before it by the new one.

    Where two or more passes agree and the new one differs, the new one is dropped. Where two
    that were there differ, the new one tells which of them is right: from the mean and the
    square sum of two passes both follow, but for the sign in each axis. With one pass before
    it nothing can be told, and both stay. Where one was dropped before, the new one stays: what
    two passes met stands there.

    Parameters
    ----------
    field, where : (point, 3) nT, and the points (point,) where the new pass has one.
    already : (point,) where a pass was dropped before.

    Returns
    -------
    where (point,) to add the new pass, and where (point,) something was dropped. Passes
    dropped from `statistics` are taken off in place.
    """
    if not where.any():
        return where, np.zeros_like(where)
    before = statistics.passes
    both = where & (before > 0)
    expected, number = _expected(statistics, vehicle)
    difference = _without_slow(field - expected, both, spacing_m)
    difference /= np.sqrt(1.0 + 1.0 / np.maximum(number, 1))[:, None]
    # What two passes of which one is disturbed say is no measure: the new one is.
    own = np.where(where[:, None], field, expected)
    disputed = _disputed(statistics, _variance(own, difference, both, spacing_m), spacing_m)
    variance = _measured(statistics, _variance(expected, difference, both, spacing_m))
    lone = _stretches(difference, variance, where & (before > 1) & ~disputed, spacing_m)
    for stretch in _runs(lone):
        lone[stretch] &= not already[stretch].any()
    dropped = lone.copy()
    for stretch in _runs(disputed & where):
        dropped[stretch] |= _settle(statistics, field, stretch, where, spacing_m)
    return where & ~lone, dropped


def _expected(statistics: Statistics, vehicle: int) -> tuple[Real, Counts]:
    """The vehicle's own mean where it was twice, else that of all passes, and of how many."""
    own = statistics.number[vehicle] > 1
    total = (statistics.number[..., None] * statistics.mean).sum(axis=0)
    mean = total / np.maximum(statistics.passes, 1)[:, None]
    number = np.where(own, statistics.number[vehicle], statistics.passes)
    return np.where(own[:, None], statistics.mean[vehicle], mean), number


def _without_slow(values: Real, where: Mask, spacing_m: float) -> Real:
    """Values (point, 3) less their running median; 0 where they are not known."""
    from scipy.ndimage import median_filter

    out = np.zeros_like(values)
    if where.any():
        size = min(int(_SLOW_M / spacing_m) | 1, int(where.sum()))
        known = values[where]
        out[where] = known - median_filter(known, size=(size, 1), mode="nearest")
    return out


def _variance(expected: Real, difference: Real, where: Mask, spacing_m: float) -> Real:
    """Variance (point, 3) of an undisturbed pass, to judge by the field and the whole road."""
    from scipy.ndimage import maximum_filter1d

    typical = 1.4826 * np.median(np.abs(difference[where]), axis=0) if where.any() else 0.0
    steep = np.abs(np.gradient(expected, spacing_m, axis=0)) if len(expected) > 1 else 0.0
    size = 2 * int(_NEAR_M / spacing_m) + 1
    steep = maximum_filter1d(np.broadcast_to(steep, expected.shape), size, axis=0)
    local = _without_slow(expected, np.ones(len(expected), dtype=np.bool_), spacing_m)
    squares = typical**2 + (_APART_M * steep) ** 2 + (_CALIBRATION * local) ** 2
    return np.asarray(np.maximum(squares, _FLOOR_NT**2))


def _measured(statistics: Statistics, variance: Real) -> Real:
    """The expected variance drawn toward that of passes of one vehicle at each point."""
    freedom = np.maximum(statistics.number - 1, 0).sum(axis=0)[:, None]
    square = statistics.square_sum.sum(axis=0)
    return np.asarray((_PRIOR * variance + square) / (_PRIOR + freedom))


def _stretches(difference: Real, variance: Real, where: Mask, spacing_m: float) -> Mask:
    """Points of disturbances: runs above the edge that are above the seed for long enough."""
    away = np.sqrt(np.mean(difference**2 / variance, axis=1))
    least = max(int(np.ceil(_LENGTH_M / spacing_m)), 2)
    out = np.zeros_like(where)
    for run in _runs((away > _EDGE) & where):
        if any(seed.stop - seed.start >= least for seed in _runs(away[run] > _SEED)):
            out[run] = True
    return out


def _runs(mask: Mask) -> list[slice]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return [slice(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _disputed(statistics: Statistics, variance: Real, spacing_m: float) -> Mask:
    """Where there are two passes, and they differ by more than scatter."""
    two = statistics.passes == 2
    apart = np.zeros_like(variance)  # of two passes of one variance, over the root of 2
    one_vehicle = (statistics.number == 2).any(axis=0) & two
    apart[one_vehicle] = np.sqrt(statistics.square_sum.sum(axis=0)[one_vehicle])
    for first, second in _pairs(statistics, two):
        both = _both(statistics, two, first, second)
        gap = statistics.mean[first] - statistics.mean[second]
        apart[both] = _without_slow(gap, both, spacing_m)[both] / np.sqrt(2.0)
    return _stretches(apart, variance, two, spacing_m)


def _pairs(statistics: Statistics, two: Mask) -> list[tuple[int, int]]:
    vehicles = range(len(statistics.names))
    pairs = ((a, b) for a in vehicles for b in vehicles if a < b)
    return [(a, b) for a, b in pairs if _both(statistics, two, a, b).any()]


def _both(statistics: Statistics, two: Mask, first: int, second: int) -> Mask:
    return np.asarray(two & (statistics.number[first] == 1) & (statistics.number[second] == 1))


def _settle(
    statistics: Statistics, field: Real, stretch: slice, where: Mask, spacing_m: float
) -> bool:
    """Drop the one of two passes that the new one speaks against; whether one was."""
    owners = np.flatnonzero((statistics.number[:, stretch] > 0).all(axis=1))
    if len(owners) == 1 and (statistics.number[owners[0], stretch] == 2).all():
        return _settle_one(statistics, int(owners[0]), field, stretch, where, spacing_m)
    if len(owners) == 2:
        a, b = (int(owner) for owner in owners)
        apart = [
            _misfit(
                field - statistics.mean[v], stretch, where & (statistics.number[v] > 0), spacing_m
            )
            for v in (a, b)
        ]
        if max(apart) > _CLEARLY * min(apart):
            statistics.forget(b if apart[1] > apart[0] else a, _mask(stretch, len(where)))
            return True
    return False


def _settle_one(
    statistics: Statistics, vehicle: int, field: Real, stretch: slice, where: Mask,
    spacing_m: float,
) -> bool:  # fmt: skip
    """Of a vehicle's two passes mean + half and mean - half, keep the nearer in each axis."""
    mean = statistics.mean[vehicle]
    there = where & (statistics.number[vehicle] > 0)
    outside = there & ~_mask(stretch, len(where))
    offset = _slow_level(field - mean, outside, stretch, spacing_m)
    half = np.sqrt(statistics.square_sum[vehicle, stretch] / 2.0)
    away = field[stretch] - offset - mean[stretch]
    kept = mean[stretch] + np.copysign(half, away)
    near, far = np.abs(np.abs(away) - half), np.abs(away) + half
    if np.sqrt(np.mean(far**2)) <= _CLEARLY * np.sqrt(np.mean(near**2)):
        return False
    full = mean.copy()
    full[stretch] = kept
    statistics.keep_one(vehicle, full, _mask(stretch, len(where)))
    return True


def _misfit(difference: Real, stretch: slice, there: Mask, spacing_m: float) -> float:
    outside = there & ~_mask(stretch, len(there))
    offset = _slow_level(difference, outside, stretch, spacing_m)
    return float(np.sqrt(np.mean((difference[stretch] - offset) ** 2)))


def _slow_level(difference: Real, outside: Mask, stretch: slice, spacing_m: float) -> Real:
    """Median difference (3,) on both sides of a stretch: that of calibrations."""
    reach = int(_SLOW_M / spacing_m)
    near = np.zeros_like(outside)
    near[max(stretch.start - reach, 0) : stretch.stop + reach] = True
    near &= outside
    return np.median(difference[near], axis=0) if near.any() else np.zeros(3)


def _mask(stretch: slice, count: int) -> Mask:
    mask = np.zeros(count, dtype=np.bool_)
    mask[stretch] = True
    return mask
