"""Hourly means in the exchange format of the World Data Centres: a day of one element a line.

An hour's value is its mean from the full hour to the next, so its time is half past.
"""

from __future__ import annotations

import datetime
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from magtiles.schemas.errors import FormatError, SourceError
from magtiles.stages.ingest.observatory.record import Header, Real, Record

_MISSING = 9999
_HOUR = np.timedelta64(3600, "s")
_LINE = re.compile(r"[A-Z0-9]{3}[ \d]\d[ \d]\d[DIHXYZEF][ \d]\d.{10}", re.IGNORECASE)
_ANGLES = ("D", "I")


@dataclass(frozen=True)
class _Day:
    """One line: nT, or arcminutes of D and I; NaN where missing."""

    code: str
    element: str
    date: datetime.date
    values: Real


def is_wdc_hourly(content: bytes) -> bool:
    """Whether the first line has the format's columns."""
    line = content[:120].decode("latin-1")
    return len(line) >= 100 and "\n" not in line and _LINE.match(line) is not None


def read_wdc_hourly(content: bytes, path: Path) -> Record:
    """The samples of a file of one station; days that the file leaves out are NaN.

    The file names its station but not where that is. Raises FormatError naming the line of a
    truncated or malformed row and of a day that is given twice; SourceError for two stations.
    """
    days: dict[tuple[str, datetime.date], _Day] = {}
    first: _Day | None = None
    for number, line in enumerate(content.decode("latin-1").splitlines(), start=1):
        if not line.strip():
            continue
        where = f"{path} line {number}"
        day = _day(line, where)
        first = first or day
        if day.code != first.code:
            raise SourceError(
                f"station '{day.code}' follows '{first.code}'",
                where=where,
                expected="one station",
                remedy="split the file by station",
            )
        if (day.element, day.date) in days:
            raise FormatError(
                f"duplicated day: {day.element} of {day.date} is given twice",
                where=where,
                remedy="remove one of the lines",
            )
        days[day.element, day.date] = day
    if first is None:
        raise FormatError("has no data", where=path, remedy="fetch it again")
    return _record(first.code, days, path)


def _record(code: str, days: dict[tuple[str, datetime.date], _Day], path: Path) -> Record:
    elements = tuple(e for e in "XYHDIEZF" if any(e == found for found, _ in days))
    dates = [date for _, date in days]
    begin = min(dates)
    count = (max(dates) - begin).days + 1
    values = np.full((len(elements), count * 24), np.nan)
    marked = np.zeros(count * 24, np.bool_)
    for (element, date), day in days.items():
        hours = slice((date - begin).days * 24, ((date - begin).days + 1) * 24)
        values[elements.index(element), hours] = day.values
        marked[hours] |= np.isnan(day.values)
    time = np.datetime64(begin, "ns") + _HOUR // 2 + np.arange(count * 24) * _HOUR

    return Record(str(path), Header(code, elements), time, values, marked, 3600.0)


def _day(line: str, where: str) -> _Day:
    if len(line.rstrip()) < 116 or _LINE.match(line) is None:
        raise FormatError(
            f"the line is truncated or malformed: '{line[:40]}'",
            where=where,
            expected="station, date, element, tabular base and 24 values in 116 columns or more",
            remedy="fetch the file again",
        )
    try:
        century = int(line[14:16]) if line[14:16].strip() else 19
        date = datetime.date(century * 100 + int(line[3:5]), int(line[5:7]), int(line[8:10]))
        base = int(line[16:20])
        hours = np.array([int(line[i : i + 4]) for i in range(20, 116, 4)], np.float64)
    except ValueError as caught:
        raise FormatError(
            f"the line is malformed: {caught}", where=where, expected="a date and whole numbers"
        ) from None
    element = line[7].upper()
    hours[hours == _MISSING] = np.nan
    # Tabular bases count degrees or hundreds of nT, values tenths of arcminutes or nT.
    values = base * 60.0 + hours / 10.0 if element in _ANGLES else base * 100.0 + hours
    return _Day(line[:3].upper(), element, date, values)
