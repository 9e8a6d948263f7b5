"""Fixes that no vehicle could have made, and times at which it stood still."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from magtiles.catalog.kernels.geodesy import metres_per_degree, wrap_longitude
from magtiles.stages.vehicle.positions import Real, Times

_REACH = 3
"""Fixes on either side that a fix is held against: medians of seven bear three bad ones."""
_SPREAD = 5.0
_MAD = 1.4826  # median absolute deviation to standard deviation


@dataclass(frozen=True)
class Way:
    """Places (n,) in metres east and north of the first, at seconds after it, ascending."""

    seconds: Real
    east: Real
    north: Real

    def chord(self, at: Real, half_s: float) -> Real:
        """Mean velocity east and north (m, 2), m/s, from `half_s` before each `at` to after it.

        NaN where the way is shorter; between places it is straight.
        """
        inside = (at - half_s >= self.seconds[0]) & (at + half_s <= self.seconds[-1])
        moved = [
            np.interp(at + half_s, self.seconds, v) - np.interp(at - half_s, self.seconds, v)
            for v in (self.east, self.north)
        ]
        return np.where(inside[:, None], np.stack(moved, axis=1) / (2.0 * half_s), np.nan)


def way_of(time: Times, latitude: Real, longitude: Real) -> Way:
    """Places (n,) on the plane about their middle; good to 1e-4 within 50 km."""
    middle = float(np.median(latitude))
    per_latitude, per_longitude = metres_per_degree(np.array([middle]), np.zeros(1))
    apart = np.cumsum(np.concatenate([[0.0], wrap_longitude(np.diff(longitude))]))
    seconds = (time - time[0]) / np.timedelta64(1, "s")
    return Way(seconds, apart * per_longitude[0], (latitude - latitude[0]) * per_latitude[0])


def fix_outliers(
    way: Way, sigma: Real, *, max_speed: float, max_acceleration: float
) -> NDArray[np.bool_]:
    """Which places (n,) a vehicle of that speed (m/s) and acceleration (m/s2) cannot have been at.

    Each is held against the robust line through it and three on either side: medians of their
    velocities and of their offsets. What may remain is half the greatest acceleration times the
    squared reach in time, and the noise: three `sigma` (n,) (m, NaN if unknown) or five robust
    deviations of all. After that, places go that are too fast from both neighbours.
    """
    if way.seconds.size < 2 * _REACH + 1:
        return np.zeros(way.seconds.size, dtype=bool)
    apart, reach = _off_line(way)
    noise = np.maximum(3.0 * np.nan_to_num(sigma), _SPREAD * _MAD * float(np.median(apart)))
    wrong = apart > 0.5 * max_acceleration * reach**2 + noise
    return wrong | _too_fast(way, wrong, max_speed)


def _off_line(way: Way) -> tuple[Real, Real]:
    """Distance from the robust line (n,), m, and the reach of its window (n,), s."""
    size = 2 * _REACH + 1
    windows = [sliding_window_view(values, size) for values in (way.seconds, way.east, way.north)]
    # Fixes at the ends have the first and last whole window.
    rows = np.clip(np.arange(way.seconds.size) - _REACH, 0, way.seconds.size - size)
    seconds, east, north = (window[rows] for window in windows)
    steps = np.diff(seconds, axis=1)
    since = seconds - way.seconds[:, None]
    squared = np.zeros(way.seconds.size)
    for values, own in ((east, way.east), (north, way.north)):
        rate = np.median(np.diff(values, axis=1) / steps, axis=1)
        expected = np.median(values - rate[:, None] * since, axis=1)
        squared += (own - expected) ** 2
    return np.sqrt(squared), np.abs(since).max(axis=1)


def _too_fast(way: Way, wrong: NDArray[np.bool_], max_speed: float) -> NDArray[np.bool_]:
    """Places that are too far both from the place before and from the one after."""
    out = np.zeros(wrong.size, dtype=bool)
    while True:
        kept = np.flatnonzero(~(wrong | out))
        distance = np.hypot(np.diff(way.east[kept]), np.diff(way.north[kept]))
        fast = np.concatenate([[True], distance > max_speed * np.diff(way.seconds[kept]), [True]])
        alone = kept[fast[1:] & fast[:-1]]
        if not alone.size or kept.size < 3:
            return out
        out[alone] = True


def stationary(way: Way, at: Real, *, speed: float, window_s: float) -> NDArray[np.bool_]:
    """At which seconds `at` (m,) the vehicle was slower than `speed` (m/s) over `window_s`."""
    half = 0.5 * window_s
    if way.seconds.size < 2 or way.seconds[-1] - way.seconds[0] <= 2.0 * half:
        return np.zeros(at.size, dtype=bool)
    # At either end the first and last whole window.
    middle = np.clip(at, way.seconds[0] + half, way.seconds[-1] - half)
    inside = (at >= way.seconds[0]) & (at <= way.seconds[-1])
    slow = np.linalg.norm(way.chord(middle, half), axis=1) < speed
    return np.asarray(inside & slow, dtype=np.bool_)
