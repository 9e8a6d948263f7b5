"""When each row of a table was measured, as UTC."""

from __future__ import annotations

import datetime
import logging
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError, SourceError
from magtiles.stages.ingest.log.source import Columns, IngestLogParams
from magtiles.stages.ingest.log.stamps import CREDIBLE
from magtiles.stages.vehicle.positions import Times

if TYPE_CHECKING:
    from magtiles.stages.ingest.log.table import Table

_LOG = logging.getLogger(__name__)

_SECONDS = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0, "sec": 1.0, "second": 1.0}
_SECONDS |= {"seconds": 1.0, "min": 60.0, "minute": 60.0, "minutes": 60.0}
_SECONDS |= {"h": 3600.0, "hr": 3600.0, "hour": 3600.0, "hours": 3600.0}
_SECONDS |= {"day": 86400.0, "days": 86400.0, "d": 86400.0}


def row_times(
    table: Table, columns: Columns, params: IngestLogParams
) -> tuple[Times, NDArray[np.bool_]]:
    """UTC (n,) of each row of a table, and (n,) which rows have one.

    A time is ISO text, text of `time_format`, or a number: since 1970, or since midnight of the
    row's date where a date is given (`columns.date`, `columns.year` with `columns.day_of_year`,
    or the key `date`). `utc_offset_h` comes off local time.

    Raises SourceError where no time can be made of what is named, FormatError naming the line.
    """
    if columns.time is None:
        raise SourceError(
            "no column holds the time",
            where=table.where,
            expected="the key 'time' in [log.columns]; the file has " + ", ".join(table.names),
        )
    day = _days(table, columns, params)
    nanoseconds, known = _read(table, columns.time, params, dated=day is not None)
    if day is not None:
        known &= ~np.isnat(day)
        midnight = np.where(known, day, np.datetime64(0, "D")).astype("datetime64[ns]")
        nanoseconds = nanoseconds + midnight.astype(np.int64)
    local = round((params.utc_offset_h or 0.0) * 3600e9)
    time = np.asarray((nanoseconds - local).astype("datetime64[ns]"))
    _check(table, columns.time, time, known, dated=day is not None)
    return time, known


def _check(table: Table, name: str, time: Times, known: NDArray[np.bool_], *, dated: bool) -> None:
    lost = int((~known).sum())
    if lost == known.size:
        raise FormatError("no row has a time", where=f"{table.where} column '{name}'")
    if lost:
        _LOG.warning(
            "%s: %d of %d rows have no time and are left out, the first at %s %d",
            table.where, lost, known.size, table.place, table.number[int(np.argmin(known))],
        )  # fmt: skip
    old = known & (time < CREDIBLE)
    if not dated and table.columns[name].dtype.kind == "f" and old.any():
        row = int(np.argmax(old))
        raise FormatError(
            f"column '{name}' gives {str(time[row])[:19]}, counted from 1970",
            where=table.at(row),
            expected="a time after 1980",
            remedy="if it counts from midnight state the date, with columns.date or the key 'date'",
        )


def _read(
    table: Table, name: str, params: IngestLogParams, *, dated: bool
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Nanoseconds of a column since 1970, or since midnight where rows are `dated`."""
    values = table.columns[name]
    if values.dtype.kind == "M":
        return values.astype("datetime64[ns]").astype(np.int64), ~np.isnat(values)
    if params.time_format is not None or values.dtype.kind == "U":
        return _texts(table, name, params, dated=dated)
    return _numbers(table, name, params)


def _numbers(
    table: Table, name: str, params: IngestLogParams
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Nanoseconds of numbers in the file's unit, else in `time_unit`."""
    own = (params.column_units or {}).get(name) or table.units.get(name)
    unit = own or params.time_unit
    if own is not None and "time_unit" in params.model_fields_set:
        same = _SECONDS.get(own.strip().lower()) == _SECONDS[params.time_unit]
        if not same:
            raise SourceError(
                f"key 'time_unit' is '{params.time_unit}'",
                where=table.where,
                expected=f"'{own}', as the file says of column '{name}'",
                remedy="remove it",
            )
    scale = _SECONDS.get(unit.strip().lower())
    if scale is None:
        raise SourceError(
            f"the unit of column '{name}' is '{unit}'",
            where=table.where,
            expected=f"one of {', '.join(_SECONDS)}",
        )
    values = table.numbers(name)
    known = np.isfinite(values)
    # Whole seconds apart: nanoseconds of today do not fit a float.
    seconds = np.where(known, values, 0.0) * scale
    whole = np.floor(seconds)
    rest = np.round((seconds - whole) * 1e9).astype(np.int64)
    return whole.astype(np.int64) * 10**9 + rest, known


def _texts(
    table: Table, name: str, params: IngestLogParams, *, dated: bool
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Nanoseconds of ISO text or text of `time_format`; since midnight where rows are dated."""
    values = _as_text(table.columns[name], params.time_format)
    known = values != ""
    unique, inverse = np.unique(values, return_inverse=True)
    instants = np.zeros(unique.size, dtype=np.int64)
    for place, text in enumerate(unique):
        if text:
            try:
                instants[place] = _instant(str(text), params.time_format, dated)
            except ValueError:
                row = int(np.argmax(inverse == place))
                raise FormatError(
                    f"column '{name}' holds '{str(text)[:40]}'",
                    where=table.at(row),
                    expected=f"a time such as {params.time_format or 'ISO 8601'}",
                ) from None
    return instants[inverse], known


def _instant(text: str, layout: str | None, dated: bool) -> int:
    if layout is not None:
        fraction = 0
        if "." in text and "%f" not in layout:
            text, _, digits = text.partition(".")
            fraction = int(digits.strip().ljust(9, "0")[:9])
        when = datetime.datetime.strptime(text.strip(), layout)  # noqa: DTZ007  # UTC or utc_offset_h
    elif dated:
        clock = datetime.time.fromisoformat(text.strip())
        when, fraction = datetime.datetime.combine(datetime.date(1970, 1, 1), clock), 0
    else:
        when, fraction = datetime.datetime.fromisoformat(text.strip()), 0
    if dated:
        when = datetime.datetime.combine(datetime.date(1970, 1, 1), when.timetz())
    if when.tzinfo is not None:
        when = when.astimezone(datetime.UTC).replace(tzinfo=None)
    return int(np.datetime64(when, "ns").astype(np.int64)) + fraction


def _days(table: Table, columns: Columns, params: IngestLogParams) -> NDArray[np.datetime64] | None:
    """The date of each row, NaT where it has none; None where times hold their own."""
    given = [params.date is not None, columns.date is not None, columns.year is not None]
    if sum(given) > 1 or (columns.year is None) != (columns.day_of_year is None):
        raise SourceError(
            "the date is given twice, or year and day_of_year not together",
            where=table.where,
            expected="one of: key 'date', columns.date, columns.year with columns.day_of_year",
        )
    if params.date is not None:
        return np.full(table.number.size, np.datetime64(params.date, "D"))
    if columns.year is not None and columns.day_of_year is not None:
        year, day = table.numbers(columns.year), table.numbers(columns.day_of_year)
        known = np.isfinite(year) & np.isfinite(day)
        first = (np.where(known, year, 1970).astype(np.int64) - 1970).astype("datetime64[Y]")
        days = first.astype("datetime64[D]") + (np.where(known, day, 1).astype(np.int64) - 1)
        return np.where(known, days, np.datetime64("NaT", "D"))
    return None if columns.date is None else _dates(table, columns.date, params.date_format)


def _dates(table: Table, name: str, layout: str) -> NDArray[np.datetime64]:
    texts = _as_text(table.columns[name], layout)
    unique, inverse = np.unique(texts, return_inverse=True)
    days = np.full(unique.size, np.datetime64("NaT", "D"))
    for place, text in enumerate(unique):
        if not text:
            continue
        try:
            when = datetime.datetime.strptime(str(text), layout)  # noqa: DTZ007  # a date
            days[place] = np.datetime64(when.date(), "D")
        except ValueError:
            row = int(np.argmax(inverse == place))
            raise FormatError(
                f"column '{name}' holds '{str(text)[:40]}'",
                where=table.at(row),
                expected=f"a date as {layout} (key 'date_format')",
            ) from None
    return days[inverse]


def _as_text(values: NDArray[np.generic], layout: str | None) -> NDArray[np.str_]:
    """Text of a column; numbers as whole, with the zeros that a format of six digits had."""
    if values.dtype.kind == "U":
        return np.char.strip(values.astype(np.str_))
    numbers = values.astype(np.float64)
    width = 6 if layout in ("%y%m%d", "%H%M%S") else 4 if layout == "%H%M" else 0
    whole = ["" if not np.isfinite(v) else _digits(float(v), width) for v in numbers]
    return np.array(whole, dtype=np.str_)


def _digits(value: float, width: int) -> str:
    text = np.format_float_positional(value, trim="-")
    head, point, tail = text.partition(".")
    return head.zfill(width) + (point + tail if tail else "")
