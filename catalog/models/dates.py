"""Dates as decimal years, which is how models count time."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtiles.schemas.errors import QueryError

_EXPECTED = "an ISO date such as 2020-07-01, a datetime, a numpy.datetime64 or a decimal year"

Date = ArrayLike | datetime | np.datetime64 | str
"""One date or an array of them."""


def decimal_year(date: Date) -> NDArray[np.float64]:
    """Dates (...) as years and fractions of the calendar year they are in, UTC.

    The fraction is of 366 days in a leap year: noon of 2 July 2020 lies 183.5 days into the
    year, at 2020 + 183.5 / 366. Numbers, and text that is a number, are decimal years already.

    Raises QueryError for what is no date.

    >>> float(decimal_year("2020-07-02"))
    2020.5
    """
    if isinstance(date, datetime):
        date = _as_utc(date)
    values = np.asarray(date)
    if values.dtype == object:
        values = np.array([_as_utc(d) for d in values.ravel()]).reshape(values.shape)
    if values.dtype.kind in "US":
        values = _from_text(values.astype(np.str_))
    if values.dtype.kind == "M":
        values = _from_calendar(values)
    if values.dtype.kind not in "iuf":
        raise QueryError(f"date is {date!r}", expected=_EXPECTED)
    years = values.astype(np.float64)
    if not np.isfinite(years).all():
        index = int(np.flatnonzero(~np.isfinite(years.ravel()))[0])
        raise QueryError("date is missing", where=f"date[{index}]", expected=_EXPECTED)
    return years


def instant(date: Date) -> NDArray[np.datetime64]:
    """Dates (...), as `decimal_year` takes them, as datetime64[ns] UTC.

    Raises QueryError for what is no date, or lies before 1700 or after 2200, which nanoseconds
    do not reach.

    >>> instant(2020.5)
    array('2020-07-02T00:00:00.000000000', dtype='datetime64[ns]')
    """
    values = np.asarray(_as_utc(date) if isinstance(date, datetime) else date)
    years = decimal_year(date)
    if not ((years >= 1700.0) & (years < 2200.0)).all():
        index = int(np.flatnonzero(~((years >= 1700.0) & (years < 2200.0)).ravel())[0])
        raise QueryError(
            f"date is {years.ravel()[index]:.12g}",
            where=f"date[{index}]",
            expected="a date from 1700 to 2199",
        )
    if values.dtype.kind == "M":  # exact, where a decimal year is to 10 microseconds
        return values.astype("datetime64[ns]")
    whole = np.floor(years)
    start = (whole.astype(np.int64) - 1970).astype("datetime64[Y]")
    first = start.astype("datetime64[us]")
    length = (start + 1).astype("datetime64[us]") - first
    part = np.rint((years - whole) * length.astype(np.float64)).astype("timedelta64[us]")
    return np.asarray((first + part).astype("datetime64[ns]"))


def _as_utc(date: Any) -> np.datetime64:
    if isinstance(date, datetime) and date.tzinfo is not None:
        date = date.astimezone(UTC).replace(tzinfo=None)
    try:
        return np.datetime64(date, "us")
    except (TypeError, ValueError):
        raise QueryError(f"date is {date!r}", expected=_EXPECTED) from None


def _from_text(text: NDArray[np.str_]) -> NDArray[np.float64]:
    years = np.empty(text.shape)
    for index, one in np.ndenumerate(text):
        try:
            years[index] = float(one)
        except ValueError:
            years[index] = _from_calendar(np.asarray(_from_iso(str(one))))
    return years


def _from_iso(text: str) -> np.datetime64:
    try:
        return _as_utc(datetime.fromisoformat(text))
    except ValueError:
        raise QueryError(f"date is {text!r}", expected=_EXPECTED) from None


def _from_calendar(dates: NDArray[Any]) -> NDArray[np.float64]:
    year = dates.astype("M8[Y]")
    start, end = year.astype("M8[us]"), (year + 1).astype("M8[us]")
    with np.errstate(invalid="ignore"):
        fraction = (dates.astype("M8[us]") - start) / (end - start)
        whole = np.where(np.isnat(dates), np.nan, year.astype(np.int64) + 1970)
    return np.asarray(whole + fraction, dtype=np.float64)
