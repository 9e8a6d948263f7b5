"""Local mean solar time, and quiet-day curves between months and minutes of that time.

A curve holds a day of local mean solar time in equal steps from midnight: column j of m is
minute 1440 j / m. Month curves stand at the middle of their months.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Times = NDArray[np.datetime64]

MINUTES_PER_DAY = 1440.0
_MINUTES_PER_DEGREE = 4.0
_NS_PER_DAY = 86_400_000_000_000
_NS_PER_MINUTE = 60e9


def solar_minute(time: Times, longitude_deg: ArrayLike) -> Floats:
    """Local mean solar time, minutes after midnight in [0, 1440).

    Universal time plus four minutes a degree east: the mean sun, without the equation of
    time (up to 16 minutes), as quiet-day curves of a month are drawn.

    Parameters
    ----------
    time : UTC, datetime64.
    longitude_deg : degrees east, of any turn; broadcasts with `time`. NaN gives NaN.
    """
    of_day = _nanoseconds(time) % _NS_PER_DAY / _NS_PER_MINUTE
    minute = np.mod(
        np.where(np.isnat(time), np.nan, of_day)
        + _MINUTES_PER_DEGREE * np.asarray(longitude_deg, np.float64),
        MINUTES_PER_DAY,
    )
    # A tiny negative sum is rounded up to the modulus itself.
    return np.where(minute >= MINUTES_PER_DAY, 0.0, minute)


def mid_month(months: Times) -> Times:
    """The instants halfway through months, datetime64[ns], given their starts."""
    start = months.astype("datetime64[M]")
    first = start.astype("datetime64[ns]")
    middle: Times = first + ((start + 1).astype("datetime64[ns]") - first) // 2
    return middle


def baseline_at(months: Times, baseline: Floats, time: Times, longitude_deg: ArrayLike) -> Floats:
    """Quiet-day curves at instants and longitudes, in the unit of `baseline`.

    Periodic and linear in minutes of local mean solar time; linear in universal time between
    mid-months, before the first and after the last the nearest month's. A month that is
    wholly NaN is passed over as if it were absent.

    Parameters
    ----------
    months : (month,) starts of months, ascending.
    baseline : (..., month, minute), for instance of several elements.
    time, longitude_deg : UTC and degrees east; they broadcast together.

    Returns
    -------
    (..., *shape of `time` with `longitude_deg`); NaN where time or longitude is missing, and
    everywhere when every month is NaN.
    """
    return _by_curve(months, baseline, time, longitude_deg, lambda w, a, b: (1.0 - w) * a + w * b)


def standard_error_at(
    months: Times, standard_error: Floats, time: Times, longitude_deg: ArrayLike
) -> Floats:
    """Standard error of what `baseline_at` returns, from that of the month curves.

    Two months share no days, so their errors combine as variances with squared weights.
    Neighbouring minutes of one curve share theirs, so along minutes the standard error
    itself is interpolated. Arguments and shapes are those of `baseline_at`.
    """
    return _by_curve(
        months, standard_error, time, longitude_deg, lambda w, a, b: np.hypot((1.0 - w) * a, w * b)
    )


def level_at(months: Times, level: Floats, time: Times) -> Floats:
    """Month levels (..., month) at instants: (..., *shape of `time`), linear between mid-months.

    Months that are NaN are passed over; before the first and after the last, the nearest's.
    """
    return baseline_at(months, np.asarray(level, np.float64)[..., None], time, 0.0)


Mix = Callable[[Floats, Floats, Floats], Floats]


def _by_curve(
    months: Times, curves: Floats, time: Times, longitude_deg: ArrayLike, mix: Mix
) -> Floats:
    curves = np.asarray(curves, np.float64)
    minute = solar_minute(time, longitude_deg)
    instant = np.broadcast_to(np.asarray(time), minute.shape).ravel()
    flat = curves.reshape(-1, *curves.shape[-2:])
    values = [_one(months, curve, instant, minute.ravel(), mix) for curve in flat]
    return np.reshape(values, curves.shape[:-2] + minute.shape)


def _one(months: Times, curve: Floats, time: Times, minute: Floats, mix: Mix) -> Floats:
    """A curve (month, minute) at instants and local minutes, both (n,)."""
    kept = ~np.isnan(curve).all(axis=1)
    known = np.isfinite(minute)
    values = np.full(minute.shape, np.nan)
    if kept.any() and known.any():
        before, after, weight = _months_around(mid_month(months[kept]), time[known])
        left, right, along = _minutes_around(curve.shape[1], minute[known])

        def of_month(index: NDArray[np.intp]) -> Floats:
            rows = curve[kept]
            return (1.0 - along) * rows[index, left] + along * rows[index, right]

        values[known] = mix(weight, of_month(before), of_month(after))
    return values


def _months_around(
    middles: Times, time: Times
) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
    """Indices of the mid-months before and after, and the weight of the later one."""
    at = _nanoseconds(middles)
    # Nanoseconds since 1970 exceed what a float64 keeps: count from the first mid-month.
    position = np.interp(
        (_nanoseconds(time) - at[0]).astype(np.float64),
        (at - at[0]).astype(np.float64),
        np.arange(len(at), dtype=np.float64),
    )
    # Ceiling, not one more: a whole position asks nothing of the next, which may be NaN.
    before, after = (round_(position).astype(np.intp) for round_ in (np.floor, np.ceil))
    return before, after, position - before


def _minutes_around(
    count: int, minute: Floats
) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
    """Indices of the columns before and after in a periodic day, and the later one's weight."""
    position = minute * (count / MINUTES_PER_DAY)
    before, after = (round_(position).astype(np.intp) for round_ in (np.floor, np.ceil))
    return before % count, after % count, position - before


def _nanoseconds(time: Times) -> NDArray[np.int64]:
    return np.asarray(time).astype("datetime64[ns]").astype(np.int64)
