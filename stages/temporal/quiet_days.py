"""The quiet days of a month: from the international list, from Kp, or from the record itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.stats import rankdata

from magtiles.catalog.flags import QuietDayChoice
from magtiles.stages.temporal.days import LocalDays
from magtiles.stages.temporal.record import TOTAL

Real = NDArray[np.float64]
Dates = NDArray[np.datetime64]

QUIET_DAYS = 5
_RANKS = 10
"""The list names ten: those after the fifth stand in for days that cannot be used."""

_SLOTS = 8
"""Kp values of a day, one for each three hours."""


@dataclass(frozen=True)
class Choice:
    """Days chosen for a month, quietest first, and how (bits of QuietDayChoice)."""

    days: Dates
    flags: int


def choose_days(
    month: np.datetime64, days: LocalDays, usable: NDArray[np.bool_], index: xr.Dataset | None
) -> Choice:
    """Up to five quiet days of a month that an observatory's record has.

    The ten that the international list names, else those that Kp ranks first as the list
    does, in order, passing over days that are not usable; without either, the usable days on
    which the record itself departs least from the month's typical day.

    Parameters
    ----------
    month : any instant in it.
    usable : (element, day), which days of which element may be used.
    index : an activity-index/1 with `quiet_rank` or `kp`, if there is one.
    """
    month = month.astype("datetime64[M]")
    fit = day_is_fit(month, days, usable)
    candidates, how = np.empty(0, "datetime64[D]"), QuietDayChoice.RECORD
    if index is not None:
        candidates, how = listed_days(index, month), QuietDayChoice.LIST
        if not candidates.size:
            candidates, how = kp_quiet_days(index, month), QuietDayChoice.KP
    if not candidates.size:
        candidates, how = _calm_days(days, fit, month), QuietDayChoice.RECORD
    kept = np.flatnonzero(np.isin(candidates, days.date[fit]))[:QUIET_DAYS]
    flags = how
    if kept.size and kept[-1] >= QUIET_DAYS:
        flags |= QuietDayChoice.STANDBY
    if kept.size < QUIET_DAYS:
        flags |= QuietDayChoice.FEWER_THAN_FIVE
    return Choice(candidates[kept], int(flags))


def day_is_fit(
    month: np.datetime64, days: LocalDays, usable: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Which days (day,) of a month may be chosen: those whose whole vector is usable.

    Where the month has no vector at all (a base station), those whose total is.
    """
    inside = days.date.astype("datetime64[M]") == month
    recorded = np.isfinite(days.departure[:TOTAL, inside]).any()
    fit: NDArray[np.bool_] = inside & (usable[:TOTAL].all(axis=0) if recorded else usable[TOTAL])
    return fit


def listed_days(index: xr.Dataset, month: np.datetime64) -> Dates:
    """The ten quietest days of a month in the order of the list; none where it has none."""
    if "quiet_rank" not in index:
        return np.empty(0, "datetime64[D]")
    date = index["time"].values.astype("datetime64[D]")
    rank = index["quiet_rank"].values
    named = (rank > 0) & (date.astype("datetime64[M]") == month)
    # An index of hours names a day as often as it has hours.
    ranks, first = np.unique(rank[named], return_index=True)
    chosen: Dates = date[named][first][ranks <= _RANKS]
    return chosen


def kp_quiet_days(index: xr.Dataset, month: np.datetime64) -> Dates:
    """The ten days of a month that Kp ranks quietest; none unless every day has all its values.

    The rule behind the international list (Johnston 1943, Terr. Magn. Atmos. Electr. 48,
    219): a day's order in the sum of its eight Kp, in the sum of their squares and in the
    greatest of them; the mean of the three orders ranks the day. Days that are equal share an
    order, and the next follows without a gap; days of one rank go by the greatest Kp, then by
    the squares. So read, it gives the five days of the list in every month of 2006 to 2019.
    """
    if "kp" not in index:
        return np.empty(0, "datetime64[D]")
    date = np.arange(month, month + 1, dtype="datetime64[D]")
    kp = _kp_of_days(index, date)
    if not np.isfinite(kp).all():
        return np.empty(0, "datetime64[D]")
    thirds = np.round(3.0 * kp)  # files round thirds, each in its own way
    squares = (thirds**2).sum(axis=1)
    greatest = thirds.max(axis=1)
    criteria = thirds.sum(axis=1), squares, greatest
    order = np.sum([rankdata(c, method="dense") for c in criteria], axis=0)
    return date[np.lexsort((date, squares, greatest, order))[:_RANKS]]


def _kp_of_days(index: xr.Dataset, date: Dates) -> Real:
    """Kp (day, 8); NaN where it is not known."""
    slot = index["time"].values.astype("datetime64[ns]") - date[0].astype("datetime64[ns]")
    number = slot // np.timedelta64(24 // _SLOTS, "h")
    kp = index["kp"].values.astype(np.float64)
    inside = (number >= 0) & (number < date.size * _SLOTS) & np.isfinite(kp)
    values = np.full(date.size * _SLOTS, np.nan)
    values[number[inside]] = kp[inside]
    return values.reshape(-1, _SLOTS)


def _calm_days(days: LocalDays, fit: NDArray[np.bool_], month: np.datetime64) -> Dates:
    """The fit days, least disturbed first: by rms departure from the month's median day."""
    if not fit.any():
        return np.empty(0, "datetime64[D]")
    departure = days.departure[:, fit]
    vector = np.isfinite(departure[:TOTAL]).any()
    departure = departure[:TOTAL] if vector else departure[TOTAL:]
    unusual = departure - _nan_median(departure)
    there = np.isfinite(unusual)
    power = np.where(there, unusual, 0.0) ** 2
    activity = power.sum(axis=(0, 2)) / there.sum(axis=(0, 2))
    return days.date[fit][np.argsort(activity, kind="stable")]


def _nan_median(departure: Real) -> Real:
    """Median over days (element, 1, phase); NaN, quietly, where no day has the phase."""
    ordered = np.sort(departure, axis=1)  # NaN last
    count = np.isfinite(departure).sum(axis=1, keepdims=True)
    last = np.maximum(count - 1, 0)
    low, high = (np.take_along_axis(ordered, n, axis=1) for n in (last // 2, (last + 1) // 2))
    return 0.5 * (low + high)
