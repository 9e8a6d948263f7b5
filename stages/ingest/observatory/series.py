"""Many records of one station on one regular time grid: gaps NaN, overlaps resolved."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.flags import RecordFlag
from magtiles.schemas.errors import FormatError
from magtiles.stages.ingest.observatory.elements import Field
from magtiles.stages.ingest.observatory.record import Real, Record, Times

_LOG = logging.getLogger(__name__)

_LEVELS = {"variation": 0, "reported": 0, "provisional": 1, "adjusted": 1}
_LEVELS |= {"quasi-definitive": 2, "definitive": 3}
_SAME_NT = 1e-6
_MOST_SAMPLES = 100_000_000


@dataclass(frozen=True)
class Combined:
    """The samples of all records.

    Attributes
    ----------
    time : (samples,) every `cadence_s` seconds.
    values : (4, samples) north, east, down, total, nT; NaN where missing.
    flags : (samples,) MISSING_MARK and OVERLAP_RESOLVED.
    duplicates : rows given more than once with the same values.
    resolved : samples given more than once with different values.
    gaps : samples without any row.
    """

    time: Times
    values: Real
    flags: NDArray[np.uint8]
    cadence_s: float
    duplicates: int
    resolved: int
    gaps: int


def combine(records: Sequence[Record], fields: Sequence[Field]) -> Combined:
    """One series of all records.

    Where two rows of one time differ, that of the higher level of processing stands (definitive,
    quasi-definitive, adjusted or provisional, variation), with what it marks as missing; at one
    level that of the file named last, and what it lacks comes from the other. Raises FormatError
    for records of different cadence, or whose times do not fall on one grid.
    """
    cadence = _cadence(records)
    time = _grid(records, cadence)
    values = np.full((4, time.size), np.nan)
    flags = np.zeros(time.size, np.uint8)
    level = np.full(time.size, -1, np.int8)
    duplicates = 0
    has_scalar = any(field.total != "vector" for field in fields)
    pairs = sorted(zip(records, fields, strict=True), key=lambda pair: _level(pair[0]))
    for record, field in pairs:
        at = _place(record, time, cadence)
        if has_scalar and field.total == "vector":
            field.values[3] = np.nan  # a magnitude among scalars would be a step
        marks = np.where(record.marked, np.uint8(RecordFlag.MISSING_MARK), np.uint8(0))
        if (level[at] < 0).all():
            values[:, at], flags[at] = field.values, marks
        else:
            duplicates += _overlay(record, field, values, flags, level, at, marks)
        level[at] = _level(record)
    return Combined(
        time=time,
        values=values,
        flags=flags,
        cadence_s=cadence,
        duplicates=duplicates,
        resolved=int(((flags & RecordFlag.OVERLAP_RESOLVED) != 0).sum()),
        gaps=int((level < 0).sum()),
    )


def _overlay(
    record: Record,
    field: Field,
    values: Real,
    flags: NDArray[np.uint8],
    level: NDArray[np.int8],
    at: slice | NDArray[np.int64],
    marks: NDArray[np.uint8],
) -> int:
    """Put a record over samples of which some are there; how many of those are the same."""
    old, there = values[:, at], level[at] >= 0
    same_level = level[at] == _level(record)
    new = np.where(same_level & np.isnan(field.values), old, field.values)
    agree = (np.abs(new - old) <= _SAME_NT) | (np.isnan(new) & np.isnan(old))
    agree |= same_level & np.isnan(old)
    differs = there & ~agree.all(axis=0)
    marks[np.isfinite(new).all(axis=0)] = 0  # filled from the other row
    kept = flags[at] & np.uint8(RecordFlag.OVERLAP_RESOLVED)
    resolved = np.where(differs, np.uint8(RecordFlag.OVERLAP_RESOLVED), np.uint8(0))
    flags[at] = marks | kept | resolved
    values[:, at] = new
    _report(record, there, differs)
    return int((there & ~differs).sum())


def _level(record: Record) -> int:
    return _LEVELS.get(record.header.data_type or "", 0)


def _report(record: Record, there: NDArray[np.bool_], differs: NDArray[np.bool_]) -> None:
    if differs.any():
        row = int(np.argmax(differs))
        _LOG.warning(
            "%s: %d of %d rows differ from another file's, the first at %s: resolved and flagged",
            record.where,
            int(differs.sum()),
            record.time.size,
            record.time[row],
        )
    elif there.any():
        _LOG.info("%s: %d rows are given twice, alike", record.where, int(there.sum()))


def _cadence(records: Sequence[Record]) -> float:
    known = [record for record in records if record.cadence_s is not None]
    if not known:
        raise FormatError(
            "a single row: its cadence is not known",
            where=records[0].where,
            expected="two rows or more",
        )
    first = known[0]
    for record in known[1:]:
        if record.cadence_s != first.cadence_s:
            raise FormatError(
                f"mixed cadence: {record.cadence_s:g} s, but {first.where} has "
                f"{first.cadence_s:g} s",
                where=record.where,
                expected="one cadence",
                remedy="ingest each cadence from files of its own",
            )
    assert first.cadence_s is not None
    return first.cadence_s


def _grid(records: Sequence[Record], cadence: float) -> Times:
    begin = min(record.time[0] for record in records)
    end = max(record.time[-1] for record in records)
    step = np.timedelta64(round(cadence * 1e9), "ns")
    count = int((end - begin) // step) + 1
    if count > _MOST_SAMPLES:
        raise FormatError(
            f"the files reach from {begin} to {end}: {count} samples at {cadence:g} s",
            where=records[0].where,
            expected=f"at most {_MOST_SAMPLES}",
            remedy="ingest records that lie far apart one by one",
        )
    time: Times = begin + np.arange(count) * step
    return time


def _place(record: Record, time: Times, cadence: float) -> slice | NDArray[np.int64]:
    """Samples of the grid that a record's rows are: a slice where the record has no gaps."""
    step = round(cadence * 1e9)
    since = record.time.view(np.int64) - time[0].astype(np.int64)
    off = since % step != 0 if record.cadence_s is None else since[:1] % step != 0
    if off.any():
        raise FormatError(
            f"mixed cadence: {record.time[int(np.argmax(off))]} is no multiple of {cadence:g} s "
            f"after {time[0]}",
            where=record.where,
            expected="times on the grid of the other files",
            remedy="ingest each on its own",
        )
    first, last = int(since[0]) // step, int(since[-1]) // step
    return slice(first, last + 1) if last - first + 1 == since.size else since // step
