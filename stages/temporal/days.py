"""A record laid out on whole days of local mean solar time, each against its own midnights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.kernels.geodesy import wrap_longitude
from magtiles.schemas.errors import ContractError
from magtiles.stages.temporal.record import check_ascending, fit_elements

Real = NDArray[np.float64]
Dates = NDArray[np.datetime64]

_DAY_NS = 86_400_000_000_000
_MINUTE_NS = 60e9
_NS_PER_DEGREE = _DAY_NS / 360.0

_NEAR_MIN = 60.0
"""A midnight's level is the mean of what is this near to it."""

_MIDNIGHT_SHARE = 0.4
"""A midnight needs this much of the time so near to it: either side is enough."""


@dataclass(frozen=True)
class LocalDays:
    """What a record holds of whole local days.

    Attributes
    ----------
    date : (day,) local dates, datetime64[D], without gaps. A day's noon lies in the UTC day of
        the same date, which is the day that lists of quiet days mean.
    minute : (phase,) minutes of local mean solar time of a day's samples, ascending.
    departure : (element, day, phase) nT, less the straight line from the level of the midnight
        before to that of the midnight after: the non-cyclic change is out.
    level : (element, day) nT, the mean of both midnights' levels.
    share : (element, day) of samples that are there; 0 for a day without both midnights.
    """

    date: Dates
    minute: Real
    departure: Real
    level: Real
    share: Real


def local_days(series: xr.Dataset) -> LocalDays:
    """Lay an observatory-series/1 out on local days.

    A midnight's level is the mean of the hour before and the hour after it.

    Raises ContractError for times that do not ascend or keep no regular step, and for a step
    below a minute, above an hour, or that does not divide the day.
    """
    check_ascending(series)
    step = _step_ns(series)
    local = _local_ns(series)
    _check_regular(local, step, series)
    first, last = (int(t) // _DAY_NS for t in (local[0], local[-1]))
    phases = _DAY_NS // step
    offset = int(local[0]) % step

    laid = np.full((4, (last - first + 1) * phases), np.nan)
    laid[:, (local - first * _DAY_NS) // step] = fit_elements(series)
    minute = (offset + step * np.arange(phases)) / _MINUTE_NS
    midnight = _midnights(laid, phases, minute)

    days = laid.reshape(4, -1, phases)
    before, after = midnight[:, :-1], midnight[:, 1:]
    along = minute / 1440.0
    line = before[..., None] * (1.0 - along) + after[..., None] * along
    level = 0.5 * (before + after)
    share = np.where(np.isfinite(level), np.isfinite(days).mean(axis=2), 0.0)
    date = np.arange(first, last + 1).astype("datetime64[D]")
    return LocalDays(date, minute, days - line, level, share)


def _midnights(laid: Real, phases: int, minute: Real) -> Real:
    """Levels (element, day + 1) of the midnights that begin the days, and of the last one's end.

    Each value stands for the time around it, half a step to either side, and counts with what
    of that is within the two hours. NaN where less than two fifths of these is known.
    """
    day = np.pad(laid, ((0, 0), (phases, phases)), constant_values=np.nan)
    day = day.reshape(len(laid), -1, phases)
    around = np.concatenate([day[:, :-1], day[:, 1:]], axis=2)
    from_midnight = np.concatenate([minute - 1440.0, minute])
    half_step = 720.0 / phases
    ends = np.clip(from_midnight[:, None] + [-half_step, half_step], -_NEAR_MIN, _NEAR_MIN)
    weight = ends[:, 1] - ends[:, 0]
    near = weight > 0.0
    known = np.isfinite(around[..., near])
    weights = np.where(known, weight[near], 0.0)
    total = weights.sum(axis=2)
    mean = (weights * np.where(known, around[..., near], 0.0)).sum(axis=2)
    enough = total >= _MIDNIGHT_SHARE * 2.0 * _NEAR_MIN
    return np.where(enough, mean / np.where(enough, total, 1.0), np.nan)


def _local_ns(series: xr.Dataset) -> NDArray[np.int64]:
    """Nanoseconds of local mean solar time since 1970, local date included."""
    longitude = float(wrap_longitude(np.asarray(series.attrs["longitude"], np.float64)))
    time = series["time"].values.astype("datetime64[ns]").astype(np.int64)
    shifted: NDArray[np.int64] = time + round(longitude * _NS_PER_DEGREE)
    return shifted


def _step_ns(series: xr.Dataset) -> int:
    cadence = float(series.attrs["cadence_s"])
    step = round(cadence * 1e9)
    if 60.0 <= cadence <= 3600.0 and _DAY_NS % step == 0:
        return step
    raise ContractError(
        f"one value every {cadence:g} s",
        where=f"{series.attrs.get('source', '')} cadence_s".strip(),
        expected="from a minute to an hour, a whole number of times a day",
        remedy="ingest the seconds with cadence = 'minute'"
        if cadence < 60.0
        else "use minute or hourly values",
    )


def _check_regular(local: NDArray[np.int64], step: int, series: xr.Dataset) -> None:
    bad = np.flatnonzero((local - local[0]) % step)
    if bad.size:
        at = int(bad[0])
        raise ContractError(
            f"{series['time'].values[at]} is no whole number of steps after the first time",
            where=f"{series.attrs.get('source', '')} time[{at}]".strip(),
            expected=f"one value every {step / 1e9:g} s",
            remedy="do not mix cadences in one series",
        )
