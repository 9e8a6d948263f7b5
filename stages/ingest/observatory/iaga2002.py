"""IAGA-2002, the exchange format of observatories: every cadence, four elements a row, nT.

Declination and inclination are in arcminutes. A comment ``# DECBAS`` gives a baseline
declination in tenths of arcminutes, from which a reported D or E counts.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError, SourceError
from magtiles.stages.ingest.observatory.decimals import fixed_point, whole_numbers
from magtiles.stages.ingest.observatory.record import (
    Header,
    Real,
    Record,
    Times,
    check_times,
    mark_missing,
)

_CHUNK = 16384
"""Rows decoded at once: their bytes stay in the processor's cache."""

_NUMBERS = {"year": (0, 4), "month": (5, 7), "day": (8, 10), "hour": (11, 13), "minute": (14, 16)}
_NUMBERS |= {"second": (17, 19), "millisecond": (20, 23), "doy": (24, 27)}
_SIGNS = {4: "-", 7: "-", 10: " ", 13: ":", 16: ":", 19: ".", 23: " "}
_FIRST_VALUE, _FIELD, _WIDTH, _POINT = 31, 10, 9, 6  # F9.2, a blank between

_DECBAS = re.compile(r"#\s*DECBAS\s+(-?\d+)")
_ELEMENT = re.compile(r"NUL|[A-Z]")


def is_iaga2002(content: bytes) -> bool:
    """Whether a line of the header names the format."""
    return re.match(rb"\s*Format\s+IAGA-2002", content) is not None


def read_iaga2002(content: bytes, path: Path) -> Record:
    """The samples of an IAGA-2002 file.

    Raises FormatError naming file and line: a header without its data header, elements that
    disagree with the header, a truncated or malformed row, a wrong day of the year, time going
    backwards, a change of cadence. SourceError where columns are another station's.
    """
    header, begin, line = _header(content, path)
    values, time, lines = _rows(content[begin:], len(header.elements), path, line)
    values, marked, never = mark_missing(values, header.elements)
    cadence = check_times(time, str(path), lines)
    return Record(str(path), header, time, values, marked, cadence, never)


def _header(content: bytes, path: Path) -> tuple[Header, int, int]:
    """What the header says, where the rows begin, and the number of the line before them."""
    fields: dict[str, str] = {}
    base, position = None, 0
    for number, raw in enumerate(content.split(b"\n", 200)[:200], start=1):
        line = raw.decode("latin-1").rstrip("\r")
        position += len(raw) + 1
        if line.upper().startswith("DATE"):
            elements = _elements(line, fields, f"{path} line {number}")
            return _facts(fields, elements, base, path), position, number
        if match := _DECBAS.search(line):
            base = int(match[1]) / 10.0
        elif not line.lstrip().startswith("#"):
            fields[line[:23].strip().lower()] = line[23:].strip().rstrip("|").strip()
    raise FormatError(
        "the line DATE TIME DOY ... that opens the data is missing",
        where=path,
        remedy="the file is truncated or not IAGA-2002: fetch it again",
    )


def _elements(line: str, fields: dict[str, str], where: str) -> tuple[str, ...]:
    names = line.rstrip("| ").split()[3:]
    code = fields.get("iaga code", "").upper()
    for name in names:
        if code and not name.upper().startswith(code):
            raise SourceError(
                f"column '{name}' is of another station than the header's IAGA CODE {code}",
                where=where,
                remedy="the file was put together from two: fetch it again",
            )
    elements = tuple(name.upper()[len(code) or 3 :] for name in names)
    reported = tuple(_ELEMENT.findall(fields.get("reported", "").upper()))
    if not elements or (reported and reported != elements[: len(reported)]):
        raise FormatError(
            f"wrong element set: the columns are {' '.join(elements) or 'none'}",
            where=where,
            expected=f"those that the header reports, {' '.join(reported) or 'one or more'}",
            remedy="the file is damaged: fetch it again",
        )
    return elements


def _facts(
    fields: dict[str, str], elements: tuple[str, ...], base: float | None, path: Path
) -> Header:
    longitude = _number(fields, "geodetic longitude", path)
    return Header(
        iaga_code=fields.get("iaga code", "").upper() or None,
        elements=elements,
        latitude=_number(fields, "geodetic latitude", path),
        longitude=None if longitude is None else (longitude + 180.0) % 360.0 - 180.0,
        elevation=_number(fields, "elevation", path),
        data_type=fields.get("data type", "").lower() or None,
        declination_base=base,
    )


def _number(fields: dict[str, str], name: str, path: Path) -> float | None:
    text = fields.get(name, "")
    try:
        return float(text) if text else None
    except ValueError:
        raise FormatError(
            f"the header's '{name}' is '{text}'", where=path, expected="a number"
        ) from None


def _rows(body: bytes, count: int, path: Path, line: int) -> tuple[Real, Times, NDArray[np.int64]]:
    """Values (elements, rows), times (rows,) and line numbers of the rows below line `line`."""
    found = _bulk(body, count)
    if found is None:  # some line is unlike the first: find it, or read it by its words
        return _line_by_line(body, count, path, line)
    values, numbers = found
    lines = line + 1 + np.arange(values.shape[1])
    return values, _times(numbers, path, lines), lines


def _bulk(body: bytes, count: int) -> tuple[Real, dict[str, NDArray[np.int32]]] | None:
    """Values and date numbers of equally long lines in the format's columns; else None."""
    width = body.find(b"\n") + 1
    if width == 0 or len(body) % width:
        return None
    block = np.frombuffer(body, np.uint8).reshape(-1, width)
    end = _FIRST_VALUE + count * _FIELD - 1
    tail = width - 1 - (block[0, -2] == ord("\r"))
    if tail < end:
        return None
    blanks = [*range(27, _FIRST_VALUE), *range(end, tail)]
    blanks += [_FIRST_VALUE + i * _FIELD - 1 for i in range(1, count)]
    signs = {**_SIGNS, **dict.fromkeys(blanks, " "), width - 1: "\n"}
    at, expected = np.array(list(signs)), np.array([ord(c) for c in signs.values()], np.uint8)
    values = np.empty((count, len(block)))
    numbers = {name: np.empty(len(block), np.int32) for name in _NUMBERS}
    for start in range(0, len(block), _CHUNK):
        part = slice(start, start + _CHUNK)
        columns = np.ascontiguousarray(block[part].T)
        good = bool((columns[at] == expected[:, None]).all())
        for name, (first, last) in _NUMBERS.items():
            numbers[name][part], fits = whole_numbers(columns[first:last])
            good = good and fits
        for i in range(count):
            first = _FIRST_VALUE + i * _FIELD
            values[i, part], fits = fixed_point(columns[first : first + _WIDTH], _POINT)
            good = good and fits
        if not good:
            return None
    return values, numbers


def _times(numbers: dict[str, NDArray[np.int32]], path: Path, lines: NDArray[np.int64]) -> Times:
    """Times (rows,) of date numbers. Raises FormatError naming the line of an impossible one."""
    date = (numbers["year"] * 100 + numbers["month"]) * 100 + numbers["day"]
    begins = np.flatnonzero(np.diff(date, prepend=-1))
    year, month, day = (numbers[n][begins].astype(np.int64) for n in ("year", "month", "day"))
    months = ((year - 1970) * 12 + month - 1).astype("datetime64[M]")
    days = months.astype("datetime64[D]") + (day - 1)
    wrong = (month < 1) | (month > 12) | (day < 1) | (days.astype("datetime64[M]") != months)
    of_day = np.repeat(np.arange(begins.size), np.diff(np.append(begins, date.size)))
    since = (days - days.astype("datetime64[Y]")).astype(np.int64) + 1
    late = (numbers["hour"] > 23) | (numbers["minute"] > 59) | (numbers["second"] > 59)
    bad = wrong[of_day] | (since[of_day] != numbers["doy"]) | late
    if bad.any():
        row = int(np.argmax(bad))
        raise FormatError(
            "no such time: " + " ".join(f"{k} {v[row]}" for k, v in numbers.items()),
            where=f"{path} line {lines[row]}",
            expected="a date with its day of the year (doy), and a time of day",
            remedy="the line is damaged: fetch the file again",
        )
    ms = (numbers["hour"] * 60 + numbers["minute"]) * 60 + numbers["second"]
    ms = ms.astype(np.int64) * 1000 + numbers["millisecond"]
    nanoseconds = days.astype("datetime64[ns]").astype(np.int64)[of_day] + ms * 1_000_000
    return nanoseconds.astype("datetime64[ns]")


def _line_by_line(
    body: bytes, count: int, path: Path, line: int
) -> tuple[Real, Times, NDArray[np.int64]]:
    """As `_rows`, for columns of other widths. Raises FormatError naming the first bad line."""
    values, stamps, lines = [], [], []
    longest = 0
    for number, raw in enumerate(body.decode("latin-1").splitlines(), start=line + 1):
        text = raw.rstrip(" \r|\x1a")
        if not text:
            continue
        words = text.split()
        longest = longest or len(text)
        if len(words) != 3 + count or len(text) < longest:
            raise FormatError(
                f"the line is truncated: '{text}'" if len(text) < longest else f"found '{text}'",
                where=f"{path} line {number}",
                expected=f"date, time, day of the year and {count} values, as in the lines before",
                remedy="the file is incomplete or damaged: fetch it again",
            )
        values.append(_floats(words[3:], f"{path} line {number}"))
        stamps.append(_stamp(words[:3], f"{path} line {number}"))
        lines.append(number)
    if not lines:
        raise FormatError("has no data", where=path, remedy="fetch it again")
    rows = np.array(lines, np.int64)
    numbers = {
        n: np.array(v, np.int32) for n, v in zip(_NUMBERS, zip(*stamps, strict=True), strict=True)
    }
    return np.array(values).T.copy(), _times(numbers, path, rows), rows


def _floats(words: list[str], where: str) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError:
        raise FormatError(
            f"the values are {' '.join(words)}", where=where, expected=f"{len(words)} numbers"
        ) from None
    if not np.isfinite(values).all():
        raise FormatError(
            f"the values are {' '.join(words)}", where=where, expected="99999.00 for a missing one"
        )
    return values


def _stamp(words: list[str], where: str) -> list[int]:
    match = re.fullmatch(
        r"(\d{4})-(\d\d)-(\d\d) (\d\d):(\d\d):(\d\d)\.(\d{3}) (\d{3})", " ".join(words)
    )
    if match is None:
        raise FormatError(
            f"the line begins with '{' '.join(words)}'",
            where=where,
            expected="date, time and day of the year, such as 2016-01-01 00:00:00.000 001",
        )
    return [int(group) for group in match.groups()]
