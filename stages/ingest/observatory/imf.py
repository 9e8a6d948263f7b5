"""IMFV1.23, INTERMAGNET's format for minute values in hourly blocks (Technical Manual, E-3).

Intensities are in tenths of nT. D is in hundredths of arcminutes, to which the header's baseline
declination, in tenths of arcminutes, adds.
"""

from __future__ import annotations

import datetime
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from magtiles.schemas.errors import FormatError, SourceError
from magtiles.stages.ingest.observatory.record import (
    Header,
    Real,
    Record,
    check_times,
    mark_missing,
)

_MISSING, _NOT_RECORDED = 999999.0, 888888.0
_LINES = 30
_MINUTE = np.timedelta64(60, "s")

_HEADER = re.compile(
    r"(?P<code>[A-Z0-9]{3}) (?P<month>[A-Z]{3})(?P<day>\d\d)(?P<year>\d\d) (?P<doy>\d{3}) "
    r"(?P<hour>\d\d) (?P<elements>[A-Z]{4}) (?P<type>[RAQD]) [A-Z]{3} "
    r"(?P<colatitude>\d{4})(?P<longitude>\d{4}) (?P<base>\d{6})"
)
_MONTHS = ("JAN", "FEB", "MAR", "APR", "MAY", "JUN", "JUL", "AUG", "SEP", "OCT", "NOV", "DEC")
_TYPES = {"R": "variation", "A": "adjusted", "Q": "quasi-definitive", "D": "definitive"}
_ANGLES = ("D", "I")


@dataclass(frozen=True)
class _Block:
    """The header of an hour and its values as stored, (elements, 60)."""

    header: Header
    start: np.datetime64
    stored: Real
    line: int


def is_imf(content: bytes) -> bool:
    """Whether the first line is the header of an hour."""
    return _HEADER.match(content[:80].decode("latin-1")) is not None


def read_imf(content: bytes, path: Path) -> Record:
    """The samples of a file of hourly blocks.

    Raises FormatError naming the line of a malformed header, a truncated block, a change of
    elements, and of an hour that does not follow; SourceError for two stations.
    """
    lines = content.decode("latin-1").splitlines()
    blocks = [_block(lines, number, path) for number in _headers(lines, path)]
    first = blocks[0].header
    for block in blocks[1:]:
        where = f"{path} line {block.line}"
        if block.header.iaga_code != first.iaga_code:
            raise SourceError(
                f"station '{block.header.iaga_code}' follows '{first.iaga_code}'",
                where=where,
                expected="one station",
                remedy="split the file by station",
            )
        if block.header != first:
            raise FormatError(
                "elements, position, data type or baseline change within the file",
                where=where,
                remedy="split the file here",
            )
    stored = np.concatenate([block.stored for block in blocks], axis=1)
    minutes = np.arange(60) * _MINUTE
    time = np.concatenate([block.start + minutes for block in blocks])
    at = np.concatenate([block.line + 1 + np.arange(60) // 2 for block in blocks])
    values, marked, never = mark_missing(stored, first.elements, _MISSING, _NOT_RECORDED)
    scale = np.array([0.01 if e in _ANGLES else 0.1 for e in first.elements])
    cadence = check_times(time, str(path), at)
    return Record(str(path), first, time, values * scale[:, None], marked, cadence, never)


def _headers(lines: list[str], path: Path) -> list[int]:
    """Indices of the headers; each with its lines below, and nothing between."""
    found, index = [], 0
    while index < len(lines):
        if not lines[index].strip("\x1a \r"):
            index += 1
            continue
        found.append(index)
        index += 1 + _LINES
    if index > len(lines):
        raise FormatError(
            f"the last hour is truncated: {len(lines) - found[-1] - 1} lines",
            where=f"{path} line {len(lines)}",
            expected=f"{_LINES} lines of two minutes below its header",
            remedy="the file is incomplete: fetch it again",
        )
    return found


def _block(lines: list[str], index: int, path: Path) -> _Block:
    where = f"{path} line {index + 1}"
    match = _HEADER.match(lines[index])
    if match is None or match["month"] not in _MONTHS:
        raise FormatError(
            f"found '{lines[index][:40]}'",
            where=where,
            expected="the header of an hour, such as BOU MAR1591 074 00 HDZF R GOL 04992548 005527",
            remedy="a line is missing or damaged: fetch the file again",
        )
    stored = np.empty((4, 60))
    for row in range(_LINES):
        words = lines[index + 1 + row].split()
        try:
            pair = np.array([float(word) for word in words]).reshape(2, 4)
        except ValueError:
            raise FormatError(
                f"found '{lines[index + 1 + row]}'",
                where=f"{path} line {index + row + 2}",
                expected="two minutes of four values",
                remedy="the line is damaged: fetch the file again",
            ) from None
        stored[:, 2 * row : 2 * row + 2] = pair.T
    return _Block(_facts(match), _start(match, where), stored, index + 1)


def _facts(match: re.Match[str]) -> Header:
    return Header(
        iaga_code=match["code"],
        elements=tuple(match["elements"]),
        latitude=90.0 - int(match["colatitude"]) / 10.0,
        longitude=(int(match["longitude"]) / 10.0 + 180.0) % 360.0 - 180.0,
        data_type=_TYPES[match["type"]],
        declination_base=int(match["base"]) / 10.0,
        position_step=0.1,
    )


def _start(match: re.Match[str], where: str) -> np.datetime64:
    year = int(match["year"])
    year += 1900 if year >= 80 else 2000  # the format is of 1991
    try:
        day = datetime.date(year, _MONTHS.index(match["month"]) + 1, int(match["day"]))
    except ValueError:
        day = None
    if day is None or day.timetuple().tm_yday != int(match["doy"]) or int(match["hour"]) > 23:
        raise FormatError(
            f"no such hour: {match[0]}",
            where=where,
            expected="a date with its day of the year, and an hour up to 23",
            remedy="the line is damaged: fetch the file again",
        )
    return np.datetime64(day, "ns") + int(match["hour"]) * np.timedelta64(3600, "s")
