"""What every reader of indices hands over: values for the interval that begins at a time."""

from __future__ import annotations

import datetime
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError

Real = NDArray[np.float64]


@dataclass(frozen=True)
class Values:
    """An index at the beginnings of its intervals, ascending.

    Attributes
    ----------
    name : variable of activity-index/1.
    hours : length of an interval: 1, 3 or 24.
    time : (n,) datetime64[h].
    values : (n,) NaN where missing.
    where : the file.
    """

    name: str
    hours: int
    time: NDArray[np.datetime64]
    values: Real
    where: str


def gather(
    name: str, hours: int, rows: list[tuple[datetime.date, list[float], int]], where: str
) -> Values:
    """Values of days, each (date, its values, line). Raises FormatError for a day given twice."""
    if not rows:
        raise FormatError("has no data", where=where, remedy="fetch it again")
    seen: set[datetime.date] = set()
    for date, _, line in rows:
        if date in seen:
            raise FormatError(
                f"duplicated day: {date} is given twice",
                where=f"{where} line {line}",
                remedy="remove one of the lines",
            )
        seen.add(date)
    rows = sorted(rows, key=lambda row: row[0])
    starts = np.array([row[0] for row in rows], "datetime64[h]")
    within = np.arange(0, 24, hours) * np.timedelta64(1, "h")
    time = np.asarray((starts[:, None] + within).ravel(), "datetime64[h]")
    return Values(name, hours, time, np.array([row[1] for row in rows], np.float64).ravel(), where)


def thirds(kp: float, where: str) -> float:
    """A Kp of three decimals as the exact third it stands for; NaN for a negative mark."""
    if kp < 0:
        return np.nan
    third = round(kp * 3)
    if not 0 <= third <= 27 or abs(third / 3 - kp) > 2e-3:
        raise FormatError(
            f"Kp is {kp:g}", where=where, expected="a third between 0 and 9, such as 2.667"
        )
    return third / 3


def number(word: str, where: str) -> float:
    """A number. Raises FormatError naming the line."""
    try:
        value = float(word)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise FormatError(f"found '{word}'", where=where, expected="a number")
    return value


def date_of(words: Sequence[int | str], where: str) -> datetime.date:
    """A date of year, month and day. Raises FormatError naming the line."""
    year, month, day = words
    try:
        return datetime.date(int(year), int(month), int(day))
    except ValueError:
        raise FormatError(
            f"no such date: {year}-{month}-{day}", where=where, expected="year, month and day"
        ) from None


def numbered(text: str) -> list[tuple[int, str]]:
    """Lines with content and their numbers, without comments."""
    lines = enumerate(text.splitlines(), start=1)
    return [(n, line) for n, line in lines if line.strip() and not line.startswith("#")]


def first_line(text: str, pattern: str) -> bool:
    """Whether the first line that is no comment matches."""
    lines = numbered(text[:20000])
    return bool(lines) and re.match(pattern, lines[0][1]) is not None
