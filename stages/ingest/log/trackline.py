"""Cruises and flights of NCEI's trackline archive: MGD77, MGD77T and the CSV of its service.

Columns are the archive's; offsets and scales of MGD77 are those of its 120-byte data record
(Hittelman et al. 1977, as revised 1998), nines throughout mean missing.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError
from magtiles.stages.ingest.log.delimited import column_names, read_delimited
from magtiles.stages.ingest.log.source import Columns, IngestLogParams
from magtiles.stages.ingest.log.table import Table, named_columns
from magtiles.stages.ingest.log.text_lines import Lines, read_lines, whole

_LOG = logging.getLogger(__name__)

_RECORD_BYTES = 120
_HEADER_BYTES = 80
_TYPE = b"5"[0]
_TYPE_BEFORE_2000 = b"3"[0]

TIME, HEIGHT = "UTC", "SENSOR_HEIGHT"
"""Columns made of the archive's: its date, time and zone; its depth of the sensor."""

_MEANING = Columns(time=TIME, field_total="MAG_TOT", latitude="LAT", longitude="LON", line="LINEID")
_UNITS = dict.fromkeys(("MAG_TOT", "MAG_TOT2", "MAG_RES", "MAG_DICORR"), "nT")
_UNITS |= {"LAT": "degrees", "LON": "degrees", HEIGHT: "m", "CORR_DEPTH": "m", "BAT_TTIME": "s"}
_UNITS |= dict.fromkeys(("GRA_OBS", "EOTVOS", "FREEAIR"), "mGal")


@dataclass(frozen=True)
class _Field:
    """Bytes [start, stop) of a record, counted from 0, and what one unit of its number is."""

    start: int
    stop: int
    scale: float = 1.0


_FIELDS = {
    "TIMEZONE": _Field(9, 12),
    "YEAR": _Field(12, 16),
    "MONTH": _Field(16, 18),
    "DAY": _Field(18, 20),
    "HOUR": _Field(20, 22),
    "MINUTE": _Field(22, 27, 1e-3),
    "LAT": _Field(27, 35, 1e-5),
    "LON": _Field(35, 44, 1e-5),
    "BAT_TTIME": _Field(45, 51, 1e-4),
    "CORR_DEPTH": _Field(51, 57, 0.1),
    "MAG_TOT": _Field(60, 66, 0.1),
    "MAG_TOT2": _Field(66, 72, 0.1),
    "MAG_RES": _Field(72, 78, 0.1),
    "MAG_DICORR": _Field(79, 84, 0.1),
    "MAG_SDEPTH": _Field(84, 90),
    "GRA_OBS": _Field(90, 97, 0.1),
    "EOTVOS": _Field(97, 103, 0.1),
    "FREEAIR": _Field(103, 108, 0.1),
}
_BEFORE_2000 = {"TIMEZONE": _Field(9, 14, 1e-2), "YEAR": _Field(14, 16)}
"""Of record type 3: a time zone of two decimals, and years of two digits."""
_CENTURY_FROM = 39  # years below are of this century


def is_mgd77(line: bytes) -> bool:
    """Whether a line could be a data record of MGD77: its type, and digits where its date is."""
    return (
        len(line.rstrip(b"\r\n")) == _RECORD_BYTES
        and line[:1] in (b"3", b"5")
        and line[16:27].strip().isdigit()
    )


def read_mgd77(path: Path, params: IngestLogParams, where: str) -> Table:
    """All columns of MGD77 records, after the header of 80-byte records if it is there.

    Raises FormatError naming the line that is no record, or truncated.
    """
    lines = read_lines(path, where)
    first = lines.data[lines.start]
    record = (first == _TYPE) | (first == _TYPE_BEFORE_2000)
    begin = int(np.argmax(record & (lines.length > _HEADER_BYTES)))
    lines = lines.select(slice(begin, None))
    lines = whole(lines, lines.length < _RECORD_BYTES - 1, lines.length, f"{_RECORD_BYTES} bytes")
    block = lines.block(_RECORD_BYTES)
    odd = (block[:, 0] != _TYPE) & (block[:, 0] != _TYPE_BEFORE_2000)
    if odd.any():
        row = int(np.argmax(odd))
        raise FormatError(
            f"a record of type '{chr(block[row, 0])}'",
            where=f"{where} line {lines.number[row]}",
            expected="5, or 3 in files from before 2000",
        )
    old = block[:, 0] == _TYPE_BEFORE_2000
    columns = {name: _cells(block, field, lines) for name, field in _FIELDS.items()}
    for name, field in _BEFORE_2000.items():
        columns[name] = np.where(old, _cells(block, field, lines, old), columns[name])
    year = columns["YEAR"]
    columns["YEAR"] = np.where(old, year + np.where(year < _CENTURY_FROM, 2000, 1900), year)
    return _table(columns | {TIME: _instants(columns)}, lines)


def _cells(
    block: NDArray[np.uint8],
    field: _Field,
    lines: Lines,
    rows: NDArray[np.bool_] | None = None,
) -> NDArray[np.float64]:
    """Numbers of a field, NaN where it is blank or all nines; only of some `rows` (n,)."""
    cells = np.ascontiguousarray(block[:, field.start : field.stop])
    texts = np.char.strip(cells.view(f"S{field.stop - field.start}").ravel())
    digits = np.char.lstrip(texts, b"+-")
    missing = np.char.strip(digits, b"9") == b""  # blank, or nines alone
    if rows is not None:
        missing |= ~rows
    # A two-digit 99 may be a value only where no mark is needed: years before 2000.
    if field is _BEFORE_2000["YEAR"] and rows is not None:
        missing = ~rows | (digits == b"")
    try:
        return np.where(missing, b"nan", texts).astype(np.float64) * field.scale
    except ValueError:
        row = next(r for r, t in enumerate(digits) if not missing[r] and not t.isdigit())
        raise FormatError(
            f"bytes {field.start + 1} to {field.stop} hold '{texts[row].decode('latin-1')}'",
            where=f"{lines.where} line {lines.number[row]}",
            expected="a whole number",
        ) from None


def _instants(columns: dict[str, NDArray[np.float64]]) -> NDArray[np.datetime64]:
    """UTC from year, month, day, hour, minute and hours to add; midnight where hours miss."""
    parts = [columns[name] for name in ("YEAR", "MONTH", "DAY", "HOUR", "MINUTE")]
    known = np.isfinite(np.stack(parts)).all(axis=0)
    year, month, day, hour, minute = (np.where(known, part, 1) for part in parts)
    known &= (month >= 1) & (month <= 12) & (day >= 1) & (day <= 31)
    months = (np.where(known, (year - 1970) * 12 + month - 1, 0)).astype("datetime64[M]")
    days = months.astype("datetime64[D]") + (day - 1).astype(np.int64)
    hours = hour + np.nan_to_num(columns["TIMEZONE"])
    after = np.round((hours * 60.0 + minute) * 60e3).astype("timedelta64[ms]")
    return np.where(known, days.astype("datetime64[ns]") + after, np.datetime64("NaT", "ns"))


def _table(
    columns: dict[str, NDArray[np.generic]], lines: Lines, others: tuple[str, ...] = ()
) -> Table:
    """The table, with the sensor's height where any depth is given, and its known meaning."""
    meaning = _MEANING
    depth = columns.get("MAG_SDEPTH")
    if depth is not None and np.isfinite(depth.astype(np.float64)).any():
        columns = columns | {HEIGHT: -depth.astype(np.float64)}
        meaning = meaning.model_copy(update={"height": HEIGHT})
    lineid = columns.get("LINEID")
    if lineid is None or not lineid.size or (lineid.dtype.kind == "f" and np.isnan(lineid).all()):
        meaning = meaning.model_copy(update={"line": None})
    units = {name: unit for name, unit in _UNITS.items() if name in columns}
    return Table(
        columns, units, lines.number, lines.where, meaning=meaning,
        height_reference="mean_sea_level", others=others,
    )  # fmt: skip


def read_mgd77t(path: Path, params: IngestLogParams, where: str) -> Table:
    """The columns of MGD77T, by the names in its first line: those needed and those asked for."""
    lines = read_lines(path, where)
    names = column_names(lines, "\t")
    needed = {"DATE", "TIME", "TIMEZONE", "LAT", "LON", "MAG_TOT", "MAG_SDEPTH", "LINEID"}
    table = read_delimited(
        lines.select(slice(1, None)), "\t", names, needed | _asked(params), params.no_data
    )
    for name in ("DATE", "TIME"):
        if name not in names:
            raise FormatError(f"has no column {name}", where=f"{where} line {lines.number[0]}")
    date, clock = table.numbers("DATE"), table.numbers("TIME")
    zone = table.numbers("TIMEZONE") if "TIMEZONE" in names else np.zeros(date.size)
    parts = {
        "YEAR": date // 10000,
        "MONTH": date // 100 % 100,
        "DAY": date % 100,
        "HOUR": clock // 100,  # hours and decimal minutes, 2359.6667
        "MINUTE": clock % 100,
        "TIMEZONE": zone,
    }
    rows = lines.select(slice(1, None)).select(slice(0, table.number.size))
    return _table(dict(table.columns) | {TIME: _instants(parts)}, rows, table.others)


def read_trackline_csv(path: Path, params: IngestLogParams, where: str) -> Table:
    """The columns of the trackline service's CSV, whose first column, unnamed, is the time.

    Times are UTC; the zone written after them means nothing.
    """
    lines = read_lines(path, where)
    names = column_names(lines, ",")
    needed = {names[0], "LAT", "LON", "MAG_TOT", "MAG_SDEPTH"}
    table = read_delimited(
        lines.select(slice(1, None)), ",", names, needed | _asked(params), params.no_data
    )
    written = np.array([text[:19] for text in table.columns[names[0]].astype(np.str_)])
    times = pd.to_datetime(written, format="%Y-%m-%d %H:%M:%S", errors="coerce").to_numpy()
    _refuse_no_times(np.asarray(times), written, table)
    rows = lines.select(slice(1, None)).select(slice(0, table.number.size))
    return _table(dict(table.columns) | {TIME: times.astype("datetime64[ns]")}, rows, table.others)


def _refuse_no_times(
    times: NDArray[np.datetime64], written: NDArray[np.str_], table: Table
) -> None:
    wrong = np.isnat(times) & (written != "")
    if wrong.any():
        row = int(np.argmax(wrong))
        raise FormatError(
            f"the first column holds '{written[row]}'",
            where=table.at(row),
            expected="a time such as 2000-07-16 12:35:00",
        )


def _asked(params: IngestLogParams) -> set[str]:
    return set() if params.columns is None else set(named_columns(params.columns).values())
