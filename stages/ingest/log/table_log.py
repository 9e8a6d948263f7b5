"""A table as a raw log: survey lines, cruises, and whatever [log.columns] explains."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtiles.schemas.errors import SourceError
from magtiles.stages.ingest.log.raw import FieldSamples, RawLog
from magtiles.stages.ingest.log.source import Columns, IngestLogParams
from magtiles.stages.ingest.log.table import SPEEDS, Table, Units, check_named, wanted
from magtiles.stages.ingest.log.table_place import row_places
from magtiles.stages.ingest.log.table_time import row_times
from magtiles.stages.vehicle.positions import Real


def table_log(table: Table, params: IngestLogParams) -> RawLog:
    """The raw log of a table whose columns its format or [log.columns] explain.

    Units are those of the file, else of `column_units`, or `units` for the field. Rows without a
    time are left out, with a warning. The survey's own columns are kept as ``source_<name>``.

    Raises
    ------
    SourceError : a column is missing; a unit or what a time counts from is not known; a key
        contradicts the file.
    FormatError : a value is no number, time or place; names file and line.
    """
    columns = wanted(table.meaning, params)
    check_named(columns, table, params)
    time, known = row_times(table, columns, params)
    table = table.rows(known)
    units = Units(table, params)
    total, vector = _total(units, columns), _vector(units, columns)
    rows, notes = row_places(table, columns, params)
    others, attrs = _others(units, columns)
    rows |= _labels(table, columns) | others
    if vector is not None and total is not None:
        rows["field_total"], attrs["field_total"] = total, {"units": "nT"}
    values = total if vector is None else vector
    if values is None:
        raise SourceError(
            "no column holds the field",
            where=table.where,
            expected="field_total, or field_x, field_y and field_z in [log.columns]; the file has "
            + ", ".join(table.names),
        )
    keys = ("field_total",) if vector is None else ("field_x", "field_y", "field_z")
    topic = ", ".join(str(getattr(columns, key)) for key in keys)
    return RawLog(
        FieldSamples(time[known], values, "nT", topic),
        height_reference=table.height_reference,
        rows=rows,
        row_attrs=attrs,
        run=_runs(table, rows),
        attrs=notes,
    )


def _runs(table: Table, rows: Mapping[str, NDArray[Any]]) -> NDArray[np.int64]:
    """Numbers of the parts that were recorded row by row: each line of each flight is one."""
    labels = [rows[name] for name in ("line", "flight") if name in rows]
    if not labels:
        return np.zeros(table.number.size, dtype=np.int64)
    changes = np.any([label[1:] != label[:-1] for label in labels], axis=0)
    return np.concatenate([[0], np.cumsum(changes)])


def _total(units: Units, columns: Columns) -> Real | None:
    return None if columns.field_total is None else units.field(columns.field_total)


def _vector(units: Units, columns: Columns) -> Real | None:
    names = (columns.field_x, columns.field_y, columns.field_z)
    found = [name for name in names if name is not None]
    if not found:
        return None
    if len(found) != 3:
        raise SourceError(
            f"[log.columns] names {len(found)} of field_x, field_y and field_z",
            where=units.table.where,
            expected="all three or none",
        )
    return np.stack([units.field(name) for name in found], axis=1)


def _labels(table: Table, columns: Columns) -> dict[str, NDArray[Any]]:
    """Line and flight: whole numbers where they are, else as written."""
    found = {}
    for label in ("line", "flight"):
        name = getattr(columns, label)
        if name is not None:
            values = table.columns[name]
            whole = values.dtype.kind == "f" and bool((values == np.round(values)).all())
            found[label] = values.astype(np.int64) if whole else values
    return found


def _others(
    units: Units, columns: Columns
) -> tuple[dict[str, NDArray[Any]], dict[str, dict[str, str]]]:
    """Speed, diurnal and the survey's own columns; attributes of the last."""
    rows: dict[str, NDArray[Any]] = {}
    attrs = {}
    if columns.speed is not None:
        rows["speed"] = units.scaled(columns.speed, SPEEDS)
    if columns.diurnal is not None:
        datum = units.params.diurnal_datum_nt
        rows["diurnal"] = units.field(columns.diurnal) - (0.0 if datum is None else datum)
    for name, column in columns.source.items():
        rows[f"source_{name}"] = units.table.numbers(column)
        attrs[f"source_{name}"] = {
            "units": units.require(column),
            "long_name": f"column '{column}' of the source",
        }
    return rows, attrs
