"""ASEG-GDF2: survey lines as a data file and the definition file that says what its columns are.

A definition is a line ``DEFN 3 ST=RECD,RT=DATA;name:format:UNIT=nT,NULL=-9999,NAME=text``, with
Fortran formats and repeats (ASEG Standards Committee 2003). Data files in the wild hold fixed
widths, or the same values separated by tabs.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError, SourceError
from magtiles.stages.ingest.log.delimited import read_delimited
from magtiles.stages.ingest.log.source import Columns, IngestLogParams
from magtiles.stages.ingest.log.table import Table, named_columns, wanted
from magtiles.stages.ingest.log.text_lines import Lines, read_lines, whole

_DEFINITION = re.compile(r"\s*DEFN\s*\d*\s*ST\s*=\s*\w+\s*,\s*RT\s*=\s*(?P<type>\w*)\s*", re.I)
_FORMAT = re.compile(r"(?P<repeat>\d*)(?P<kind>[AIFEGD])(?P<width>\d+)(?:\.\d+)?", re.I)
_ATTRIBUTE = re.compile(r"[:,]\s*(?=\w+\s*=)")
_DATA_TYPES = ("", "DATA")
_OTHER_ROWS = ("COMM", "PROJ", "TRNS")
_TYPE_WIDTH = 4


@dataclass(frozen=True)
class Definition:
    """A column: its name, Fortran kind and width in bytes, unit and mark of missing values."""

    name: str
    kind: str
    width: int
    unit: str | None
    null: str | None


def read_aseg(path: Path, definition: Path, params: IngestLogParams, where: str) -> Table:
    """The columns of a data file that [log.columns] names.

    Raises
    ------
    FormatError : a definition or a value cannot be read; a line is truncated: it names the line.
    """
    defined = read_definitions(definition)
    lines = _data_lines(read_lines(path, where), defined)
    named = named_columns(wanted(Columns(), params))
    asked = {*named.values()} & {column.name for column in defined}
    if (lines.data == b"\t"[0]).any():
        table = _separated(lines, defined, asked)
    else:
        table = _fixed(lines, defined, asked)
    units = {column.name: column.unit for column in defined if column.unit}
    others = tuple(column.name for column in defined if column.name not in table.columns)
    return Table(table.columns, units, table.number, where, others=others)


def read_definitions(path: Path) -> list[Definition]:
    """The columns of the data records, in order; repeated ones are ``name[1]``, ``name[2]``, ...

    Raises FormatError naming the line that is no definition.
    """
    lines = read_lines(path, str(path))
    found: list[Definition] = []
    for row in range(lines.number.size):
        text, place = lines.text(row), f"{path} line {lines.number[row]}"
        head = _DEFINITION.match(text)
        if head is None:
            raise FormatError(
                f"holds '{text.strip()[:40]}'",
                where=place,
                expected="DEFN n ST=RECD,RT=...;name:format:...",
            )
        if head["type"].upper() in _DATA_TYPES:
            for part in text[head.end() :].split(";"):
                if part.strip() and not part.strip().upper().startswith("END DEFN"):
                    found.extend(_columns(part.strip(), place))
    if not found:
        raise FormatError("defines no columns of data", where=path)
    return found


def _columns(text: str, place: str) -> list[Definition]:
    name, _, rest = text.partition(":")
    layout = _FORMAT.match(rest.strip())
    if layout is None:
        raise FormatError(
            f"the format of '{name.strip()}' is '{rest[:20].strip()}'",
            where=place,
            expected="a Fortran format such as F10.3, I6, A8 or 15F12.6",
        )
    attributes = {}
    for pair in _ATTRIBUTE.split(rest.strip()[layout.end() :])[1:]:
        key, _, value = pair.partition("=")
        attributes[key.strip().upper().rstrip("S")] = value.strip(" ,:")
    repeat = int(layout["repeat"] or 1)
    unit, null = attributes.get("UNIT") or None, attributes.get("NULL") or None
    kind, width = layout["kind"].upper(), int(layout["width"])
    names = (
        [name.strip()] if repeat == 1 else [f"{name.strip()}[{i}]" for i in range(1, repeat + 1)]
    )
    return [Definition(one, kind, width, unit, null) for one in names]


def _data_lines(lines: Lines, defined: list[Definition]) -> Lines:
    """Rows of data; drops the definition of a record type that rows do not begin with."""
    begin = lines.block(_TYPE_WIDTH).view(f"S{_TYPE_WIDTH}").ravel()
    other = np.isin(np.char.upper(begin), [name.encode() for name in _OTHER_ROWS])
    lines = lines.select(~other)
    if not lines.number.size:
        raise FormatError("holds no rows of data", where=lines.where)
    if (
        defined[0].name.upper() == "RT"
        and not np.char.startswith(np.char.upper(begin[~other]), b"DATA").all()
    ):
        del defined[0]
    return lines


def _separated(lines: Lines, defined: Sequence[Definition], asked: Collection[str]) -> Table:
    table = read_delimited(lines, "\t", [column.name for column in defined], asked)
    columns = dict(table.columns)
    for column in defined:
        if column.name in asked:
            values = columns[column.name]
            if column.kind != "A":
                values = table.numbers(column.name).copy()
            columns[column.name] = _without_null(values, column)
    return Table(columns, {}, table.number, table.where)


def _fixed(lines: Lines, defined: Sequence[Definition], asked: Collection[str]) -> Table:
    ends = np.cumsum([column.width for column in defined])
    # Trailing blanks may have been cut from text, never from a number.
    needed = int(max((e for e, c in zip(ends, defined, strict=True) if c.kind != "A"), default=1))
    lines = whole(lines, lines.length < needed, lines.length, f"{needed} bytes")
    block = lines.block(int(ends[-1]))
    columns: dict[str, NDArray[np.generic]] = {}
    for column, end in zip(defined, ends, strict=True):
        if column.name in asked:
            cells = np.ascontiguousarray(block[:, end - column.width : end])
            texts = np.char.strip(cells.view(f"S{column.width}").ravel())
            values = texts.astype(np.str_) if column.kind == "A" else _numbers(texts, column, lines)
            columns[column.name] = _without_null(values, column)
    return Table(columns, {}, lines.number, lines.where)


def _numbers(texts: NDArray[np.bytes_], column: Definition, lines: Lines) -> NDArray[np.float64]:
    fortran = np.char.replace(np.char.upper(texts), b"D", b"E") if column.kind in "DG" else texts
    filled = np.where(fortran == b"", b"nan", fortran)
    try:
        return filled.astype(np.float64)
    except ValueError:
        row = next(r for r, text in enumerate(filled) if not _is_number(text))
        raise FormatError(
            f"column '{column.name}' holds '{texts[row].decode('latin-1')}'",
            where=f"{lines.where} line {lines.number[row]}",
            expected=f"a number of {column.width} bytes; does the definition belong to these data?",
        ) from None


def _without_null(values: NDArray[np.generic], column: Definition) -> NDArray[np.generic]:
    if column.null is None:
        return values
    if values.dtype.kind == "U":
        return np.where(values == column.null, "", values)
    try:
        mark = float(column.null)
    except ValueError:
        raise SourceError(
            f"the NULL of column '{column.name}' is '{column.null}'", expected="a number"
        ) from None
    return np.where(values == mark, np.nan, values)


def _is_number(text: bytes) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
