"""Kp and ap: GFZ's tables of three-hour intervals and of days, its CSV, and the WDC format."""

from __future__ import annotations

import datetime
import re

import numpy as np

from magtiles.schemas.errors import FormatError
from magtiles.stages.ingest.index_values import (
    Values,
    date_of,
    first_line,
    gather,
    number,
    numbered,
    thirds,
)

_INTERVAL = r"\d{4} \d\d \d\d \d\d\.\d \d\d\.\d{2} "
_DAY = r"\d{4} \d\d \d\d +\d+ +\d+\.\d +\d{4} +\d+ "
_WDC = r"[ \d]\d[ \d]\d[ \d]\d(\d{4}|    )[ \d]{2}[ \d]{16}[ \d]{3}"
_CSV = "Date,K_00,K_03,K_06,K_09,K_12,K_15,K_18,K_21"

_FIRST_ROTATION = datetime.date(1832, 2, 8)  # of Bartels' count, 27 days each


def is_kp_intervals(text: str) -> bool:
    """Whether it is GFZ's ``Kp_ap``: one three-hour interval a line."""
    return first_line(text, _INTERVAL)


def read_kp_intervals(text: str, where: str) -> list[Values]:
    """Kp and ap of GFZ's ``Kp_ap_since_1932.txt``. Raises FormatError naming the line."""
    times, kp, ap = [], [], []
    for line, row in numbered(text):
        place = f"{where} line {line}"
        words = _words(row, 10, place)
        hour = number(words[3], place)
        if hour % 3 != 0 or not 0 <= hour < 24:
            raise FormatError(f"hour {words[3]}", where=place, expected="0, 3, ... 21")
        day = np.datetime64(date_of(words[:3], place)).astype("datetime64[h]")
        times.append(day + np.timedelta64(int(hour), "h"))
        kp.append(thirds(number(words[7], place), place))
        ap.append(_missing_below_zero(number(words[8], place)))
        if len(times) > 1 and times[-1] <= times[-2]:
            raise FormatError(
                f"time goes backwards: {times[-1]} follows {times[-2]}",
                where=place,
                expected="each interval once, in order",
            )
    time = np.array(times)
    return [
        Values("kp", 3, time, np.array(kp), where),
        Values("ap", 3, time, np.array(ap), where),
    ]


def is_kp_days(text: str) -> bool:
    """Whether it is GFZ's ``Kp_ap_Ap_SN_F107``: a day a line."""
    return first_line(text, _DAY)


def read_kp_days(text: str, where: str) -> list[Values]:
    """Kp and ap of GFZ's ``Kp_ap_Ap_SN_F107_since_1932.txt``. Raises FormatError."""
    kp, ap = [], []
    for line, row in numbered(text):
        place = f"{where} line {line}"
        words = _words(row, 28, place)
        date = date_of(words[:3], place)
        kp.append((date, [thirds(number(w, place), place) for w in words[7:15]], line))
        ap.append((date, [_missing_below_zero(number(w, place)) for w in words[15:23]], line))
    return [gather("kp", 3, kp, where), gather("ap", 3, ap, where)]


def is_kp_csv(text: str) -> bool:
    """Whether it is a CSV of dates and eight Kp."""
    return text.lstrip("\ufeff").startswith(_CSV)


def read_kp_csv(text: str, where: str) -> list[Values]:
    """Kp of a CSV of dates and eight Kp each; an empty one is missing. Raises FormatError."""
    rows = []
    for line, row in numbered(text)[1:]:
        place = f"{where} line {line}"
        words = row.split(",")
        if len(words) < 9 or re.fullmatch(r"\d{4}-\d\d-\d\d", words[0]) is None:
            raise FormatError(f"found '{row}'", where=place, expected="a date and eight Kp")
        date = date_of(words[0].split("-"), place)
        kp = [thirds(number(w, place), place) if w.strip() else np.nan for w in words[1:9]]
        rows.append((date, kp, line))
    return [gather("kp", 3, rows, where)]


def is_kp_wdc(text: str) -> bool:
    """Whether it is the WDC format: a day a line in fixed columns."""
    return first_line(text, _WDC)


def read_kp_wdc(text: str, where: str) -> list[Values]:
    """Kp, in tenths rounded down to 0, 3, 7, and ap. Raises FormatError naming the line."""
    kp, ap = [], []
    for line, row in numbered(text):
        place = f"{where} line {line}"
        if len(row) < 55 or re.match(_WDC, row) is None:
            raise FormatError(
                f"the line is truncated or malformed: '{row[:40]}'",
                where=place,
                expected="date, rotation, eight Kp, their sum and eight ap in 55 columns or more",
                remedy="fetch the file again",
            )
        date = date_of((_year(row, place), row[2:4], row[4:6]), place)
        kp.append((date, [_tenths(row[i : i + 2], place) for i in range(12, 28, 2)], line))
        ap.append((date, [_blank_or(row[i : i + 3], place) for i in range(31, 55, 3)], line))
    return [gather("kp", 3, kp, where), gather("ap", 3, ap, where)]


def _words(row: str, count: int, where: str) -> list[str]:
    words = row.split()
    if len(words) != count:
        raise FormatError(
            f"the line is truncated or malformed: '{row[:60]}'",
            where=where,
            expected=f"{count} columns",
            remedy="fetch the file again",
        )
    return words


def _missing_below_zero(value: float) -> float:
    return value if value >= 0 else np.nan


def _blank_or(field: str, where: str) -> float:
    return number(field, where) if field.strip() else np.nan


def _tenths(field: str, where: str) -> float:
    if not field.strip():
        return np.nan
    whole, tenth = divmod(int(number(field, where)), 10)
    if tenth not in (0, 3, 7) or whole * 10 + tenth > 90:
        raise FormatError(f"Kp is '{field}'", where=where, expected="such as 20, 23 or 27")
    return (3 * whole + (0, 3, 7).index(tenth)) / 3


def _year(row: str, where: str) -> int:
    """The year of a line, its century from the solar rotation where that is given."""
    short = int(row[:2])
    if not row[6:10].strip():
        return short + (1900 if short >= 32 else 2000)  # Kp begins in 1932
    rotation = int(number(row[6:10], where))
    year = (_FIRST_ROTATION + datetime.timedelta(days=27 * (rotation - 1))).year
    # A rotation may begin in December of the year before.
    return next((y for y in (year, year + 1) if y % 100 == short), 1900 + short)
