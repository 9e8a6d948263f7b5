"""GFZ's lists of the ten quietest and five most disturbed days of each month.

A quiet day marked A has Ap above 6, one marked K has a Kp above 3 or two above 2+: it is one of
the month's quietest without being quiet. A disturbed day marked * has Ap below 20.
"""

from __future__ import annotations

import datetime
import re

import numpy as np

from magtiles.schemas.errors import FormatError
from magtiles.stages.ingest.index_values import Values, date_of, first_line, numbered

_MONTHS = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")
_HEADINGS = re.compile(r"\s*(International\s+)?Quietest Days|\s*Month\b|\s*Q1\s+Q2")
_ROW = re.compile(rf"\s*({'|'.join(_MONTHS)})\s+(\d{{4}})((?:\s+\d+[AK*]?)*)\s*$")
_DAY = re.compile(r"(\d+)([AK*]?)")
_QUIET, _DISTURBED = 10, 5
MARKS = {"": 0.0, "A": 1.0, "K": 2.0, "*": 3.0}
"""Values of `day_mark` by the list's letters."""


def is_day_list(text: str) -> bool:
    """Whether it is such a list."""
    return first_line(text, _HEADINGS.pattern)


def read_day_list(text: str, where: str) -> list[Values]:
    """Ranks 1 to 10 of quiet days, 1 to 5 of disturbed ones, and marks; 0 for the others.

    All days of the listed months are given. Raises FormatError naming the line.
    """
    months: dict[datetime.date, tuple[list[int], list[int], list[float]]] = {}
    for line, row in numbered(text):
        if _HEADINGS.match(row):
            continue
        place = f"{where} line {line}"
        match = _ROW.match(row)
        days = [] if match is None else _DAY.findall(match[3])
        if match is None or len(days) != _QUIET + _DISTURBED:
            raise FormatError(
                f"the line is truncated or malformed: '{row.strip()[:60]}'",
                where=place,
                expected="a month, ten quiet days and five disturbed ones",
                remedy="fetch the file again",
            )
        first = date_of((match[2], _MONTHS.index(match[1]) + 1, 1), place)
        if first in months:
            raise FormatError(f"{row.strip()[:8]} is given twice", where=place)
        months[first] = _ranks(first, days, place)
    if not months:
        raise FormatError("has no data", where=where, remedy="fetch it again")
    starts = sorted(months)
    time = np.concatenate([_days_of(first) for first in starts]).astype("datetime64[h]")
    return [
        Values(name, 24, time, np.concatenate([months[m][i] for m in starts]).astype(float), where)
        for i, name in enumerate(("quiet_rank", "disturbed_rank", "day_mark"))
    ]


def _days_of(first: datetime.date) -> np.ndarray[tuple[int], np.dtype[np.datetime64]]:
    month = np.datetime64(first, "M")
    return np.arange(month, month + 1, dtype="datetime64[D]")


def _ranks(
    first: datetime.date, days: list[tuple[str, str]], where: str
) -> tuple[list[int], list[int], list[float]]:
    count = _days_of(first).size
    quiet, disturbed, marks = [0] * count, [0] * count, [0.0] * count
    for place, (day, mark) in enumerate(days):
        index = int(day) - 1
        ranks, rank = (quiet, place + 1) if place < _QUIET else (disturbed, place - _QUIET + 1)
        if not 0 <= index < count or ranks[index]:
            raise FormatError(
                f"day {day}", where=where, expected=f"each of 1 to {count} once in a list"
            )
        ranks[index] = rank
        marks[index] = MARKS[mark]
    return quiet, disturbed, marks
