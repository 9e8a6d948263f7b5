"""IAGA-2002, the exchange format of observatories: every cadence, four elements a row, nT.

Declination and inclination are in arcminutes. A comment ``# DECBAS`` gives a baseline
declination in tenths of arcminutes, from which a reported D or E counts.
"""

from __future__ import annotations

import datetime
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError, SourceError
from magtiles.stages.ingest.observatory.record import (
    Header,
    Real,
    Record,
    Times,
    check_times,
    mark_missing,
)

_HEADER_BYTES = 65536

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
    found = _bulk(content, begin, len(header.elements))
    if found is None:  # some line is unlike the first: find it, or read all by their words
        found = _line_by_line(content[begin:], len(header.elements), path, line)
    values, time, skipped = found
    lines = line + 1 + np.arange(time.size) if skipped is None else skipped
    values, marked, never = mark_missing(values, header.elements)
    cadence = check_times(time, str(path), lines)
    return Record(str(path), header, time, values, marked, cadence, never)


def _header(content: bytes, path: Path) -> tuple[Header, int, int]:
    """What the header says, where the rows begin, and the number of the line before them."""
    fields: dict[str, str] = {}
    base, position = None, 0
    for number, raw in enumerate(content[:_HEADER_BYTES].split(b"\n"), start=1):
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


_Rows = tuple[Real, Times, NDArray[np.int64] | None]
"""Values (elements, rows), times (rows,) and the rows' lines; None for one line each."""


def _bulk(content: bytes, begin: int, count: int) -> _Rows | None:
    """Equally long rows in the format's columns, from byte `begin` on; else None."""
    from magtiles.stages.ingest.observatory.iaga2002_compiled import (
        FIELD,
        FIRST_VALUE,
        parse_rows,
    )

    width = content.find(b"\n", begin) + 1 - begin
    if width <= 0 or (len(content) - begin) % width:
        return None
    text = np.frombuffer(content, np.uint8)
    tail = width - 1 - int(content[begin + width - 2 : begin + width] == b"\r\n")
    if tail < FIRST_VALUE + count * FIELD - 1:
        return None
    rows = (len(content) - begin) // width
    time, values = np.empty(rows, np.int64), np.empty((count, rows))
    if parse_rows(text, begin, width, tail, time, values) >= 0:
        return None
    # Whole numbers over 100 round to the double that parsing the text gives; compiled with
    # reciprocals allowed, the division would not.
    values /= 100.0
    time *= 1_000_000
    return values, time.view("datetime64[ns]"), None


def _line_by_line(body: bytes, count: int, path: Path, line: int) -> _Rows:
    """Rows of other columns. Raises FormatError naming the first bad line."""
    values, stamps, lines = [], [], []
    length = 0
    for number, raw in enumerate(body.decode("latin-1").splitlines(), start=line + 1):
        text = raw.rstrip(" \r|\x1a")
        if not text:
            continue
        words = text.split()
        length = length or len(text)
        if len(words) != 3 + count or len(text) < length:
            raise FormatError(
                f"the line is truncated: '{text}'" if len(text) < length else f"found '{text}'",
                where=f"{path} line {number}",
                expected=f"date, time, day of the year and {count} values, as in the lines before",
                remedy="the file is incomplete or damaged: fetch it again",
            )
        values.append(_floats(words[3:], f"{path} line {number}"))
        stamps.append(_stamp(words[:3], f"{path} line {number}"))
        lines.append(number)
    if not lines:
        raise FormatError("has no data", where=path, remedy="fetch it again")
    return np.array(values).T.copy(), np.array(stamps, "datetime64[ns]"), np.array(lines)


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


def _stamp(words: list[str], where: str) -> datetime.datetime:
    try:
        time = datetime.datetime.strptime(" ".join(words[:2]), "%Y-%m-%d %H:%M:%S.%f")  # noqa: DTZ007
    except ValueError:
        time = None
    if time is None or str(time.timetuple().tm_yday) != words[2].lstrip("0"):
        raise FormatError(
            f"no such time: '{' '.join(words)}'",
            where=where,
            expected="a date, a time and the day of the year, as 2016-01-01 00:00:00.000 001",
            remedy="the line is damaged: fetch the file again",
        )
    return time
