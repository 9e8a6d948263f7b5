"""Rows of IAGA-2002 in the format's columns, compiled to machine code.

A year of one-minute rows is 37 MB of text, read here in one pass.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.kernels.jit import compiled

Bytes = NDArray[np.uint8]

FIRST_VALUE, FIELD, WIDTH, POINT = 31, 10, 9, 6
"""Columns of the first value, from value to value, of a value (F9.2) and its decimal point."""

_BAD = -1
_MALFORMED = 10**12
_MS_PER_DAY = 86_400_000


@compiled
def _at(text: Bytes, index: int) -> int:
    """A byte; that the index counts from the front spares a test of its sign each time."""
    return int(text[np.uint64(index)])


@compiled
def _digits(text: Bytes, begin: int, count: int) -> int:
    """The whole number of so many digits; -1 where another character stands."""
    value = 0
    for i in range(begin, begin + count):
        digit = _at(text, i) - 48
        if digit < 0 or digit > 9:
            return _BAD
        value = value * 10 + digit
    return value


@compiled
def _day(text: Bytes, row: int) -> int:
    """Days since 1970 of ``YYYY-MM-DD ... DOY``; a large negative number where there is none."""
    year, month, day = (
        _digits(text, row + 0, 4),
        _digits(text, row + 5, 2),
        _digits(text, row + 8, 2),
    )
    if (
        year < 1
        or month < 1
        or month > 12
        or day < 1
        or _at(text, row + 4) != 45
        or _at(text, row + 7) != 45
    ):
        return -_MS_PER_DAY
    leap = 1 if year % 4 == 0 and (year % 100 != 0 or year % 400 == 0) else 0
    length = 31
    if month == 2:
        length = 28 + leap
    elif month in (4, 6, 9, 11):
        length = 30
    before = (month - 1) * 31
    if month > 2:  # 153 days are five months from March on
        before = (153 * (month - 3) + 2) // 5 + 59 + leap
    if day > length or _digits(text, row + 24, 3) != before + day:
        return -_MS_PER_DAY
    past = year - 1
    return past * 365 + past // 4 - past // 100 + past // 400 + before + day - 1 - 719162


@compiled
def _clock(text: Bytes, row: int) -> int:
    """Milliseconds of the day of ``HH:MM:SS.mmm`` from column 11; -1 where there is none."""
    hour, minute, second = (
        _digits(text, row + 11, 2),
        _digits(text, row + 14, 2),
        _digits(text, row + 17, 2),
    )
    fraction = _digits(text, row + 20, 3)
    marks = (
        _at(text, row + 10) == 32
        and _at(text, row + 13) == 58
        and _at(text, row + 16) == 58
        and _at(text, row + 19) == 46
        and _at(text, row + 23) == 32
    )
    if not marks or hour < 0 or minute < 0 or second < 0 or fraction < 0:
        return _BAD
    if hour > 23 or minute > 59 or second > 59:
        return _BAD
    return ((hour * 60 + minute) * 60 + second) * 1000 + fraction


@compiled
def _hundredths(text: Bytes, begin: int) -> int:
    """The value of a field in hundredths, read from its end; `_MALFORMED` where it has none."""
    value, scale = _digits(text, begin + POINT + 1, 2), 100
    column = POINT - 1
    while column >= 0:
        digit = _at(text, begin + column) - 48
        if digit < 0 or digit > 9:
            break
        value += scale * digit
        scale *= 10
        column -= 1
    good = value >= 0 and scale > 100 and _at(text, begin + POINT) == 46
    negative = column >= 0 and _at(text, begin + column) == 45
    for blank in range(column if negative else column + 1):
        good = good and _at(text, begin + blank) == 32
    if not good:
        return _MALFORMED
    return -value if negative else value


@compiled
def parse_rows(
    text: Bytes,
    begin: int,
    width: int,
    tail: int,
    time: NDArray[np.int64],
    values: NDArray[np.float64],
) -> int:
    """Fill times (rows,), ms, and values (count, rows), hundredths; the first bad row, or -1.

    Times count from 1970. Rows of `width` bytes stand from byte `begin` on; from the last value
    to column `tail` they must be blank.
    """
    count, rows = values.shape
    end = FIRST_VALUE + count * FIELD - 1
    day = 0
    for i in range(rows):
        row = begin + i * width
        same = i > 0
        for column in range(10):
            same = same and _at(text, row + column) == _at(text, row + column - width)
        for column in range(24, 27):
            same = same and _at(text, row + column) == _at(text, row + column - width)
        if not same:
            day = _day(text, row)
        clock = _clock(text, row)
        good = day > -_MS_PER_DAY and clock >= 0 and _at(text, row + width - 1) == 10
        for column in range(27, FIRST_VALUE):
            good = good and _at(text, row + column) == 32
        for column in range(end, tail):
            good = good and _at(text, row + column) == 32
        for k in range(count):
            field = row + FIRST_VALUE + k * FIELD
            hundredths = _hundredths(text, field)
            good = good and hundredths < _MALFORMED and _at(text, field - 1) == 32
            values[k, i] = hundredths
        if not good or (tail == width - 2 and _at(text, row + tail) != 13):
            return i
        time[i] = day * _MS_PER_DAY + clock
    return -1
