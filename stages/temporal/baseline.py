"""Quiet-day curves of an observatory, month by month: ``quiet-day-baseline``.

The noon-time swing of quiet days is no Gauss-Markov process and has to come out before one
is fitted (Canciani and Raquet 2016, "Temporal Variation Parameterization"): it is the mean
of a month's five quietest days, a function of local time.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from magtiles.catalog.flags import QuietDayChoice, flag_attributes
from magtiles.catalog.kernels.local_time import MINUTES_PER_DAY
from magtiles.schemas.errors import CoverageError
from magtiles.stages.declare import OptionalInput, Params, Stage, quantity
from magtiles.stages.temporal.days import LocalDays, local_days
from magtiles.stages.temporal.dip import dip_latitude
from magtiles.stages.temporal.quiet_days import QUIET_DAYS, Choice, choose_days
from magtiles.stages.temporal.record import ELEMENTS

_LOG = logging.getLogger(__name__)

Real = NDArray[np.float64]

_SMOOTH_ABOVE_MIN = 10.0
"""Values farther apart than this are joined by a spline, closer ones by straight lines."""

_FAR_MIN = 60.0
"""A minute farther than this from any value that is there is left missing."""


class QuietDayBaselineParams(Params):
    """Parameters of quiet-day-baseline."""

    least_days: int = quantity(
        "1", default=3, ge=2, le=QUIET_DAYS, doc="Fewest quiet days that make a month's curve."
    )
    least_share: float = quantity(
        "1", default=0.9, gt=0, le=1, doc="Least share of a day's samples that makes it usable."
    )


@dataclass(frozen=True)
class Month:
    """One month of one observatory.

    Attributes
    ----------
    curve, error : (element, minute) nT, the baseline and its standard error.
    level : (element,) nT.
    choice : the days used and how they were chosen.
    """

    curve: Real
    error: Real
    level: Real
    choice: Choice


def quiet_day_baseline(
    series: xr.Dataset, *, params: QuietDayBaselineParams, index: xr.Dataset | None = None
) -> xr.Dataset:
    """Mean quiet-day curve of each month by local mean solar time, each minute, nT.

    For north, east, down and total alike: whole local days, each less the straight line
    between the levels of its two midnights, averaged over the month's quiet days. `level` is
    what those lines have at midday on average, so that record - level - baseline is what a
    Gauss-Markov process has to describe. The standard error is that of the mean of days.

    Parameters
    ----------
    series : observatory-series/1 with a value every minute to every hour.
    index : activity-index/1 with `quiet_rank` or `kp`; without, days are chosen by the record.

    Returns
    -------
    temporal-model/1 of one observatory, from the first month with a usable day to the last. A
    month with fewer than `least_days` is NaN and flagged. Times of means are their centres;
    values more than ten minutes apart are joined by a periodic cubic spline.

    Raises CoverageError when no month has days enough, ContractError for times that do not
    ascend or a step that is not between a minute and an hour.
    """
    days = local_days(series)
    usable = days.share >= params.least_share
    months = _months(days, usable)
    made = [_month(m, days, usable, index, params) for m in months]
    for month, each in zip(months, made, strict=True):
        _report(month, each, index, series)
    if all(m.choice.flags & QuietDayChoice.TOO_FEW_DAYS for m in made):
        most = max((m.choice.days.size for m in made), default=0)
        raise CoverageError(
            f"no month has {params.least_days} usable quiet days; the best has {most}",
            where=series.attrs["source"],
            expected=f"whole local days with {params.least_share:.0%} of their samples, and an "
            "hour to either side",
            remedy="give a longer record, or lower least_share or least_days",
        )
    return _model(series, months, made)


def _months(days: LocalDays, usable: NDArray[np.bool_]) -> NDArray[np.datetime64]:
    """Months (month,) from the first with a usable day to the last, datetime64[M]."""
    held = days.date[usable.any(axis=0)].astype("datetime64[M]")
    return np.arange(held[0], held[-1] + 1) if held.size else held


def _month(
    month: np.datetime64,
    days: LocalDays,
    usable: NDArray[np.bool_],
    index: xr.Dataset | None,
    params: QuietDayBaselineParams,
) -> Month:
    choice = choose_days(month, days, usable, index)
    if choice.days.size < params.least_days:
        choice = Choice(choice.days, choice.flags | QuietDayChoice.TOO_FEW_DAYS)
    curve, error = np.full((2, len(ELEMENTS), int(MINUTES_PER_DAY)), np.nan)
    level = np.full(len(ELEMENTS), np.nan)
    at = np.searchsorted(days.date, choice.days)
    for element in range(len(ELEMENTS)):
        used = at[usable[element, at]]
        if used.size >= params.least_days:
            mean, spread = _mean_day(days.departure[element, used], params.least_days)
            curve[element] = _by_minute(days.minute, mean, smooth=True)
            error[element] = _by_minute(days.minute, spread, smooth=False)
            level[element] = days.level[element, used].mean()
    return Month(curve, error, level, choice)


def _mean_day(departure: Real, least_days: int) -> tuple[Real, Real]:
    """Mean (phase,) over days and its standard error; NaN where fewer than `least_days` are."""
    there = np.isfinite(departure)
    count = there.sum(axis=0)
    enough = count >= least_days
    n = np.where(enough, count, 2)
    mean = np.where(there, departure, 0.0).sum(axis=0) / n
    squares = (np.where(there, departure - mean, 0.0) ** 2).sum(axis=0)
    error = np.sqrt(squares / (n - 1) / n)
    return np.where(enough, mean, np.nan), np.where(enough, error, np.nan)


def _by_minute(phase: Real, values: Real, *, smooth: bool) -> Real:
    """A periodic curve at minutes 0 to 1439 from its values (phase,) at `phase` minutes.

    Where values are more than ten minutes apart and `smooth`, by a periodic cubic spline: a
    straight line between hourly means would cut off an eighth of the sixth-hour wave's crest.
    """
    there = np.isfinite(values)
    minute = np.arange(MINUTES_PER_DAY)
    if not there.any():
        return np.full(minute.shape, np.nan)
    x, y = phase[there], values[there]
    if smooth and MINUTES_PER_DAY / phase.size > _SMOOTH_ABOVE_MIN:
        closed = np.append(x, x[0] + MINUTES_PER_DAY), np.append(y, y[0])
        curve = CubicSpline(*closed, bc_type="periodic")(minute)
    else:
        curve = np.interp(minute, x, y, period=MINUTES_PER_DAY)
    return np.where(_distance(minute, x) <= _FAR_MIN, curve, np.nan)


def _distance(minute: Real, phase: Real) -> Real:
    """Minutes from each minute of the day to the nearest phase, over midnight too."""
    around = np.concatenate([phase[-1:] - MINUTES_PER_DAY, phase, phase[:1] + MINUTES_PER_DAY])
    after = np.searchsorted(around, minute).clip(1)
    return np.asarray(np.minimum(minute - around[after - 1], around[after] - minute), np.float64)


def _report(
    month: np.datetime64, made: Month, index: xr.Dataset | None, series: xr.Dataset
) -> None:
    where = f"{series.attrs['iaga_code']} {month}"
    if made.choice.flags & QuietDayChoice.TOO_FEW_DAYS:
        _LOG.warning("%s: %d usable quiet days: no baseline", where, made.choice.days.size)
    elif made.choice.flags & QuietDayChoice.FEWER_THAN_FIVE:
        _LOG.warning("%s: baseline of %d quiet days only", where, made.choice.days.size)
    if index is not None and made.choice.flags & QuietDayChoice.RECORD:
        _LOG.warning("%s: the index has neither ranks nor all Kp; days chosen by the record", where)


def _model(series: xr.Dataset, months: NDArray[np.datetime64], made: list[Month]) -> xr.Dataset:
    curve = ("observatory", "element", "month", "minute")
    days = np.full((1, len(made), QUIET_DAYS), "NaT", "datetime64[ns]")
    for row, each in zip(days[0], made, strict=True):
        row[: each.choice.days.size] = each.choice.days
    flags = np.array([[m.choice.flags for m in made]], np.uint8)
    middle = (
        months[0].astype("datetime64[ns]")
        + ((months[-1] + 1).astype("datetime64[ns]") - months[0].astype("datetime64[ns]")) // 2
    )
    return observatory(series, middle).assign(
        month=("month", months.astype("datetime64[ns]"), {"long_name": "start of the month"}),
        minute=(
            "minute",
            np.arange(MINUTES_PER_DAY),
            {"units": "min", "long_name": "local mean solar time after midnight"},
        ),
        baseline=(
            curve,
            np.stack([m.curve for m in made], axis=1)[None],
            {"units": "nT", "long_name": "quiet-day curve above the level of local midnight"},
        ),
        baseline_standard_error=(
            curve,
            np.stack([m.error for m in made], axis=1)[None],
            {"units": "nT", "long_name": "standard error of the mean of the quiet days"},
        ),
        level=(
            curve[:3],
            np.stack([m.level for m in made], axis=1)[None],
            {"units": "nT", "long_name": "mean level of the quiet days' midnights"},
        ),
        quiet_day=(("observatory", "month", "rank"), days, {"long_name": "days used"}),
        quiet_day_choice=(
            ("observatory", "month"),
            flags,
            flag_attributes(QuietDayChoice)
            | {"long_name": "how the quiet days were chosen, and what they lack"},
        ),
    )


def observatory(series: xr.Dataset, date: np.datetime64) -> xr.Dataset:
    """The part of a temporal-model/1 that says which observatory it is of."""
    latitude, longitude, elevation = (
        np.array([float(series.attrs[name])]) for name in ("latitude", "longitude", "elevation")
    )
    dip = dip_latitude(latitude, longitude, elevation, date)
    return xr.Dataset(
        {
            "iaga_code": ("observatory", np.array([series.attrs["iaga_code"]])),
            "latitude": ("observatory", latitude, {"units": "degrees_north"}),
            "longitude": ("observatory", longitude, {"units": "degrees_east"}),
            "elevation": ("observatory", elevation, {"units": "m"}),
            "dip_latitude": ("observatory", dip, {"units": "degree"}),
            "element": ("element", np.array(ELEMENTS)),
        },
        attrs={"source": str(series.attrs["source"]), "cadence_s": series.attrs["cadence_s"]},
    )


STAGE = Stage(
    name="quiet-day-baseline",
    version=1,
    params=QuietDayBaselineParams,
    inputs={"series": "observatory-series/1", "index": OptionalInput("activity-index/1")},
    output="temporal-model/1",
    run=quiet_day_baseline,
)
