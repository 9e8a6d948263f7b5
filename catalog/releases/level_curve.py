"""Matching on a small area's map: level curves and parallel paths (Cuenca 2020, 3.1)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from magtiles.catalog.kernels.bspline import Floats
from magtiles.catalog.kernels.geodesy import metres_per_degree
from magtiles.catalog.releases.arguments import broadcast, check_positions
from magtiles.schemas.errors import QueryError

Evaluate = Callable[[Floats, Floats], Floats]
"""The total-field anomaly, nT, at latitudes and longitudes of one shape; NaN without coverage."""

COARSE = 40
"""Steps from the middle of the window to its side: a curve inside one cell may be missed."""
_FINE = 6
_ZOOMS = 7
_MOST_SHIFTS = 1_000_000


@dataclass(frozen=True)
class LevelPoint:
    """A place with the value asked for, degrees, and how far it is, m; NaN where there is none."""

    latitude: float
    longitude: float
    distance_m: float


@dataclass(frozen=True)
class PathMatch:
    """How a path fits where it is shifted to.

    Attributes
    ----------
    north_m, east_m : (i,), (j,) shifts, m.
    deviation : (i, j) mean absolute deviation, nT; NaN where a shifted place has no coverage.
    best_north_m, best_east_m : shift of the least deviation; NaN where all are.
    """

    north_m: Floats
    east_m: Floats
    deviation: Floats
    best_north_m: float
    best_east_m: float


def nearest_on_level_curve(
    evaluate: Evaluate, value: float, latitude: float, longitude: float, within_m: float
) -> LevelPoint:
    """The place nearest to a position where the map has a value (Cuenca 2020, eq. 3.6).

    The curve is looked for on a lattice of `within_m` / 40 and followed on ever finer ones, to
    a hundred-thousandth of that. Raises QueryError for arguments that are not one finite number.
    """
    for name, number in (("value", value), ("latitude", latitude), ("longitude", longitude)):
        if np.ndim(number) or not np.isfinite(number):
            raise QueryError(f"is {number!r}", where=name, expected="one finite number")
    check_positions((), np.array([latitude]), np.array([longitude]))
    _positive("within_m", within_m)
    scale = np.ravel(metres_per_degree(np.array(latitude), 0.0))

    def misses(y: Floats, x: Floats) -> Floats:
        return evaluate(latitude + y / scale[0], longitude + x / scale[1]) - value

    step, steps, middle = within_m / COARSE, COARSE, np.zeros(2)
    for _ in range(_ZOOMS):
        axis = step * np.arange(-steps, steps + 1)
        found = _crossings(misses, middle[0] + axis, middle[1] + axis)
        if not len(found):
            return LevelPoint(np.nan, np.nan, np.nan)
        middle = found[np.argmin(np.hypot(found[:, 0], found[:, 1]))]
        # The curve's nearest place is within about a step of the nearest crossing.
        step, steps = 2.0 * step / _FINE, _FINE
    distance = float(np.hypot(*middle))
    if distance > within_m:
        return LevelPoint(np.nan, np.nan, np.nan)
    place = np.array([latitude, longitude]) + middle / scale
    return LevelPoint(float(place[0]), float((place[1] + 180.0) % 360.0 - 180.0), distance)


def _crossings(misses: Callable[[Floats, Floats], Floats], y: Floats, x: Floats) -> Floats:
    """Where the lattice's lines cross the curve (n, 2), m, linear between nodes."""
    rows, columns = np.meshgrid(y, x, indexing="ij")
    value = misses(rows, columns)
    found = [np.column_stack([rows[value == 0.0], columns[value == 0.0]])]
    for axis in (0, 1):
        before = np.moveaxis(value, axis, 0)[:-1]
        after = np.moveaxis(value, axis, 0)[1:]
        crosses = before * after < 0.0
        share = before[crosses] / (before[crosses] - after[crosses])
        ends = [np.moveaxis(p, axis, 0) for p in (rows, columns)]
        found.append(
            np.column_stack([p[:-1][crosses] + share * np.diff(p, axis=0)[crosses] for p in ends])
        )
    return np.concatenate(found)


def mean_absolute_deviation(
    evaluate: Evaluate,
    values: ArrayLike,
    latitude: ArrayLike,
    longitude: ArrayLike,
    half_width_m: float,
    step_m: float,
) -> PathMatch:
    """How well measured values fit the map along a path, and along paths parallel to it.

    deviation[i, j] = mean over k of |map(path k, shifted by north i and east j) - value k|
    (Cuenca 2020, eq. 3.5; of one sample it is the minimum difference, eq. 3.4).

    Parameters
    ----------
    values : (n,) nT; `latitude`, `longitude` : (n,) degrees, where they seemed to be measured.
    half_width_m, step_m : shifts go from -half_width to half_width, in steps, north and east.

    Raises QueryError for values or positions that are not finite, and for a window that is none.
    """
    shape, (wanted, lat, lon) = broadcast(values=values, latitude=latitude, longitude=longitude)
    check_positions(shape, lat, lon)
    if not (wanted.size and np.isfinite([wanted, lat, lon]).all()):
        raise QueryError("are not all finite", where="values, latitude, longitude")
    _positive("half_width_m", half_width_m)
    _positive("step_m", step_m)
    count = int(np.floor(half_width_m / step_m + 1e-9))
    if (2 * count + 1) ** 2 > _MOST_SHIFTS:
        raise QueryError(
            f"makes {(2 * count + 1) ** 2} shifts",
            where="step_m",
            expected=f"at most {_MOST_SHIFTS}",
        )
    shift = step_m * np.arange(-count, count + 1, dtype=np.float64)
    north, east = metres_per_degree(lat, 0.0)
    total = np.zeros((shift.size, shift.size))
    for k in range(wanted.size):
        y, x = np.meshgrid(lat[k] + shift / north[k], lon[k] + shift / east[k], indexing="ij")
        total += np.abs(evaluate(y, x) - wanted[k])
    deviation = total / wanted.size
    best = (np.nan, np.nan)
    if np.isfinite(deviation).any():
        i, j = np.unravel_index(int(np.nanargmin(deviation)), deviation.shape)
        best = float(shift[i]), float(shift[j])
    return PathMatch(shift, shift.copy(), deviation, *best)


def _positive(name: str, value: float) -> None:
    if np.ndim(value) or not 0.0 < value < np.inf:
        raise QueryError(f"is {value!r}", where=name, expected="one positive number of metres")
