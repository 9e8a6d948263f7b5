"""Dst in the format of WDC Kyoto: a day a line, hourly values over a base in hundreds of nT."""

from __future__ import annotations

import re

import numpy as np

from magtiles.schemas.errors import FormatError
from magtiles.stages.ingest.index_values import Values, date_of, first_line, gather, numbered

_LINE = r"DST\d{2}\d{2}[* ][ \d]\d"
_MISSING = 9999


def is_dst_wdc(text: str) -> bool:
    """Whether the first line is of the format."""
    return first_line(text, _LINE)


def read_dst_wdc(text: str, where: str) -> list[Values]:
    """Hourly Dst, nT. Raises FormatError naming the line."""
    rows = []
    for line, row in numbered(text):
        place = f"{where} line {line}"
        if re.match(_LINE, row) is None or len(row) < 116:
            raise FormatError(
                f"the line is truncated or malformed: '{row[:40]}'",
                where=place,
                expected="DST, date, base and 24 values in 116 columns or more",
                remedy="fetch the file again",
            )
        try:
            century = int(row[14:16]) if row[14:16].strip() else 19
            base = int(row[16:20]) if row[16:20].strip() else 0
            stored = np.array([int(row[i : i + 4]) for i in range(20, 116, 4)], np.float64)
        except ValueError as caught:
            raise FormatError(
                f"the line is malformed: {caught}", where=place, expected="whole numbers"
            ) from None
        date = date_of((century * 100 + int(row[3:5]), row[5:7], row[8:10]), place)
        stored[stored == _MISSING] = np.nan
        rows.append((date, list(base * 100.0 + stored), line))
    return [gather("dst", 1, rows, where)]
