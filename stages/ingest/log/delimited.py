"""Tables of text whose values are separated: CSV, tabs, semicolons."""

from __future__ import annotations

import io
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError
from magtiles.stages.ingest.log.source import Columns, IngestLogParams
from magtiles.stages.ingest.log.table import Table, named_columns, wanted
from magtiles.stages.ingest.log.text_lines import Lines, read_lines, whole

_SEPARATORS = ",\t;"


def read_csv(path: Path, params: IngestLogParams, where: str) -> Table:
    """The columns of a CSV file that [log.columns] names; lines that begin with # are skipped.

    Raises FormatError naming the line that has too few or too many fields.
    """
    lines = _uncommented(read_lines(path, where))
    separator = separator_of(lines.text(0))
    names = column_names(lines, separator)
    asked = set(named_columns(wanted(Columns(), params)).values())
    return read_delimited(lines.select(slice(1, None)), separator, names, asked, params.no_data)


def separator_of(header: str) -> str:
    """What separates the names of a header line: the first of comma, tab, semicolon it has."""
    return next((mark for mark in _SEPARATORS if mark in header), ",")


def column_names(lines: Lines, separator: str) -> list[str]:
    """Names in the first line; a column without one is ``column <n>``, counted from 1.

    Raises FormatError where a name occurs twice, or the line holds numbers.
    """
    row = pd.read_csv(io.StringIO(lines.text(0)), sep=separator, header=None, dtype=str)
    words = ["" if pd.isna(w) else str(w).strip() for w in row.iloc[0]]
    words[0] = words[0].removeprefix("\xef\xbb\xbf").strip('"')  # a byte order mark
    place = f"{lines.where} line {lines.number[0]}"
    if all(_is_number(word) for word in words):
        raise FormatError("holds numbers", where=place, expected="the names of the columns")
    names = [word or f"column {number}" for number, word in enumerate(words, start=1)]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise FormatError(f"the column '{twice}' occurs twice", where=place)
    return names


def read_delimited(
    lines: Lines,
    separator: str,
    names: Sequence[str],
    asked: Collection[str],
    no_data: float | None = None,
) -> Table:
    """The `asked` columns of lines of separated values.

    Raises FormatError naming the line that has fewer or more values than `names`.
    """
    lines = _check_fields(lines, separator, len(names))
    if not lines.number.size:
        raise FormatError("holds no rows", where=lines.where)
    frame = pd.read_csv(
        io.BytesIO(lines.joined()), sep=separator, header=None, names=list(names),
        usecols=[n for n in names if n in asked], index_col=False, encoding="latin-1",
        skip_blank_lines=False, low_memory=False, keep_default_na=False,
        na_values=["", "NaN", "nan", "NA", "NULL"],
    )  # fmt: skip
    columns = {name: _values(frame[name], no_data) for name in frame}
    others = tuple(name for name in names if name not in columns)
    return Table(columns, {}, lines.number, lines.where, others=others)


def _check_fields(lines: Lines, separator: str, expected: int) -> Lines:
    if lines.quoted:
        return lines  # pandas counts fields around quotation marks
    fields = lines.count(ord(separator)) + 1
    lines = whole(lines, fields < expected, fields, f"{expected} fields")
    more = fields[: lines.number.size] > expected
    if more.any():
        row = int(np.argmax(more))
        raise FormatError(
            f"the line has {fields[row]} fields",
            where=f"{lines.where} line {lines.number[row]}",
            expected=f"{expected}, as its header",
        )
    return lines


def _values(column: pd.Series, no_data: float | None) -> NDArray[np.generic]:
    if column.dtype.kind in "biuf":
        numbers = np.array(column, dtype=np.float64)
        if no_data is not None:
            numbers[numbers == no_data] = np.nan
        return numbers
    return np.array(["" if pd.isna(v) else str(v).strip() for v in column], dtype=np.str_)


def _uncommented(lines: Lines) -> Lines:
    kept = lines.select(lines.data[lines.start] != b"#"[0])
    if not kept.number.size:
        raise FormatError("holds nothing but comments", where=lines.where)
    return kept


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
